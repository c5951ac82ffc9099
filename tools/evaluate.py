#!/usr/bin/env python
"""Score the result file of any model: AP_chamfer and AP_raster.

Examples:
    python tools/evaluate.py results.json gsmap_nuscenes_val.arrow --eval chamfer raster
    python tools/evaluate.py results.json nuscenes_map_anns_val.json --eval chamfer --hard
    python tools/evaluate.py gsmap_nuscenes_val.arrow --prior gsmap_nuscenes_train.arrow
    python tools/evaluate.py maps/changes.geojson val.arrow --changes data/minicity/changes.geojson
"""

# ruff: noqa: E402 - numpy reads these variables when it is imported
import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # more threads would slow the worker processes down

# Imported before all libraries: this handles Ctrl-C during their imports, and keeps them from
# reading settings files in the working folder.
import gsmap  # noqa: F401

# isort: split
import argparse
import sys
import time
from pathlib import Path
from typing import NamedTuple

from scoring.analyses import (
    change_report,
    consistency_report,
    group_report,
    interval_report,
    open_pairs,
    read_groups,
    read_resamples,
    uncertainty_report,
)
from scoring.options import parse_args

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import CLASSES, RANGES
from gsmap.datasets.errors import explain_errors
from gsmap.evaluation.core.chamfer_ap import HARD_CHAMFER_THRESHOLDS
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.file_evaluation import (
    Evaluation,
    evaluate_files,
    match_samples,
)
from gsmap.evaluation.core.match_files import require_own_matches, write_matches
from gsmap.evaluation.core.metric import MetricSettings, metric_class, metric_files
from gsmap.evaluation.core.report import MetricReport, format_table, write_figures
from gsmap.evaluation.core.results_json import GROUND_TRUTH_KEY, read_leading_meta
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.grid import BEVGrid
from gsmap.utils.cli import run_command
from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_own
from gsmap.utils.faults import suggestion
from gsmap.utils.ray_shards import run_on_ray
from gsmap.utils.shards import digest, digest_of_common, read_shard
from gsmap.utils.words import format_count

# Names of reports that `print_reports` skips, because the code that makes them also prints them.
PRINTED = ("intervals", "by", "uncertainty", "changes")


class TruthSettings(NamedTuple):
    """Classes and extent of the ground truth, as described in its file.

    Attributes:
        classes: Names of the classes, in label order.
        x_range: Smallest and largest x in metres.
        y_range: Smallest and largest y in metres.
    """

    classes: tuple[str, ...]
    x_range: tuple[float, float]
    y_range: tuple[float, float]


def json_settings(path: Path) -> TruthSettings:
    """Read the settings of ground truth in JSON from the entry ``meta`` of the file.

    The default of a missing setting is its value for nuScenes.

    Args:
        path: Ground-truth file in JSON, for example written by ``create_data.py export``.

    Returns:
        Classes and range of the ground truth.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file has no ground truth, or its classes or its range are malformed.
    """
    meta = read_leading_meta(path, GROUND_TRUTH_KEY)
    x_range, y_range = RANGES["lidar"]
    # Errors about the content begin with the first text and end with the second one.
    with explain_errors(f"meta of {path}", "correct it, or remove it"):
        classes = meta.get("classes", CLASSES)
        is_list = isinstance(classes, (list, tuple))
        if not is_list or not all(isinstance(name, str) for name in classes):
            raise InputError(f"classes must be a list of names, got {classes!r:.80}")
        low_x, high_x = meta.get("x_range", x_range)
        low_y, high_y = meta.get("y_range", y_range)
        grid = BEVGrid((low_x, high_x), (low_y, high_y))  # raises an error for an invalid range
    return TruthSettings(tuple(classes), x_range=grid.x_range, y_range=grid.y_range)


def metric_settings(args: argparse.Namespace) -> MetricSettings:
    """Build the settings of the metrics from the options and the ground-truth file."""
    if args.ground_truth.suffix.lower() == ".json":
        described = json_settings(args.ground_truth)
    else:
        meta = AnnotationFile(args.ground_truth).meta
        described = TruthSettings(meta.classes, x_range=meta.x_range, y_range=meta.y_range)
    classes = tuple(args.classes or described.classes)
    x_range = described.x_range
    y_range = described.y_range
    for name in args.polygon_classes:
        if name not in classes and name not in AREA_CLASSES:
            hint = suggestion(name, classes)
            raise InputError(f"--polygon-classes: there is no class {name!r}{hint}")
    if args.range:
        x_min, y_min, x_max, y_max = args.range
        x_range = (x_min, x_max)
        y_range = (y_min, y_max)
    thresholds = HARD_CHAMFER_THRESHOLDS if args.hard else args.thresholds
    return MetricSettings(
        classes=classes,
        thresholds=tuple(thresholds) if thresholds else None,
        dim=args.dim,
        resample_predictions=not args.keep_pred_points,
        resample_ground_truth=not args.keep_gt_points,
        grid=BEVGrid(x_range, y_range),
        polygon_classes=tuple(args.polygon_classes),
        min_score=args.min_score,
    )


def build_evaluator(args: argparse.Namespace, settings: MetricSettings) -> MapEvaluator:
    """Build the metrics of ``--eval``.

    Raises:
        ValueError: If a metric is unknown, or no chosen metric can use one of the options.
    """
    for module in args.custom_imports:  # modules that register further metrics
        import_own(module)
    evaluator = MapEvaluator.from_names(args.eval, settings, args.gt_points)
    uses_min_score = any(metric.takes_min_score for metric in evaluator.metrics)
    if args.min_score is not None and not uses_min_score:
        names = _metrics_with("takes_min_score")
        raise InputError(f"--min-score applies to {names}: leave it out.")
    uses_thresholds = any(metric.takes_thresholds for metric in evaluator.metrics)
    if settings.thresholds and not (uses_thresholds or args.consistency):
        names = _metrics_with("takes_thresholds")
        raise InputError(f"--thresholds and --hard apply to {names}: leave them out.")
    if args.pr_curves and not any(metric.has_curves for metric in evaluator.metrics):
        raise InputError(
            "--pr-curves draws metrics that rank predictions over all samples: name chamfer or "
            "raster."
        )
    needs_ap = args.by or args.bootstrap is not None or args.against
    if needs_ap and not any(metric.ranks for metric in evaluator.metrics):
        raise InputError("--by, --bootstrap and --against apply to AP: name chamfer or raster.")
    return evaluator


def _metrics_with(attribute: str) -> str:
    """Names of the metrics whose class has an attribute that is true, as a list in a sentence."""
    names = []
    for name in metric_files():
        if getattr(metric_class(name), attribute):
            names.append(name)
    return ", ".join(names)


def evaluate_results(
    results: Path, args: argparse.Namespace, evaluator: MapEvaluator
) -> Evaluation:
    """Score a result file.

    Args:
        results: The result file: the first argument of the command, or ``--against``.
        args: The options of the command.
        evaluator: The metrics and their rules.
    """
    return evaluate_files(
        results,
        args.ground_truth,
        evaluator,
        num_workers=args.workers,
        allow_mismatch=args.allow_mismatch,
        allow_other_split=args.allow_other_split,
    )


def evaluate_input(args: argparse.Namespace, evaluator: MapEvaluator) -> Evaluation:
    """Score the result file, or with ``--prior`` the best fixed map."""
    if not args.prior:
        return evaluate_results(args.results, args, evaluator)
    from gsmap.evaluation.analysis.prior import MAX_ELEMENTS, evaluate_prior

    max_elements = MAX_ELEMENTS if args.prior_elements is None else args.prior_elements
    return evaluate_prior(
        args.prior,
        args.ground_truth,
        evaluator=evaluator,
        max_elements=max_elements,
        allow_other_split=args.allow_other_split,
    )


def match_shard(args: argparse.Namespace, evaluator: MapEvaluator, settings: MetricSettings) -> str:
    """Match one shard of the samples and write the matches.

    Args:
        args: The options of the command.
        evaluator: The metrics.
        settings: The rules of the metrics, which are written beside the matches.

    Returns:
        A line with the number of samples and the file.

    Raises:
        FileNotFoundError: If the results do not exist.
        ValueError: If a file is malformed, or another program's file has the name of the output.
    """
    require_own_matches(args.out, args.shard)
    # The results are in one file for all shards, or in a file for this shard. If neither exists,
    # `digest` raises an error that names the first one.
    results = args.results
    results_shard = args.shard.path_of(args.results)
    # The source identifies the inputs. It must be equal for all shards of one evaluation.
    if args.results.exists() or not results_shard.exists():
        source = digest(args.results)
    else:
        results = results_shard
        source = digest_of_common(read_shard(results_shard))
    pairs = open_pairs(args, results, classes=evaluator.classes)
    matches = list(match_samples(pairs, evaluator, args.workers))
    # Notes on ignored elements are complete only after all pairs were matched.
    notes = pairs.notes(evaluator.counts_heights, evaluator.canvas)
    source += digest(args.ground_truth)
    path = write_matches(
        args.out,
        args.shard,
        matches=matches,
        notes=notes,
        evaluator=evaluator,
        settings=settings,
        source=source,
    )
    return f"{format_count(len(matches), 'sample')} matched: {path}"


def print_reports(reports: list[MetricReport], notes: list[str], args: argparse.Namespace) -> None:
    """Print tables and notes; write the files of ``--out`` and ``--pr-curves``.

    Args:
        reports: Reports of all metrics and analyses.
        notes: Remarks about samples and elements without a score.
        args: The options of the command.
    """
    for report in reports:
        if report.name not in PRINTED:
            print(format_table(report) + "\n")
    for note in notes:
        print(f"note: {note}")
    if args.out:
        write_figures(args.out, reports)
        print(f"figures: {args.out}")
    if args.pr_curves:
        from gsmap.visualization.figure import save_figure  # matplotlib takes a second
        from gsmap.visualization.plots import plot_result

        # Metrics with an AP per sample have no curve over all samples.
        with_curves = []
        for report in reports:
            if report.detections and not report.sample_aps:
                with_curves.append(report)
        path = save_figure(plot_result(with_curves), args.pr_curves)
        print(f"curves: {path}")


def main(argv: list[str] | None = None) -> str:
    """Run the command, and return its last line, which `run_command` prints."""
    args = parse_args(__doc__, argv)
    if args.executor:  # a Ray cluster runs this command once for each shard
        return run_on_ray(args, sys.argv)
    start = time.perf_counter()
    if args.changes:
        print_reports([change_report(args)], [], args)
        return f"{args.results} in {time.perf_counter() - start:.1f} s"
    settings = metric_settings(args)
    evaluator = build_evaluator(args, settings)
    if args.shard.count:  # 0 without ``--shard``
        return match_shard(args, evaluator, settings)
    # These files are read first, so that errors in them end the command before the scoring.
    groups = read_groups(args)
    resamples = read_resamples(args)  # random samples of the scenes; None without an interval
    reports, notes = evaluate_input(args, evaluator)
    ranked = []  # reports of metrics with an AP
    for report in reports:
        if report.detections:
            ranked.append(report)
    analyses = []
    if resamples is not None:
        # The notes of the other file are appended to `notes`, which are printed at the end.
        others = evaluate_results(args.against, args, evaluator) if args.against else None
        analyses.append(interval_report((ranked, notes), others, resamples, args))
    if args.by:
        analyses.append(group_report(ranked, groups, args, evaluator))
    if args.consistency:
        analyses.append(consistency_report(args, settings))
    if args.uncertainty:
        analyses.append(uncertainty_report(args, settings))
    print_reports([*reports, *analyses], notes, args)
    number = len(reports[0].tokens)
    return f"{format_count(number, 'sample')} in {time.perf_counter() - start:.1f} s"


if __name__ == "__main__":
    run_command(main)
