import pytest
import torch
from head_cases import (
    ALONG_X,
    ALONG_Y,
    GSMAP,
    HEAD,
    LANES,
    MASKS,
    along_y,
    bev,
    build_head,
    elements,
    losses_of,
    predictions_of,
    with_layer,
)
from predictions import predicted, stacked

from gsmap.models.gsmap.layer import GaussianDecoderLayer
from gsmap.models.maptr.losses import PointsLoss
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.structures.grid import BEVGrid

SIX = {"query_groups": [{"num": 6}]}
MAPTR, GSMAP = {**HEAD, **SIX}, {**GSMAP, **SIX}
DECOUPLED = with_layer(HEAD, self_attn={"type": "DecoupledSelfAttention"})
EMPTY = elements()


@pytest.mark.parametrize("grid", [ALONG_Y, ALONG_X], ids=["forward y", "forward x"])
@pytest.mark.parametrize("decoder", [HEAD["decoder"], DECOUPLED], ids=["joint", "decoupled"])
def test_with_the_weights_of_another_head_its_points_and_scores_are_exactly_the_same(decoder, grid):
    settings = {"decoder": decoder, "grid": grid}
    other = build_head(MAPTR, **settings).eval()
    gsmap_head = build_head(GSMAP, **settings).eval()
    for parameter in other.parameters():  # as if trained: no sampling offset is a round number
        parameter.data += 0.1 * torch.randn_like(parameter)
    left = gsmap_head.load_state_dict(other.state_dict(), strict=False)
    assert not left.unexpected_keys
    parts = ("reference.gaussian_init.", "reference.gaussian_branches.", ".guidance.embedding.")
    for key in left.missing_keys:
        assert any(part in key for part in parts)
    expected = other(bev())
    actual = gsmap_head(bev())
    assert torch.equal(stacked(actual).pts, stacked(expected).pts)
    assert torch.equal(stacked(actual).scores, stacked(expected).scores)


def shapes_of(module: torch.nn.Module) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in module.state_dict().items()}


def weights_of_costs(head: torch.nn.Module) -> list[float]:
    return [cost.weight for cost in head.assigner.match_costs]


def loss_names(losses: dict) -> set[str]:
    """Names of losses, without statistics."""
    return {name for name in losses if "loss" in name}


def test_the_guided_attention_is_as_large_as_maptrs_and_drops_as_much():
    decoder = with_layer(MAPTR, dropout=0.25)
    plain = build_head(MAPTR, decoder=decoder).decoder.layers[0]
    guided = build_head(GSMAP, decoder=decoder).decoder.layers[0]
    assert plain.guidance is None
    assert type(guided.guidance).__name__ == "GaussianGuidance"
    assert guided.cross_attn.dropout.p == plain.cross_attn.dropout.p == 0.25
    assert shapes_of(guided.cross_attn) == shapes_of(plain.cross_attn)


def test_the_points_get_another_weight_in_loss_and_matching():
    head = build_head(GSMAP)
    lighter = build_head(GSMAP, points_weight=1.0)
    assert head.losses["pts"].loss_weight == 5.0
    assert lighter.losses["pts"].loss_weight == 1.0
    class_weight, *others = weights_of_costs(head)
    assert others == [5.0, 2.0]
    assert weights_of_costs(lighter) == [class_weight, 1.0, 2.0]


@pytest.mark.parametrize("kind", ["PointsLoss", "mmdet3d.PointsLoss", PointsLoss])
@pytest.mark.parametrize("head", ["GSMapHead", "MapVRHead"])
def test_the_points_are_found_however_their_class_is_named(kind, head):
    losses = [{"type": kind, "loss_weight": 5.0}, HEAD["losses"][1]]
    costs = [HEAD["match_costs"][0], {"type": "mmdet3d.OrderedPointsCost", "weight": 5.0}]
    settings = {"losses": losses, "match_costs": costs, "points_weight": 1.5}
    built = build_head(HEAD, type=head, **settings)
    assert built.losses["pts"].loss_weight == 1.5
    assert built.assigner.match_costs[1].weight == 1.5


def test_a_weight_of_points_that_there_are_not_is_refused():
    with pytest.raises(ValueError, match="no config has the type PointsLoss: add one"):
        build_head(GSMAP, losses=HEAD["losses"][1:], points_weight=1.0)


def test_the_older_form_of_a_gsmap_config_builds_the_same_head():
    """The README's lines name every part; the head's own defaults are these."""
    older = build_head(
        GSMAP,
        decoder=with_layer(HEAD, type="GaussianDecoderLayer"),
        loss_raster={"type": "RasterLoss", "loss_weight": 10.0},
        iou_cost={"type": "IoUCost", "weight": 2.0},
    )
    short = build_head(GSMAP)
    assert repr(older) == repr(short)
    expected = losses_of(short, LANES)
    losses = losses_of(older, LANES)
    assert losses.keys() == expected.keys()
    for name, loss in losses.items():
        assert torch.equal(loss, expected[name])


def test_every_parameter_learns():
    head = build_head(GSMAP)
    for step in range(2):  # what feeds a matrix of zeros learns from the second step on
        losses = losses_of(head, LANES, EMPTY)
        head.zero_grad()
        total = sum(losses[name] for name in losses if "loss" in name)
        total.backward()
        with torch.no_grad():
            for parameter in head.parameters():
                parameter -= 1e-3 * parameter.grad if step == 0 else 0
    for name, parameter in head.named_parameters():
        assert parameter.grad.abs().sum() > 0, name


def test_each_layer_has_its_raster_loss_or_only_the_last():
    every = build_head(GSMAP)
    last = build_head(GSMAP, loss_raster={"type": "RasterLoss", "last_layer_only": True})
    names = {"loss_cls", "loss_pts", "loss_dir", "loss_raster"}
    found = loss_names(losses_of(every, LANES))
    assert found == names | {f"d0.{name}" for name in names}
    assert found - set(losses_of(last, LANES)) == {"d0.loss_raster"}


def perfect_outputs(head, gt, scales=(0.0, 0.0), rotation=0.0):
    """Return outputs whose first instances are the ground truth itself, the others far away."""
    outputs = head(bev())
    references = torch.full_like(stacked(outputs).references, 1e-3)
    references[..., 2:] = torch.tensor([*scales, rotation])
    references[:, :, : len(gt.pts), :, :2] = head.grid.norm_from_metres(gt.pts)
    scores = torch.full_like(stacked(outputs).scores, -9.0)
    scores[:, :, range(len(gt.pts)), gt.labels_3d] = 9.0
    return predicted(head, scores, references.requires_grad_())


def test_a_band_along_the_line_has_a_smaller_raster_loss_than_one_across_it():
    head = build_head(GSMAP)
    lane = elements(((-3, -20), (-3, 20)))
    along = head.loss_by_feat(perfect_outputs(head, lane, scales=(3.0, 0.0)), [lane], [{}])
    across = head.loss_by_feat(perfect_outputs(head, lane, scales=(0.0, 3.0)), [lane], [{}])
    assert along["loss_pts"] < 1e-5
    assert along["loss_raster"] < 0.6 * across["loss_raster"]


def test_the_raster_loss_reaches_centres_scales_and_angles():
    head = build_head(GSMAP)
    lane = elements(((-3, -20), (-1, 20)))
    outputs = perfect_outputs(head, lane, scales=(0.2, 0.7), rotation=0.3)
    loss = head.loss_by_feat(outputs, [lane], [{}])["loss_raster"]
    (gradient,) = torch.autograd.grad(loss, outputs[-1].references)
    matched = gradient[0, 0]
    others = gradient[0, 1:]
    assert (matched.abs().sum(0) > 0).all()  # each of mu_x, mu_y, sigma_x, sigma_y, theta
    assert not others.any()


def test_matching_reads_the_rendered_masks():
    """Two predictions at the same points: the one whose Gaussians lie along the line is matched."""
    head = build_head(GSMAP)
    lane = elements(((-3, -20), (-3, 20)))
    outputs = perfect_outputs(head, lane)
    references = stacked(outputs).references.detach().clone()
    references[-1, 0, 0, :, 2:] = torch.tensor([0.0, 3.0, 0.0])
    references[-1, 0, 1] = references[-1, 0, 0]
    references[-1, 0, 1, :, 2:] = torch.tensor([3.0, 0.0, 0.0])
    scores = stacked(outputs).scores
    scores[-1, 0, 1] = scores[-1, 0, 0]
    predictions = predictions_of(head, predicted(head, scores, references), 1)
    pairs = head.match([predictions], head.prepare_gts([lane]), [{}])
    assert pairs.query_inds.tolist() == [1]

    blind = build_head(GSMAP, iou_cost=None)
    predictions = predictions_of(blind, predicted(blind, scores, references), 1)
    pairs = blind.match([predictions], blind.prepare_gts([lane]), [{}])
    assert pairs.query_inds.tolist() == [0]


def test_the_masks_of_matching_carry_no_gradient():
    head = build_head(GSMAP)
    predictions = predictions_of(head, head(bev()), 1)
    sample = predictions.sample(0)
    assert sample.cost_masks.shape == (6, 80, 40)
    assert not sample.cost_masks.requires_grad
    assert sample.references.requires_grad


def test_the_rendered_mask_is_that_of_the_predicted_gaussians():
    head = build_head(GSMAP).eval()
    outputs = head(bev())
    (result,) = head.predict_by_feat(outputs, [{}])
    grid = BEVGrid((-15, 15), (-30, 30), 40, 20)
    expected = render_gaussians(result.pts, result.scales, result.rotations, grid, "reference")
    order = stacked(outputs).scores[-1, 0].sigmoid().flatten().topk(len(result)).indices // 3
    gaussians = head.reference.space.decode(stacked(outputs).references[-1, 0])
    actual = render_gaussians(*gaussians, head.masks.grid)[order]
    torch.testing.assert_close(actual, expected, atol=1e-5, rtol=0)


def test_more_ground_truth_than_queries_is_matched_as_far_as_it_goes():
    head = build_head(GSMAP)
    crowd = elements(*along_y(*range(-9, 9, 2)))
    losses = losses_of(head, crowd)
    assert torch.stack(list(losses.values())).isfinite().all()
    assert losses["loss_raster"] > 0


@pytest.mark.parametrize("part", ["guide_sampling", "embed_gaussians"])
def test_parts_of_the_guided_layer_switch_off_by_themselves(part):
    decoder = with_layer(GSMAP, **{part: False})
    head = build_head(GSMAP, decoder=decoder)
    full = build_head(GSMAP)
    for changed in (head, full):  # Gaussians that are not the first ones any more
        torch.nn.init.constant_(changed.reference.gaussian_init.bias, 0.5)
    layer = full.decoder.layers[0]
    if part == "embed_gaussians":
        torch.nn.init.constant_(layer.guidance.embedding[-1].bias, 0.5)
        assert head.decoder.layers[0].guidance.embedding is None
    assert isinstance(head.decoder.layers[0], GaussianDecoderLayer)
    weights = full.state_dict()
    for name in weights.keys() - head.state_dict().keys():
        del weights[name]
    head.load_state_dict(weights)
    assert not torch.equal(head(bev())[-1].scores, full(bev())[-1].scores)


def test_a_plain_layer_may_stand_under_the_head():
    head = build_head(GSMAP, decoder=with_layer(GSMAP, type="MapDecoderLayer"))
    assert head.decoder.layers[0].guidance is None
    assert "loss_raster" in losses_of(head, LANES)


def test_gaussians_of_the_queries_that_predict_are_returned():
    groups = [{"num": 6}, {"name": "one2many", "num": 4, "repeats": 2}]
    head = build_head(GSMAP, query_groups=groups, decoder=DECOUPLED).eval()
    (result,) = head.predict_by_feat(head(bev()), [{}])
    assert result.scales.shape == result.pts.shape
    assert result.rotations.shape == result.pts.shape[:2]


def test_the_log_says_how_the_gaussians_of_each_class_live():
    losses = losses_of(build_head(GSMAP), LANES)
    figures = losses.keys() - loss_names(losses)
    expected = {"at_floor"}
    for kind in ("soft_iou", "sigma_along", "sigma_across"):
        expected |= {f"{kind}/divider", f"{kind}/boundary"}
    assert figures == expected
    assert losses["sigma_along/divider"] == pytest.approx(1.0, abs=0.3)
    assert not losses["soft_iou/divider"].requires_grad
    without_truth = losses_of(build_head(GSMAP), EMPTY)
    assert without_truth.keys() == loss_names(without_truth)


def test_without_either_mask_nothing_is_drawn_or_rendered(monkeypatch):
    head = build_head(GSMAP, loss_raster=None, iou_cost=None)
    for maker in ("maptr.masks.draw_polylines", "gsmap.reference.render_gaussians"):
        monkeypatch.setattr(f"gsmap.models.{maker}", lambda *_: pytest.fail("a mask was made"))
    losses = losses_of(head, LANES)
    names = {"loss_cls", "loss_pts", "loss_dir"}
    assert set(losses) == names | {f"d0.{name}" for name in names}


def test_the_smallest_gaussian_is_half_a_pixel_of_the_masks():
    for pixel_m, smallest_m in ((0.3, 0.15), (0.6, 0.3), ((0.3, 0.5), 0.25)):
        head = build_head(GSMAP, masks={"pixel_m": pixel_m}, reference=None)
        assert head.reference.space.min_scale_m == smallest_m
    own = build_head(GSMAP, masks={"pixel_m": 0.3}, reference={"min_scale_m": 0.2})
    assert own.reference.space.min_scale_m == 0.2
    with pytest.raises(ValueError, match=r"min_scale_m < init_scales_m .* got 0.75, "):
        build_head(GSMAP, masks=MASKS, reference={"init_scales_m": (1.0, 0.4)})


@pytest.mark.parametrize("extent", [(30, 60), (50, 100), (100, 200)])
def test_any_range_has_a_first_gaussian_above_its_smallest(extent):
    x, y = extent
    grid = BEVGrid((-x / 2, x / 2), (-y / 2, y / 2))
    config = {**GSMAP, "grid": grid}
    config.pop("masks", None)
    config.pop("reference", None)
    space = build_head(config).reference.space
    assert space.min_scale_m == pytest.approx(y / 200 / 2)
    assert space.min_scale_m * 1.49 < min(space.init_scales_m)
