"""Parts of MapVR as its paper or release prints them; paper.json has further numbers."""

from paper_cases import head_of
from torch import nn


def test_mapvr_renders_as_released():
    head = head_of("configs/mapvr/mapvr_r50_24e.py")
    loss, cost = head.losses["dice"].renderer, head.assigner.match_costs[-1].renderer
    assert (loss.size, cost.size) == ((256, 128), (128, 64))
    for renderer in (loss, cost):
        assert (renderer.line_softness, renderer.polygon_softness) == (2.0, 4.0)
        assert (renderer.polygon_classes, renderer.distance) == ((1,), "squared")
    assert all(part.p == 0 for part in head.modules() if isinstance(part, nn.Dropout))
