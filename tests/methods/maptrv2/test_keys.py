"""The table between MapTRv2's upstream keys and ours."""

import pytest
import torch

from gsmap.checkpoints.convert import ours_from_upstream, upstream_from_ours
from gsmap.checkpoints.key_map import find_key_map
from gsmap.models.maptr.keys import MAPTR
from gsmap.models.maptrv2.keys import MAPTRV2

LAYER = "pts_bbox_head.transformer.decoder.layers.3."
OURS = "map_head.decoder.layers.3."
PAIRS = {
    LAYER + "attentions.0.attn.in_proj_bias": OURS + "self_attn.instance_attn.in_proj_bias",
    LAYER + "attentions.1.attn.out_proj.bias": OURS + "self_attn.point_attn.out_proj.bias",
    LAYER + "attentions.2.value_proj.weight": OURS + "cross_attn.value_proj.weight",
    LAYER + "norms.0.weight": OURS + "self_attn.norm.weight",
    LAYER + "norms.3.weight": OURS + "norms.2.weight",
    "pts_bbox_head.transformer.encoder.depth_net.depth_conv.3.aspp2.bn.bias": (
        "bev_encoder.depth_net.depth_conv.3.aspp2.bn.bias"
    ),
    "pts_bbox_head.transformer.encoder.downsample.4.running_var": (
        "bev_encoder.downsample.4.running_var"
    ),
    "pts_bbox_head.seg_head.2.bias": "map_head.aux_heads.seg.2.bias",
    "pts_bbox_head.pv_seg_head.0.weight": "map_head.aux_heads.pv_seg.0.weight",
}


@pytest.mark.parametrize(("upstream", "ours"), PAIRS.items())
def test_names_by_hand_in_both_directions(upstream, ours):
    assert MAPTRV2.to_ours(upstream) == ours
    assert MAPTRV2.to_upstream(ours) == upstream


def test_the_architecture_is_found_by_its_depth_net():
    depth = "pts_bbox_head.transformer.encoder.depth_net.depth_conv.4.bias"
    assert find_key_map([depth, "img_neck.x"]) is MAPTRV2
    assert find_key_map([MAPTRV2.to_ours(depth)]) is MAPTRV2
    assert find_key_map(["img_neck.x"]) is MAPTR


def test_unused_keys_are_left_out_and_come_back_as_what_upstream_expects():
    state = {ours: torch.ones(1) for ours in PAIRS.values()}
    state["bev_encoder.depth_net.depth_conv.4.bias"] = torch.ones(68)
    upstream = upstream_from_ours(state)
    encoder = "pts_bbox_head.transformer.encoder."
    assert upstream[encoder + "dx"].tolist() == pytest.approx([0.15, 0.15, 20])
    assert upstream[encoder + "bx"].tolist() == pytest.approx([-14.925, -29.925, 0])
    assert upstream[encoder + "nx"].tolist() == [200, 400, 1]
    assert upstream["pts_bbox_head.loss_seg.loss_fn.pos_weight"].tolist() == [4]
    assert upstream["pts_bbox_head.positional_encoding.row_embed.weight"].shape == (200, 128)
    back = ours_from_upstream(upstream)
    assert back.keys() == state.keys()
    assert all(torch.equal(back[key], state[key]) for key in state)
