import pytest
import torch
from torch import nn

from gsmap.apis.checkpoint import load_weights, read_weights


class Attack:
    """Would create a file when unpickled without protection."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


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
    with pytest.raises(ValueError, match=r"and 3 more"):
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
        {"state_dict": {"w": torch.ones(1)}, "x": Attack(tmp_path / "proof")},
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
