"""Analyses of ``tools/evaluate.py``: intervals, groups, drives, changes and Gaussians.

``args`` are the options of that command; ``args.results`` is the result file, and
``args.ground_truth`` the annotation file. Modules that only one analysis needs are imported in its
function, so that a plain evaluation starts quickly.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.evaluation.analysis import DISTANCE
from gsmap.evaluation.core.chamfer_ap import CHAMFER_THRESHOLDS, ChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.file_evaluation import (
    Evaluation,
    SamplePairs,
    match_samples,
    scenes_of,
)
from gsmap.evaluation.core.metric import MetricSettings
from gsmap.evaluation.core.report import UNDEFINED, MetricReport
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.model_facts import law_of
from gsmap.utils.words import markdown_table

if TYPE_CHECKING:
    from gsmap.evaluation.analysis.bootstrap import Resamples
    from gsmap.evaluation.analysis.groups import Groups

DEFAULT_RESAMPLES = 1000  # number of resamples without a number in the options


def open_pairs(
    args: argparse.Namespace, results: Path, classes: Sequence[str], gaussians: bool = False
) -> SamplePairs:
    """Open a result file and the ground truth.

    Args:
        args: The options of the command.
        results: The result file.
        classes: Names of the classes.
        gaussians: Whether to read the Gaussians of the results.

    Returns:
        Iterable of samples with predictions and ground truth. It can be iterated only once.
    """
    return SamplePairs(
        results,
        args.ground_truth,
        classes,
        allow_mismatch=args.allow_mismatch,
        shard=args.shard,
        allow_other_split=args.allow_other_split,
        gaussians=gaussians,
    )


def polygon_labels(args: argparse.Namespace, classes: Sequence[str]) -> list[int]:
    """Labels of the classes of ``--polygon-classes``, whose elements are areas."""
    return [label for label, name in enumerate(classes) if name in args.polygon_classes]


def consistency_report(args: argparse.Namespace, settings: MetricSettings) -> MetricReport:
    """Score the drives of a result file; with ``--tracks``, write its tracks."""
    from gsmap.evaluation.analysis.consistency import ConsistencyConfig
    from gsmap.evaluation.analysis.drive_files import evaluate_drives

    if args.ground_truth.suffix.lower() == ".json":
        raise InputError(
            f"--consistency needs poses, which {args.ground_truth} has not: give the "
            "annotation file (.arrow)."
        )
    annotations = AnnotationFile(args.ground_truth)
    meta = annotations.meta
    config = ConsistencyConfig(
        classes=settings.classes,
        grid=BEVGrid(meta.x_range, meta.y_range),
        filled_classes=settings.areas,
        thresholds=settings.thresholds or CHAMFER_THRESHOLDS,
    )
    figures = evaluate_drives(args.results, annotations, config=config, tracks_file=args.tracks)
    # `groups` and `detections` concern metrics with an AP.
    return MetricReport("consistency", groups={}, metrics=figures, detections={})


def change_report(args: argparse.Namespace) -> MetricReport:
    """Print precision and recall of changes of the map.

    ``args.results`` is the GeoJSON file of the changes that were found, and ``args.changes`` the
    file of the true changes.
    """
    from gsmap.evaluation.analysis.change_files import KINDS, read_changes
    from gsmap.evaluation.analysis.changes import change_figures

    if args.ground_truth.suffix.lower() == ".json":
        raise InputError(
            f"--changes needs poses, which {args.ground_truth} has not: give the annotation file "
            "(.arrow)."
        )
    found_changes = read_changes(args.results)
    true_changes = read_changes(args.changes)
    annotations = AnnotationFile(args.ground_truth)
    figures = change_figures(found_changes, true_changes, annotations, found_file=args.results)
    rows = []
    # For "all", a found change must have the kind of the true one. For "any_kind", it need not.
    for name in (*KINDS, "all", "any_kind"):
        row = [name.replace("_", " ")]
        for key in ("precision", "recall"):
            value = figures[f"{name}/{key}"]
            # The value is undefined if there is no change to count.
            row.append("-" if value == UNDEFINED else f"{100 * value:.1f}")
        # "any_kind" counts all changes, and `figures` has these numbers only for "all".
        counted = "all" if name == "any_kind" else name
        for key in ("num_found", "num_true"):
            row.append(f"{figures[f'{counted}/{key}']:.0f}")
        rows.append(row)
    print(markdown_table(["changes", "precision", "recall", "found", "true in view"], rows) + "\n")
    return MetricReport.of_figures("changes", figures)


def uncertainty_report(args: argparse.Namespace, settings: MetricSettings) -> MetricReport:
    """Print the scores of predicted Gaussians; with ``--reliability``, draw their curves."""
    from gsmap.evaluation.analysis import calibration

    classes = settings.classes
    rules = ChamferConfig(classes)  # without AP_chamfer, its default rules match the vertices
    if "chamfer" in args.eval:
        rules = ChamferConfig.from_settings(settings)
    pairs = open_pairs(args, args.results, classes=classes, gaussians=True)
    vertices = calibration.matched_vertices(pairs, rules)
    # Distribution of the errors: "normal" or "laplace". The metadata `about` are complete only
    # after `matched_vertices` has iterated over the pairs.
    law = args.law or law_of(pairs.about)
    if args.reliability:
        from gsmap.visualization.figure import save_figure
        from gsmap.visualization.plots import plot_uncertainty

        figure = plot_uncertainty(vertices, classes, law)
        print(f"reliability: {save_figure(figure, args.reliability)}")
    report = calibration.uncertainty_report(vertices, classes, args.polygon_classes, law)
    print(calibration.format_uncertainty(report.metrics, law) + "\n")
    return report


def read_resamples(args: argparse.Namespace) -> "Resamples | None":
    """Create random resamples of the scenes of the ground truth; None if no option needs intervals.

    Intervals are the spread of an AP over the resamples (bootstrap).
    """
    if args.bootstrap is None and not args.against:
        return None
    from gsmap.evaluation.analysis.bootstrap import Resamples

    count = DEFAULT_RESAMPLES if args.bootstrap is None else args.bootstrap
    return Resamples(scenes_of(args.ground_truth), count, seed=args.seed or 0)


def interval_report(
    evaluation: Evaluation,
    others: Evaluation | None,
    resamples: "Resamples",
    args: argparse.Namespace,
) -> MetricReport:
    """Print the interval of every AP, and of its difference from another result file.

    Args:
        evaluation: Reports of the metrics with an AP, and notes, for the result file. The notes of
            ``others`` are appended to these notes, in place.
        others: Reports of all metrics, and notes, for the file of ``--against``, if it is given.
        resamples: The resamples of the scenes.
        args: The options of the command.

    Returns:
        The ends ``low`` and ``high`` of the intervals. For differences, whose keys have the prefix
        ``minus_other/``, also the ``value``.
    """
    from gsmap.evaluation.analysis.bootstrap import (
        ap_differences,
        ap_intervals,
        format_intervals,
    )

    reports, notes = evaluation
    origin = f"of {resamples.count} resamples of the scenes, seed {resamples.seed}"
    figures = {}
    intervals = ap_intervals(reports, resamples)
    print(format_intervals(intervals, f"AP with intervals of 95 % {origin}") + "\n")
    for key, interval in intervals.items():
        for field, value in vars(interval).items():
            if field != "value":  # the report of the metric has it
                figures[f"{key}/{field}"] = value
    if others is not None:
        other_reports, other_notes = others
        # As in `reports`, only metrics with an AP are compared. Only their reports have detections.
        ranked = []
        for report in other_reports:
            if report.detections:
                ranked.append(report)
        for note in other_notes:
            notes.append(f"{args.against}: {note}")
        differences = ap_differences(reports, ranked, resamples)
        title = f"{args.results} minus {args.against}, {origin}"
        print(format_intervals(differences, title, signed=True) + "\n")
        for key, interval in differences.items():
            for field, value in vars(interval).items():
                figures[f"minus_other/{key}/{field}"] = value
    return MetricReport("intervals", groups={}, metrics=figures, detections={})


def read_groups(args: argparse.Namespace) -> "Groups | None":
    """Read the group of each sample; None without ``--by``, and for ``--by distance``.

    Distances divide the map of each sample, not the samples.
    """
    if args.by in (None, DISTANCE):
        return None
    from gsmap.evaluation.analysis import groups

    return groups.read_groups(args.ground_truth, args.by)


def group_report(
    reports: Sequence[MetricReport],
    groups: "Groups | None",
    args: argparse.Namespace,
    evaluator: MapEvaluator,
) -> MetricReport:
    """Print the AP of each group of samples, or of each band of distances from the vehicle.

    Args:
        reports: Reports of metrics with an AP; not used if ``groups`` is None.
        groups: Groups of the samples; None cuts the map into bands of distances, which are matched
            again.
        args: The options of the command.
        evaluator: The metrics and their rules.
    """
    from gsmap.evaluation.analysis import groups as grouping

    if groups is None:
        from gsmap.evaluation.analysis.distances import cut_by_distance, distance_groups

        ap_metrics = [metric for metric in evaluator.metrics if metric.ranks]
        evaluator = MapEvaluator(*ap_metrics, ground_truth_points=evaluator.ground_truth_points)
        classes = evaluator.classes
        pairs = open_pairs(args, args.results, classes=classes)
        # Each sample becomes one sample per band, and the bands become the groups.
        pieces = cut_by_distance(pairs, polygon_labels(args, classes))
        reports = evaluator.reports(match_samples(pieces, evaluator, args.workers))
        groups = distance_groups(reports[0].tokens)
    aps = grouping.ap_by_group(reports, groups)
    headers, rows = grouping.group_table(reports, groups, aps)
    print(markdown_table(headers, rows) + "\n")
    return grouping.group_report(aps)
