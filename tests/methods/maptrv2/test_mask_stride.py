"""The benchmark of a model draws camera masks of the stride that the config says."""

from pathlib import Path

import pytest

from benchmarks.model import mask_stride
from gsmap.engine.launch import read_config

REPO = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(("config", "stride"), [("r50_24e", 32), ("r18_minicity", 8)])
def test_camera_masks_are_as_coarse_as_the_configs(config, stride):
    assert mask_stride(read_config(REPO / f"configs/maptrv2/maptrv2_{config}.py")) == stride
