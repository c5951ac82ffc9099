"""Tables and curves of results on the report page.

Figures are the values of `MetricReport.metrics`, by flat keys such as ``chamfer/divider/AP@0.5``. A
figure that does not exist has the value ``UNDEFINED``.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gsmap.evaluation.analysis.bootstrap import Interval, Resamples, ap_differences, ap_intervals
from gsmap.evaluation.analysis.calibration import (
    AXES,
    COVERED,
    LEVELS,
    Vertices,
    half_widths,
    matched_vertices,
    reliability,
)
from gsmap.evaluation.analysis.groups import Groups, ap_by_group, group_table
from gsmap.evaluation.core.average_precision import precision_recall
from gsmap.evaluation.core.chamfer_ap import CHAMFER_THRESHOLDS, ChamferConfig
from gsmap.evaluation.core.matches import ClassDetections
from gsmap.evaluation.core.metric import Sample
from gsmap.evaluation.core.report import UNDEFINED, MetricReport, flat_metrics
from gsmap.structures.elements import MapElements
from gsmap.visualization.page.scores import ScoredResult
from gsmap.visualization.style import MapStyle

Table = dict[str, Any]
"""Title (``caption``), headings of the columns (``head``) and cells of each row (``rows``)."""
_MAX_CURVE_POINTS = 120  # largest number of points of a precision-recall curve
_MAX_DIFFERENCES = 12  # samples in the table of differences
_UNITS = {"chamfer": "m", "raster": "IoU"}  # units of thresholds


def _format_value(value: float, factor: float = 100, digits: int = 1) -> str:
    """Format a value, by default in percent; a dash if it is undefined."""
    return "\N{EN DASH}" if value == UNDEFINED else f"{factor * value:.{digits}f}"


def summary_table(results: Sequence[ScoredResult], resamples: Resamples | None = None) -> Table:
    """Create the table of the means over the classes, with a row per figure.

    Args:
        results: One result, or two with their difference in a last column.
        resamples: Resamples of the scenes for intervals of 95 %, or None for no intervals.

    Returns:
        Table with a column per result.
    """
    head = ["mean over classes"]
    columns = []  # figures and intervals of each result, by flat key
    for result in results:
        intervals: Mapping[str, Interval] = {}
        if resamples is not None:
            intervals = ap_intervals(result.reports, resamples)
        head.append(result.name)
        columns.append((flat_metrics(result.reports), intervals))
    key_of_title = _summary_keys(results[0].reports)
    rows = []
    for title, key in key_of_title.items():
        cells = []
        for values, intervals in columns:
            cells.append(_format_value(values[key]) + _format_interval(intervals.get(key)))
        rows.append([title, *cells])
    if len(results) == 2:
        first, second = results
        head.append(f"{second.name} minus {first.name}")
        intervals = {}
        if resamples is not None:
            intervals = ap_differences(second.reports, first.reports, resamples)
        (first_values, _), (second_values, _) = columns
        for row, key in zip(rows, key_of_title.values(), strict=True):
            difference = _format_difference(first_values[key], second_values[key])
            row.append(difference + _format_interval(intervals.get(key), sign="+"))
    caption = "Summary"
    if resamples is not None:
        caption += ", intervals of 95 % over scenes"
    return {"caption": caption, "head": head, "rows": rows}


def _summary_keys(reports: Sequence[MetricReport]) -> dict[str, str]:
    """Metric key of each row of the summary, by title."""
    key_of_title = {}
    for report in reports:
        key_of_title[f"mAP_{report.name} (%)"] = f"{report.name}/mAP"
    for threshold in CHAMFER_THRESHOLDS:
        key_of_title[f"AP_chamfer at {threshold} m (%)"] = f"chamfer/AP@{threshold}"
    return key_of_title


def _format_difference(first: float, second: float) -> str:
    """Format second minus first in percent; a dash if one of them is undefined."""
    if UNDEFINED in (first, second):
        return _format_value(UNDEFINED)
    return f"{100 * (second - first):+.1f}"


def _format_interval(interval: Interval | None, sign: str = "") -> str:
    """Format an interval in percent, to follow its value; empty if it is undefined."""
    if interval is None or UNDEFINED in (interval.value, interval.low, interval.high):
        return ""
    return f" ({100 * interval.low:{sign}.1f} to {100 * interval.high:{sign}.1f})"


def difference_table(
    results: Sequence[ScoredResult], titles: Mapping[str, str], score_thr: float
) -> Table:
    """Create the table of the samples with the largest differences in F1, in falling order.

    Args:
        results: Two results.
        titles: Title of each sample on the page, by token.
        score_thr: Smallest score of a prediction that counts in F1.

    Returns:
        Table with a row per sample.
    """
    first_result, second_result = results
    f1_of_samples = []  # token, F1 of the first result, F1 of the second result
    for token in titles:
        first = first_result.f1(token, score_thr)
        second = second_result.f1(token, score_thr)
        if first != second:
            f1_of_samples.append((token, first, second))
    f1_of_samples.sort(key=lambda row: -abs(row[2] - row[1]))  # largest difference first
    rows = []
    for token, first, second in f1_of_samples[:_MAX_DIFFERENCES]:
        difference = f"{second - first:+.2f}"
        rows.append([titles[token], token, f"{first:.2f}", f"{second:.2f}", difference])
    head = [
        "sample",
        "token",
        f"F1 of {first_result.name}",
        f"F1 of {second_result.name}",
        "difference",
    ]
    caption = f"Where they differ most, from score {score_thr:g}"
    return {"caption": caption, "head": head, "rows": rows}


def _columns(report: MetricReport, class_name: str) -> list[tuple[str, str, float, int]]:
    """Heading, metric key, factor and digits of each column of a table of classes.

    The key is the end of a flat key, after the names of the metric and the class. The figure is
    multiplied by the factor, 100 for percent, and shown with the number of decimal digits.
    """
    thresholds = report.detections[class_name].thresholds
    unit = _UNITS[report.name]
    # Thresholds are ascending. The loosest one is the largest distance, or the smallest IoU.
    if report.name == "chamfer":
        loosest = thresholds[-1]
        match_quality = ("mean error (m)", f"error_m@{loosest}", 1, 2)
    else:
        loosest = thresholds[0]
        match_quality = ("mIoU", "mIoU", 1, 3)
    ap_columns = [(f"at {value} {unit}", f"AP@{value}", 100, 1) for value in thresholds]
    return [
        ("AP (%)", "AP", 100, 1),
        *ap_columns,
        (f"recall at {loosest} {unit} (%)", f"recall@{loosest}", 100, 1),
        match_quality,
        (f"calibration error at {loosest} {unit}", f"calibration_error@{loosest}", 1, 3),
        ("truths", "num_gts", 1, 0),
        ("predictions", "num_preds", 1, 0),
    ]


def class_tables(results: Sequence[ScoredResult], style: MapStyle) -> list[Table]:
    """Create a table per metric and group of classes, with a row per class and result.

    Args:
        results: One or two results.
        style: Class names.

    Returns:
        Tables in the order of the metrics.
    """
    tables = []
    has_several = len(results) > 1
    for index, report in enumerate(results[0].reports):
        # The classes of a group have common thresholds, so they fit in one table.
        for group, names in report.groups.items():
            columns = _columns(report, names[0])
            rows = []
            for name in names:
                title = style.title(style.classes.index(name))
                for result in results:
                    metrics = result.reports[index].metrics
                    row = [title, result.name] if has_several else [title]
                    for _, key, factor, digits in columns:
                        value = metrics[f"{report.name}/{name}/{key}"]
                        row.append(_format_value(value, factor=factor, digits=digits))
                    rows.append(row)
            head = ["class", "result"] if has_several else ["class"]
            head += [heading for heading, _, _, _ in columns]
            caption = f"AP_{report.name}"
            if len(report.groups) > 1:
                caption += f", {group} classes"
            tables.append({"caption": caption, "head": head, "rows": rows})
    return tables


def curves(results: Sequence[ScoredResult], style: MapStyle) -> list[dict[str, Any]]:
    """Create a panel per metric and class, with a line per threshold.

    Args:
        results: One or two results.
        style: Class names.

    Returns:
        Panels. Each line has lists of the AP and of the points (recall, precision), with an entry
        per result.
    """
    panels = []
    for index, report in enumerate(results[0].reports):
        reports = [result.reports[index] for result in results]
        for name, detections in report.detections.items():
            lines = []
            for column, threshold in enumerate(detections.thresholds):
                key = f"{report.name}/{name}/AP@{threshold}"
                aps = []
                points = []
                for result_report in reports:
                    aps.append(_format_value(result_report.metrics[key]))
                    points.append(_curve_points(result_report.detections[name], column))
                label = f"{threshold} {_UNITS[report.name]}"
                lines.append({"label": label, "ap": aps, "points": points})
            class_index = style.classes.index(name)
            panels.append({"metric": f"AP_{report.name}", "class": class_index, "lines": lines})
    return panels


def reliability_curves(
    results: Sequence[ScoredResult], truth: Mapping[str, MapElements], style: MapStyle
) -> list[dict[str, Any]]:
    """Create a panel per class: the share of errors within each central interval.

    The intervals are central intervals of the law of the result, that is, of the distribution that
    its errors are assumed to have (normal or Laplace).

    Args:
        results: Any number of results; results without Gaussians have no curve.
        truth: Ground truth of each sample, by token.
        style: Class names.

    Returns:
        Panels of the classes with a curve. Each panel has lines for the errors along and across the
        elements.
    """
    vertices_of_results = [
        _matched_vertices(result, truth=truth, style=style) for result in results
    ]
    laws: dict[str, None] = {}  # keys only: a set in the order of the results
    for result, vertices in zip(results, vertices_of_results, strict=True):
        if vertices:
            laws[result.law] = None
    panels = []
    for label in range(len(style.classes)):
        lines = []
        for axis, axis_name in enumerate(AXES):
            shares: list[str] = []
            points: list[list[list[float]]] = []
            for result, vertices in zip(results, vertices_of_results, strict=True):
                share, curve = _reliability(result.law, vertices, label=label, axis=axis)
                shares.append(_format_value(share))
                points.append(curve)
            title = f"{axis_name}, in the interval of 68.3 % ({' | '.join(laws)} law)"
            # The page shows the entry "ap" behind the label, as it does for the other curves.
            lines.append({"label": title, "ap": shares, "points": points})
        has_curve = any(any(line["points"]) for line in lines)
        if has_curve:
            panels.append({"metric": "Gaussians", "class": label, "lines": lines})
    return panels


def _reliability(
    law: str, vertices: Vertices | None, label: int, axis: int
) -> tuple[float, list[list[float]]]:
    """Measure the reliability of one class in one direction.

    Args:
        law: Distribution of the errors, ``normal`` or ``laplace``.
        vertices: Matched vertices of a result, or None.
        label: Index of the class.
        axis: Index of the direction in ``AXES``.

    Returns:
        Share of errors in the interval of 68.3 %, and (level, share) of intervals of all levels;
        undefined and empty without vertices.
    """
    if vertices is None:
        return UNDEFINED, []
    of_class = vertices.select(vertices.labels == label)
    if not len(of_class.labels):
        return UNDEFINED, []
    errors = of_class.errors[:, axis]
    sigmas = of_class.sigmas[:, axis]
    one_sigma_level = COVERED[0]  # probability of the interval of one sigma of a normal law, 68.3 %
    half_width = half_widths(law, [one_sigma_level])[0]  # in units of sigma
    share = float((errors <= half_width * sigmas).mean())
    # `reliability` returns the share of errors in the central interval of each of ``LEVELS``.
    points = np.stack([LEVELS, reliability(errors, sigmas, law)], axis=1)
    return share, points.round(3).tolist()


def _matched_vertices(
    result: ScoredResult, truth: Mapping[str, MapElements], style: MapStyle
) -> Vertices | None:
    """Vertices of matched predictions, or None without Gaussians or matches."""
    for elements in result.predictions.values():
        if len(elements) and elements.scales is None:
            return None
    # Without a match, `matched_vertices` would raise an error.
    has_match = any((matches.matched_gt >= 0).any() for matches in result.matches.values())
    if not has_match:
        return None
    samples = []
    for token, true_elements in truth.items():
        if token in result.predictions:
            predictions = result.predictions[token]
            samples.append(Sample(token, predictions=predictions, ground_truth=true_elements))
    return matched_vertices(samples, ChamferConfig(tuple(style.classes)))


def group_tables(results: Sequence[ScoredResult], groups: Groups, by: str) -> list[Table]:
    """Create a table per result: AP in percent of each group of samples.

    Args:
        results: One or two results.
        groups: Groups of the samples.
        by: Name of the grouping for the caption, such as ``scene``.

    Returns:
        Tables in the order of the results.
    """
    tables = []
    for result in results:
        ap = ap_by_group(result.reports, groups)
        head, rows = group_table(result.reports, groups, group_aps=ap)
        caption = f"AP (%) by {by}"
        if len(results) > 1:
            caption += f", {result.name}"
        tables.append({"caption": caption, "head": head, "rows": rows})
    return tables


def _curve_points(detections: ClassDetections, column: int) -> list[list[float]]:
    """Points (recall, precision) at evenly spread ranks, for one column (threshold) of the hits."""
    recall, precision = precision_recall(detections.hits[:, column], detections.num_gts)
    points = np.stack([recall, precision], axis=1).round(3)
    if len(points) > _MAX_CURVE_POINTS:
        ranks = np.linspace(0, len(points) - 1, _MAX_CURVE_POINTS).astype(int)
        points = points[ranks]
    return points.tolist()
