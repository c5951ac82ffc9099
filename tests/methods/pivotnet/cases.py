"""Cases of general tests for this method."""

from mmdet3d.registry import TRANSFORMS

EXPORTS = {"as it is": ("configs/pivotnet/pivotnet_r18_minicity.py", {})}

EXPORT_SIZES = {
    "as it is": {
        "model.map_head.queries": ((20, 10), (25, 2), (15, 16)),
        "model.map_head.score_threshold": None,
    }
}

TARGETS = (
    {"queries": [[9, 4], [9, 6], [9, 8]], "mask_pixel_m": 0.9375},
    {"num_points": [4, 6, 8], "pixel_m": 0.9375},
)

LOSSES = ("num_pts", ())  # field of the ground truth; losses that may be zero

PROFILES = ("pivotnet/pivotnet_r18_minicity", ("192", "320"))  # the size of its positions

TRANSFORM_CASES = {"FormatPivotTargets": {"adds": {"gt_instances_3d"}, "needs_truth": True}}

ANY_NUMBER = True  # lines have no equal numbers of points


def check_targets(head, steps) -> None:
    """Targets have the points of the head's queries."""
    (step,) = steps
    numbers = tuple(points for _, points in head.decoder.queries)
    assert TRANSFORMS.build(step).num_points == numbers
