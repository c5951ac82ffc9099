"""HDMapNet's vectorising: lines from maps of classes, instance embeddings and directions.

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

import gsmap.utils.compilation  # noqa: F401 - says that kernels are compiled
from gsmap.models.hdmapnet.clustering import dense_clusters
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.utils.errors import InputError
from gsmap.utils.settings import check_positive

Float32 = np.float32
NONE = -1  # no direction


@dataclass(frozen=True)
class VectorizeConfig:
    """What decides about lines; the defaults are the release's.

    Args:
        min_area_px: Components of a class that are not larger are left out, in pixels.
        eps: Largest distance of neighbours in the standardised embedding space.
        min_neighbours: Neighbours that make a pixel the core of a cluster, itself included.
        ridge_tolerance: What a ridge pixel may have less than the largest probability beside it.
        step_px: Length of a step along the direction, in pixels.
        jump_px: Largest distance of the next point from the end of a step, in pixels.
        degrees: Angle of one direction class, in degrees.
    """

    min_area_px: int = 100
    eps: float = 1.5
    min_neighbours: int = 50
    ridge_tolerance: float = 1e-4
    step_px: int = 7
    jump_px: float = 50.0
    degrees: int = 10

    def __post_init__(self) -> None:
        check_positive(
            **{name: value for name, value in vars(self).items() if name != "min_area_px"}
        )
        if not self.min_area_px >= 0:
            raise InputError(f"min_area_px must not be negative, got {self.min_area_px}.")


class TracedLine(NamedTuple):
    """A line: pixels (column, row) (n, 2) in order, class, and mean probability of its pixels."""

    pixels: IntArray
    label: int
    score: float


def vectorize(
    semantic: Tensor,
    embedding: Tensor,
    direction: Tensor,
    config: VectorizeConfig | None = None,
    choose_start: Callable[[int], int] | None = None,
) -> list[TracedLine]:
    """Turn the outputs of a segmentation network into lines.

    Args:
        semantic: Logits of the background and C classes. (1 + C, H, W)
        embedding: Pixels of one element have similar embeddings. (E, H, W)
        direction: Logits of no direction and of K directions: direction k >= 1 points
            ``(k - 1) * degrees`` from +column towards +row. (1 + K, H, W)
        config: What decides about lines.
        choose_start: Takes a number of points and returns the one that a line is traced from.
            None: the first, so that the same maps give the same lines. The release takes one by
            chance: ``lambda count: random.randrange(count)``.

    Returns:
        The lines, class after class; labels are 0 to C - 1.

    Raises:
        ValueError: If the maps have other sizes or values that are not finite, or there is no class
            beside the background.
    """
    config = config or VectorizeConfig()
    _check(semantic, embedding, direction, config)
    probs = semantic.detach().cpu().float().softmax(0).numpy()
    best = probs.argmax(0)
    embeddings = embedding.detach().cpu().float().numpy()
    direction = direction.detach().cpu()
    directions = np.full((*best.shape, 2), NONE)
    lines = []
    for label in range(1, len(probs)):
        mask = clean_mask(best == label, config.min_area_px)
        clusters = cluster_pixels(mask, embeddings, config)
        ridge = ridge_pixels(np.where(clusters > 0, probs[label], 0), config.ridge_tolerance)
        directions[ridge] = top_directions(direction[:, from_numpy(ridge)])
        for number in range(1, clusters.max() + 1):
            own = clusters == number
            points = order_by_distance(along_longer_side(own, ridge))
            if len(points):
                start = choose_start(len(points)) if choose_start else 0
                pixels = trace(points, directions, start, config)
                lines.append(TracedLine(pixels, label - 1, float(probs[label][own].mean())))
    return lines


def elements_of_lines(
    lines: Sequence[TracedLine], first_m: tuple[float, float], pixel_m: tuple[float, float]
) -> MapElements:
    """Return lines in metres, as metrics and results files take them; single pixels are left out.

    Args:
        lines: From `vectorize`.
        first_m: Centre of pixel (0, 0), x and y in metres in the frame of the annotations.
        pixel_m: What x grows with a column, and y with a row, in metres; negative if it falls.
    """
    lines = [line for line in lines if len(line.pixels) > 1]
    points = [np.array(first_m) + line.pixels * np.array(pixel_m) for line in lines]
    labels, scores = [line.label for line in lines], [line.score for line in lines]
    return MapElements.from_polylines(points, labels, scores)


def _check(semantic: Tensor, embedding: Tensor, direction: Tensor, config: VectorizeConfig) -> None:
    """Check the shapes of the maps."""
    shapes = [tuple(values.shape) for values in (semantic, embedding, direction)]
    if any(len(shape) != 3 or shape[1:] != shapes[0][1:] for shape in shapes):
        raise InputError(f"the maps must be (channels, H, W) of one size, got {shapes}.")
    if len(semantic) < 2:
        raise InputError("semantic needs the background and at least one class.")
    if (len(direction) - 1) * config.degrees != 360:
        raise InputError(
            f"{len(direction)} channels of direction are none and {len(direction) - 1} directions, "
            f"which make no circle in steps of {config.degrees} degrees."
        )
    named = {"semantic": semantic, "embedding": embedding, "direction": direction}
    broken = [
        name for name, values in named.items() if not torch.stack(values.aminmax()).isfinite().all()
    ]
    if broken:
        raise InputError(f"{' and '.join(broken)} have values that are not finite.")


def top_directions(direction: Tensor) -> IntArray:
    """Return two directions of each pixel: the best, and the best that is not beside it.

    Args:
        direction: Logits of no direction and of K directions. (1 + K, ...)

    Returns:
        Directions 0 to K - 1, or -1 for none. The two before and after the best are left out for
        the second, and as in the release K - 1 and 0 do not count as neighbours. (..., 2)
    """
    probs = direction.detach().cpu().float().softmax(0).numpy()
    first = probs.argmax(0)
    numbers = np.arange(len(probs)).reshape(-1, *[1] * first.ndim)
    beside = np.abs(numbers - first) <= 2
    second = np.where(beside, 0, probs).argmax(0)
    return np.stack([first, second], axis=-1) - 1


def clean_mask(mask: BoolArray, min_area_px: int) -> BoolArray:
    """Close the gaps of a class's mask, and remove its small components. (H, W) -> (H, W)"""
    ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, ellipse)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] > min_area_px
    large[0] = False  # the background
    return large[labels]


def cluster_pixels(mask: BoolArray, embedding: FloatArray, config: VectorizeConfig) -> IntArray:
    """Cluster the pixels of a class by their embeddings, scaled to mean 0 and deviation 1.

    Args:
        mask: Its pixels. (H, W)
        embedding: Of all pixels. (E, H, W)
        config: Distance and neighbours of a cluster.

    Returns:
        Number of each pixel's cluster, from 1 on in the order of rows; 0 for none. (H, W)
    """
    from sklearn.preprocessing import StandardScaler  # takes a second

    clusters = np.zeros(mask.shape, dtype=np.int64)
    if mask.any():
        scaled = StandardScaler().fit_transform(embedding[:, mask].T)
        found = dense_clusters(scaled.astype(np.float64), config.eps, config.min_neighbours)
        clusters[mask] = found + 1
    return clusters


def ridge_pixels(probs: FloatArray, tolerance: float) -> BoolArray:
    """Return which pixels are the most probable ones across their line.

    A line is upright where the mean over 9 rows and 5 columns is more than that over 5 rows and 9
    columns; then a pixel must be the largest of 5 in its row, else of 5 in its column.

    Args:
        probs: Probability of a class, 0 outside its clusters. (H, W)
        tolerance: What a pixel may have less than the largest.
    """
    return _ridge(probs.astype(Float32), np.argwhere(probs > 0), Float32(tolerance))


@njit(cache=True)
def _ridge(probs: FloatArray, pixels: IntArray, tolerance: Float32) -> BoolArray:
    """Return which of some pixels (row, column) (n, 2) are on a ridge. (H, W) -> (H, W)"""
    ridge = np.zeros(probs.shape, np.bool_)
    for i in range(len(pixels)):
        row, column = pixels[i, 0], pixels[i, 1]
        if _mean(probs, row, column, 4, 2) > _mean(probs, row, column, 2, 4):
            largest = probs[row, max(column - 2, 0) : column + 3].max()
        else:
            largest = probs[max(row - 2, 0) : row + 3, column].max()
        ridge[row, column] = largest - probs[row, column] < tolerance
    return ridge


@njit(cache=True)
def _mean(values: FloatArray, row: int, column: int, down: int, aside: int) -> Float32:
    """Return the mean around a pixel, with zeros beyond the map; summed as the release does."""
    total = Float32(0)
    for i in range(max(row - down, 0), min(row + down + 1, values.shape[0])):
        for j in range(max(column - aside, 0), min(column + aside + 1, values.shape[1])):
            total += values[i, j]
    return total / Float32((2 * down + 1) * (2 * aside + 1))


def along_longer_side(cluster: BoolArray, ridge: BoolArray) -> IntArray:
    """Return the ridge pixels of a cluster, sorted along its longer side. (H, W) -> (n, 2)"""
    extent = [np.ptp(found) for found in np.nonzero(cluster)]  # rows, columns
    rows, columns = np.nonzero(cluster & ridge)
    order = np.argsort(columns if extent[1] > extent[0] else rows, kind="stable")
    return np.stack([columns, rows], axis=1)[order]


def order_by_distance(points: IntArray) -> IntArray:
    """Order points from nearest to nearest, beginning with the first.

    A point that is more than 3 px from the last, but within 5 px of an earlier one, is left out: it
    belongs to a place that has been passed. When nine tenths are done, a gap of 10 px is the end.

    Args:
        points: Pixels. (n, 2)

    Returns:
        The points that are kept, in order. (m, 2)
    """
    return points[_order(points)] if len(points) else points


@njit(cache=True)
def _order(points: IntArray) -> IntArray:
    """Return which points are kept, in order: saturated maps have thousands. (n, 2) -> (m,)"""
    left, chosen, kept = np.ones(len(points), np.bool_), np.zeros(len(points), np.int64), 1
    left[0] = False
    for step in range(len(points) - 1):
        nearest, gap = -1, 0
        for i in range(len(points)):
            if left[i]:
                apart = _squared_distance(points[i], points[chosen[kept - 1]])
                if nearest < 0 or apart < gap:
                    nearest, gap = i, apart
        left[nearest] = False
        passed = False
        if gap > 3**2:
            for i in chosen[:kept]:
                passed |= _squared_distance(points[i], points[nearest]) < 5**2
        if passed:
            continue
        if gap > 10**2 and step > 0.9 * len(points):
            break
        chosen[kept] = nearest
        kept += 1
    return chosen[:kept]


@njit(cache=True)
def _squared_distance(point: IntArray, other: IntArray) -> int:
    """Return the squared distance of two pixels. (2,) each"""
    return int((point[0] - other[0]) ** 2 + (point[1] - other[1]) ** 2)


def trace(points: IntArray, directions: IntArray, start: int, config: VectorizeConfig) -> IntArray:
    """Follow the directions from a point to both ends of its line.

    Args:
        points: Pixels of the line. (n, 2)
        directions: Two directions of each pixel of the map, -1 for none. (H, W, 2)
        start: Which point is the first.
        config: Length of a step, largest jump.

    Returns:
        Pixels from one end to the other. (m, 2)
    """
    used = np.zeros(directions.shape, dtype=bool)
    line = [points[start]]
    for _ in range(2):
        line.extend(_walk(line[-1], points, directions, used, config))
        line.reverse()
    return np.stack(line[::-1])


def _walk(
    last: IntArray, points: IntArray, directions: IntArray, used: BoolArray, config: VectorizeConfig
) -> Iterator[IntArray]:
    """Yield the points after the last one; marks the directions that are used."""
    while True:
        column, row = last
        free = np.flatnonzero(~used[row, column])
        if not len(free):
            return
        used[row, column, free[0]] = True
        taken = directions[row, column, free[0]]
        if taken == NONE:
            continue
        points = points[np.hypot(*(points - last).T) > config.step_px - 1]
        if not len(points):
            return
        angle = np.deg2rad(Float32(config.degrees * taken))  # float32 decides between equal pixels
        step = Float32(config.step_px) * np.array([np.cos(angle), np.sin(angle)])
        distances = np.hypot(*(points - (last + step)).T)
        nearest = distances.argmin()
        if distances[nearest] > config.jump_px:
            continue
        last, back = points[nearest], last - points[nearest]
        column, row = last
        angle = np.rad2deg(np.arctan2(back[1], back[0])) % 360
        turn = np.abs(config.degrees * directions[row, column] - angle)
        used[row, column, np.minimum(turn, 360 - turn).argmin()] = True  # the way back
        yield last
