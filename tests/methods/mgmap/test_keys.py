"""The table between MGMap's upstream keys and ours; reference.py checks all keys."""

import pytest
import torch

from gsmap.checkpoints.convert import ours_from_upstream
from gsmap.checkpoints.key_map import find_key_map
from gsmap.models.maptr.keys import MAPTR
from gsmap.models.mgmap.keys import MGMAP

HEAD = "pts_bbox_head."
MASKS = HEAD + "transformer.decoder.ins_conv.3.bias"
PAIRS = {
    MASKS: "map_head.decoder.mask_net.3.bias",
    HEAD + "transformer.bevencode.layer2.1.ca.fc.0.weight": (
        "map_head.decoder.neck.stages.1.1.gates.channel.0.weight"
    ),
    HEAD + "transformer.bevencode.layer3.0.downsample.1.bias": (
        "map_head.decoder.neck.stages.2.0.downsample.1.bias"
    ),
    HEAD + "transformer.bevencode.neck.convs.3.norm.bias": "map_head.decoder.neck.levels.3.1.bias",
    HEAD + "glimpse_transformer_1.decoder.layers.0.linear1.bias": (
        "map_head.decoder.refinements.1.layer.linear1.bias"
    ),
    HEAD + "layer_norms_1.0.bias": "map_head.decoder.refinements.1.fuser.1.bias",
    HEAD + "cls_branches.5.6.bias": "map_head.cls_branches.5.6.bias",
    HEAD + "pts_embedding_.bias": "map_head.pts_embedding.bias",
}
IDLE = [
    HEAD + "glimpse_transformer.decoder.norm.bias",
    HEAD + "cls_branches.6.6.bias",
    HEAD + "rego_hs_fuser_0.1.weight",
    HEAD + "transformer.bevencode.fpn_conv.bn.bias",
]


@pytest.mark.parametrize(("upstream", "ours"), PAIRS.items())
def test_names_by_hand_in_both_directions(upstream, ours):
    assert MGMAP.to_ours(upstream) == ours
    assert MGMAP.to_upstream(ours) == upstream


def test_what_is_never_called_is_left_out_and_what_nobody_knows_is_refused():
    state = {key: torch.ones(()) for key in (*PAIRS, *IDLE)}
    assert ours_from_upstream(state).keys() == set(PAIRS.values())
    with pytest.raises(ValueError, match=r"no mgmap model has: pts_bbox_head\.conv_segment\.x"):
        ours_from_upstream({**state, HEAD + "conv_segment.x": torch.ones(())})


def test_the_architecture_is_found_by_its_masks():
    assert find_key_map([MASKS]) is MGMAP
    assert find_key_map([PAIRS[MASKS]]) is MGMAP
    assert find_key_map(["img_neck.x"]) is MAPTR
