"""The table between MapQR's upstream keys and ours; reference.py checks all keys."""

import pytest

from gsmap.checkpoints.key_map import find_key_map
from gsmap.models.mapqr.keys import MAPQR
from gsmap.models.maptr.keys import MAPTR

TRANSFORMER = "pts_bbox_head.transformer."
HEIGHTS = TRANSFORMER + "encoder.layers.2.attentions.1.height_offsets.bias"
PAIRS = {
    HEIGHTS: "bev_encoder.layers.2.cross_attn.height_offsets.bias",
    TRANSFORMER + "encoder.layers.2.attentions.1.attention.value_proj.bias": (
        "bev_encoder.layers.2.cross_attn.value_proj.bias"
    ),
    TRANSFORMER + "decoder.layers.3.attentions.1.output_proj.2.weight": (
        "map_head.decoder.layers.3.cross_attn.output_proj.2.weight"
    ),
    TRANSFORMER + "decoder.pt_pos_query_projs.3.bias": (
        "map_head.decoder.layers.3.position_proj.bias"
    ),
    TRANSFORMER + "reference_points.2.bias": "map_head.reference.initial.2.bias",
    "pts_bbox_head.reg_branches.4.6.bias": "map_head.reference.branches.4.6.bias",
    "pts_bbox_head.pv_seg_head.2.bias": "map_head.aux_heads.pv_seg.2.bias",
}


@pytest.mark.parametrize(("upstream", "ours"), PAIRS.items())
def test_names_by_hand_in_both_directions(upstream, ours):
    assert MAPQR.to_ours(upstream) == ours
    assert MAPQR.to_upstream(ours) == upstream


def test_the_architecture_is_found_by_its_heights():
    assert find_key_map([HEIGHTS, "img_neck.x"]) is MAPQR
    assert find_key_map([PAIRS[HEIGHTS], "img_neck.x"]) is MAPQR
    assert find_key_map([key for key in PAIRS if key != HEIGHTS]) is MAPTR
