"""Parts of HDMapNet as its paper or release prints them; paper.json has further numbers."""

import pytest
from paper_cases import head_of

from gsmap.engine.launch import check_config, read_config
from gsmap.models.hdmapnet.encoder import ViewTransformEncoder
from gsmap.models.hdmapnet.losses import LineMapLosses
from gsmap.models.hdmapnet.targets import MakeLineMaps


def test_hdmapnet_weighs_and_draws_as_released():
    head, targets = head_of("configs/hdmapnet/hdmapnet_effb0_30e.py"), MakeLineMaps()
    assert head.losses == LineMapLosses(1.0, 1.0, 1.0, 0.2, 2.13, 0.5, 3.0)
    assert [maps[-1].out_channels for maps in head.decoder.maps] == [4, 16, 37]
    assert len(head.decoder.joined) == 2  # directions have no block of their own
    assert head.map_size == (200, 400)
    assert (targets.pixel_m, targets.thickness_px, targets.gap_px) == (0.15, 5, 9)
    assert (targets.step_m, targets.num_directions) == (1.0, 36)
    assert ViewTransformEncoder(head.grid, num_cams=0).released_units


@pytest.mark.parametrize("side", ["head", "transform"])
def test_a_setting_that_head_and_transform_share_has_one_value(side):
    cfg = read_config("configs/hdmapnet/hdmapnet_r18_minicity.py")
    steps = cfg.train_dataloader.dataset.pipeline
    (step,) = [step for step in steps if step.type == "MakeLineMaps"]
    (cfg.model.map_head if side == "head" else step).num_directions = 72
    message = r"num_directions of MakeLineMaps is \d+, but the settings of HDMapNetHead require \d+"
    with pytest.raises(ValueError, match=message):
        check_config(cfg)
    cfg.model.map_head.num_directions = step.num_directions = 72
    check_config(cfg)
