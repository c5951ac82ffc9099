"""Unused keys of MapTRv2; ../test_keys.py asks what holds of every table."""

from pathlib import Path

import pytest
import torch

from gsmap.checkpoints.convert import ours_from_upstream, upstream_from_ours
from gsmap.utils.files import read_json

PAIRS = read_json(Path(__file__).with_name("keys.json"))["maptrv2"]["pairs"]


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
