"""BeMapNet's targets: the control points of every line, and its mask."""

from collections.abc import Sequence
from dataclasses import dataclass

from mmdet3d.registry import TRANSFORMS

from gsmap.models.lines.front import front_size
from gsmap.models.lines.targets import FormatLineTargets, Points, directed
from gsmap.structures.bezier import MAX_DEGREE, curve_points, fit_pieces, mean_deviation
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import is_closed
from gsmap.utils.errors import InputError


@TRANSFORMS.register_module()
@dataclass(eq=False)
class FormatBezierTargets(FormatLineTargets):
    """Add ``gt_instances_3d`` with the control points of lines, from ``map_instances``.

    Args:
        degrees: Degrees of the pieces of each class; a config has them in the head.
        pieces: Most pieces of each class, likewise; as released, further ones are lost.
        max_error_m: A piece is accepted below this mean deviation, in metres.

    Other settings, and what the targets are, are those of `FormatLineTargets`. ValueError if a
    degree is not 1 to 5, a class has no piece or just one of the two, or ``edge_classes`` names one
    that is not.
    """

    degrees: Sequence[int] = (2, 1, 3)
    pieces: Sequence[int] = (3, 1, 7)
    max_error_m: float = 0.1

    def __post_init__(self) -> None:
        check_curves(self.degrees, self.pieces)
        super().__post_init__()

    def by_class(self) -> tuple[str, Sequence[int]]:
        """Return the setting that has a number for each class: its name and the numbers."""
        return "degrees", self.degrees

    def most(self) -> int:
        """Return the largest number P of control points of a line."""
        return max(d * k + 1 for d, k in zip(self.degrees, self.pieces, strict=True))

    def way(self, points: Points, label: int) -> Points:
        """Return points of the curve of control points."""
        return curve_points(points, self.degrees[label])

    def points(self, line: Points, label: int, grid: BEVGrid) -> Points:
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
        raise InputError(
            f"degrees must be 1 to {MAX_DEGREE} for each class of pieces, got {list(degrees)} for "
            f"{list(pieces)}."
        )
    if min(pieces, default=0) < 1:
        raise InputError(f"pieces must be >= 1 for each class, got {list(pieces)}.")
