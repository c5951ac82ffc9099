"""Kalman update of predicted lines by known lines, the lines of previous frames.

The points of both kinds of lines are Gaussians.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from gsmap.structures.gaussians import Gaussians, covariances, with_covariances

# Smallest divisor, in square metres. With it, a segment of length 0 has the share 0 and not NaN.
_MIN_SQUARED_LENGTH = 1e-9


class LinePlaces(NamedTuple):
    """For each point of an element, the nearest place on a line, for K pairs of element and line.

    Attributes:
        distances: Distance of each point from its place, in metres. (K, P)
        segments: Index of the segment of the line on which the place lies. (K, P)
        shares: Position of the place on its segment, in [0, 1]. (K, P)
        beside: Whether the point lies beside the line, which means that it is not beyond one of the
            ends. (K, P)
    """

    distances: Tensor
    segments: Tensor
    shares: Tensor
    beside: Tensor


def nearest_places(points: Tensor, lines: Tensor) -> LinePlaces:
    """Find the nearest place on a line for each point of an element, in K pairs of both.

    A line is a chain of straight segments between its vertices.

    Args:
        points: Points of the element of each pair, in metres. (K, P, 2)
        lines: Vertices of the line of each pair, in metres. (K, Q, 2)

    Returns:
        Nearest places. (K, P)
    """
    points = points.mT.contiguous()  # (K, 2, P), with the longest axis last
    lines = lines.mT.contiguous()  # (K, 2, Q)
    starts = lines[:, :, None, :-1]
    steps = lines.diff(dim=-1)[:, :, None]
    offsets = points[..., None] - starts  # (K, 2, P, Q - 1)
    shares = (offsets * steps).sum(1) / steps.square().sum(1).clamp(min=_MIN_SQUARED_LENGTH)
    clamped = shares.clamp(0.0, 1.0)
    squared = (offsets - clamped[:, None] * steps).square().sum(1)  # (K, P, Q - 1)
    squares, segments = squared.min(-1)
    # `share` is the unlimited position on the nearest segment: < 0 before its start, > 1 behind its
    # end. Only the first and the last segment have no neighbour there.
    share = shares.gather(-1, segments[..., None])[..., 0]
    clamped = clamped.gather(-1, segments[..., None])[..., 0]
    before = (segments == 0) & (share < 0)
    behind = (segments == lines.shape[-1] - 2) & (share > 1)
    return LinePlaces(squares.sqrt(), segments, shares=clamped, beside=~(before | behind))


def _candidate_pairs(
    now: Gaussians, labels: Tensor, known: Gaussians, known_labels: Tensor, gate_m: float
) -> tuple[Tensor, ...]:
    """Find the pairs of one class whose bounding boxes are closer than ``gate_m``.

    Returns:
        Index of the element (K,) and of the known line (K,) of each pair.
    """
    # The gap along an axis is negative if the boxes overlap. The larger gap of both axes counts.
    low, high = now.means.aminmax(dim=1)
    known_low, known_high = known.means.aminmax(dim=1)
    gaps = torch.maximum(low[:, None] - known_high, known_low - high[:, None]).amax(-1)  # (N, M)
    is_pair = (labels[:, None] == known_labels) & (gaps < gate_m)
    return is_pair.nonzero(as_tuple=True)


def update_from_known_lines(
    now: Gaussians, labels: Tensor, known: Gaussians, known_labels: Tensor, gate_m: float
) -> Gaussians:
    r"""Update the Gaussians of elements by the known lines that they belong to.

    An element belongs to the nearest known line of its class, by the mean distance of the points
    that lie beside the line. The update moves a point across the line, but not along it, because
    the spacing of points differs between frames. With the normal n of the line at the nearest place
    c on the line, and the variance :math:`v = n^T \Sigma_c n` there, the Kalman update in this
    direction is

    .. math:: k = \Sigma n / (n^T \Sigma n + v), \quad \mu' = \mu + k\, n^T (c - \mu), \quad
              \Sigma' = \Sigma - k n^T \Sigma

    Args:
        now: Gaussians of N elements. (N, P)
        labels: Classes of the elements. (N,)
        known: Gaussians of M known lines in the current frame. (M, Q)
        known_labels: Classes of the known lines. (M,)
        gate_m: Distance in metres. Elements and points that are this far from their line, or
            farther, are not updated.

    Returns:
        Gaussians of all elements. An element without a known line, or with fewer than two points
        beside it, is unchanged, and so is a point that does not lie beside the line. (N, P)
    """
    rows, cols = _candidate_pairs(
        now, labels, known=known, known_labels=known_labels, gate_m=gate_m
    )
    if not len(rows):
        return now
    places = nearest_places(now.means[rows], known.means[cols])
    num_beside = places.beside.sum(-1)
    # Mean distance of the points beside the line, for each pair. (K,)
    pair_distances = (places.distances * places.beside).sum(-1) / num_beside.clamp(min=1)
    is_far = (num_beside < 2) | (pair_distances >= gate_m)
    mean_distances = pair_distances.new_full((len(labels), len(known_labels)), torch.inf)  # (N, M)
    mean_distances[rows, cols] = pair_distances.masked_fill(is_far, torch.inf)
    # For each element and line, the index of their pair among the K pairs. (N, M)
    pairs = torch.zeros_like(mean_distances, dtype=torch.long)
    pairs[rows, cols] = torch.arange(len(rows), device=rows.device)
    # Nearest line of each element, and the pair of both. An element without a line gets some pair,
    # but its smallest mean is infinite, so `belongs` is False and it is not changed.
    smallest_mean, line = mean_distances.min(1)
    pair = pairs.gather(1, line[:, None])[:, 0]
    point_distances = places.distances[pair]  # (N, P)
    segments = places.segments[pair]
    shares = places.shares[pair][..., None]
    line = line[:, None]
    starts = known.means[line, segments]
    ends = known.means[line, segments + 1]
    # Covariance of the line at the nearest place, between two vertices. (N, P, 2, 2)
    vertex_covariances = covariances(known)
    line_covariance = torch.lerp(
        vertex_covariances[line, segments],
        vertex_covariances[line, segments + 1],
        shares[..., None],
    )
    along = torch.nn.functional.normalize(ends - starts, dim=-1)
    normal = torch.stack([-along[..., 1], along[..., 0]], dim=-1)[..., None]  # (N, P, 2, 1)
    offset = torch.lerp(starts, ends, shares) - now.means
    covariance = covariances(now)
    toward = covariance @ normal  # Sigma n, (N, P, 2, 1)
    gain = toward / (normal.mT @ (toward + line_covariance @ normal))
    means = now.means + (gain @ (normal.mT @ offset[..., None]))[..., 0]
    # A covariance has several equivalent rotations. `near` selects the one closest to the old one.
    updated = with_covariances(means, covariance - gain @ toward.mT, near=now.rotations)
    belongs = (smallest_mean < gate_m)[:, None]
    is_updated = belongs & places.beside[pair] & (point_distances < gate_m)  # (N, P)
    # The direction `along` has length 1. For a segment of length 0 it has length 0, and there is no
    # normal.
    is_updated &= along.norm(dim=-1) > 0.5
    return Gaussians(
        means=torch.where(is_updated[..., None], updated.means, now.means),
        scales=torch.where(is_updated[..., None], updated.scales, now.scales),
        rotations=torch.where(is_updated, updated.rotations, now.rotations),
    )
