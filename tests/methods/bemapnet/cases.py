"""Cases of general tests for this method."""

from mmdet3d.registry import TRANSFORMS

EXPORTS = {"as it is": ("configs/bemapnet/bemapnet_r18_minicity.py", {})}

EXPORT_SIZES = {
    "as it is": {
        "model.map_head.queries": (20, 25, 15),
        "model.map_head.score_threshold": None,
    }
}

TARGETS = (
    {"pieces": [2, 2, 2], "degrees": [1, 2, 3]},
    {"pieces": [2, 2, 2], "degrees": [1, 2, 3], "pixel_m": 0.46875},
)

TRANSFORM_CASES = {"FormatBezierTargets": {"adds": {"gt_instances_3d"}, "needs_truth": True}}

ANY_NUMBER = True  # lines have no equal numbers of points


def check_targets(head, steps) -> None:
    """Targets have the degrees and pieces of the head's curves."""
    (step,) = steps
    targets = TRANSFORMS.build(step)
    shapes = zip(targets.degrees, targets.pieces, strict=True)
    assert [d * k + 1 for d, k in shapes] == [curve.weights.shape[-1] for curve in head.curves]
