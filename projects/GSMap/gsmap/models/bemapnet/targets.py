"""BeMapNet's targets: the control points of every line, and its mask."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from mmdet3d.registry import TRANSFORMS

from gsmap.models.pivotnet.front import front_size
from gsmap.models.pivotnet.targets import FormatLineTargets, Points, directed
from gsmap.structures.bezier import MAX_DEGREE, curve_points, fit_pieces, mean_deviation
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import is_closed


@TRANSFORMS.register_module()
@dataclass(eq=False)
class FormatBezierTargets(FormatLineTargets):
    """Add ``gt_instances_3d`` with the control points of lines, from ``map_instances``.

    It has ``labels_3d`` (K,), ``pts`` (K, P, 2) in metres, the last point repeated, ``num_pts``
    (K,), ``masks`` (K, H, W), with rows from the front and columns from the left, and ``redrawn``
    (K,): whether a mask was drawn by its curve because lines hide one of that class.

    Args:
        degrees: Degrees of the pieces of each class, as in the head.
        pieces: Most pieces of each class, as in the head; as released, further ones are lost.
        max_error_m: A piece is accepted below this mean deviation, in metres.

    Other settings are those of `FormatLineTargets`. ValueError if a degree is not 1 to 5, a class
    has no piece or just one of the two, or ``edge_classes`` names one that is not.
    """

    degrees: Sequence[int] = (2, 1, 3)
    pieces: Sequence[int] = (3, 1, 7)
    max_error_m: float = 0.1

    def __post_init__(self) -> None:
        check_curves(self.degrees, self.pieces)
        super().__post_init__()

    def by_class(self) -> tuple[str, Sequence[int]]:
        """Return the setting with a number for each class, and its value."""
        return "degrees", self.degrees

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Add the targets; ValueError without ground truth or for a class that has no degree."""
        parts, grid = self.annotated(results)
        labels, size = [label for label, _ in parts], front_size(grid)
        controls = [self.controls(line, label, grid) for label, line in parts]
        curves = (
            curve_points(line, self.degrees[label])
            for line, label in zip(controls, labels, strict=True)
        )
        masks, redrawn = self.masks(parts, curves, size)
        most = max(d * k + 1 for d, k in zip(self.degrees, self.pieces, strict=True))
        found = self.instances(labels, list(map(grid.metres_from_front, controls)), masks, most)
        found.redrawn = torch.from_numpy(redrawn)
        results["gt_instances_3d"] = found
        return results

    def controls(self, line: Points, label: int, grid: BEVGrid) -> Points:
        """Return the control points of a line, [0, 1] from the front and the left. (P, 2)"""
        if self.sort_rings and is_closed(line):
            line = directed(line, 0.0, sort_rings=True)
        size_m = tuple(pixels * self.pixel_m for pixels in front_size(grid))
        degree = self.degrees[label]
        fitted = fit_pieces(line * size_m, degree, self.max_error_m, mean_deviation)
        if fitted[0, 0] > fitted[-1, 0]:  # a curve runs away from the front
            fitted = fitted[::-1]
        return fitted[: degree * self.pieces[label] + 1] / size_m


def check_curves(degrees: Sequence[int], pieces: Sequence[int]) -> None:
    """Raise ValueError if these are not degrees and numbers of pieces of classes."""
    if len(degrees) != len(pieces) or not all(1 <= d <= MAX_DEGREE for d in degrees):
        raise ValueError(
            f"degrees must be 1 to {MAX_DEGREE} for each class of pieces, got {list(degrees)} for "
            f"{list(pieces)}."
        )
    if min(pieces, default=0) < 1:
        raise ValueError(f"pieces must be >= 1 for each class, got {list(pieces)}.")
