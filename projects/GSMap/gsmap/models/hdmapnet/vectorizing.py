"""HDMapNet's vectorisation: lines from maps of classes, instance embeddings and directions.

Li et al., "HDMapNet: An Online HD Map Construction and Evaluation Framework", ICRA 2022, III-D.
Pixels are (column, row) here.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numba import njit
from torch import Tensor, from_numpy

import gsmap.utils.compilation  # noqa: F401 - prints a notice when kernels are compiled
from gsmap.models.hdmapnet.clustering import dense_clusters
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.utils.errors import InputError
from gsmap.utils.settings import check_positive

Float32 = np.float32  # type of the released code, whose comparisons depend on its rounding
NONE = -1  # no direction


@dataclass(frozen=True)
class VectorizeConfig:
    """Settings of `vectorize`, by default as in the released code.

    Args:
        min_area_px: Largest area of the components of a class that are removed, in pixels, >= 0.
        eps: Largest distance of two neighbours in the standardised embedding space.
        min_neighbours: Smallest number of neighbours of a cluster's core pixel, itself included.
        ridge_tolerance: Bound of the difference between the probability of a ridge pixel and the
            largest probability across the line.
        step_px: Length of a step along the direction, in pixels.
        jump_px: Largest distance of the next point from the end of a step, in pixels.
        degrees: Angle between neighbouring directions, in degrees.

    Raises:
        ValueError: If ``min_area_px`` is negative, or if another setting is not positive.
    """

    min_area_px: int = 100
    eps: float = 1.5
    min_neighbours: int = 50
    ridge_tolerance: float = 1e-4
    step_px: int = 7
    jump_px: float = 50.0
    degrees: int = 10

    def __post_init__(self) -> None:
        positive = dict(vars(self))
        del positive["min_area_px"]
        check_positive(**positive)
        if not self.min_area_px >= 0:
            raise InputError(f"min_area_px must not be negative, got {self.min_area_px}.")


class TracedLine(NamedTuple):
    """Line of pixels with its class and its score."""

    pixels: IntArray  # (column, row) from one end to the other (n, 2)
    label: int  # class index
    score: float  # mean probability of the pixels in [0, 1]


def vectorize(
    semantic: Tensor,
    embedding: Tensor,
    direction: Tensor,
    config: VectorizeConfig | None = None,
    choose_start: Callable[[int], int] | None = None,
) -> list[TracedLine]:
    """Trace lines in the outputs of a segmentation network.

    Args:
        semantic: Logits of the background and C classes. (1 + C, H, W)
        embedding: Instance embeddings, similar within an element. (E, H, W)
        direction: Logits of no direction and of K directions: direction k >= 1 points
            ``(k - 1) * degrees`` from +column towards +row. (1 + K, H, W)
        config: Settings, by default `VectorizeConfig()`.
        choose_start: Function from a number of points to the index of the point at which tracing
            starts. By default the first point, so that results are reproducible. The released code
            chooses at random: ``lambda count: random.randrange(count)``.

    Returns:
        Lines in the order of their labels 0 to C - 1.

    Raises:
        ValueError: If the sizes of the maps differ, if a value is not finite, or if there is no
            class in addition to the background.
    """
    config = config or VectorizeConfig()
    _check(semantic, embedding, direction=direction, config=config)
    probs = semantic.detach().cpu().float().softmax(dim=0).numpy()
    best = probs.argmax(axis=0)  # most probable class of each pixel, 0 for the background. (H, W)
    embeddings = embedding.detach().cpu().float().numpy()
    direction = direction.detach().cpu()
    directions = np.full((*best.shape, 2), fill_value=NONE)
    lines = []
    for label in range(1, len(probs)):
        mask = clean_mask(best == label, config.min_area_px)
        clusters = cluster_pixels(mask, embeddings, config=config)
        ridge = ridge_pixels(np.where(clusters > 0, probs[label], 0), config.ridge_tolerance)
        # Only ridge pixels can become points of lines, so other pixels need no directions.
        directions[ridge] = top_directions(direction[:, from_numpy(ridge)])
        for number in range(1, clusters.max() + 1):
            cluster = clusters == number
            points = order_by_distance(sort_along_longer_side(cluster, ridge))
            if not len(points):
                continue
            start = choose_start(len(points)) if choose_start else 0
            pixels = trace(points, directions, start=start, config=config)
            score = float(probs[label][cluster].mean())
            lines.append(TracedLine(pixels, label=label - 1, score=score))
    return lines


def elements_of_lines(
    lines: Sequence[TracedLine], first_m: tuple[float, float], pixel_m: tuple[float, float]
) -> MapElements:
    """Convert lines to elements in metres; lines of a single pixel are dropped.

    Args:
        lines: Lines from `vectorize`.
        first_m: Centre of pixel (0, 0), x and y in metres in the frame of the annotations.
        pixel_m: Increase of x from a column to the next, and of y from a row to the next, in
            metres; negative for a decrease.
    """
    polylines = []
    labels = []
    scores = []
    for line in lines:
        if len(line.pixels) > 1:
            polylines.append(np.array(first_m) + line.pixels * np.array(pixel_m))
            labels.append(line.label)
            scores.append(line.score)
    return MapElements.from_polylines(polylines, labels, scores=scores)


def _check(semantic: Tensor, embedding: Tensor, direction: Tensor, config: VectorizeConfig) -> None:
    """Raise ValueError if the maps do not fit each other or the settings."""
    maps = {"semantic": semantic, "embedding": embedding, "direction": direction}
    shapes = [tuple(values.shape) for values in maps.values()]
    if any(len(shape) != 3 or shape[1:] != shapes[0][1:] for shape in shapes):
        raise InputError(f"the maps must be (channels, H, W) of one size, got {shapes}.")
    if len(semantic) < 2:
        raise InputError("semantic needs the background and at least one class.")
    if (len(direction) - 1) * config.degrees != 360:
        raise InputError(
            f"direction has one channel for no direction and {len(direction) - 1} channels for "
            f"directions, which make no full circle in steps of {config.degrees} degrees."
        )
    not_finite = []
    for name, values in maps.items():
        bounds = torch.stack(values.aminmax())
        if not bounds.isfinite().all():
            not_finite.append(name)
    if not_finite:
        raise InputError(f"{' and '.join(not_finite)} have values that are not finite.")


def top_directions(direction: Tensor) -> IntArray:
    """Return the two most probable directions of each pixel that are not next to each other.

    The channels of the two differ by more than 2. As in the released code, the channel of no
    direction counts as the neighbour of direction 0, and directions K - 1 and 0 do not count as
    neighbours.

    Args:
        direction: Logits of no direction and of K directions. (1 + K, ...)

    Returns:
        Directions 0 to K - 1, or -1 for none. (..., 2)
    """
    probs = direction.detach().cpu().float().softmax(dim=0).numpy()
    first = probs.argmax(axis=0)
    numbers = np.arange(len(probs)).reshape((-1,) + (1,) * first.ndim)  # (1 + K, 1, ...)
    is_near = np.abs(numbers - first) <= 2
    second = np.where(is_near, 0, probs).argmax(axis=0)
    return np.stack([first, second], axis=-1) - 1


def clean_mask(mask: BoolArray, min_area_px: int) -> BoolArray:
    """Close the gaps of a class's mask, and remove its small components. (H, W) -> (H, W)"""
    ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, ksize=(5, 5))
    closed_mask = cv2.morphologyEx(mask.astype(np.uint8), op=cv2.MORPH_CLOSE, kernel=ellipse)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(closed_mask, connectivity=8)
    is_large = stats[:, cv2.CC_STAT_AREA] > min_area_px
    is_large[0] = False  # the background
    return is_large[labels]


def cluster_pixels(mask: BoolArray, embedding: FloatArray, config: VectorizeConfig) -> IntArray:
    """Cluster the pixels of a class by their standardised embeddings.

    Args:
        mask: Pixels of the class. (H, W)
        embedding: Instance embeddings. (E, H, W)
        config: Settings ``eps`` and ``min_neighbours`` of the clusters.

    Returns:
        Cluster number of each pixel, from 1 on in the order of the clusters' first core pixels, row
        by row; 0 for none. (H, W)
    """
    from sklearn.preprocessing import StandardScaler  # the import takes a second

    clusters = np.zeros(mask.shape, dtype=np.int64)
    if mask.any():
        scaled_embeddings = StandardScaler().fit_transform(embedding[:, mask].T).astype(np.float64)
        labels = dense_clusters(scaled_embeddings, config.eps, min_neighbours=config.min_neighbours)
        clusters[mask] = labels + 1
    return clusters


def ridge_pixels(probs: FloatArray, tolerance: float) -> BoolArray:
    """Find the pixels with the largest probability across their line.

    At a pixel, a line is vertical if the mean probability of the surrounding 9 rows and 5 columns
    exceeds the mean of 5 rows and 9 columns. A ridge pixel has the largest probability of 5 pixels,
    in its row if the line is vertical, otherwise in its column.

    Args:
        probs: Probability of a class, 0 outside its clusters. (H, W)
        tolerance: Largest difference of a ridge pixel from the largest probability.

    Returns:
        True for ridge pixels. (H, W)
    """
    return _ridge(probs.astype(Float32), np.argwhere(probs > 0), Float32(tolerance))


@njit(cache=True)
def _ridge(probs: FloatArray, pixels: IntArray, tolerance: Float32) -> BoolArray:
    """Test candidate pixels (row, column) (n, 2) for `ridge_pixels`. (H, W) -> (H, W)"""
    ridge = np.zeros(probs.shape, np.bool_)
    for i in range(len(pixels)):
        row = pixels[i, 0]
        column = pixels[i, 1]
        if _mean(probs, row, column, 4, 2) > _mean(probs, row, column, 2, 4):
            largest = probs[row, max(column - 2, 0) : column + 3].max()
        else:
            largest = probs[max(row - 2, 0) : row + 3, column].max()
        ridge[row, column] = largest - probs[row, column] < tolerance
    return ridge


@njit(cache=True)
def _mean(values: FloatArray, row: int, column: int, num_rows: int, num_columns: int) -> Float32:
    """Average the values around a pixel, with zeros beyond the map.

    There are ``num_rows`` rows on each side of the pixel's row, and ``num_columns`` columns on each
    side of its column. The sum is computed in the order of the released code.
    """
    total = Float32(0)
    for i in range(max(row - num_rows, 0), min(row + num_rows + 1, values.shape[0])):
        for j in range(
            max(column - num_columns, 0), min(column + num_columns + 1, values.shape[1])
        ):
            total += values[i, j]
    return total / Float32((2 * num_rows + 1) * (2 * num_columns + 1))


def sort_along_longer_side(cluster: BoolArray, ridge: BoolArray) -> IntArray:
    """Sort the ridge pixels of a cluster along its longer side.

    Args:
        cluster: Pixels of the cluster. (H, W)
        ridge: Ridge pixels of the class. (H, W)

    Returns:
        Pixels (column, row). (n, 2)
    """
    cluster_rows, cluster_columns = np.nonzero(cluster)
    is_wide = np.ptp(cluster_columns) > np.ptp(cluster_rows)
    rows, columns = np.nonzero(cluster & ridge)
    order = np.argsort(columns if is_wide else rows, kind="stable")
    return np.stack([columns, rows], axis=1)[order]


def order_by_distance(points: IntArray) -> IntArray:
    """Order points greedily: the first point is followed by its nearest point, and so on.

    A point that is more than 3 px from its predecessor, but less than 5 px from one of the ordered
    points, is dropped, because its section is already covered. (The predecessor is also one of the
    ordered points, so a gap between 3 and 5 px always drops the point.) After nine tenths of the
    points, a gap of more than 10 px ends the line.

    Args:
        points: Pixels. (n, 2)

    Returns:
        Remaining points in order. (m, 2)
    """
    return points[_order(points)] if len(points) else points


@njit(cache=True)
def _order(points: IntArray) -> IntArray:
    """Return the indices of the remaining points of `order_by_distance`. (n, 2) -> (m,)"""
    is_free = np.ones(len(points), np.bool_)
    is_free[0] = False
    order = np.zeros(len(points), np.int64)
    count = 1
    for step in range(len(points) - 1):
        nearest = -1
        squared_gap = 0
        for i in range(len(points)):
            if is_free[i]:
                distance = _squared_distance(points[i], points[order[count - 1]])
                if nearest < 0 or distance < squared_gap:
                    nearest = i
                    squared_gap = distance
        is_free[nearest] = False
        is_covered = False
        if squared_gap > 3**2:
            for i in order[:count]:
                is_covered |= _squared_distance(points[i], points[nearest]) < 5**2
        if is_covered:
            continue
        if squared_gap > 10**2 and step > 0.9 * len(points):
            break
        order[count] = nearest
        count += 1
    return order[:count]


@njit(cache=True)
def _squared_distance(point: IntArray, other: IntArray) -> int:
    """Return the squared distance of two pixels. (2,) each"""
    return int((point[0] - other[0]) ** 2 + (point[1] - other[1]) ** 2)


def trace(points: IntArray, directions: IntArray, start: int, config: VectorizeConfig) -> IntArray:
    """Follow the directions from a point to both ends of its line.

    Args:
        points: Pixels of the line. (n, 2)
        directions: Two directions of each pixel of the map, -1 for none. (H, W, 2)
        start: Index of the first point.
        config: Settings ``step_px``, ``jump_px`` and ``degrees``.

    Returns:
        Pixels from one end to the other. (m, 2)
    """
    is_used = np.zeros(directions.shape, dtype=bool)  # directions that need not be followed again
    line = [points[start]]
    line.extend(_walk(line[-1], points, directions, is_used=is_used, config=config))
    # The last point is now the start. The second walk begins there, in its other direction, because
    # the first walk has marked one direction as used.
    line.reverse()
    line.extend(_walk(line[-1], points, directions, is_used=is_used, config=config))
    return np.stack(line)


def _walk(
    last: IntArray,
    points: IntArray,
    directions: IntArray,
    is_used: BoolArray,
    config: VectorizeConfig,
) -> Iterator[IntArray]:
    """Yield the points that follow a point, and mark their directions as used in ``is_used``."""
    remaining = points
    while True:
        # Each round uses up a direction of the last point, with or without a step to a new point.
        column, row = last
        free = np.flatnonzero(~is_used[row, column])
        if not len(free):  # both directions are used
            return
        first_free = free[0]
        is_used[row, column, first_free] = True
        direction = directions[row, column, first_free]
        if direction == NONE:
            continue
        # Points near the line are left out for good: the line does not turn back to them.
        remaining = remaining[_distances(remaining, last) > config.step_px - 1]
        if not len(remaining):
            return
        # The released code computes the step in float32, which decides between pixels at equal
        # distances.
        angle = np.deg2rad(Float32(config.degrees * direction))
        step = Float32(config.step_px) * np.array([np.cos(angle), np.sin(angle)])
        distances = _distances(remaining, last + step)
        nearest = distances.argmin()
        if distances[nearest] > config.jump_px:
            continue
        # One direction of the new point leads back to the previous point, and must not be followed.
        back = last - remaining[nearest]
        last = remaining[nearest]
        column, row = last
        back_angle = np.rad2deg(np.arctan2(back[1], back[0])) % 360
        # As in the released code, a missing direction is a candidate for the way back, too. Its
        # number -1 becomes the angle -degrees, so `turn` may exceed 360 and 360 - turn be negative.
        turn = np.abs(config.degrees * directions[row, column] - back_angle)
        back_way = np.minimum(turn, 360 - turn).argmin()
        is_used[row, column, back_way] = True
        yield last  # pixel (column, row)


def _distances(points: IntArray, point: FloatArray | IntArray) -> FloatArray:
    """Return the distances of points (n, 2) from one point (2,). (n,)"""
    offsets = points - point
    return np.hypot(offsets[:, 0], offsets[:, 1])
