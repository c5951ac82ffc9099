"""Parts of PivotNet as its paper or release prints them; paper.json has further numbers."""

from paper_cases import head_of

from gsmap.models.pivotnet.head import PivotHead
from gsmap.models.pivotnet.losses import PivotLosses
from gsmap.models.pivotnet.targets import FormatPivotTargets


def test_pivotnet_weighs_as_released():
    head = head_of("configs/pivotnet/pivotnet_r50_30e.py")
    assert head.losses == PivotLosses(
        cls=2.0, mask=5.0, pivots=30.0, collinear=10.0, point_cls=2.0, semantic=3.0, end_weight=5.0,
        none_weight=0.5, between_weight=0.2, point_cls_per_line=True,
    )  # fmt: skip
    assert head.layer_weights == (0.4, 0.4, 0.4, 0.8, 1.2, 1.6)
    assert PivotHead.level_weights == (0.4, 0.8, 1.6, 2.4)
    assert head.mask_size == (400, 200)
    targets = FormatPivotTargets()
    assert (targets.num_points, targets.edge_classes) == ((10, 2, 30), (1,))
    assert (targets.pixel_m, targets.thickness_px) == (0.15, 8)
    assert (targets.step_m, targets.min_area_m2) == (1.0, 2.0)
    assert not targets.keep_end
    assert not targets.sort_rings
