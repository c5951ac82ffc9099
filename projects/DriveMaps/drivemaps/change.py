"""Changes of a place since an old map was made, and the rules that all kinds of changes share."""

from dataclasses import dataclass, field

import numpy as np
import shapely
from scipy.special import ndtr

from drivemaps.drive import Drive
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements

REMOVED = "removed"  # in the old map only
ADDED = "added"  # in the new drives only
MOVED = "moved"  # in both, at another position
KINDS = (REMOVED, ADDED, MOVED)
"""Kinds of changes."""
MIN_VIEWS = 5
"""A point is in view of a pass if at least this many frames of the pass have it in range."""
_NEW_GROUND_M = 30.0  # ground farther than this from all elements of the old map is new
# A view of an element is a frame that has the element in range. A share of views is computed as if
# this many further views were against the change.
_PRIOR_VIEWS = 2.0
_MAP_SIGMA_M = 0.2  # standard deviation of the error of the old map, common to all frames
_MIN_SIGMAS = 5.0  # a shift is significant if it is at least this many standard errors


@dataclass(frozen=True, eq=False)
class Pass:
    """A drive past a place.

    Args:
        drive: Frames of the drive with their predictions.
        elements: Map made from the drive, in metres in the global frame.
    """

    drive: Drive
    elements: MapElements


@dataclass(frozen=True, eq=False)
class Change:
    """An element, or a part of a line, that differs from the old map.

    Args:
        kind: ``removed``, ``added`` or ``moved``.
        label: Index of the class.
        line: Vertices in metres in the global frame, closed for areas. A removed element has its
            position in the old map, and others have their new position. (n, 2)
        confidence: Confidence that the change is real, in [0, 1].
        passes_in_view: Number of passes that have the element in view.
        num_passes: Number of the passes in view that agree with the change: they do not detect a
            removed element, or they detect an added or moved one.
        moved_m: Distance in metres by which a moved element moved, across a line or between the
            centres of an area; None for other kinds.
        moved_std_m: Standard error of this distance in metres; None for other kinds.
    """

    kind: str
    label: int
    line: FloatArray
    confidence: float
    passes_in_view: int
    num_passes: int
    moved_m: float | None = None
    moved_std_m: float | None = None


@dataclass(frozen=True, eq=False)
class Changes:
    """Changes of a place.

    Args:
        changes: The changes, sorted by class and then by kind.
        num_on_new_ground: Number of elements of the passes on ground that the old map does not
            cover, by class name. They do not count as changes.
        num_not_in_view: Number of elements of the old map that no pass has in view, by class name:
            lines without a point in view, and areas with less than 80 percent of their outline in
            view.
        num_too_small: Number of areas of the old map in view that enclose less than 1 square metre,
            by class name.
        num_of_absent_classes: Number of added elements of classes of which the old map has no
            element at all, by class name: it may just not record these classes.
    """

    changes: list[Change]
    num_on_new_ground: dict[str, int] = field(default_factory=dict)
    num_not_in_view: dict[str, int] = field(default_factory=dict)
    num_too_small: dict[str, int] = field(default_factory=dict)
    num_of_absent_classes: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Shift:
    """Mean distance between the new and the old position of an element.

    Args:
        mean_m: Weighted mean over the frames that detect the element, in metres.
        std_m: Standard error of the mean in metres: the larger one of two estimates, one from the
            variances of the frames, one from the scatter of their distances. Both estimates treat
            frames as independent.
    """

    mean_m: float
    std_m: float

    @classmethod
    def of_frames(
        cls, distances: FloatArray, variances: FloatArray, weights: FloatArray
    ) -> "Shift":
        """Compute the mean over frames and its error.

        Args:
            distances: Distance in each frame, in metres. (F,)
            variances: Variance of each distance in square metres. (F,)
            weights: Weight of each frame, such as its score over its variance. (F,)
        """
        shares = weights / weights.sum()
        mean_m = float(shares @ distances)
        # Variance of a weighted mean of independent values: sum of share^2 * variance.
        by_variances = float(shares**2 @ variances)
        # Each squared deviation from the mean estimates the variance of its frame.
        by_scatter = float(shares**2 @ (distances - mean_m) ** 2)
        return cls(mean_m, std_m=max(by_variances, by_scatter) ** 0.5)

    def exceeds(self, smallest_m: float) -> bool:
        """Whether the shift is at least ``smallest_m`` and at least five standard errors."""
        return abs(self.mean_m) >= max(smallest_m, _MIN_SIGMAS * self.std_m)

    def probability(self, smallest_m: float) -> float:
        """Probability that the shift exceeds ``smallest_m``.

        The errors of the shift and of the old map are taken to be normally distributed. The error
        of the old map is not part of ``std_m``, since it is common to all frames.
        """
        sigma = float(np.hypot(self.std_m, _MAP_SIGMA_M))
        return float(ndtr((abs(self.mean_m) - smallest_m) / sigma))


def smooth_share(support: float, views: float) -> float:
    """Share of the frames that support a change, as if two more frames were against it.

    The two frames keep the share low if few frames have the element in view.

    Args:
        support: Number of frames that support the change. A frame may count in part, by a score.
        views: Number of frames that have the element in view.

    Returns:
        ``support / (views + 2)``, clipped to [0, 1].
    """
    return float(np.clip(support / (views + _PRIOR_VIEWS), 0, 1))


def views_of_passes(points: FloatArray, passes: list[Pass]) -> IntArray:
    """Count the frames of each pass that have points in range. (M, 2) -> (passes, M)"""
    if not len(points):
        return np.zeros((len(passes), 0), np.int64)
    counts = []  # for each pass, the number of frames that have each point in range. (M,) each
    for one_pass in passes:
        counts.append(one_pass.drive.count_frames_in_range(points))
    return np.stack(counts)


def near_lines(points: FloatArray, lines: list[FloatArray], within_m: float) -> BoolArray:
    """Find the points near any line.

    Args:
        points: Points in metres. (M, 2)
        lines: Vertices of lines or rings in metres. N x (n, >= 2)
        within_m: Largest distance in metres.

    Returns:
        True for points within the distance. (M,)
    """
    shapes = []
    for line in lines:
        if len(line) > 1:  # shapely makes no line of a single vertex
            shapes.append(shapely.LineString(line[:, :2]))
    is_near = np.zeros(len(points), dtype=np.bool_)
    if shapes and len(points):
        tree = shapely.STRtree(shapes)
        pairs = tree.query(shapely.points(points), predicate="dwithin", distance=within_m)
        point_indices, _ = pairs  # rows: indices of points, indices of shapes
        is_near[point_indices] = True
    return is_near


def on_known_ground(points: FloatArray, old: MapElements) -> BoolArray:
    """Find the points within 30 m of an element of the old map. (M, 2) -> (M,)"""
    return near_lines(points, old.polylines, within_m=_NEW_GROUND_M)
