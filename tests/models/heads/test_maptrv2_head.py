"""MapTRv2's head: two groups of queries, their losses, auxiliary masks."""

import math

import pytest
import torch
from head_cases import GAUSSIANS, HEAD, C, N, P, along_y, bev, build_head, elements, with_layer
from mmdet3d.structures import Det3DDataSample
from mmengine.structures import InstanceData

CONFIG = {
    **HEAD,
    "type": "MapTRv2Head",
    "num_one2many": 6,
    "num_repeats": 3,
    "decoder": with_layer(HEAD, type="DecoupledDecoderLayer", num_points=P),
    "bev_seg": {"weight": 1.0, "pos_weight": 4.0},
    "pv_seg": {"weight": 2.0, "pos_weight": 1.0},
}
GSMAP = {
    **CONFIG,
    **GAUSSIANS,
    "type": "GSMapV2Head",
    "decoder": with_layer(CONFIG, type="GaussianDecoupledLayer"),
    "raster_size": (20, 10),
    "cost_raster_size": (20, 10),
}


def build(config=CONFIG, **settings):
    return build_head(config, **settings)


def lines(num: int) -> InstanceData:
    """Straight lines along y, one metre apart, of all classes in turn."""
    return elements(*along_y(*range(num)), labels=[i % 3 for i in range(num)])


def sample(num: int) -> Det3DDataSample:
    result = Det3DDataSample(metainfo={"token": "a"})
    result.gt_instances_3d = lines(num)
    result.gt_seg = torch.zeros(1, 10, 5)
    result.gt_seg[0, 2] = 1
    result.gt_pv_seg = torch.zeros(2, 1, 3, 4)
    return result


def test_further_queries_exist_in_training_only():
    head = build()
    assert head.train()(bev(2))["all_pts_preds"].shape == (2, 2, 10, P, 2)
    assert head.eval()(bev(2))["all_pts_preds"].shape == (2, 2, N, P, 2)
    assert head.attention_mask() is None


def test_one_to_one_queries_predict_the_same_in_training_and_test():
    head = build()
    tested = head.eval()(bev())
    trained = head.split_groups(head.train()(bev()))[0]
    for key in ("all_cls_scores", "all_pts_preds"):
        torch.testing.assert_close(trained[key], tested[key])


def test_mask_separates_the_groups():
    mask = build().train().attention_mask()
    assert mask.shape == (10, 10)
    assert mask[:N, N:].all()
    assert mask[N:, :N].all()
    assert not mask[:N, :N].any()
    assert not mask[N:, N:].any()


def test_every_ground_truth_is_matched_once_and_then_several_times():
    head = build().train()
    outputs = head(bev())
    first, further = head.split_groups(outputs)
    assert further["all_cls_scores"].shape[2] == 6
    gt = lines(2)
    losses = head.loss_by_feat(outputs, [gt], [{"token": "a"}])
    predictions = head.layer_predictions(further, 1)
    prepared = [head.prepare_gt(gt)]
    targets = head.get_targets(predictions, prepared, [{"token": "a"}], repeats=3)
    counts = torch.bincount(targets.matches[0].gt_inds)
    assert counts.tolist() == [3, 3]  # k = 3 queries for each of the two elements
    expected = head.matched_losses(predictions, prepared, targets)["loss_pts"]
    torch.testing.assert_close(losses["loss_pts_one2many"], expected)
    alone = build().train()
    alone.load_state_dict(head.state_dict())
    first_losses = super(type(head), alone).loss_by_feat(first, [gt], [{"token": "a"}])
    torch.testing.assert_close(losses["loss_pts"], first_losses["loss_pts"])


def test_more_repeats_than_queries_match_every_query():
    head = build().train()
    losses = head.loss_by_feat(head(bev()), [lines(4)], [{"token": "a"}])
    assert losses["loss_pts_one2many"].isfinite()  # 12 copies for 6 queries


def test_weight_of_the_further_queries():
    plain, halved = build().train(), build(one2many_weight=0.5).train()
    args = ([lines(2)], [{"token": "a"}])
    one, half = (head.loss_by_feat(head(bev()), *args) for head in (plain, halved))
    torch.testing.assert_close(half["loss_cls_one2many"], one["loss_cls_one2many"] / 2)
    torch.testing.assert_close(half["loss_cls"], one["loss_cls"])


@pytest.mark.parametrize("num", [0, 1, 3])
@pytest.mark.parametrize("config", [CONFIG, GSMAP], ids=["MapTRv2", "GSMap"])
def test_losses_reach_every_parameter(config, num):
    head = build(config).train()
    losses = head.loss(bev(), [sample(num)])
    assert {"loss_cls", "d0.loss_cls_one2many", "loss_seg", "loss_pv_seg"} <= set(losses)
    sum(losses.values()).backward()
    grads = [p.grad for p in head.parameters()]
    assert all(g.isfinite().all() for g in grads if g is not None)
    if num:
        assert all(g is not None for g in grads)


def test_no_further_queries_is_plain_maptr():
    head = build(num_one2many=0).train()
    losses = head.loss_by_feat(head(bev()), [lines(2)], [{"token": "a"}])
    assert not [name for name in losses if "one2many" in name]
    assert head.attention_mask() is None


def test_mask_losses_by_hand():
    head = build().eval()
    outputs = {"seg": torch.zeros(1, 1, 10, 5), "pv_seg": torch.zeros(1, 2, 1, 3, 4)}
    losses = head.segmentation_losses(outputs, [sample(1)])
    # a tenth of the BEV cells is foreground, which weighs four times: (4 + 9) / 10 * log 2
    assert losses["loss_seg"].item() == pytest.approx(1.3 * math.log(2))
    assert losses["loss_pv_seg"].item() == pytest.approx(2 * math.log(2))


def test_missing_mask_is_named():
    head = build().eval()
    empty = Det3DDataSample(metainfo={"token": "b"})
    with pytest.raises(ValueError, match=r"sample 'b' has no gt_seg"):
        head.segmentation_losses({"seg": torch.zeros(1, 1, 10, 5)}, [empty])


def test_masks_can_be_left_out():
    head = build(bev_seg=None, pv_seg=None).train()
    outputs = head({"bev_feats": bev()["bev_feats"]})
    assert "seg" not in outputs
    assert head.segmentation_losses(outputs, [sample(1)]) == {}


def test_prediction_leaves_out_the_masks():
    head = build().eval()
    only_bev = {"bev_feats": bev()["bev_feats"]}  # the camera mask would need image features
    result = head.predict(only_bev, [sample(0)])[0]
    assert result.pts.shape[1:] == (P, 2)


def test_bad_numbers_are_named():
    with pytest.raises(ValueError, match="num_repeats >= 1"):
        build(num_repeats=0)


def test_gsmap_starts_at_maptrv2s_points():
    maptrv2, gsmap_head = build().eval(), build(GSMAP).eval()
    for (
        parameter
    ) in maptrv2.parameters():  # as if trained: the sampling offsets are no round numbers
        parameter.data += 0.1 * torch.randn_like(parameter)
    left = gsmap_head.load_state_dict(maptrv2.state_dict(), strict=False)
    assert not left.unexpected_keys
    assert all("gaussian_" in key for key in left.missing_keys)
    expected, actual = maptrv2(bev()), gsmap_head(bev())
    assert torch.equal(actual["all_pts_preds"], expected["all_pts_preds"])
    assert torch.equal(actual["all_cls_scores"], expected["all_cls_scores"])


def test_gsmap_predicts_gaussians_of_one_to_one_queries():
    result = build(GSMAP).eval().predict(bev(), [sample(0)])[0]
    assert result.scales.shape == result.pts.shape
    assert result.rotations.shape == result.pts.shape[:2]


def test_every_mask_is_drawn_once_for_both_groups(monkeypatch):
    head, drawn = build(GSMAP).train(), []
    draw = head.draw_gt
    monkeypatch.setattr(head, "draw_gt", lambda gt, grid: drawn.append(len(gt)) or draw(gt, grid))
    head.loss_by_feat(head(bev()), [lines(2)], [{"token": "a"}])
    assert drawn == [2, 2]  # for the loss, and for matching


def test_the_raster_loss_of_the_further_queries_compares_with_the_matched_masks():
    """The same Gaussians against the same elements cost the further queries what the first pay."""
    gt = lines(2)
    head = build(GSMAP, num_instances=2, num_one2many=4, num_repeats=2).train()
    outputs = head(bev())
    references = torch.zeros_like(outputs["all_references"])
    references[..., :2] = head.grid.norm_from_metres(gt.pts).repeat(3, 1, 1)  # three times both
    scores = torch.zeros_like(outputs["all_cls_scores"])
    outputs.update(
        all_references=references, all_pts_preds=references[..., :2], all_cls_scores=scores
    )
    losses = head.loss_by_feat(outputs, [gt], [{"token": "a"}])
    assert losses["loss_pts"] < 1e-5
    torch.testing.assert_close(losses["loss_raster_one2many"], losses["loss_raster"])
    crossed = head.prepare_gt(gt)
    crossed.masks = crossed.masks.flip(0)
    others = head.losses_by_layer(outputs, [crossed], [{"token": "a"}])
    assert others["loss_raster_one2many"] > 1.1 * losses["loss_raster_one2many"]


def test_the_further_queries_can_do_without_the_raster_loss():
    every, first = build(GSMAP).train(), build(GSMAP, raster_one2many=False).train()
    args = ([lines(2)], [{"token": "a"}])
    expected, losses = (head.loss_by_feat(head(bev()), *args) for head in (every, first))
    assert set(expected) - set(losses) == {"loss_raster_one2many", "d0.loss_raster_one2many"}
    for name, loss in losses.items():  # what is matched with what does not change
        torch.testing.assert_close(loss, expected[name])


def instance_queries(head):
    return head.state_dict()["instance_embedding.weight"]


@pytest.mark.parametrize("num_one2many", [2, 6, 9])
def test_checkpoint_with_another_number_of_further_queries(num_one2many):
    loaded = instance_queries(build(num_one2many=num_one2many)).clone()
    head = build()
    own = instance_queries(head).clone()
    state = {"map_head.instance_embedding.weight": loaded}
    head.fit_state(state, "map_head.")
    fitted = state["map_head.instance_embedding.weight"]
    both = min(len(loaded), len(own))
    assert fitted.shape == own.shape
    assert torch.equal(fitted[:both], loaded[:both])
    assert torch.equal(fitted[both:], own[both:])


def test_checkpoint_with_fewer_predicting_queries_is_left_for_the_strict_check():
    state = {"map_head.instance_embedding.weight": torch.zeros(N - 1, 2 * C)}
    build().fit_state(state, "map_head.")
    assert state["map_head.instance_embedding.weight"].shape == (N - 1, 2 * C)
