"""MGMap's decoder: activated queries, levels, patches and stages of the refinement."""

import pytest
import torch
from head_cases import GSMAP, HEAD, LANES, N, P, bev, build_head, losses_of, train_a_step
from mmengine.registry import init_default_scope

from gsmap.models.mgmap.decoder import MaskedDecoded, MGMapDecoder, RefinedDecoded
from gsmap.models.mgmap.refinement import crop_patches
from gsmap.models.streams.query_memory import QueryMemory

GROUPS = [{"num": N}, {"name": "one2many", "num": 2, "repeats": 2}]
LOSSES = [*HEAD["losses"], {"type": "QueryMaskLoss"}, {"type": "ForegroundLoss"}]


@pytest.fixture(autouse=True)
def scope():
    init_default_scope("mmdet3d")


def lanes():
    gt = LANES.clone()
    masks = torch.zeros(len(gt), 10, 5, dtype=torch.bool)
    masks[0, :, 1] = masks[1, :, 4] = True
    gt.masks = masks
    return gt


def mgmap(base=HEAD, decoder=None, **settings):
    own = {"type": "MGMapDecoder", "num_masks": N, "refine_ffn_dims": 32, **(decoder or {})}
    shared = {
        "decoder": {**HEAD["decoder"], **own},
        "losses": LOSSES,
        "points_from_instances": True,
    }
    return build_head(base, **{**shared, **settings})


def test_two_layers_and_two_stages_that_share_their_branches():
    head = mgmap().eval()
    outputs = head(bev())
    kinds = [type(output.decoded) for output in outputs]
    assert kinds == [MaskedDecoded] * 2 + [RefinedDecoded] * 2
    assert head.decoder.branches == [0, 1, 0, 1]
    assert [output.pts.shape for output in outputs] == [(1, N, P, 2)] * 4
    assert outputs[0].decoded.mask_logits.shape == (1, N, 10, 5)
    assert outputs[-1].decoded.segmentation.shape == (1, 2, 10, 5)


def test_instance_features_are_means_under_the_masks():
    feats = torch.arange(12.0).view(1, 2, 2, 3)
    logits = torch.full((1, 1, 2, 3), -50.0)
    logits[..., 1] = 50.0  # the middle column: 1 and 4, 7 and 10
    means = MGMapDecoder.instance_features(feats, logits)
    assert means.flatten().tolist() == pytest.approx([2.5, 8.5])


def test_a_patch_by_hand():
    """On a plane value = x the bins are the mean places of their samples; half a cell unshifted."""
    feats = torch.arange(40.0).view(1, 1, 1, 40).expand(1, 1, 20, 40)
    patches = crop_patches(feats, torch.tensor([[[0.5, 0.5]]]))  # 4 cells wide, from 18
    expected = [18 + (bin + 0.5) * 4 / 5 for bin in range(5)]
    assert patches.shape == (1, 1, 1, 5, 5)
    for row in patches[0, 0, 0]:
        assert row.tolist() == pytest.approx(expected)
    outside = crop_patches(feats + 1, torch.tensor([[[0.0, 0.5]]]))[0, 0, 0, 0]
    assert outside[0] == 0.0  # more than a cell outside
    assert outside[4] == pytest.approx(1 + 1.6)


def test_patches_are_zero_unless_they_are_asked_for():
    for patches in (False, True):
        head = mgmap(decoder={"patches": patches})
        losses_of(head.train(), lanes())["loss_pts"].backward()
        gradient = head.decoder.mask_feature.reduce.weight.grad
        assert (gradient is not None and bool(gradient.any())) == patches


def test_the_masks_reach_the_queries_and_the_refinement_is_not_masked():
    losses = losses_of(mgmap().train(), lanes())
    assert {"d0.loss_ins", "d1.loss_ins", "loss_seg", "d2.loss_pts", "loss_pts"} <= set(losses)
    assert not {"loss_ins", "d2.loss_ins", "d0.loss_seg"} & set(losses)
    head = mgmap().eval()
    before = head(bev())[0].scores
    head.decoder.mask_net[3].bias.data[0] += 5.0
    assert not torch.allclose(head(bev())[0].scores[:, 0], before[:, 0])


@pytest.mark.parametrize("base", [HEAD, GSMAP], ids=["points", "Gaussians"])
def test_it_learns_with_patches_and_further_groups(base):
    head = mgmap(base, {"patches": True, "num_masks": N + 2}, query_groups=GROUPS)
    losses = train_a_step(head, lanes())
    assert {"d0.loss_ins_one2many", "loss_pts_one2many", "loss_seg"} <= set(losses)
    assert "loss_seg_one2many" not in losses


def test_query_groups_do_not_see_each_other():
    head = mgmap(decoder={"patches": True, "num_masks": N + 2}, query_groups=GROUPS).eval()
    alone = head(bev())[-1].scores
    head.training = True
    torch.testing.assert_close(head(bev())[-1].scores[:, :N], alone, atol=1e-5, rtol=1e-5)


def test_bad_settings_are_refused_when_the_head_is_built():
    with pytest.raises(ValueError, match="there are 3 stages and 2 layers"):
        mgmap(decoder={"refinements": 3})
    with pytest.raises(ValueError, match="there are -1 stages and 2 layers"):
        mgmap(decoder={"refinements": -1}, losses=HEAD["losses"])
    with pytest.raises(ValueError, match="num_masks is 3, and there are 4 queries: set both"):
        mgmap(decoder={"num_masks": 3})
    with pytest.raises(ValueError, match="ForegroundLoss needs a refinement"):
        mgmap(decoder={"refinements": 0})
    with pytest.raises(ValueError, match="QueryMaskLoss needs the masks of MGMapDecoder, got MapD"):
        build_head(HEAD, losses=LOSSES)


def test_a_pipeline_without_masks_is_named():
    gt = lanes()
    del gt.masks
    with pytest.raises(ValueError, match="add MakeInstanceMasks to the training pipeline"):
        losses_of(mgmap().train(), gt)


def test_a_memory_of_queries_is_refused():
    """The masks, which losses and the queries use, would belong to other queries."""
    with pytest.raises(ValueError, match="MGMapDecoder has a mask for each of its own queries"):
        QueryMemory(embed_dims=HEAD["embed_dims"], num=2).check(mgmap())
