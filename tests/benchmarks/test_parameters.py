import pytest
from torch import nn

from benchmarks.parameters import count_parameters


def test_parameters_are_counted_by_module():
    model = nn.Sequential(nn.Linear(2, 3), nn.BatchNorm1d(3), nn.Sequential(nn.Linear(3, 1)))
    model[0].bias.requires_grad_(False)
    expected = {"": (19, 16, 26), "0": (9, 6, 9), "1": (6, 6, 13), "2": (4, 4, 4)}
    assert count_parameters(model, 1) == expected  # two statistics of three channels, and a count
    with pytest.raises(ValueError, match="depth must be >= 0, got -1"):
        count_parameters(model, -1)
