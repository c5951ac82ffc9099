"""Lines of Gaussians that are seen again: what is known of a line says where new points lie."""

from typing import NamedTuple

import torch
from torch import Tensor

from gsmap.structures.gaussians import Gaussians, covariances, with_covariances

_SHORT = 1e-9  # square metres; a shorter segment has no direction


class LinePlaces(NamedTuple):
    """The place on each of M lines that is nearest to each of P points of N elements. (N, M, P)"""

    distances: Tensor  # metres
    segments: Tensor  # number of the segment that it lies on
    shares: Tensor  # where on it, [0, 1]
    beside: Tensor  # whether the point lies beside the line, not beyond one of its ends


def nearest_places(points: Tensor, lines: Tensor) -> LinePlaces:
    """Return the nearest places on lines. (N, P, 2), (M, Q, 2) metres -> (N, M, P)"""
    starts, steps = lines[None, :, None, :-1], lines.diff(dim=1)[None, :, None]
    away = points[:, None, :, None] - starts  # (N, M, P, Q - 1, 2)
    shares = (away * steps).sum(-1) / steps.square().sum(-1).clamp(min=_SHORT)
    kept = shares.clamp(0.0, 1.0)
    distances, segments = (away - kept[..., None] * steps).norm(dim=-1).min(-1)
    own, kept = (values.gather(-1, segments[..., None])[..., 0] for values in (shares, kept))
    before = (segments == 0) & (own < 0)
    behind = (segments == lines.shape[1] - 2) & (own > 1)
    return LinePlaces(distances, segments, kept, ~(before | behind))


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
    if not len(labels) or not len(known_labels):
        return now
    places = nearest_places(now.means, known.means)
    count = places.beside.sum(-1)
    mean = (places.distances * places.beside).sum(-1) / count.clamp(min=1)
    fits = (labels[:, None] == known_labels) & (count > 1) & (mean < gate_m)  # (N, M)
    line = mean.masked_fill(~fits, torch.inf).argmin(1)
    rows = torch.arange(len(labels), device=labels.device)
    distances, segments, shares, beside = (values[rows, line] for values in places)  # (N, P)
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
    known_here = fits.any(1)[:, None] & beside & (distances < gate_m) & (along.norm(dim=-1) > 0.5)
    return Gaussians(
        torch.where(known_here[..., None], updated.means, now.means),
        torch.where(known_here[..., None], updated.scales, now.scales),
        torch.where(known_here, updated.rotations, now.rotations),
    )
