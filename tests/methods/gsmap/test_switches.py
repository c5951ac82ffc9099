"""Every switch of GSMap builds, trains a step, and changes what it is there to change."""

import head_cases as heads
import pytest
import torch
from predictions import stacked

SQUARE = heads.elements(((-4, -4), (4, -4)), labels=[1])
SQUARE.polylines = torch.tensor([[[-4.0, -4], [4, -4], [4, 4], [-4, 4], [-4, -4]]])


def switched(**settings) -> tuple[torch.nn.Module, dict, dict]:
    """Return a switched head that has trained a step, its losses before, and the default's."""
    head = heads.build_head(heads.GSMAP, **settings)
    expected = heads.losses_of(heads.build_head(heads.GSMAP), heads.LANES)
    return head, heads.train_a_step(head, heads.LANES), expected


def changed(losses: dict, expected: dict) -> set[str]:
    """Return the losses of the last layer that differ, or that one of both does not have."""
    names = {name for name in losses.keys() | expected.keys() if name.startswith("loss_")}
    return {
        name
        for name in names
        if name not in losses
        or name not in expected
        or not torch.allclose(losses[name], expected[name])
    }


@pytest.mark.parametrize("cut", [True, False])
def test_points_reach_the_earlier_layers_branch_through_the_reference(cut):
    decoder = {**heads.HEAD["decoder"], **({} if cut else {"detach_reference": False})}
    head = heads.build_head(heads.GSMAP, decoder=decoder)
    heads.train_a_step(head, heads.LANES)
    head.zero_grad()
    heads.losses_of(head, heads.LANES)["loss_pts"].backward()  # of the second layer
    gradients = [p.grad for p in head.reference.branches[0].parameters()]
    assert any(g is not None and g.any() for g in gradients) == (not cut)
    # the first layer's sigma and theta are refined by the second one
    gradients = [p.grad for p in head.reference.gaussian_branches[0].parameters()]
    assert any(g is not None and g.any() for g in gradients) == (not cut)


def test_the_literal_covariance_squares_what_is_rendered():
    head, losses, expected = switched(reference={"min_scale_m": 0.15, "literal_covariance": True})
    assert "loss_raster" in changed(losses, expected)
    first = head.reference.space.decode(torch.zeros(1, 5)).scales
    torch.testing.assert_close(first, torch.tensor([[1.0, 0.16]]))


def test_sigma_and_theta_from_an_mlp_start_alike_and_learn():
    head, losses, expected = switched(reference={"min_scale_m": 0.15, "mlp": True})
    assert not changed(losses, expected) - {"loss_cls", "loss_pts", "loss_dir", "loss_raster"}
    branch = head.reference.gaussian_branches[0]
    assert len(branch) == 5  # two hidden layers, two ReLUs, the last matrix
    heads.losses_of(head, heads.LANES)["d0.loss_raster"].backward()
    assert branch[0].weight.grad.abs().sum() > 0  # from the second step on


@pytest.mark.parametrize("activation", ["softplus", "exp"])
def test_another_activation_has_the_same_first_gaussian_and_another_slope(activation):
    reference = {"min_scale_m": 0.15, "activation": activation}
    head, losses, expected = switched(reference=reference)
    assert not changed(losses, expected)  # a new model's Gaussians are the first ones
    raw = torch.tensor([[0.5, 0.5, 1.0, 0.5, 0.0]])
    assert not torch.allclose(
        head.reference.space.decode(raw).scales,
        heads.build_head(heads.GSMAP).reference.space.decode(raw).scales,
    )


@pytest.mark.parametrize("kind", ["dice", "iou"])
@pytest.mark.parametrize("last_layer_only", [True, False])
def test_overlap_takes_the_place_of_the_raster_loss(kind, last_layer_only):
    loss = {"type": "MaskOverlapLoss", "kind": kind, "loss_weight": 4.0}
    head, losses, expected = switched(loss_raster={**loss, "last_layer_only": last_layer_only})
    assert changed(losses, expected) == {"loss_raster"}
    assert ("d0.loss_raster" in losses) == (not last_layer_only)
    assert 0 < losses["loss_raster"] < 4.0
    assert head.losses["raster"].kind == kind


def test_an_unknown_overlap_is_refused():
    with pytest.raises(ValueError, match="kind must be 'dice' or 'iou', got 'area'"):
        heads.build_head(heads.GSMAP, loss_raster={"type": "MaskOverlapLoss", "kind": "area"})


def total_cost(head: torch.nn.Module) -> torch.Tensor:
    """Return the summed matching costs of a new model's first prediction. (N, K)"""
    prediction = heads.predictions_of(head, head(heads.bev()), 0).sample(0)
    gt = head.prepare_gts([heads.LANES]).sample(0)
    return sum(cost(prediction, gt, {}) for cost in head.assigner.match_costs)


@pytest.mark.parametrize("kind", ["dice", "iou"])
def test_the_mask_cost_weighs_as_it_is_told(kind):
    costs = {}
    for weight in (0.0, 2.0, 10.0):
        head = heads.build_head(
            heads.GSMAP, iou_cost={"type": "IoUCost", "kind": kind, "weight": weight}
        )
        costs[weight] = total_cost(head)
        heads.train_a_step(head, heads.LANES)
    without = heads.build_head(heads.GSMAP, iou_cost=None)
    torch.testing.assert_close(costs[0.0], total_cost(without))
    part = costs[2.0] - costs[0.0]
    assert part.min() > 0
    torch.testing.assert_close(costs[10.0] - costs[0.0], 5 * part, atol=1e-5, rtol=1e-5)
    heads.train_a_step(without, heads.LANES)


def test_the_direction_loss_can_be_left_out():
    _, losses, expected = switched(losses=heads.HEAD["losses"][:1])
    assert changed(losses, expected) == {"loss_dir"}


def test_lambda_v_weighs_the_points():
    _, losses, expected = switched(losses=[{"type": "PointsLoss", "loss_weight": 10.0}])
    torch.testing.assert_close(losses["loss_pts"], 2 * expected["loss_pts"])


@pytest.mark.parametrize("invariant", [True, False])
def test_the_invariant_frame_does_not_tell_a_gaussian_from_itself_turned_by_pi(invariant):
    head = heads.build_head(
        heads.GSMAP, decoder=heads.with_layer(heads.HEAD, invariant_frame=invariant)
    )
    heads.train_a_step(head, heads.LANES)
    head.eval()
    scores = []
    for turn in (0.4, 0.4 + torch.pi):
        torch.nn.init.constant_(head.reference.gaussian_init.bias[2:], turn)
        scores.append(stacked(head(heads.bev())).scores)
    assert torch.allclose(*scores, atol=1e-5) == invariant


@pytest.mark.parametrize("source", ["full", "points"])
def test_masks_come_from_full_resolution_or_from_the_matched_points(source):
    """The ground truth's polyline is a ring; its points are one side of it."""
    head = heads.build_head(heads.GSMAP, masks={**heads.MASKS, "source": source})
    heads.train_a_step(head, SQUARE)
    predictions = heads.predictions_of(head, head(heads.bev()), 1)
    gts = head.prepare_gts([SQUARE])
    pairs = head.match([predictions], gts, [{}])
    drawn = {"full": SQUARE.polylines, "points": SQUARE.pts}[source]
    expected = head.masks.draw(drawn, SQUARE.labels_3d, head.masks.grid)
    torch.testing.assert_close(pairs.gt_masks, expected)


def test_filled_classes_have_filled_masks():
    hollow = heads.build_head(heads.GSMAP, masks={**heads.MASKS, "pixel_m": 0.3})
    filled = heads.build_head(
        heads.GSMAP, masks={**heads.MASKS, "pixel_m": 0.3, "filled_classes": (1,)}
    )
    assert hollow.prepare_gts([SQUARE]).masks[0, 100, 50] == 0
    assert filled.prepare_gts([SQUARE]).masks[0, 100, 50] == 1
    lane = heads.elements(*heads.along_y(-3.0))
    assert torch.equal(hollow.prepare_gts([lane]).masks, filled.prepare_gts([lane]).masks)
    assert heads.train_a_step(filled, SQUARE)["loss_raster"] > 0


@pytest.mark.parametrize("source", ["full", "points"])
def test_one_to_many_queries_train_with_or_without_the_raster_loss(source):
    """With masks from points, each group draws the order that it was matched in."""
    further = {"name": "one2many", "num": 6, "repeats": 3}
    masks = {**heads.MASKS, "source": source}
    for losses in (None, ("cls", "pts", "dir")):
        groups = [{"num": heads.N}, {**further, "losses": losses}]
        found = heads.train_a_step(
            heads.build_head(heads.GSMAP, query_groups=groups, masks=masks), heads.LANES
        )
        assert ("loss_raster_one2many" in found) == (losses is None)
