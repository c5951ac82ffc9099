"""Parts of HDMapNet as its paper or release prints them; paper.json has further numbers."""

from paper_cases import head_of

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
