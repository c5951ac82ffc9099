"""Whether Gaussians say how far off vertices are: scores of the vertices that AP_chamfer matches.

Errors and sigmas are taken along and across the line (`gsmap.structures.gaussians.line_errors`).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import stats

from gsmap.evaluation.core.chamfer_ap import ChamferConfig, match_chamfer
from gsmap.evaluation.core.metric import Sample
from gsmap.evaluation.core.report import MetricReport
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.structures.polylines import equivalent_orders
from gsmap.utils.errors import InputError
from gsmap.utils.model_facts import LAW_NAMES

AXES = ("along", "across")
DISTANCES_M = (0.0, 10.0, 20.0, np.inf)  # from the vehicle
LEVELS = np.linspace(0.05, 0.95, 19)  # of central intervals
_STANDARD = stats.norm(), stats.laplace(scale=0.5**0.5)  # of variance 1
LAWS = dict(zip(LAW_NAMES, _STANDARD, strict=True))
COVERED = (2 * stats.norm.cdf([1.0, 2.0]) - 1).tolist()  # by one and two sigma of a normal law
_FEWEST = 100  # vertices of a class whose sigmas are fitted
_COLUMNS = (
    ("nll", "NLL"), ("coverage@1", "68.3 %"), ("coverage@2", "95.4 %"), ("sigma_m", "sigma m"),
    ("error_m", "error m"), ("reliability_error", "reliab."), ("sparsification_error", "spars."),
    ("rank_correlation", "rank"), ("distance_rank_correlation", "by dist."),
)  # fmt: skip


class Vertices(NamedTuple):
    """Matched vertices: class (n,), errors and sigmas along and across, distance from the vehicle.

    All in metres: ``errors`` (n, 2), >= 0, ``sigmas`` (n, 2), ``distances`` (n,).
    """

    labels: IntArray
    errors: FloatArray
    sigmas: FloatArray
    distances: FloatArray

    def of(self, rows: IntArray | BoolArray) -> "Vertices":
        """Return some of the vertices, by their places or a mask."""
        labels, errors, sigmas, distances = self
        return Vertices(labels[rows], errors[rows], sigmas[rows], distances[rows])


def matched_vertices(samples: Iterable[Sample], config: ChamferConfig) -> Vertices:
    """Return the vertices of all predictions that match, at the loosest threshold.

    Args:
        samples: Token, predictions with Gaussians and ground truth of each sample.
        config: Rules of the match.

    Raises:
        ValueError: If predictions of a sample have no Gaussians, or no sample has a match.
    """
    parts = [part for sample in samples for part in _of_sample(*sample, config)]
    if not parts:
        raise InputError("no prediction matches: there is no vertex to measure.")
    labels, errors, sigmas, distances = map(np.concatenate, zip(*parts, strict=True))
    return Vertices(labels, errors, sigmas, distances)


def _of_sample(
    token: str, found: MapElements, truth: MapElements, config: ChamferConfig
) -> Iterator[Vertices]:
    """Yield the vertices of each prediction that matches."""
    if not len(found):
        return
    if found.scales is None or found.rotations is None:
        raise InputError(
            f"sample {token!r} has predictions without Gaussians: predict with a model that has "
            "them, such as GSMap."
        )
    import torch  # only Gaussians need it

    from gsmap.structures.gaussians import Gaussians, extents_along_line, line_errors

    matches, lines = match_chamfer(found, truth, config, token), truth.polylines
    for row, gt in zip(matches.pred_index, matches.matched_gt[:, -1], strict=True):
        if gt < 0:
            continue
        own = slice(*found.offsets[row : row + 2])
        points, line = found.points[own, :2], lines[gt][:, :2]
        orders = equivalent_orders(line, len(points))
        target = orders[np.abs(orders - points).sum((1, 2)).argmin()]
        values = points, found.scales[own], found.rotations[own], target, line
        means, scales, rotations, *true = map(torch.tensor, values)
        sigmas = extents_along_line(Gaussians(means, scales, rotations)).numpy()
        errors = line_errors(means, *true).numpy()
        labels = np.full(len(points), found.labels[row])
        yield Vertices(labels, errors, sigmas, np.linalg.norm(points, axis=1))


def half_widths(law: str, levels: Sequence[float] | FloatArray) -> FloatArray:
    """Return half the widths of a law's central intervals, in sigma. (n,)

    Args:
        law: ``normal``, or ``laplace`` for longer tails with the same variance.
        levels: Shares of the errors that the intervals are to cover (n,).
    """
    return LAWS[law].ppf((1 + np.asarray(levels)) / 2)


def reliability(errors: FloatArray, sigmas: FloatArray, law: str = "normal") -> FloatArray:
    """Return the share of errors in the interval of each of ``LEVELS``. (19,)

    Args:
        errors: In metres, >= 0. (n,)
        sigmas: In metres. (n,)
        law: What the errors are distributed by, one of ``LAWS``.
    """
    ratios = np.sort(errors / sigmas)
    return np.searchsorted(ratios, half_widths(law, LEVELS), side="right") / len(errors)


def sparsification(errors: FloatArray, order: FloatArray) -> FloatArray:
    """Return the mean error of the first n, where ``order`` is smallest, for each n. 2 x (n,)"""
    kept = errors[np.argsort(order, kind="stable")]
    return np.cumsum(kept) / np.arange(1, len(kept) + 1)


def rank_correlation(first: FloatArray, second: FloatArray) -> float:
    """Return Spearman's rank correlation; 0 if one of both is the same everywhere. 2 x (n,)"""
    if len(first) < 2 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return 0.0
    return float(stats.spearmanr(first, second).statistic)


def uncertainty_figures(vertices: Vertices, law: str = "normal") -> dict[str, float]:
    """Return the scores of at least one vertex, by ``along/NAME`` and ``across/NAME``.

    The negative log-likelihood and the coverage are of a distribution around the vertex, one of
    ``LAWS``: ``coverage@1`` and ``coverage@2`` of its central intervals of 68.3 and 95.4 %, which
    are one and two sigma of the normal one (0.81 and 2.18 of Laplace's).
    ``sparsification_error``: how much larger than with the true order the mean error is while the
    vertices of the largest sigmas are taken away, as a share of the mean error of all.
    """
    figures: dict[str, float] = {}
    one, two = half_widths(law, COVERED)
    for axis, name in enumerate(AXES):
        errors, sigmas = vertices.errors[:, axis], vertices.sigmas[:, axis]
        apart = sparsification(errors, sigmas) - sparsification(errors, errors)
        values = {
            "nll": (np.log(sigmas) - LAWS[law].logpdf(errors / sigmas)).mean(),
            "coverage@1": (errors <= one * sigmas).mean(),
            "coverage@2": (errors <= two * sigmas).mean(),
            "sigma_m": sigmas.mean(),
            "error_m": errors.mean(),
            "reliability_error": np.abs(reliability(errors, sigmas, law) - LEVELS).mean(),
            "sparsification_error": apart.mean() / max(errors.mean(), np.finfo(float).tiny),
            "rank_correlation": rank_correlation(sigmas, errors),
            "distance_rank_correlation": rank_correlation(vertices.distances, errors),
        }
        figures |= {f"{name}/{key}": float(value) for key, value in values.items()}
    return figures | {"num_vertices": float(len(vertices.labels))}


def uncertainty_report(
    vertices: Vertices, classes: Sequence[str], areas: Sequence[str], law: str = "normal"
) -> MetricReport:
    """Score each class, all ``line`` classes together, and each at distances from the vehicle.

    Args:
        vertices: Matched vertices.
        classes: Names of the classes.
        areas: Those of them that are no lines.
        law: What the errors are distributed by, one of ``LAWS``.
    """
    lines = [label for label, name in enumerate(classes) if name not in areas]
    groups = {name: [label] for label, name in enumerate(classes)} | {"line": lines}
    metrics: dict[str, float] = {}
    for name, labels in groups.items():
        own = vertices.of(np.isin(vertices.labels, labels))
        parts = {name: own}
        for low, high in pairwise(DISTANCES_M):
            title = f"{low:g}m+" if high == np.inf else f"{low:g}-{high:g}m"
            parts[f"{name}/{title}"] = own.of((low <= own.distances) & (own.distances < high))
        for part, chosen in parts.items():
            figures = uncertainty_figures(chosen, law) if len(chosen.labels) else {}
            metrics |= {f"uncertainty/{part}/{key}": value for key, value in figures.items()}
    return MetricReport("uncertainty", {}, metrics, {})


def format_uncertainty(metrics: Mapping[str, float], law: str = "normal") -> str:
    """Return the table of an ``uncertainty_report``: a row for each class, distance and axis."""
    end = "/num_vertices"
    names = [key.removesuffix(end) for key in metrics if key.endswith(end)]
    wide = max((len(name) for name in names), default=0) + 1 - len("uncertainty/")
    titles = "".join(title.rjust(9) for _, title in _COLUMNS)
    first = f"{f'matched vertices, {law} law':<{wide + 8}}"
    rows = [f"{first}{titles} vertices"]
    for name in names:
        for axis in AXES:
            cells = "".join(f"{metrics[f'{name}/{axis}/{key}']:9.3f}" for key, _ in _COLUMNS)
            label = f"{name.removeprefix('uncertainty/'):<{wide}} {axis:<7}"
            rows.append(
                f"{label:<{len(rows[0]) - len(titles) - 9}}{cells} {metrics[name + end]:8.0f}"
            )
    return "\n".join(rows)


def fitted_factors(
    vertices: Vertices, classes: Sequence[str], num_sigmas: float = 1.0, law: str = "normal"
) -> FloatArray:
    """Return factors of sigma that give an interval of each class's errors its coverage. (C, 2)

    Args:
        vertices: Matched vertices.
        classes: Names of the classes.
        num_sigmas: The interval, by what a normal distribution has within so many sigma: 1 for
            68.3 % of the errors, 2 for 95.4 %. Errors with other tails than the law's fit one of
            both only.
        law: What the errors are distributed by, one of ``LAWS``.

    Raises:
        ValueError: If a class has too few vertices for that, or ``num_sigmas`` is not in (0, 3].
    """
    if not 0 < num_sigmas <= 3:
        raise InputError(f"num_sigmas must be in (0, 3], got {num_sigmas}.")
    covered = 2 * stats.norm.cdf(num_sigmas) - 1
    width = half_widths(law, covered)
    factors = np.empty((len(classes), len(AXES)))
    for label, name in enumerate(classes):
        own = vertices.of(vertices.labels == label)
        if len(own.labels) < _FEWEST:
            raise InputError(
                f"class {name!r} has {len(own.labels)} matched vertices, {_FEWEST} are needed: "
                "give results of more samples."
            )
        factors[label] = np.quantile(own.errors / own.sigmas, covered, axis=0) / width
    return factors
