"""The table between MGMapNet's upstream keys and ours; reference.py checks all 1019 keys."""

import pytest

from gsmap.checkpoints.key_map import find_key_map
from gsmap.models.maptrv2.keys import MAPTRV2
from gsmap.models.mgmapnet.keys import MGMAPNET

TRANSFORMER = "pts_bbox_head.transformer."
ATTENTION = TRANSFORMER + "decoder.layers.3.attentions.1."
LAYER = "map_head.decoder.layers.3."
PAIRS = {
    TRANSFORMER + "bev_downsample.norm.bias": "map_head.decoder.bev_pyramid.merges.0.norm.bias",
    TRANSFORMER + "decoder.layers.3.attentions.0.attn.in_proj_bias": (
        LAYER + "self_attn.in_proj_bias"
    ),
    ATTENTION + "p2p_attention.cross_attn.out_proj.bias": (
        LAYER + "cross_attn.p2p.attn.out_proj.bias"
    ),
    ATTENTION + "p2i_attention.linear1.weight": LAYER + "cross_attn.p2i.ffn.layers.0.0.weight",
    ATTENTION + "p2i_attention.norm3.bias": LAYER + "cross_attn.p2i.norms.1.bias",
    ATTENTION + "instance_pos.2.bias": LAYER + "cross_attn.instance_code.2.bias",
    ATTENTION + "sampling_offsets.bias": LAYER + "cross_attn.sampling_offsets.bias",
    ATTENTION + "output_proj_point.weight": LAYER + "cross_attn.output_proj.weight",
    ATTENTION + "point2ins_proj.0.weight": LAYER + "cross_attn.instance_mlp.0.weight",
    TRANSFORMER + "decoder.point_ffn.3.layers.1.bias": LAYER + "point_ffn.layers.1.bias",
    TRANSFORMER + "decoder.point_norm.3.weight": LAYER + "point_norm.weight",
    TRANSFORMER + "decoder.gen_pos_embed.3.0.bias": LAYER + "reference_code.0.bias",
    "pts_bbox_head.ins_seg_head.4.bias": "map_head.losses.ins_seg.embedding.4.bias",
}
UNUSED = [
    ATTENTION + "output_proj_instance.weight",
    TRANSFORMER + "decoder.gen_pos_embed.0.0.weight",
    "pts_bbox_head.pts_embedding.weight",
    "pts_bbox_head.bev_pv_seg_head.4.running_var",
]


@pytest.mark.parametrize(("upstream", "ours"), PAIRS.items())
def test_names_by_hand_in_both_directions(upstream, ours):
    assert MGMAPNET.to_ours(upstream) == ours
    assert MGMAPNET.to_upstream(ours) == upstream


@pytest.mark.parametrize("key", UNUSED)
def test_keys_without_effect_have_no_place_although_a_rule_fits(key):
    assert MGMAPNET.to_ours(key) is None
    assert key in MGMAPNET.unused


def test_the_architecture_is_found_by_its_down_sampling():
    depth = TRANSFORMER + "encoder.depth_net.depth_conv.4.bias"
    down = TRANSFORMER + "bev_downsample.norm.bias"
    assert find_key_map([depth, down]) is MGMAPNET
    assert find_key_map([MGMAPNET.to_ours(key) for key in (depth, down)]) is MGMAPNET
    assert find_key_map([depth]) is MAPTRV2
