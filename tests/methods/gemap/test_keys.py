"""Whole states of GeMap; ../test_keys.py asks what holds of every table."""

import json
from pathlib import Path

import torch

from gsmap.checkpoints.convert import ours_from_upstream, upstream_from_ours
from gsmap.models.gemap.attention import GeometryDecoupledAttention
from gsmap.models.maptr.keys import MAPTR
from gsmap.utils.files import read_json

PAIRS = read_json(Path(__file__).with_name("keys.json"))["gemap"]["pairs"]


def read_keys(golden_dir, name):
    return json.loads((golden_dir / f"models/{name}_state.json").read_text())["state"]


def test_every_key_of_the_simple_model_has_its_place(golden_dir):
    """All but the self-attention's keys go where MapTR's go, and those to its parameters."""
    state = {key: torch.ones(()) for key in read_keys(golden_dir, "gemap_simple_r50")}
    ours = ours_from_upstream(state)
    assert len(ours) == len(state) - 1 == 709
    others = {key for key in ours if ".self_attn.int" not in key}
    maptr = {MAPTR.to_ours(key) for key in read_keys(golden_dir, "maptr_r50")} - {None}
    assert others == {key for key in maptr if "decoder" not in key or "self_attn" not in key}
    prefix = "map_head.decoder.layers.5.self_attn."
    parameters = {prefix + key for key in GeometryDecoupledAttention().state_dict()}
    assert {key for key in ours if key.startswith(prefix)} == parameters
    assert upstream_from_ours(ours).keys() == state.keys()


def test_every_key_of_the_full_model_has_its_place(golden_dir):
    """The full objective's model is MapTRv2's with the decoder of the simple one, and ``tau``."""
    decoder = "pts_bbox_head.transformer.decoder."
    simple = read_keys(golden_dir, "gemap_simple_r50")
    lifted = read_keys(golden_dir, "maptrv2_r50")
    keys = {key for key in simple if key.startswith(decoder)}
    keys |= {key for key in lifted if not key.startswith(decoder)} | {"pts_bbox_head.tau"}
    state = {key: torch.ones(()) for key in keys}
    ours = ours_from_upstream(state)
    assert upstream_from_ours(ours).keys() == keys
    assert "map_head.aux_heads.seg.2.bias" in ours


def test_argoverse_2s_simple_model_holds_keys_of_losses_that_are_off():
    losses = [f"pts_bbox_head.{name}.loss_fn.pos_weight" for name in ("loss_seg", "loss_pv_seg")]
    state = {key: torch.ones(1) for key in [*PAIRS, "pts_bbox_head.tau", *losses]}
    ours = ours_from_upstream(state)
    assert ours.keys() == set(PAIRS.values())
    assert upstream_from_ours(ours).keys() == {*PAIRS, "pts_bbox_head.code_weights"}
