"""Lines of Gaussians that are seen again: what is known of a line says where new points lie."""

from typing import NamedTuple

import torch
from torch import Tensor

from gsmap.structures.gaussians import Gaussians, covariances, with_covariances

_SHORT = 1e-9  # square metres; a shorter segment has no direction


class LinePlaces(NamedTuple):
    """The place on a line that is nearest to each of P points of an element, for K pairs. (K, P)"""

    distances: Tensor  # metres
    segments: Tensor  # number of the segment that it lies on
    shares: Tensor  # where on it, [0, 1]
    beside: Tensor  # whether the point lies beside the line, not beyond one of its ends


def nearest_places(points: Tensor, lines: Tensor) -> LinePlaces:
    """Return the nearest places on lines, pair by pair. (K, P, 2), (K, Q, 2) metres -> (K, P)"""
    points, lines = points.mT.contiguous(), lines.mT.contiguous()  # many points along the last axis
    starts, steps = lines[:, :, None, :-1], lines.diff(dim=-1)[:, :, None]
    away = points[..., None] - starts  # (K, 2, P, Q - 1)
    shares = (away * steps).sum(1) / steps.square().sum(1).clamp(min=_SHORT)
    kept = shares.clamp(0.0, 1.0)
    squares, segments = (away - kept[:, None] * steps).square().sum(1).min(-1)
    own, kept = (values.gather(-1, segments[..., None])[..., 0] for values in (shares, kept))
    before = (segments == 0) & (own < 0)
    behind = (segments == lines.shape[-1] - 2) & (own > 1)
    return LinePlaces(squares.sqrt(), segments, kept, ~(before | behind))


def _worth_measuring(
    now: Gaussians, labels: Tensor, known: Gaussians, known_labels: Tensor, gate_m: float
) -> tuple[Tensor, ...]:
    """Return the K pairs of one class whose boxes are less than the gate apart. (K,), (K,)"""
    (low, high), (known_low, known_high) = (part.means.aminmax(dim=1) for part in (now, known))
    gaps = torch.maximum(low[:, None] - known_high, known_low - high[:, None]).amax(-1)  # (N, M)
    return ((labels[:, None] == known_labels) & (gaps < gate_m)).nonzero(as_tuple=True)


def seen_again(
    now: Gaussians, labels: Tensor, known: Gaussians, known_labels: Tensor, gate_m: float
) -> Gaussians:
    r"""Return elements, whose points are updated by what is known of their lines.

    An element is the nearest known one of its class, by the mean distance of the points that lie
    beside it. Such a point knows from that line where it lies across it, but not along it, for
    points are spread anew in each frame. So with the normal n of the nearest place c on the line
    and the variance :math:`v = n^T \Sigma_c n` there, a Kalman update in one direction gives

    .. math:: k = \Sigma n / (n^T \Sigma n + v), \quad \mu' = \mu + k\, n^T (c - \mu), \quad
              \Sigma' = \Sigma - k n^T \Sigma

    Args:
        now: Gaussians of N elements. (N, P)
        labels: Their classes. (N,)
        known: Gaussians of M lines, where they lie now. (M, Q)
        known_labels: Their classes. (M,)
        gate_m: Largest distance, in metres, of an element from its line, and of a point.
    """
    rows, cols = _worth_measuring(now, labels, known, known_labels, gate_m)
    if not len(rows):
        return now
    places = nearest_places(now.means[rows], known.means[cols])
    count = places.beside.sum(-1)
    mean = (places.distances * places.beside).sum(-1) / count.clamp(min=1)  # (K,)
    apart = mean.new_full((len(labels), len(known_labels)), torch.inf)
    apart[rows, cols] = mean.masked_fill((count < 2) | (mean >= gate_m), torch.inf)
    pairs = torch.zeros_like(apart, dtype=torch.long)
    pairs[rows, cols] = torch.arange(len(rows), device=rows.device)
    nearest, line = apart.min(1)
    chosen = pairs.gather(1, line[:, None])[:, 0]
    distances, segments, shares, beside = (values[chosen] for values in places)  # (N, P)
    line, shares = line[:, None], shares[..., None]
    starts, ends = known.means[line, segments], known.means[line, segments + 1]
    spread = covariances(known)
    spread = torch.lerp(spread[line, segments], spread[line, segments + 1], shares[..., None])
    along = torch.nn.functional.normalize(ends - starts, dim=-1)
    normal = torch.stack([-along[..., 1], along[..., 0]], -1)[..., None]  # (N, P, 2, 1)
    offset = torch.lerp(starts, ends, shares) - now.means
    own = covariances(now)
    toward = own @ normal
    gain = toward / (normal.mT @ (toward + spread @ normal))
    means = now.means + (gain @ (normal.mT @ offset[..., None]))[..., 0]
    updated = with_covariances(means, own - gain @ toward.mT, now.rotations)
    known_here = (nearest < gate_m)[:, None] & beside & (distances < gate_m)
    known_here &= along.norm(dim=-1) > 0.5  # a segment without length has no direction
    return Gaussians(
        torch.where(known_here[..., None], updated.means, now.means),
        torch.where(known_here[..., None], updated.scales, now.scales),
        torch.where(known_here, updated.rotations, now.rotations),
    )
