import pytest
import torch
from gsmap.models.decoders.gaussian_layer import GaussianDecoderLayer
from head_cases import GAUSSIANS, HEAD, along_y, bev, build_head, elements, with_layer
from mmengine.structures import InstanceData

from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.structures.grid import BEVGrid

MAPTR = {**HEAD, "num_instances": 6}
RASTERS = {"raster_size": (40, 20), "cost_raster_size": (80, 40)}
GSMAP = {**MAPTR, **GAUSSIANS, **RASTERS, "type": "GSMapHead"}
LANES = elements(((-3, -20), (-3, 20)), ((3, -20), (4, 20)), labels=[0, 2])
EMPTY = elements()


def test_with_maptr_weights_the_points_and_scores_are_maptrs_exactly():
    maptr, gsmap_head = build_head(MAPTR).eval(), build_head(GSMAP).eval()
    left = gsmap_head.load_state_dict(maptr.state_dict(), strict=False)
    assert not left.unexpected_keys
    assert all("gaussian_" in key for key in left.missing_keys)
    expected, actual = maptr(bev()), gsmap_head(bev())
    assert torch.equal(actual["all_pts_preds"], expected["all_pts_preds"])
    assert torch.equal(actual["all_cls_scores"], expected["all_cls_scores"])


def test_the_guided_attention_is_as_large_as_maptrs_and_drops_as_much():
    decoder = with_layer(MAPTR, dropout=0.25)
    plain = build_head(MAPTR, decoder=decoder).decoder.layers[0].cross_attn
    guided = build_head(GSMAP, decoder=decoder).decoder.layers[0].cross_attn
    assert type(guided) is not type(plain)
    assert guided.dropout.p == plain.dropout.p == 0.25
    shapes = [{k: v.shape for k, v in part.state_dict().items()} for part in (plain, guided)]
    assert shapes[0] == shapes[1]


def test_every_parameter_learns():
    head = build_head(GSMAP)
    for step in range(2):  # what feeds a matrix of zeros learns from the second step on
        losses = head.loss_by_feat(head(bev(2)), [LANES, EMPTY], [{}, {}])
        head.zero_grad()
        sum(losses.values()).backward()
        with torch.no_grad():
            for parameter in head.parameters():
                parameter -= 1e-3 * parameter.grad if step == 0 else 0
    idle = [name for name, p in head.named_parameters() if not p.grad.abs().sum() > 0]
    assert not idle


def test_each_layer_has_its_raster_loss_or_only_the_last():
    every, last = build_head(GSMAP), build_head(GSMAP, raster_layers="last")
    outputs = every(bev())
    names = {"loss_cls", "loss_pts", "loss_dir", "loss_raster"}
    assert set(every.loss_by_feat(outputs, [LANES], [{}])) == names | {f"d0.{n}" for n in names}
    losses = last.loss_by_feat(outputs, [LANES], [{}])
    assert "loss_raster" in losses
    assert "d0.loss_raster" not in losses


def perfect_outputs(head, gt, scales=(0.0, 0.0), rotation=0.0):
    """Return outputs whose first instances are the ground truth itself, the others far away."""
    outputs = head(bev())
    references = torch.full_like(outputs["all_references"], 1e-3)
    references[..., 2:] = torch.tensor([*scales, rotation])
    references[:, :, : len(gt.pts), :, :2] = head.grid.norm_from_metres(gt.pts)
    scores = torch.full_like(outputs["all_cls_scores"], -9.0)
    scores[:, :, range(len(gt.pts)), gt.labels_3d] = 9.0
    return {
        **outputs,
        "all_references": references.requires_grad_(),
        "all_pts_preds": references[..., :2],
        "all_cls_scores": scores,
    }


def test_a_band_along_the_line_has_a_smaller_raster_loss_than_one_across_it():
    head = build_head(GSMAP)
    lane = elements(((-3, -20), (-3, 20)))
    along = head.loss_by_feat(perfect_outputs(head, lane, scales=(0.0, 3.0)), [lane], [{}])
    across = head.loss_by_feat(perfect_outputs(head, lane, scales=(3.0, 0.0)), [lane], [{}])
    assert along["loss_pts"] < 1e-5
    assert along["loss_raster"] < 0.6 * across["loss_raster"]


def test_the_raster_loss_reaches_centres_scales_and_angles():
    head = build_head(GSMAP)
    lane = elements(((-3, -20), (-1, 20)))
    outputs = perfect_outputs(head, lane, scales=(0.2, 0.7), rotation=0.3)
    loss = head.loss_by_feat(outputs, [lane], [{}])["loss_raster"]
    (gradient,) = torch.autograd.grad(loss, outputs["all_references"])
    matched, others = gradient[-1, 0, 0], gradient[-1, 0, 1:]
    assert (matched.abs().sum(0) > 0).all()  # each of mu_x, mu_y, sigma_x, sigma_y, theta
    assert not others.any()


def test_matching_reads_the_rendered_masks():
    """Two predictions at the same points: the one whose Gaussians lie along the line is matched."""
    head = build_head(GSMAP)
    lane = elements(((-3, -20), (-3, 20)))
    outputs = perfect_outputs(head, lane)
    references = outputs["all_references"].detach().clone()
    references[-1, 0, 0, :, 2:] = torch.tensor([3.0, 0.0, 0.0])
    references[-1, 0, 1] = references[-1, 0, 0]
    references[-1, 0, 1, :, 2:] = torch.tensor([0.0, 3.0, 0.0])
    outputs["all_references"], outputs["all_pts_preds"] = references, references[..., :2]
    outputs["all_cls_scores"][-1, 0, 1] = outputs["all_cls_scores"][-1, 0, 0]
    predictions = head.layer_predictions(outputs, 1)
    targets = head.get_targets(predictions, [head.prepare_gt(lane)], [{}])
    assert targets.matches[0].query_inds.tolist() == [1]

    blind = build_head(GSMAP, iou_cost=None)
    predictions = blind.layer_predictions(outputs, 1)
    assert "rasters" not in predictions[0]
    targets = blind.get_targets(predictions, [blind.prepare_gt(lane)], [{}])
    assert targets.matches[0].query_inds.tolist() == [0]


def test_the_masks_of_matching_carry_no_gradient():
    head = build_head(GSMAP)
    predictions = head.layer_predictions(head(bev()), 1)
    assert predictions[0].rasters.shape == (6, 80, 40)
    assert not predictions[0].rasters.requires_grad
    assert predictions[0].references.requires_grad


def test_the_rendered_mask_is_that_of_the_predicted_gaussians():
    head = build_head(GSMAP).eval()
    outputs = head(bev())
    (result,) = head.predict_by_feat(outputs, [{}])
    grid = BEVGrid((-15, 15), (-30, 30), 40, 20)
    expected = render_gaussians(result.pts, result.scales, result.rotations, grid, "reference")
    order = outputs["all_cls_scores"][-1, 0].sigmoid().flatten().topk(len(result)).indices // 3
    actual = head.render(outputs["all_references"][-1, 0], head.raster_grid)[order]
    torch.testing.assert_close(actual, expected, atol=1e-5, rtol=0)


def test_no_ground_truth_gives_only_a_classification_loss():
    head = build_head(GSMAP)
    losses = head.loss_by_feat(head(bev()), [EMPTY], [{}])
    assert losses["loss_cls"] > 0
    assert losses["loss_raster"] == losses["loss_pts"] == losses["loss_dir"] == 0
    sum(losses.values()).backward()


def test_more_ground_truth_than_queries_is_matched_as_far_as_it_goes():
    head = build_head(GSMAP)
    crowd = elements(*along_y(*range(-9, 9, 2)))
    losses = head.loss_by_feat(head(bev()), [crowd], [{}])
    assert all(torch.isfinite(loss) for loss in losses.values())
    assert losses["loss_raster"] > 0


def test_filled_classes_have_filled_masks():
    square = torch.tensor([[[-4.0, -4], [4, -4], [4, 4], [-4, 4], [-4, -4]]])
    gt = InstanceData(labels_3d=torch.tensor([1]), pts=square, pts_shifts=square[:, None])
    hollow, filled = build_head(GSMAP), build_head(GSMAP, filled_classes=(1,))
    assert hollow.prepare_gt(gt).masks[0, 20, 10] == 0
    assert filled.prepare_gt(gt).masks[0, 20, 10] == 1


@pytest.mark.parametrize("part", ["guide_sampling", "embed_gaussians"])
def test_parts_of_the_guided_layer_switch_off_by_themselves(part):
    decoder = with_layer(GSMAP, **{part: False})
    head, full = build_head(GSMAP, decoder=decoder), build_head(GSMAP)
    for changed in (head, full):  # Gaussians that are not the first ones any more
        torch.nn.init.constant_(changed.gaussian_init.bias, 0.5)
    layer = full.decoder.layers[0]
    if part == "embed_gaussians":
        torch.nn.init.constant_(layer.gaussian_embedding[-1].bias, 0.5)
        assert head.decoder.layers[0].gaussian_embedding is None
    assert isinstance(head.decoder.layers[0], GaussianDecoderLayer)
    weights = {k: v for k, v in full.state_dict().items() if k in head.state_dict()}
    head.load_state_dict(weights)
    assert not torch.equal(head(bev())["states"], full(bev())["states"])


def test_a_plain_layer_may_stand_under_the_head():
    head = build_head(GSMAP, decoder=with_layer(GSMAP, type="MapDecoderLayer"))
    assert "loss_raster" in head.loss_by_feat(head(bev()), [LANES], [{}])


def test_unknown_raster_layers_are_refused():
    with pytest.raises(ValueError, match="raster_layers must be 'all' or 'last', got 'first'"):
        build_head(GSMAP, raster_layers="first")
