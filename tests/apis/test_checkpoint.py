import json

import pytest
import torch
from fuzz.attacks import Calls
from mmengine.config import Config
from torch import nn

from gsmap.apis.checkpoint import adopt_settings, load_weights, read_weights
from gsmap.checkpoints.settings import MODEL_SETTINGS, differences


def save(path, content):
    torch.save(content, path)
    return path


def test_weights_are_loaded_from_a_training_checkpoint_and_a_bare_state(tmp_path):
    source, target = nn.Linear(2, 3), nn.Linear(2, 3)
    for content in ({"state_dict": source.state_dict(), "meta": {"epoch": 1}}, source.state_dict()):
        load_weights(target, save(tmp_path / "a.pth", content))
        torch.testing.assert_close(target.weight, source.weight)
        nn.init.zeros_(target.weight)


def test_other_architecture_lists_the_first_keys_and_the_remedy(tmp_path):
    path = save(tmp_path / "other.pth", nn.Sequential(nn.Linear(2, 3)).state_dict())
    message = r"other.pth does not belong .*lacks weight, bias and has 0.weight, 0.bias too many"
    with pytest.raises(ValueError, match=message):
        load_weights(nn.Linear(2, 3), path)
    with pytest.raises(ValueError, match=r"and 5 more"):
        load_weights(
            nn.Sequential(*[nn.Linear(2, 2) for _ in range(4)]), save(path, {"x": torch.ones(1)})
        )


def test_other_size_is_named(tmp_path):
    path = save(tmp_path / "wide.pth", nn.Linear(4, 3).state_dict())
    with pytest.raises(ValueError, match=r"wide.pth does not belong [^!]*size mismatch for weight"):
        load_weights(nn.Linear(2, 3), path)


def test_checkpoint_that_would_run_code_is_refused_and_nothing_runs(tmp_path):
    path = save(
        tmp_path / "attack.pth",
        {"state_dict": {"w": torch.ones(1)}, "x": Calls(open, str(tmp_path / "proof"), "w")},
    )
    with pytest.raises(ValueError, match=r"attack.pth was not loaded: .*save its state_dict alone"):
        read_weights(path)
    assert not (tmp_path / "proof").exists()


def test_missing_truncated_and_empty_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no checkpoint .*gone.pth"):
        read_weights(tmp_path / "gone.pth")
    path = save(tmp_path / "half.pth", {"w": torch.ones(1000)})
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"half.pth"):
        read_weights(path)
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"half.pth"):
        read_weights(path)
    with pytest.raises(ValueError, match=r"holds no state dict"):
        read_weights(save(tmp_path / "meta.pth", {"meta": {}}))


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_weights_that_are_not_finite_are_refused(tmp_path, value):
    state = {"good": torch.ones(2), "bad": torch.tensor([1.0, value]), "count": torch.tensor(3)}
    with pytest.raises(ValueError, match=r"failed.pth holds NaN or infinite weights \(bad\)"):
        read_weights(save(tmp_path / "failed.pth", {"state_dict": state}))


def test_a_model_is_tested_with_the_settings_of_its_checkpoint(tmp_path):
    settings = {"head": {"floor_m": 0.15, "layers": [{"width": 2}, {"width": 3}]}, "same": [1, 2]}
    path = save(
        tmp_path / "a.pth",
        {"state_dict": {"w": torch.ones(1)}, "meta": {MODEL_SETTINGS: json.dumps(settings)}},
    )
    config = {"head": {"floor_m": 0.234, "layers": [{"width": 2}]}, "same": (1, 2)}
    cfg = Config({"model": config})
    assert adopt_settings(cfg, path, {"data.size": 3}) == [
        f"model.head.floor_m: 0.15, as {path} was trained; the config has 0.234",
        f"model.head.layers.1: {{'width': 3}}, as {path} was trained; the config has None",
    ]
    assert cfg.model.to_dict() == settings
    cfg = Config({"model": {**settings, "head": {**settings["head"], "floor_m": 0.5}}})
    assert adopt_settings(cfg, path, {"model.head.floor_m": 0.5}) == [
        f"model.head.floor_m: 0.5, as asked for; {path} was trained with 0.15"
    ]
    assert cfg.model.head.floor_m == 0.5
    assert adopt_settings(cfg, save(path, {"w": torch.ones(1)}), None) == []


def test_differences_of_other_kinds_are_named_whole():
    assert differences({"a": [1]}, {"a": {"b": 1}}) == {"a": ([1], {"b": 1})}
    assert differences({"a": None}, {"a": {"b": 1}}) == {"a": (None, {"b": 1})}
    assert differences([1, 2], [1, 2, 3], "x") == {"x.2": (None, 3)}
