import pytest
from torch import nn

from benchmarks.parameters import count_parameters


def test_parameters_are_counted_by_module():
    model = nn.Sequential(nn.Linear(2, 3), nn.ReLU(), nn.Sequential(nn.Linear(3, 1)))
    model[0].bias.requires_grad_(False)
    assert count_parameters(model, 1) == {"": (13, 10), "0": (9, 6), "2": (4, 4)}
    with pytest.raises(ValueError, match="depth must be >= 0, got -1"):
        count_parameters(model, -1)
