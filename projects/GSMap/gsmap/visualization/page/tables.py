"""Tables and curves of scored results, as the page shows them."""

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
_CURVE_POINTS = 120
_DIFFERENCES = 12  # samples in which two results differ most
_UNITS = {"chamfer": "m", "raster": "IoU"}


def _figure(value: float, factor: float = 100, digits: int = 1) -> str:
    """Write a figure, by default in percent; a dash where it does not exist."""
    return "\N{EN DASH}" if value == UNDEFINED else f"{factor * value:.{digits}f}"


def summary_table(results: Sequence[ScoredResult], resamples: Resamples | None = None) -> Table:
    """Return the means over the classes: a row per figure, a column per result.

    Args:
        results: One result, or two with their difference in a last column.
        resamples: Scenes to compute intervals of 95 % from; None shows none.
    """
    reports = [result.reports for result in results]
    of_each: list[Mapping[str, Interval]] = [{} for _ in results]
    of_difference: Mapping[str, Interval] = {}
    if resamples is not None:
        of_each = [ap_intervals(of_result, resamples) for of_result in reports]
        if len(results) == 2:
            of_difference = ap_differences(reports[1], reports[0], resamples)
    metrics = [flat_metrics(result.reports) for result in results]
    keys = {f"mAP_{report.name} (%)": f"{report.name}/mAP" for report in results[0].reports}
    for threshold in CHAMFER_THRESHOLDS:
        keys[f"AP_chamfer at {threshold} m (%)"] = f"chamfer/AP@{threshold}"
    head = ["mean over classes", *(result.name for result in results)]
    columns = [
        [_figure(figures[key]) + _range(intervals.get(key)) for key in keys.values()]
        for figures, intervals in zip(metrics, of_each, strict=True)
    ]
    rows = [[title, *cells] for title, *cells in zip(keys, *columns, strict=True)]
    if len(results) == 2:
        head.append(f"{results[1].name} minus {results[0].name}")
        for row, key in zip(rows, keys.values(), strict=True):
            first, second = (m[key] for m in metrics)
            known = UNDEFINED not in (first, second)
            difference = f"{100 * (second - first):+.1f}" if known else _figure(UNDEFINED)
            row.append(difference + _range(of_difference.get(key), "+"))
    caption = "Summary" + (", intervals of 95 % over scenes" if resamples else "")
    return {"caption": caption, "head": head, "rows": rows}


def _range(interval: Interval | None, sign: str = "") -> str:
    """Write an interval behind its figure, in percent; nothing where it does not exist."""
    if interval is None or UNDEFINED in (interval.value, interval.low, interval.high):
        return ""
    return f" ({100 * interval.low:{sign}.1f} to {100 * interval.high:{sign}.1f})"


def difference_table(
    results: Sequence[ScoredResult], titles: Mapping[str, str], score_thr: float
) -> Table:
    """Return the samples in which two results differ most in F1, the largest difference first.

    Args:
        results: Two results.
        titles: What the page calls each sample, by token.
        score_thr: Smallest score that F1 counts.
    """
    rows = []
    for token, title in titles.items():
        first, second = (result.f1(token, score_thr) for result in results)
        rows.append((abs(second - first), [title, token, first, second, second - first]))
    rows.sort(key=lambda row: -row[0])
    shown = [
        [title, token, f"{first:.2f}", f"{second:.2f}", f"{difference:+.2f}"]
        for apart, (title, token, first, second, difference) in rows[:_DIFFERENCES]
        if apart > 0
    ]
    head = ["sample", "token", *(f"F1 of {result.name}" for result in results), "difference"]
    return {
        "caption": f"Where they differ most, from score {score_thr:g}",
        "head": head,
        "rows": shown,
    }


def _columns(report: MetricReport, class_name: str) -> list[tuple[str, str, float, int]]:
    """Return heading, key, factor and digits of the columns, as in ``format_table``."""
    keys = report.detections[class_name].thresholds
    chamfer, unit = report.name == "chamfer", _UNITS[report.name]
    loosest = keys[-1 if chamfer else 0]
    error = ("mean error (m)", f"error_m@{loosest}", 1, 2) if chamfer else ("mIoU", "mIoU", 1, 3)
    return [
        ("AP (%)", "AP", 100, 1),
        *((f"at {key} {unit}", f"AP@{key}", 100, 1) for key in keys),
        (f"recall at {loosest} {unit} (%)", f"recall@{loosest}", 100, 1),
        error,
        (f"calibration error at {loosest} {unit}", f"calibration_error@{loosest}", 1, 3),
        ("truths", "num_gts", 1, 0),
        ("predictions", "num_preds", 1, 0),
    ]


def class_tables(results: Sequence[ScoredResult], style: MapStyle) -> list[Table]:
    """Return a table per metric and group of classes: a row per class and result."""
    tables, several = [], len(results) > 1
    for index, report in enumerate(results[0].reports):
        for group, names in report.groups.items():
            columns = _columns(report, names[0])
            rows = []
            for name in names:
                for result in results:
                    figures = result.reports[index].metrics
                    title = style.title(style.classes.index(name))
                    values = [
                        _figure(figures[f"{report.name}/{name}/{key}"], factor, digits)
                        for _, key, factor, digits in columns
                    ]
                    rows.append([title, *([result.name] if several else []), *values])
            what = f", {group} classes" if len(report.groups) > 1 else ""
            named = ["class", *(["result"] if several else [])]
            head = [*named, *(column[0] for column in columns)]
            tables.append({"caption": f"AP_{report.name}{what}", "head": head, "rows": rows})
    return tables


def curves(results: Sequence[ScoredResult], style: MapStyle) -> list[dict[str, Any]]:
    """Return a panel per metric and class: AP and (recall, precision) per threshold and result."""
    panels = []
    for index, report in enumerate(results[0].reports):
        for name, detections in report.detections.items():
            found = [result.reports[index] for result in results]
            lines = []
            for t, threshold in enumerate(detections.thresholds):
                key = f"{report.name}/{name}/AP@{threshold}"
                ap = [_figure(each.metrics[key]) for each in found]
                points = [_thinned(each.detections[name], t) for each in found]
                label = f"{threshold} {_UNITS[report.name]}"
                lines.append({"label": label, "ap": ap, "points": points})
            panel = {"metric": f"AP_{report.name}", "class": style.classes.index(name)}
            panels.append(panel | {"lines": lines})
    return panels


def reliability_curves(
    results: Sequence[ScoredResult], truth: Mapping[str, MapElements], style: MapStyle
) -> list[dict[str, Any]]:
    """Return a panel per class: the share of errors within intervals of each result's law.

    Args:
        results: One result or two; those without Gaussians have no curve.
        truth: Ground truth of each sample, by token.
        style: Names of the classes.
    """
    found = [_vertices(result, truth, style) for result in results]
    laws = " | ".join(dict.fromkeys(r.law for r, each in zip(results, found, strict=True) if each))
    panels = []
    for label in range(len(style.classes)):
        own = [each.of(each.labels == label) if each else None for each in found]
        lines = []
        for axis, name in enumerate(AXES):
            shares: list[float] = []
            points: list[list[list[float]]] = []
            for result, each in zip(results, own, strict=True):
                if each is None or not len(each.labels):
                    shares.append(UNDEFINED)
                    points.append([])
                    continue
                errors, sigmas = each.errors[:, axis], each.sigmas[:, axis]
                width = half_widths(result.law, COVERED)[0]
                shares.append(float((errors <= width * sigmas).mean()))
                curve = reliability(errors, sigmas, result.law)
                points.append(np.stack([LEVELS, curve], 1).round(3).tolist())
            title = f"{name}, in the interval of 68.3 % ({laws} law)"
            label_ap = {"label": title, "ap": [_figure(s) for s in shares]}
            lines.append(label_ap | {"points": points})
        if any(map(any, (line["points"] for line in lines))):
            panels.append({"metric": "Gaussians", "class": label, "lines": lines})
    return panels


def _vertices(
    result: ScoredResult, truth: Mapping[str, MapElements], style: MapStyle
) -> Vertices | None:
    """Return the vertices of matched predictions, or None without Gaussians or matches."""
    some = [elements for elements in result.predictions.values() if len(elements)]
    matched = any((matches.matched_gt >= 0).any() for matches in result.matches.values())
    if not matched or any(elements.scales is None for elements in some):
        return None
    predictions = result.predictions
    pairs = (Sample(t, predictions[t], gt) for t, gt in truth.items() if t in predictions)
    return matched_vertices(pairs, ChamferConfig(tuple(style.classes)))


def group_tables(results: Sequence[ScoredResult], groups: Groups, by: str) -> list[Table]:
    """Return a table per result: AP in percent of each group of samples.

    Args:
        results: One result or two.
        groups: Of the samples.
        by: What they are, for the caption.
    """
    tables = []
    for result in results:
        head, rows = group_table(result.reports, groups, ap_by_group(result.reports, groups))
        what = f", {result.name}" if len(results) > 1 else ""
        tables.append({"caption": f"AP (%) by {by}{what}", "head": head, "rows": rows})
    return tables


def _thinned(found: ClassDetections, column: int) -> list[list[float]]:
    """Return recall and precision at some ranks, at most ``_CURVE_POINTS``."""
    hits = found.hits[:, column]
    pairs = np.stack(precision_recall(hits, found.num_gts), axis=1).round(3)
    if len(pairs) > _CURVE_POINTS:
        pairs = pairs[np.linspace(0, len(pairs) - 1, _CURVE_POINTS).astype(int)]
    return pairs.tolist()
