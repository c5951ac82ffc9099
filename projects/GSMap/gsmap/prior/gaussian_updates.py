"""Measurements of stored Gaussians by the lines of a frame, and their Kalman update.

The Gaussians of a prior lie along the lines of its map. A predicted line of a new frame measures
how far a Gaussian is from it.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsmap.prior.gaussian_rule import GaussianRule
from gsmap.prior.inputs import PlanarPose
from gsmap.structures.elements import FloatArray, IntArray, MapElements
from gsmap.structures.gaussians import Gaussians, extents_along_line
from gsmap.structures.polylines import arc_lengths

REACH_M = 1.5
"""Largest distance in metres of a line from a Gaussian that it measures, as in ``build_map``."""
# Smallest cosine between the directions of a Gaussian and of a line that measures it.
_LEAST_COSINE = np.cos(np.radians(30.0))
_SIGMA_PER_M = 0.02  # standard deviation per metre of distance from the vehicle
# No Gaussian is added nearer to another one, along a line, than this share of the spacing.
_COVERED = 0.75
_ROUNDING_M = 1e-3  # tolerance at the ends of a line, for the rounding of stored positions


@dataclass(frozen=True, eq=False)
class LineSamples:
    """Points along the lines of one class of a frame, in the global frame.

    Args:
        points: Points in metres; point i and point i + 1 are the ends of a segment unless i is the
            last point of a line. (M, 2)
        variances: Variance of each point across its line, in square metres. (M,)
        scores: Score of the line of each point, in [0, 1]. (M,)
        starts: Indices of the first ends of the segments. (S,)
        angles: Direction of the line at each point in radians, anticlockwise from +x. (M,)
    """

    points: FloatArray
    variances: FloatArray
    scores: FloatArray
    starts: IntArray
    angles: FloatArray


class Measurements(NamedTuple):
    """Distances of Gaussians from the nearest line of a frame, one for each Gaussian.

    Attributes:
        is_found: Whether a line crosses the normal of the Gaussian within reach. (N,)
        distances: Distance to this line along the normal in metres, positive on the left. (N,)
        variances: Variance of the distance in square metres. (N,)
        turns: Angle from the Gaussian to the line, in radians within 30 degrees. (N,)
        scores: Score of the line, in [0, 1]; 0 without a line. (N,)
    """

    is_found: NDArray[np.bool_]
    distances: FloatArray
    variances: FloatArray
    turns: FloatArray
    scores: FloatArray


def sample_lines(
    elements: MapElements, label: int, pose: PlanarPose, rule: GaussianRule
) -> LineSamples:
    """Sample the lines of one class at equal steps.

    The variance of a vertex across its line is the variance of its Gaussian, or of the rule, plus
    (0.02 d)^2 at the distance d from the vehicle.

    Args:
        elements: Predictions in metres in the frame of ``pose``.
        label: Index of the class.
        pose: Position and yaw of the frame.
        rule: Distance of the points, and variance of predictions without Gaussians.

    Returns:
        Points and segments of all lines of the class. A line without length is left out.
    """
    chosen = elements.select(elements.labels == label).with_coordinates(2)
    # Each list starts with an empty array, so that it can be concatenated without any line.
    points = [np.zeros((0, 2))]
    variances = [np.zeros(0)]
    scores = [np.zeros(0)]
    angles = [np.zeros(0)]
    starts = [np.zeros(0, np.int64)]
    num_points = 0
    vertex_variances = _vertex_variances(chosen, rule)
    for index, (line, _, score) in enumerate(chosen.rows):
        # Distance from the first vertex to each vertex along the line.
        along = arc_lengths(line) if len(line) > 1 else np.zeros(1)
        if along[-1] <= 0.0:  # a line without length has no direction
            continue
        count = max(2, int(np.ceil(along[-1] / rule.spacing_m)) + 1)
        positions = np.linspace(0.0, along[-1], count)
        local_x = np.interp(positions, along, line[:, 0])
        local_y = np.interp(positions, along, line[:, 1])
        local = np.stack([local_x, local_y], axis=1)
        vertices = slice(chosen.offsets[index], chosen.offsets[index + 1])
        distance_variances = (_SIGMA_PER_M * np.linalg.norm(local, axis=1)) ** 2
        in_global = pose.to_global(local)
        steps = np.gradient(in_global, axis=0)
        points.append(in_global)
        line_variances = np.interp(positions, along, vertex_variances[vertices])
        variances.append(line_variances + distance_variances)
        scores.append(np.full(count, score))
        angles.append(np.arctan2(steps[:, 1], steps[:, 0]))
        starts.append(num_points + np.arange(count - 1))  # all points but the last of the line
        num_points += count
    return LineSamples(
        points=np.concatenate(points),
        variances=np.concatenate(variances),
        scores=np.concatenate(scores),
        starts=np.concatenate(starts),
        angles=np.concatenate(angles),
    )


def _vertex_variances(elements: MapElements, rule: GaussianRule) -> FloatArray:
    """Variance of each vertex across its line, in square metres. (M,)"""
    variances = np.full(len(elements.points), rule.sigma_m**2)
    if elements.scales is None or elements.rotations is None:
        return variances
    for start, end in zip(elements.offsets[:-1], elements.offsets[1:], strict=True):
        if end - start > 1:
            gaussians = Gaussians(
                torch.from_numpy(elements.points[start:end]),
                scales=torch.from_numpy(elements.scales[start:end]),
                rotations=torch.from_numpy(elements.rotations[start:end]),
            )
            variances[start:end] = extents_along_line(gaussians)[:, 1].numpy() ** 2
    return variances


def measure(means: FloatArray, angles: FloatArray, lines: LineSamples) -> Measurements:
    """Measure Gaussians by the nearest line that crosses their normals.

    A line counts if it crosses the normal within 1.5 m at an angle of at most 30 degrees from the
    direction of the Gaussian.

    Args:
        means: Centres of the Gaussians in metres. (N, 2)
        angles: Directions of their lines in radians. (N,)
        lines: Lines of the frame.

    Returns:
        A measurement for each Gaussian. Without a line, its variance is 1 and has no meaning.
    """
    count = len(means)
    measurements = Measurements(
        is_found=np.zeros(count, dtype=np.bool_),
        distances=np.zeros(count),
        variances=np.ones(count),  # not 0, because `fuse_across` divides by them
        turns=np.zeros(count),
        scores=np.zeros(count),
    )
    if not count or not len(lines.starts):
        return measurements
    start_points = lines.points[lines.starts]
    end_points = lines.points[lines.starts + 1]
    lengths = np.linalg.norm(end_points - start_points, axis=1)
    # If a segment crosses a normal within reach, its middle is within this radius of the Gaussian.
    radius_m = REACH_M + lengths.max() / 2 + _ROUNDING_M
    rows, segments = _near_pairs(means, (start_points + end_points) / 2, radius_m=radius_m)
    # Ends of each segment, along and across the Gaussian of its pair.
    starts = _offsets(start_points[segments], means[rows], angles=angles[rows])
    ends = _offsets(end_points[segments], means[rows], angles=angles[rows])
    extent, rise = (ends - starts).T  # of each segment along and across the Gaussian
    start_along, start_across = starts.T
    end_along = ends[:, 0]
    # The segment crosses the normal, where `along` is 0, at this share of its length. A segment
    # that is parallel to the normal has extent 0, and its share is 0.
    fraction = -start_along / np.where(extent == 0, np.inf, extent)
    distances = start_across + fraction * rise
    # The ends of the segment lie on different sides of the normal, or on it.
    begins_before = np.minimum(start_along, end_along) <= _ROUNDING_M
    ends_behind = np.maximum(start_along, end_along) >= -_ROUNDING_M
    crosses = begins_before & ends_behind
    is_match = crosses & (np.abs(distances) <= REACH_M) & (lengths[segments] > 0)
    # The extent of a segment is its length times the cosine of its angle to the Gaussian.
    is_match &= np.abs(extent) >= _LEAST_COSINE * lengths[segments]
    matches = np.flatnonzero(is_match)
    # Sort by Gaussian, distance and segment, so that the first match of a Gaussian is its best one.
    order = np.lexsort((segments[matches], np.abs(distances[matches]), rows[matches]))
    matches = matches[order]
    index, first = np.unique(rows[matches], return_index=True)
    best = matches[first]
    start_indices = lines.starts[segments[best]]  # of the points at which the best segments start
    start_variances = lines.variances[start_indices]
    end_variances = lines.variances[start_indices + 1]
    best_variances = start_variances + fraction[best] * (end_variances - start_variances)
    measurements.is_found[index] = True
    measurements.distances[index] = distances[best]
    measurements.turns[index] = np.arctan(rise[best] / extent[best])
    measurements.scores[index] = lines.scores[start_indices]
    measurements.variances[index] = best_variances
    return measurements


def _near_pairs(
    first: FloatArray, second: FloatArray, radius_m: float
) -> tuple[IntArray, IntArray]:
    """Find the pairs of points within a radius, and return the indices of both points of each pair.

    Points (N, 2) and (M, 2) -> indices (pairs,) and (pairs,)
    """
    pairs = cKDTree(first).sparse_distance_matrix(cKDTree(second), radius_m, output_type="ndarray")
    return pairs["i"], pairs["j"]


def _offsets(points: FloatArray, means: FloatArray, angles: FloatArray) -> FloatArray:
    """Coordinates of each point along and across the Gaussian of equal index, in metres. (n, 2)"""
    x, y = (points - means).T
    cos = np.cos(angles)
    sin = np.sin(angles)
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)


def find_covered_points(
    means: FloatArray, angles: FloatArray, lines: LineSamples, spacing_m: float
) -> NDArray[np.bool_]:
    """Find the points of lines that a Gaussian already describes.

    New Gaussians are only added at the other points.

    Args:
        means: Centres of the Gaussians in metres. (N, 2)
        angles: Directions of their lines in radians. (N,)
        lines: Lines of the frame. M points
        spacing_m: Distance of Gaussians along a line in metres.

    Returns:
        Whether a Gaussian of about the direction of the line is within reach. (M,)
    """
    is_covered = np.zeros(len(lines.points), dtype=np.bool_)
    if not len(means) or not len(lines.points):
        return is_covered
    most_along_m = _COVERED * spacing_m
    radius_m = float(np.hypot(most_along_m, REACH_M))
    point_indices, rows = _near_pairs(lines.points, means, radius_m=radius_m)
    offsets = np.abs(_offsets(lines.points[point_indices], means[rows], angles=angles[rows]))
    cosine = np.abs(np.cos(lines.angles[point_indices] - angles[rows]))
    is_near = (offsets[:, 0] <= most_along_m) & (offsets[:, 1] <= REACH_M)
    is_parallel = cosine >= _LEAST_COSINE
    is_covered[point_indices[is_near & is_parallel]] = True
    return is_covered


def fuse_across(
    variances: FloatArray, found: Measurements, decay: float, least_variance: float
) -> tuple[FloatArray, FloatArray]:
    r"""Multiply Gaussians with their measurements, in information form.

    A line with normal n measures only the position across the line, with the variance
    :math:`\sigma_m^2`. Its information is :math:`n n^T / \sigma_m^2`. The variance of the Gaussian
    across the line becomes :math:`1 / (\lambda / \sigma^2 + 1 / \sigma_m^2)` with the decay
    :math:`\lambda`, and its centre moves by the gain :math:`\sigma_{new}^2 / \sigma_m^2` times the
    distance. The least variance limits only the new variance, not the gain. A Gaussian without a
    measurement does not change.

    Args:
        variances: Variances of the Gaussians across their lines, in square metres. (N,)
        found: Measurement of each Gaussian.
        decay: Factor of the older information, in (0, 1].
        least_variance: Smallest new variance in square metres.

    Returns:
        New variances in square metres (N,), and gains in [0, 1], 0 without a measurement (N,).
    """
    stored_information = decay / variances
    measured_information = found.is_found / found.variances  # 0 without a measurement
    fused_variances = 1.0 / (stored_information + measured_information)
    gains = fused_variances * measured_information
    limited_variances = np.maximum(fused_variances, least_variance)
    new_variances = np.where(found.is_found, limited_variances, variances)
    return new_variances, gains
