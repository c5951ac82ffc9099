#!/usr/bin/env python
"""Score the result file of any model: AP_chamfer and AP_raster.

Examples:
    python tools/evaluate.py results.json gsmap_nuscenes_val.arrow --eval chamfer raster
    python tools/evaluate.py results.json nuscenes_map_anns_val.json --eval chamfer --hard
    python tools/evaluate.py gsmap_nuscenes_val.arrow --prior gsmap_nuscenes_train.arrow
"""

# Over 400 lines: one command scores, and a third of it names its options.
# ruff: noqa: E402 - numpy reads these variables when it is imported
import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # idle threads would only stand in the workers' way

import argparse
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import CLASSES, RANGES
from gsmap.evaluation.analysis import DISTANCE
from gsmap.evaluation.core.chamfer_ap import (
    CHAMFER_THRESHOLDS,
    HARD_CHAMFER_THRESHOLDS,
    ChamferConfig,
)
from gsmap.evaluation.core.evaluator import METRIC_NAMES, MapEvaluator
from gsmap.evaluation.core.file_evaluation import (
    Evaluation,
    SamplePairs,
    evaluate_files,
    match_samples,
    scenes_of,
)
from gsmap.evaluation.core.match_files import write_matches
from gsmap.evaluation.core.metric import MetricSettings, metric_class, metric_files
from gsmap.evaluation.core.report import MetricReport, format_table, write_figures
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.grid import BEVGrid
from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.faults import nearest
from gsmap.utils.model_facts import LAW_NAMES, law_of
from gsmap.utils.ray_shards import run_on_ray
from gsmap.utils.shards import add_shard_options, digest, digest_of_common, read_shard
from gsmap.utils.words import counted, markdown_table

if TYPE_CHECKING:  # what only some options need is imported where it is used
    from gsmap.evaluation.analysis.bootstrap import Resamples
    from gsmap.evaluation.analysis.groups import Groups


def parse_args(argv: list[str] | None = None) -> argparse.Namespace:
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_inputs(parser)
    add_metrics(parser)
    add_rules(parser)
    add_analysis(parser)
    add_outputs(parser)
    add_shard_options(parser)
    args = parser.parse_args(argv)
    check_combinations(parser, args)
    args.eval = metrics_from(args)
    return args


def add_inputs(parser: argparse.ArgumentParser) -> None:
    """Add the files that are read, and what is said of them."""
    parser.add_argument("results", type=Path, nargs="?", help="results in MapTR's JSON form")
    parser.add_argument(
        "ground_truth", type=Path, help="annotation file (*.arrow), or JSON with a list of GTs"
    )
    group = parser.add_argument_group("inputs")
    group.add_argument(
        "--prior",
        type=Path,
        metavar="TRAIN",
        help="score the best fixed set of elements, fitted on this ground truth",
    )
    group.add_argument("--prior-elements", type=int, default=50, help="elements in that set")
    group.add_argument("--classes", nargs="+", help="default: the annotation file's, or MapTR's")
    group.add_argument(
        "--allow-mismatch",
        action="store_true",
        help="samples without results count as empty, results without ground truth are left out",
    )
    group.add_argument(
        "--allow-other-split",
        action="store_true",
        help="the model may be trained on another split, which may hold places of this one",
    )
    group.add_argument("--workers", type=int, default=1, help="number of processes")


def add_metrics(parser: argparse.ArgumentParser) -> None:
    """Add the choice of metrics."""
    group = parser.add_argument_group("metrics")
    group.add_argument(
        "--eval",
        nargs="+",
        default=list(METRIC_NAMES),
        metavar="METRIC",
        help=f"names of metrics: {', '.join(metric_files())}; chamfer_hard: AP_chamfer at 0.2, "
        "0.5 and 1.0 m, too. Those of methods, and their variants, are not comparable with others",
    )
    group.add_argument(
        "--custom-imports",
        nargs="+",
        default=[],
        metavar="MODULE",
        help="modules with metrics of one's own, which --eval then knows",
    )
    group.add_argument(
        "--topology",
        action="store_true",
        help="--eval topology beside the others: elements in pieces, elements joined and lines "
        "that fold back; with --dim 3 also --eval heights",
    )
    group.add_argument(
        "--pld",
        action="store_true",
        help="--eval pld beside the others: distance of whole maps, in which the order of points "
        "and all scores count",
    )


def add_rules(parser: argparse.ArgumentParser) -> None:
    """Add the rules that metrics follow."""
    group = parser.add_argument_group("rules of metrics")
    group.add_argument(
        "--thresholds", nargs="+", type=float, help="of AP_chamfer, in metres (0.5 1.0 1.5)"
    )
    group.add_argument("--hard", action="store_true", help="AP_chamfer at 0.2, 0.5 and 1.0 m")
    group.add_argument(
        "--dim",
        type=int,
        default=2,
        choices=(2, 3),
        help="coordinates of AP_chamfer; 3 needs heights in results and ground truth",
    )
    group.add_argument(
        "--polygon-classes",
        nargs="*",
        default=list(AREA_CLASSES),
        help="classes that AP_raster fills",
    )
    group.add_argument(
        "--range",
        nargs=4,
        type=float,
        metavar=("X0", "Y0", "X1", "Y1"),
        help="canvas of AP_raster in metres: the annotation file's, or nuScenes' -15 -30 15 30; "
        "Argoverse 2: -30 -15 30 15",
    )
    group.add_argument(
        "--gt-points", type=int, help="resample ground truth to that many points first (raw)"
    )
    group.add_argument(
        "--keep-pred-points",
        action="store_true",
        help="AP_chamfer: compare predictions at their own points, not at 100",
    )
    group.add_argument(
        "--keep-gt-points",
        action="store_true",
        help="AP_chamfer: compare ground truth at its own vertices, not at 100 points",
    )
    group.add_argument(
        "--min-score",
        type=float,
        help="of predictions that topology counts (0.4), and metrics of AP per sample (0: all)",
    )


def add_analysis(parser: argparse.ArgumentParser) -> None:
    """Add what is made of the metrics, and of drives and Gaussians."""
    group = parser.add_argument_group("analysis")
    group.add_argument(
        "--bootstrap",
        type=int,
        nargs="?",
        const=1000,
        metavar="N",
        help="intervals of 95 %% of every AP, of N resamples of the scenes (1000)",
    )
    group.add_argument("--seed", type=int, default=0, help="of the resamples")
    group.add_argument(
        "--against",
        type=Path,
        metavar="OTHER",
        help="second result file: what the first has more in every AP, with its interval",
    )
    group.add_argument(
        "--by",
        metavar="map|scene|distance|FILE",
        help="AP of each map or scene alone, of the map cut at 10 and 20 m from the vehicle, or "
        "of scenes by night and weather (FILE: scene.json of nuScenes' tables, or JSON with a word "
        "for each scene or each sample)",
    )
    group.add_argument(
        "--consistency",
        action="store_true",
        help="C-mAP of MapTracker and jitter over drives; needs an annotation file with poses",
    )
    group.add_argument(
        "--tracks",
        type=output_file,
        help="with --consistency: write the results again, each element with its track_id",
    )
    group.add_argument(
        "--uncertainty",
        action="store_true",
        help="whether Gaussians say how far off matched vertices are: likelihood, coverage, ranks",
    )
    group.add_argument(
        "--law",
        choices=LAW_NAMES,
        help="with --uncertainty: distribution of the errors (that of the model's calibration, as "
        "the results say, or normal)",
    )
    group.add_argument(
        "--reliability", type=output_file, help="with --uncertainty: draw its curves"
    )


def add_outputs(parser: argparse.ArgumentParser) -> None:
    """Add the files that are written."""
    group = parser.add_argument_group("outputs")
    group.add_argument("--out", type=output_file, help="write all figures as flat JSON")
    group.add_argument("--pr-curves", type=output_file, help="draw PR curves and calibration")


def check_combinations(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Refuse options that exclude each other."""
    if args.results and args.results.suffix == ".arrow":
        parser.error(f"{args.results} holds ground truth: name the result file before it")
    if (args.results is None) == (args.prior is None):
        parser.error("name either a result file or --prior")
    for refused, why in (
        (args.hard and args.thresholds, "--hard and --thresholds exclude each other"),
        (args.tracks and not args.consistency, "--tracks needs --consistency"),
        (args.reliability and not args.uncertainty, "--reliability needs --uncertainty"),
        (args.law and not args.uncertainty, "--law needs --uncertainty"),
        (args.against and args.prior, "--against compares two result files: leave out --prior"),
        (args.by == DISTANCE and args.prior, "--by distance cuts a result file: leave out --prior"),
        (args.by == DISTANCE and args.dim == 3, "--by distance is in the plane: leave out --dim 3"),
        (
            args.shard.count and (not args.out or args.prior or args.pr_curves),
            "--shard needs --out, and can neither fit a --prior nor draw --pr-curves",
        ),
        (
            args.shard.count and (args.bootstrap is not None or args.against or args.by),
            "--bootstrap, --against and --by need all samples: leave out --shard",
        ),
    ):
        if refused:
            parser.error(why)
    for name in ("consistency", "uncertainty"):
        if getattr(args, name) and (args.prior or args.shard.count):
            parser.error(f"--{name} needs a result file as a whole: leave out --prior and --shard")


def metrics_from(args: argparse.Namespace) -> list[str]:
    """Return the names of the metrics that the options ask for, once each."""
    names = [*args.eval]
    if args.pld:
        names.append("pld")
    if args.topology:
        names += ["topology", "heights"] if args.dim == 3 else ["topology"]
    return list(dict.fromkeys(names))


def settings_from(args: argparse.Namespace) -> MetricSettings:
    """Join the arguments with what the annotation file says."""
    classes, (x_range, y_range) = CLASSES, RANGES["lidar"]
    if args.ground_truth.suffix.lower() != ".json":
        meta = AnnotationFile(args.ground_truth).meta
        classes, x_range, y_range = meta.classes, meta.x_range, meta.y_range
    classes = tuple(args.classes or classes)
    for name in set(args.polygon_classes) - {*classes, *AREA_CLASSES}:
        raise InputError(f"--polygon-classes: there is no class {name!r}{nearest(name, classes)}")
    if args.range:
        x_range, y_range = tuple(args.range[::2]), tuple(args.range[1::2])
    thresholds = HARD_CHAMFER_THRESHOLDS if args.hard else args.thresholds
    return MetricSettings(
        classes,
        tuple(thresholds) if thresholds else None,
        dim=args.dim,
        resample_predictions=not args.keep_pred_points,
        resample_ground_truth=not args.keep_gt_points,
        grid=BEVGrid(x_range, y_range),
        polygon_classes=tuple(args.polygon_classes),
        min_score=args.min_score,
    )


def evaluator_from(args: argparse.Namespace, settings: MetricSettings) -> MapEvaluator:
    """Return the metrics that are asked for.

    Raises:
        ValueError: If there is no metric of a name, or an option is of no metric of them.
    """
    for module in args.custom_imports:
        import_module(module)
    evaluator = MapEvaluator.named(args.eval, settings, args.gt_points)
    if args.min_score is not None and not any(m.takes_min_score for m in evaluator.metrics):
        takers = [name for name in metric_files() if metric_class(name).takes_min_score]
        raise InputError(f"--min-score is of {', '.join(takers)}: leave it out.")
    if args.pr_curves and not any(metric.has_curves for metric in evaluator.metrics):
        raise InputError(
            "--pr-curves draws what counts predictions of all samples: name chamfer or raster."
        )
    of_ap = args.by or args.bootstrap is not None or args.against
    if of_ap and not any(metric.ranks for metric in evaluator.metrics):
        raise InputError("--by, --bootstrap and --against are of AP: name chamfer or raster.")
    return evaluator


def report(outcome: Evaluation, args: argparse.Namespace) -> None:
    reports, notes = outcome
    for found in reports:
        if found.name in ("intervals", "by", "uncertainty"):  # printed
            continue
        print(format_table(found) + "\n")
    for note in notes:
        print(f"note: {note}")
    if args.out:
        write_figures(args.out, reports)
        print(f"figures: {args.out}")
    if args.pr_curves:
        from gsmap.visualization.figure import save_figure  # matplotlib takes a second
        from gsmap.visualization.plots import plot_result

        drawn = [found for found in reports if found.detections and not found.sample_aps]
        print(f"curves: {save_figure(plot_result(drawn), args.pr_curves)}")


def consistency_report(args: argparse.Namespace) -> MetricReport:
    """Score the drives of a result file, and write its tracks if that is asked for."""
    from gsmap.evaluation.analysis.consistency import ConsistencyConfig
    from gsmap.evaluation.analysis.drive_files import evaluate_drives

    if args.ground_truth.suffix.lower() == ".json":
        raise InputError(
            f"--consistency needs poses, which {args.ground_truth} has not: give the "
            "annotation file (.arrow)."
        )
    annotations = AnnotationFile(args.ground_truth)
    meta = annotations.meta
    classes = tuple(args.classes or meta.classes)
    config = ConsistencyConfig(
        classes,
        BEVGrid(meta.x_range, meta.y_range),
        tuple(label for label, name in enumerate(classes) if name in args.polygon_classes),
        tuple(args.thresholds or CHAMFER_THRESHOLDS),
    )
    figures = evaluate_drives(args.results, annotations, config, args.tracks)
    return MetricReport("consistency", {}, figures, {})


def report_of_gaussians(args: argparse.Namespace, settings: MetricSettings) -> MetricReport:
    """Print the scores of a result file's Gaussians; draw their curves if that is asked for."""
    from gsmap.evaluation.analysis.calibration import (
        format_uncertainty,
        matched_vertices,
        uncertainty_report,
    )

    classes = settings.classes
    rules = ChamferConfig.of(settings) if "chamfer" in args.eval else ChamferConfig(classes)
    inputs = args.results, args.ground_truth, classes, args.allow_mismatch, args.shard
    pairs = SamplePairs(*inputs, args.allow_other_split, gaussians=True)
    vertices = matched_vertices(pairs, rules)
    law = args.law or law_of(pairs.about)
    if args.reliability:
        from gsmap.visualization.figure import save_figure
        from gsmap.visualization.plots import plot_uncertainty

        figure = plot_uncertainty(vertices, classes, law)
        print(f"reliability: {save_figure(figure, args.reliability)}")
    found = uncertainty_report(vertices, classes, args.polygon_classes, law)
    print(format_uncertainty(found.metrics, law) + "\n")
    return found


def match_shard(args: argparse.Namespace, evaluator: MapEvaluator, settings: MetricSettings) -> str:
    """Match a part of the samples and keep the matches; return what was done."""
    results = args.shard.path_of(args.results)
    if args.results.exists() or not results.exists():
        results, source = args.results, digest(args.results)
    else:  # of results in shards, too, the same one is enough
        source = digest_of_common(read_shard(results))
    pairs = SamplePairs(
        results,
        args.ground_truth,
        evaluator.classes,
        args.allow_mismatch,
        args.shard,
        args.allow_other_split,
    )
    matches = list(match_samples(pairs, evaluator, args.workers))
    notes = pairs.notes(evaluator.counts_heights)
    source += digest(args.ground_truth)
    path = write_matches(args.out, args.shard, matches, notes, evaluator, settings, source)
    return f"{counted(len(matches), 'sample')} matched: {path}"


def evaluate(results: Path, args: argparse.Namespace, evaluator: MapEvaluator) -> Evaluation:
    """Score a result file."""
    return evaluate_files(
        results,
        args.ground_truth,
        evaluator,
        args.workers,
        args.allow_mismatch,
        args.allow_other_split,
    )


def resamples_from(args: argparse.Namespace) -> "Resamples | None":
    """Read the scenes of samples before anything is scored; None without intervals."""
    if args.bootstrap is None and not args.against:
        return None
    from gsmap.evaluation.analysis.bootstrap import Resamples

    count = 1000 if args.bootstrap is None else args.bootstrap
    return Resamples(scenes_of(args.ground_truth), count, args.seed)


def interval_report(
    outcome: Evaluation, resamples: "Resamples", args: argparse.Namespace, evaluator: MapEvaluator
) -> MetricReport:
    """Print the intervals of every AP, and of what it has more than in another result file."""
    from gsmap.evaluation.analysis.bootstrap import (
        ap_differences,
        ap_intervals,
        format_intervals,
    )

    what = f"of {resamples.count} resamples of the scenes, seed {resamples.seed}"
    found = {"": ap_intervals(outcome[0], resamples)}
    print(format_intervals(found[""], f"AP with intervals of 95 % {what}") + "\n")
    if args.against:
        others, notes = evaluate(args.against, args, evaluator)
        others = [found for found in others if found.detections]
        outcome[1].extend(f"{args.against}: {note}" for note in notes)
        found["minus_other/"] = ap_differences(outcome[0], others, resamples)
        title = f"{args.results} minus {args.against}, {what}"
        print(format_intervals(found["minus_other/"], title, signed=True) + "\n")
    flat = {
        f"{prefix}{key}/{part}": value
        for prefix, intervals in found.items()
        for key, interval in intervals.items()
        for part, value in vars(interval).items()
        if prefix or part != "value"
    }
    return MetricReport("intervals", {}, flat, {})


def groups_from(args: argparse.Namespace) -> "Groups | None":
    """Read the groups of samples before anything is scored; None: bands of distances, or none."""
    if args.by in (None, DISTANCE):
        return None
    from gsmap.evaluation.analysis.groups import read_groups

    return read_groups(args.ground_truth, args.by)


def report_of_parts(
    reports: Sequence[MetricReport],
    groups: "Groups | None",
    args: argparse.Namespace,
    evaluator: MapEvaluator,
) -> MetricReport:
    """Print the AP of each group of samples; without groups, of the map in bands of distances."""
    from gsmap.evaluation.analysis.groups import ap_by_group, group_report, group_table

    if groups is None:
        from gsmap.evaluation.analysis.distances import cut_by_distance, distance_groups

        ranking = [metric for metric in evaluator.metrics if metric.ranks]
        evaluator = MapEvaluator(*ranking, ground_truth_points=evaluator.ground_truth_points)
        classes = evaluator.classes
        inputs = args.results, args.ground_truth, classes, args.allow_mismatch, args.shard, True
        areas = [label for label, name in enumerate(classes) if name in args.polygon_classes]
        pieces = cut_by_distance(SamplePairs(*inputs), areas)
        reports = evaluator.reports(match_samples(pieces, evaluator, args.workers))
        groups = distance_groups(reports[0].tokens)
    aps = ap_by_group(reports, groups)
    print(markdown_table(*group_table(reports, groups, aps)) + "\n")
    return group_report(aps)


def main(argv: list[str] | None = None) -> str:
    args = parse_args(argv)
    if args.executor:
        return run_on_ray(args, sys.argv)
    start = time.perf_counter()
    settings = settings_from(args)
    evaluator = evaluator_from(args, settings)
    if args.shard.count:
        return match_shard(args, evaluator, settings)
    groups = groups_from(args)
    resamples = resamples_from(args)
    if args.prior:
        from gsmap.evaluation.analysis.prior import evaluate_prior

        how = args.prior_elements, args.allow_other_split
        outcome = evaluate_prior(args.prior, args.ground_truth, evaluator, *how)
    else:
        outcome = evaluate(args.results, args, evaluator)
    reports, notes = outcome
    ranked = [found for found in reports if found.detections]
    counts = [found for found in reports if not found.detections]
    analysis = []
    if resamples is not None:
        analysis.append(interval_report((ranked, notes), resamples, args, evaluator))
    if args.by:
        analysis.append(report_of_parts(ranked, groups, args, evaluator))
    analysis += counts
    if args.consistency:
        analysis.append(consistency_report(args))
    if args.uncertainty:
        analysis.append(report_of_gaussians(args, settings))
    report(([*ranked, *analysis], notes), args)
    number = len(reports[0].tokens)
    return f"{counted(number, 'sample')} in {time.perf_counter() - start:.1f} s"


if __name__ == "__main__":
    run_command(main)
