"""Tables and curves of scored results, as the page shows them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsmap.evaluation.average_precision import precision_recall
from gsmap.evaluation.chamfer_ap import CHAMFER_THRESHOLDS
from gsmap.evaluation.matches import ClassDetections
from gsmap.evaluation.report import UNDEFINED, MetricReport, flat_metrics
from gsmap.visualization.page.scores import ScoredResult
from gsmap.visualization.style import MapStyle

Table = dict[str, Any]
_CURVE_POINTS = 120
_UNITS = {"chamfer": "m", "raster": "IoU"}


def _figure(value: float, factor: float = 100, digits: int = 1) -> str:
    """Write a figure, by default in percent; a dash where it does not exist."""
    return "\N{EN DASH}" if value == UNDEFINED else f"{factor * value:.{digits}f}"


def summary_table(results: Sequence[ScoredResult]) -> Table:
    """Return the means over the classes: a row per figure, a column per result.

    Args:
        results: One result, or two with their difference in a last column.
    """
    metrics = [flat_metrics(result.reports) for result in results]
    keys = {f"mAP_{report.name} (%)": f"{report.name}/mAP" for report in results[0].reports}
    for threshold in CHAMFER_THRESHOLDS:
        keys[f"AP_chamfer at {threshold} m (%)"] = f"chamfer/AP@{threshold}"
    head = ["mean over classes", *(result.name for result in results)]
    rows = [[title, *(_figure(m[key]) for m in metrics)] for title, key in keys.items()]
    if len(results) == 2:
        head.append(f"{results[1].name} minus {results[0].name}")
        for row, key in zip(rows, keys.values(), strict=True):
            first, second = (m[key] for m in metrics)
            known = UNDEFINED not in (first, second)
            row.append(f"{100 * (second - first):+.1f}" if known else _figure(UNDEFINED))
    return {"caption": "Summary", "head": head, "rows": rows}


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


def _thinned(found: ClassDetections, column: int) -> list[list[float]]:
    """Return recall and precision at some ranks, at most ``_CURVE_POINTS``."""
    hits = found.hits[:, column]
    pairs = np.stack(precision_recall(hits, found.num_gts), axis=1).round(3)
    if len(pairs) > _CURVE_POINTS:
        pairs = pairs[np.linspace(0, len(pairs) - 1, _CURVE_POINTS).astype(int)]
    return pairs.tolist()
