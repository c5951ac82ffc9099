import pytest
from head_cases import ALONG_X, ALONG_Y, HEAD, bev, build_head, elements

MAPVR = {**HEAD, "type": "MapVRHead", "masks": {"pixel_m": 0.75, "cost_pixel_m": 1.5}}
LANES = elements(((-3, -20), (-3, 20)), ((3, -20), (4, 20)), labels=[0, 1])


def test_mapvr_is_maptr_but_for_its_losses_costs_and_dropout():
    head = build_head(MAPVR, masks=None, decoder=HEAD["decoder"] | {"layer": {"dropout": 0.1}})
    losses, costs = head.losses, head.assigner.match_costs
    assert list(losses) == ["pts", "dir", "dice"]
    weights = [loss.loss_weight for loss in losses.values()]
    assert weights == [1.0, 0.002, 15.0]
    assert [cost.weight for cost in costs] == [2.0, 1.0, 10.0]
    assert type(losses["dir"]).__name__ == "SelfDirectionLoss"
    assert losses["dice"].renderer.size == (256, 128)
    assert costs[-1].renderer.size == (128, 64)
    assert head.decoder.layers[0].self_attn.dropout == 0
    maptr = build_head(HEAD, decoder=HEAD["decoder"] | {"layer": {"dropout": 0.1}})
    assert head.state_dict().keys() == maptr.state_dict().keys()


def test_rasters_turn_with_the_map():
    head = build_head(MAPVR, masks=None, grid=ALONG_X)
    assert head.losses["dice"].renderer.size == (128, 256)
    assert head.assigner.match_costs[-1].renderer.size == (64, 128)


def test_polygons_are_the_areas_or_what_is_named():
    classes = ["divider", "stop_line", "boundary", "carpark_area"]
    head = build_head(MAPVR, classes=classes)
    renderers = head.losses["dice"].renderer, head.assigner.match_costs[-1].renderer
    assert [renderer.polygon_classes for renderer in renderers] == [(1, 3), (1, 3)]
    lines = build_head(MAPVR, polygons=[], rendering={"line_softness": 4.0})
    renderers = lines.losses["dice"].renderer, lines.assigner.match_costs[-1].renderer
    assert [renderer.polygon_classes for renderer in renderers] == [(), ()]
    assert [renderer.line_softness for renderer in renderers] == [4.0, 4.0]


def test_each_part_can_be_switched_off():
    head = build_head(MAPVR, loss_dice=None, dice_cost=None, loss_direction=None, points_weight=5.0)
    losses = head.loss_by_feat(head(bev()), [LANES], [{}])
    assert {name for name in losses if "." not in name} == {"loss_cls", "loss_pts"}
    assert len(head.assigner.match_costs) == 2
    assert head.losses["pts"].loss_weight == head.assigner.match_costs[1].weight == 5.0


def test_a_loss_that_a_config_has_removed_is_none():
    head = build_head(MAPVR, losses=[{"type": "PointsLoss"}, None], points_weight=5.0)
    assert "pts" in head.losses
    assert head.losses["pts"].loss_weight == 5.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"polygons": ["crosswalk"]}, r"polygons must be classes of .* got \['crosswalk'\]"),
        (
            {"loss_dice": {"polygon_classes": (1, 3)}},
            r"RenderedDiceLoss\.polygon_classes .* \(1, 3\)",
        ),
        ({"dice_cost": {"polygon_classes": (7,)}}, r"RenderedDiceCost\.polygon_classes .*\(7,\)"),
        ({"masks": {"pixel_m": 0.7}}, "pixels of 0.7 x 0.7 m do not divide the map of 30 x 60 m"),
        ({"masks": {"filled_classes": (3,)}}, r"masks\.filled_classes .* got \(3,\)"),
        ({"rendering": {"line_softness": 0}}, "softness must be > 0, got 0 and 4.0"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        build_head({**MAPVR, "grid": ALONG_Y}, **settings)
