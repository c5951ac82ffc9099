"""Calibration of Gaussians: whether their sigmas agree with the errors of the vertices.

The vertices are from predictions that AP_chamfer matches. Errors and sigmas are measured along and
across the line (`gsmap.structures.gaussians.line_errors`). A law is the probability distribution of
the errors that the sigmas describe.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import stats

from gsmap.evaluation.core.chamfer_ap import ChamferConfig, match_chamfer
from gsmap.evaluation.core.matches import check_group_names
from gsmap.evaluation.core.metric import Sample
from gsmap.evaluation.core.report import MetricReport
from gsmap.structures.elements import BoolArray, FloatArray, IntArray
from gsmap.structures.polylines import equivalent_orders
from gsmap.utils.errors import InputError
from gsmap.utils.model_facts import LAW_NAMES

AXES = ("along", "across")
# Limits of the bands of distance from the vehicle: 0 to 10 m, 10 to 20 m, and beyond 20 m.
DISTANCES_M = (0.0, 10.0, 20.0, np.inf)
LEVELS = np.linspace(0.05, 0.95, num=19)  # probabilities of central intervals
# Distributions of variance 1, in the order of `LAW_NAMES`: "normal", "laplace".
_STANDARD = (stats.norm(), stats.laplace(scale=0.5**0.5))
LAWS = dict(zip(LAW_NAMES, _STANDARD, strict=True))
"""Laws of errors of variance 1, by name."""
# Probabilities that an error of a normal law lies within one and within two sigma.
COVERED = (2 * stats.norm.cdf([1.0, 2.0]) - 1).tolist()
_FEWEST = 100  # smallest number of vertices of a class for which factors of the class are fitted
_COLUMNS = (  # for each column of the table, the key of its figure and its title
    ("nll", "NLL"), ("coverage@1", "68.3 %"), ("coverage@2", "95.4 %"), ("sigma_m", "sigma m"),
    ("error_m", "error m"), ("reliability_error", "reliab."), ("sparsification_error", "spars."),
    ("rank_correlation", "rank"), ("distance_rank_correlation", "by dist."),
)  # fmt: skip


class Vertices(NamedTuple):
    """Vertices of matched predictions.

    Args:
        labels: Class index. (n,)
        errors: Errors along and across the line in metres, >= 0. (n, 2)
        sigmas: Standard deviations along and across the line in metres. (n, 2)
        distances: Distance from the vehicle in metres. (n,)
    """

    labels: IntArray
    errors: FloatArray
    sigmas: FloatArray
    distances: FloatArray

    def select(self, rows: IntArray | BoolArray) -> "Vertices":
        """Select vertices by their indices or a mask."""
        return Vertices(
            labels=self.labels[rows],
            errors=self.errors[rows],
            sigmas=self.sigmas[rows],
            distances=self.distances[rows],
        )


def matched_vertices(samples: Iterable[Sample], config: ChamferConfig) -> Vertices:
    """Collect the vertices of all predictions that match at the loosest threshold.

    Args:
        samples: Samples whose predictions have Gaussians.
        config: Settings of the matching. Its last threshold is the loosest one.

    Raises:
        ValueError: If predictions of a sample have no Gaussians, or no prediction matches.
    """
    lines: list[Vertices] = []  # vertices of each prediction that matches
    for sample in samples:
        lines += _vertices_of_sample(sample, config)
    if not lines:
        raise InputError(
            "no prediction matches, so there is no vertex to measure: give the results and the "
            "ground truth of equal samples."
        )
    return Vertices(
        labels=np.concatenate([line.labels for line in lines]),
        errors=np.concatenate([line.errors for line in lines]),
        sigmas=np.concatenate([line.sigmas for line in lines]),
        distances=np.concatenate([line.distances for line in lines]),
    )


def _vertices_of_sample(sample: Sample, config: ChamferConfig) -> Iterator[Vertices]:
    """Yield the vertices of each prediction that matches."""
    token, predictions, truth = sample
    if not len(predictions):
        return
    if predictions.scales is None or predictions.rotations is None:
        raise InputError(
            f"sample {token!r} has predictions without Gaussians: predict with a model that has "
            "them, such as GSMap."
        )
    import torch  # other metrics do not need it

    from gsmap.structures.gaussians import Gaussians, extents_along_line, line_errors

    matches = match_chamfer(predictions, truth, config=config, token=token)
    gt_lines = truth.polylines
    matched_gt = matches.matched_gt[:, -1]  # at the loosest threshold; -1 without a match
    for row, gt in zip(matches.pred_index, matched_gt, strict=True):
        if gt < 0:
            continue
        span = slice(predictions.offsets[row], predictions.offsets[row + 1])
        points = predictions.points[span, :2]
        line = gt_lines[gt][:, :2]
        # `orders` has the true line, resampled to the number of predicted points, in all equivalent
        # orders: in both directions if it is open, and from each start if it is closed. Unused rows
        # have points far away, which are never nearest. The points of the nearest order are paired
        # with the points of the prediction.
        orders = equivalent_orders(line, num_points=len(points))
        nearest_order = np.abs(orders - points).sum(axis=(1, 2)).argmin()
        means = torch.tensor(points)
        gaussians = Gaussians(
            means,
            scales=torch.tensor(predictions.scales[span]),
            rotations=torch.tensor(predictions.rotations[span]),
        )
        # The error along the line is measured to the paired point, and the error across it to the
        # true line.
        target = torch.tensor(orders[nearest_order])
        yield Vertices(
            labels=np.full(len(points), fill_value=predictions.labels[row]),
            errors=line_errors(means, target, lines=torch.tensor(line)).numpy(),
            sigmas=extents_along_line(gaussians).numpy(),
            distances=np.linalg.norm(points, axis=1),
        )


def half_widths(law: str, levels: Sequence[float] | FloatArray) -> FloatArray:
    """Compute half the widths of the central intervals of a law, in units of sigma.

    Args:
        law: ``normal``, or ``laplace`` with equal variance and longer tails.
        levels: Probabilities of the intervals, in (0, 1). (n,)

    Returns:
        Half widths in units of sigma. (n,)
    """
    # A central interval of probability p leaves (1 - p) / 2 above it.
    return LAWS[law].ppf((1 + np.asarray(levels)) / 2)


def reliability(errors: FloatArray, sigmas: FloatArray, law: str = "normal") -> FloatArray:
    """Compute the share of errors within the central interval of each of ``LEVELS``.

    Args:
        errors: Errors in metres, >= 0. (n,)
        sigmas: Standard deviations in metres. (n,)
        law: Law of the errors, one of ``LAWS``.

    Returns:
        Shares in [0, 1]. (19,)
    """
    ratios = np.sort(errors / sigmas)
    return np.searchsorted(ratios, half_widths(law, LEVELS), side="right") / len(errors)


def sparsification(errors: FloatArray, order: FloatArray) -> FloatArray:
    """Compute the sparsification curve: the mean of the first k errors, for each k.

    Args:
        errors: Errors in metres, >= 0. (n,)
        order: Sort keys of the errors, which are sorted in ascending order of the keys. (n,)

    Returns:
        Mean errors in metres, for k from 1 to n. (n,)
    """
    sorted_errors = errors[np.argsort(order, kind="stable")]
    return np.cumsum(sorted_errors) / np.arange(1, len(sorted_errors) + 1)


def rank_correlation(first: FloatArray, second: FloatArray) -> float:
    """Compute Spearman's rank correlation; 0 if one argument is constant or has a single value.

    Args:
        first: Values. (n,)
        second: Values. (n,)
    """
    if len(first) < 2 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return 0.0
    return float(stats.spearmanr(first, second).statistic)


def uncertainty_figures(vertices: Vertices, law: str = "normal") -> dict[str, float]:
    """Compute the calibration figures of vertices.

    The figures of each direction are:

    * ``nll``: mean negative log-likelihood of the errors.
    * ``coverage@1`` and ``coverage@2``: shares of errors within the central intervals of 68.3 and
      95.4 % of the law, which are one and two sigma of the normal law, and 0.81 and 2.18 sigma of
      Laplace's law.
    * ``sigma_m`` and ``error_m``: mean sigma and mean error in metres.
    * ``reliability_error``: mean gap between the shares of `reliability` and their levels.
    * ``sparsification_error``: mean gap between the curves of `sparsification` in the order of
      sigmas and in the order of errors, divided by the mean error. It is 0 if the sigmas rank the
      errors perfectly.
    * ``rank_correlation`` and ``distance_rank_correlation``: rank correlations of sigmas and of
      distances from the vehicle with errors.

    Args:
        vertices: Matched vertices, at least one.
        law: Law of the errors, one of ``LAWS``.

    Returns:
        Figures by ``along/NAME`` and ``across/NAME``, with the names above, and ``num_vertices``.
    """
    figures: dict[str, float] = {}
    half_width_1, half_width_2 = half_widths(law, COVERED)  # in units of sigma
    for axis, name in enumerate(AXES):
        errors = vertices.errors[:, axis]
        sigmas = vertices.sigmas[:, axis]
        gaps = sparsification(errors, order=sigmas) - sparsification(errors, order=errors)
        # The law has variance 1, so it gives the density of errors / sigmas. The density of the
        # errors is this density divided by sigma. So log(sigma) is added in the figure "nll".
        log_densities = LAWS[law].logpdf(errors / sigmas)
        values = {
            "nll": (np.log(sigmas) - log_densities).mean(),
            "coverage@1": (errors <= half_width_1 * sigmas).mean(),
            "coverage@2": (errors <= half_width_2 * sigmas).mean(),
            "sigma_m": sigmas.mean(),
            "error_m": errors.mean(),
            "reliability_error": np.abs(reliability(errors, sigmas, law) - LEVELS).mean(),
            "sparsification_error": gaps.mean() / max(errors.mean(), np.finfo(float).tiny),
            "rank_correlation": rank_correlation(sigmas, errors),
            "distance_rank_correlation": rank_correlation(vertices.distances, errors),
        }
        for key, value in values.items():
            figures[f"{name}/{key}"] = float(value)
    figures["num_vertices"] = float(len(vertices.labels))
    return figures


def uncertainty_report(
    vertices: Vertices, classes: Sequence[str], areas: Sequence[str], law: str = "normal"
) -> MetricReport:
    """Compute the calibration figures of each class and of all lines, in total and by distance.

    The distance of a vertex is measured from the vehicle.

    Args:
        vertices: Matched vertices.
        classes: Names of the classes.
        areas: Names of the classes that are areas; the others are lines.
        law: Law of the errors, one of ``LAWS``.

    Returns:
        Report with keys such as ``uncertainty/divider/along/nll``, and with the distance
        ``uncertainty/divider/0-10m/along/nll``. The group ``line`` has all classes that are not
        areas. A group or a band without vertices has no figures.

    Raises:
        ValueError: If a class is called ``line``.
    """
    check_group_names(classes, groups=["line"])
    groups: dict[str, list[int]] = {}
    line_labels = []
    for label, name in enumerate(classes):
        groups[name] = [label]
        if name not in areas:
            line_labels.append(label)
    groups["line"] = line_labels

    subsets: dict[str, Vertices] = {}  # by the middle part of the keys
    for name, labels in groups.items():
        group = vertices.select(np.isin(vertices.labels, labels))
        subsets[name] = group
        for low, high in pairwise(DISTANCES_M):
            band = f"{low:g}m+" if high == np.inf else f"{low:g}-{high:g}m"
            in_band = (low <= group.distances) & (group.distances < high)
            subsets[f"{name}/{band}"] = group.select(in_band)
    metrics: dict[str, float] = {}
    for name, subset in subsets.items():
        if len(subset.labels):
            for key, value in uncertainty_figures(subset, law).items():
                metrics[f"uncertainty/{name}/{key}"] = value
    # `groups` and `detections` concern metrics with an AP.
    return MetricReport(name="uncertainty", groups={}, metrics=metrics, detections={})


def format_uncertainty(metrics: Mapping[str, float], law: str = "normal") -> str:
    """Format the table of an `uncertainty_report`, with a row per class, distance band and axis.

    Args:
        metrics: Figures of the report.
        law: Law of the errors, one of ``LAWS``.
    """
    prefix = "uncertainty/"
    suffix = "/num_vertices"  # each class and each distance band has one key with this suffix
    names = []
    for key in metrics:
        if key.endswith(suffix):
            names.append(key.removeprefix(prefix).removesuffix(suffix))
    name_width = max(map(len, names), default=0) + 1
    title = f"matched vertices, {law} law"
    label_width = max(len(title), name_width + 8)
    head = title.ljust(label_width)
    for _, column_title in _COLUMNS:
        head += column_title.rjust(9)
    rows = [f"{head} vertices"]
    for name in names:
        num_vertices = metrics[f"{prefix}{name}{suffix}"]
        for axis in AXES:
            row = f"{name:<{name_width}} {axis:<7}".ljust(label_width)
            for key, _ in _COLUMNS:
                value = metrics[f"{prefix}{name}/{axis}/{key}"]
                row += f"{value:9.3f}"
            rows.append(f"{row} {num_vertices:8.0f}")
    return "\n".join(rows)


def fit_factors(
    vertices: Vertices, classes: Sequence[str], num_sigmas: float = 1.0, law: str = "normal"
) -> FloatArray:
    """Fit a factor for the sigmas of each class, so that an interval covers its share of errors.

    Args:
        vertices: Matched vertices.
        classes: Names of the classes.
        num_sigmas: Number n in (0, 3] that sets the share: the probability that a normal error lies
            within n sigma, which is 68.3 % for n = 1 and 95.4 % for n = 2. If the distribution of
            the errors differs from the law, other intervals do not cover their shares.
        law: Law of the errors, one of ``LAWS``.

    Returns:
        Factors of the sigmas along and across the line. (classes, 2)

    Raises:
        ValueError: If a class has fewer than 100 vertices, or ``num_sigmas`` is not in (0, 3].
    """
    if not 0 < num_sigmas <= 3:
        raise InputError(f"num_sigmas must be in (0, 3], got {num_sigmas}.")
    covered = 2 * stats.norm.cdf(num_sigmas) - 1  # share of errors that the interval covers
    half_width = half_widths(law, covered)
    factors = np.empty((len(classes), len(AXES)))
    for label, name in enumerate(classes):
        of_class = vertices.select(vertices.labels == label)
        if len(of_class.labels) < _FEWEST:
            raise InputError(
                f"class {name!r} has {len(of_class.labels)} matched vertices, {_FEWEST} are "
                "needed: give results of more samples."
            )
        # The share `covered` of the errors is within this quantile times sigma. After the
        # correction, it is within `half_width` times the corrected sigma.
        ratios = of_class.errors / of_class.sigmas
        factors[label] = np.quantile(ratios, covered, axis=0) / half_width
    return factors
