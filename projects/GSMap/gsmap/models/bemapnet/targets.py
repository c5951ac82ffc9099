"""BeMapNet's targets: the control points and the mask of every line.

A line is a curve of joined Bezier pieces. Neighbouring pieces share a control point, so k pieces of
degree d have k * d + 1 control points.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from mmdet3d.registry import TRANSFORMS

from gsmap.models.lines.front import front_size
from gsmap.models.lines.targets import FormatLineTargets, Points, orient_line
from gsmap.structures.bezier import MAX_DEGREE, curve_points, fit_pieces, mean_deviation
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import is_closed
from gsmap.utils.errors import InputError


@TRANSFORMS.register_module()
@dataclass(eq=False)
class FormatBezierTargets(FormatLineTargets):
    """Add ``gt_instances_3d`` with Bezier control points that are fitted to ``map_instances``.

    The fields of the targets and the other settings are described in `FormatLineTargets`.

    Args:
        degrees: Degree of the Bezier pieces of a line, for each class, 1 to 5. Configs set
            ``degrees`` of the head, and the head's `target_settings` set it here.
        pieces: Largest number of pieces of a line, for each class, >= 1, set by the head like
            ``degrees``. As in the released code, further pieces of a line are dropped.
        max_error_m: Largest mean deviation of a piece from its line, in metres.

    Raises:
        ValueError: If degrees and pieces are out of range or differ in length, or if
            ``edge_classes`` has an unknown class.
    """

    degrees: Sequence[int] = (2, 1, 3)
    pieces: Sequence[int] = (3, 1, 7)
    max_error_m: float = 0.1

    def __post_init__(self) -> None:
        check_curves(self.degrees, self.pieces)
        super().__post_init__()

    def class_setting(self) -> tuple[str, Sequence[int]]:
        """Return the name and the values of a setting with one number for each class.

        The base class checks the labels of the elements against the number of values.
        """
        return "degrees", self.degrees

    def max_points(self) -> int:
        """Return the largest number P of control points of a line."""
        counts = []
        for degree, num_pieces in zip(self.degrees, self.pieces, strict=True):
            counts.append(degree * num_pieces + 1)
        return max(counts)

    def polyline(self, points: Points, label: int) -> Points:
        """Return points along the curve that control points of a class define. (P, 2) -> (n, 2)"""
        return curve_points(points, self.degrees[label])

    def points(self, line: Points, label: int, grid: BEVGrid) -> Points:
        """Fit the control points of a line, from its front end to its rear end.

        Args:
            line: Points (from the front, from the left) in [0, 1]. (n, 2)
            label: Class index.
            grid: Raster of the masks, which covers [0, 1]. Its size converts the line to metres.

        Returns:
            Control points (from the front, from the left) in [0, 1]. (P, 2)
        """
        if self.sort_rings and is_closed(line):
            # A ring starts at its rearmost vertex and runs clockwise. The tolerance concerns lines
            # with two ends.
            line = orient_line(line, tolerance=0.0, sort_rings=True)
        rows, columns = front_size(grid)  # pixels along the direction of travel, and across it
        size_m = (rows * self.pixel_m, columns * self.pixel_m)
        degree = self.degrees[label]
        controls = fit_pieces(
            line * size_m,
            degree,
            max_error_m=self.max_error_m,
            deviation=mean_deviation,  # as in the released code
        )
        first_u = controls[0, 0]  # u is the distance from the front
        last_u = controls[-1, 0]
        if first_u > last_u:  # the line begins at its rear end
            controls = controls[::-1]
        max_controls = degree * self.pieces[label] + 1
        return controls[:max_controls] / size_m


def check_curves(degrees: Sequence[int], pieces: Sequence[int]) -> None:
    """Check the degrees and the numbers of pieces of the classes.

    Raises:
        ValueError: If they are out of range or differ in length.
    """
    if len(degrees) != len(pieces) or not all(1 <= d <= MAX_DEGREE for d in degrees):
        raise InputError(
            f"degrees must be 1 to {MAX_DEGREE} for each class of pieces, got {list(degrees)} for "
            f"{list(pieces)}."
        )
    if min(pieces, default=0) < 1:
        raise InputError(f"pieces must be >= 1 for each class, got {list(pieces)}.")
