"""Weights in the wrappings of other training loops: found by one rule, or the keys are named."""

import pytest
import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel

from gsmap.checkpoints.convert import convert_state
from gsmap.checkpoints.reading import read_weights
from gsmap.checkpoints.unwrapping import WRAPPERS, unwrap

MODEL = nn.Sequential(nn.Linear(2, 3), nn.BatchNorm1d(3))
STATE = MODEL.state_dict()
OPTIMISER = {"state": {0: {"step": torch.ones(1), "exp_avg": torch.ones(2)}}, "param_groups": []}


def with_prefix(prefix: str) -> dict[str, torch.Tensor]:
    return {prefix + key: value for key, value in STATE.items()}


@pytest.mark.parametrize(
    "content",
    [
        STATE,
        *({name: STATE, "optimizer": OPTIMISER, "epoch": 3, "meta": {}} for name in WRAPPERS),
        {"epoch": 29, "model_state": STATE, "optimizer_state": None, "callback": {}},
        {"model": {"state_dict": STATE}, "args": {"lr": 1}},
        {"model": {"net": {"weights": with_prefix("module.")}}},
        {"detector": STATE, "optimizer": OPTIMISER},  # the one state dict there is
        {"state_dict": STATE, "ema_state_dict": with_prefix("module.")},
        {"state_dict": with_prefix("model."), "optimizer_states": [OPTIMISER]},
        {"model": with_prefix("module._orig_mod.")},
        with_prefix("_orig_mod.module."),
        with_prefix("model._fsdp_wrapped_module."),
        {key.replace("0.", "0._orig_mod.", 1): value for key, value in STATE.items()},
        AveragedModel(MODEL).state_dict(),
        {**STATE, "epoch": 3, "best": torch.tensor(0.5)},
    ],
)
def test_weights_are_found_and_have_the_keys_of_the_model(content, tmp_path):
    torch.save(content, tmp_path / "a.pth")
    state = read_weights(tmp_path / "a.pth")
    assert set(state) == set(STATE)
    for key, value in STATE.items():
        assert torch.equal(state[key], value)


def test_averages_beside_their_weights_are_left_out_and_counted():
    averages = {f"ema_{key.replace('.', '_')}": value + 1 for key, value in STATE.items()}
    unwrapped = unwrap({"state_dict": {**STATE, **averages, "note": "x"}, "meta": {}})
    assert unwrapped.state.keys() == STATE.keys()
    expected = {"averages of weights (EMA)": len(STATE), "entries that are no tensors": 1}
    assert unwrapped.left_out == expected
    alone = {"ema_other_weight": torch.ones(2), **STATE}
    assert "ema_other_weight" in unwrap(alone).state  # an average of no weight of the model
    beside = {"state_dict": STATE, "ema_state_dict": with_prefix("module."), "meta": {"a": 1}}
    assert unwrap(beside).left_out == {"weights under 'ema_state_dict'": len(STATE)}
    nested = {"model": {"net": STATE}, "ema": {"module": with_prefix("module."), "updates": 1}}
    assert unwrap(nested).left_out == {"weights under 'module' of 'ema'": len(STATE)}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"generator": STATE, "critic": STATE}, r"has the keys \['generator', 'critic'\]"),
        ({"optimizer": OPTIMISER}, r"has the keys \['optimizer'\]"),
        ([1, 2], "is a list"),
        ({}, "has no key"),
        ({"state_dict": {}}, r"has the keys \['state_dict'\]"),
    ],
)
def test_a_file_without_weights_names_the_keys_found_and_wanted(content, message, tmp_path):
    torch.save(content, tmp_path / "a.pth")
    wanted = rf"a\.pth holds no state dict of tensors: it {message}.*under state_dict, model_state"
    with pytest.raises(ValueError, match=wanted):
        read_weights(tmp_path / "a.pth")


def test_two_weights_under_one_key_are_refused():
    with pytest.raises(ValueError, match=r"holds two weights under '0\.weight'"):
        unwrap({"0.weight": torch.ones(2), "module.0.weight": torch.zeros(2)})


@pytest.mark.parametrize(
    ("content", "remedy"),
    [(b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"), (b"<html>", "web page")],
)
def test_what_stands_in_place_of_a_checkpoint_is_named(content, remedy, tmp_path):
    (tmp_path / "a.pth").write_bytes(content)
    with pytest.raises(ValueError, match=rf"a\.pth .*{remedy}"):
        read_weights(tmp_path / "a.pth")


def test_the_offsets_of_the_kernel_that_published_weights_hold_are_left_out():
    layer = "pts_bbox_head.transformer.encoder.layers.0.attentions.1.attention."
    weight = torch.ones(2)
    state = {f"{layer}attention_weights.weight": weight, f"{layer}grid_offsets": torch.ones(15, 2)}
    converted, _ = convert_state(state)
    assert converted == {"bev_encoder.layers.0.cross_attn.attention_weights.weight": weight}
