"""Parts of BeMapNet as its paper or release prints them; paper.json has further numbers."""

from paper_cases import head_of

from gsmap.models.bemapnet.head import BezierHead
from gsmap.models.bemapnet.losses import BezierLosses
from gsmap.models.bemapnet.targets import FormatBezierTargets


def test_bemapnet_weighs_as_released():
    head = head_of("configs/bemapnet/bemapnet_r50_30e.py")
    assert head.losses == BezierLosses(
        cls=2.0, mask=5.0, controls=5.0, pieces=2.0, curve=10.0, recovery=1.0, semantic=0.5,
        none_weight=0.5, mask_points=20000, redrawn_in_px=True,
    )  # fmt: skip
    assert head.layer_weights == (0.4, 0.4, 0.4, 0.8, 1.2, 1.6)
    assert BezierHead.level_weights == (0.5, 0.8, 1.2, 1.8)
    assert (head.mask_size, head.bev_size) == ((400, 200), (200, 100))
    assert tuple(head.queries) == (20, 25, 15)
    assert [curve.weights.shape[-1] for curve in head.curves] == [7, 2, 22]
    targets = FormatBezierTargets()
    assert (targets.degrees, targets.pieces) == ((2, 1, 3), (3, 1, 7))
    assert (targets.edge_classes, targets.max_error_m) == ((1,), 0.1)
    assert (targets.pixel_m, targets.thickness_px, targets.step_m) == (0.15, 8, 1.0)
    assert not targets.sort_rings
