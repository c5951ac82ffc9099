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
from pathlib import Path

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import CLASSES, RANGES
from gsmap.evaluation.analysis.bootstrap import (
    Resamples,
    ap_differences,
    ap_intervals,
    format_intervals,
)
from gsmap.evaluation.analysis.calibration import (
    LAWS,
    format_uncertainty,
    matched_vertices,
    uncertainty_report,
)
from gsmap.evaluation.analysis.distances import DISTANCE, cut_by_distance, distance_groups
from gsmap.evaluation.analysis.groups import (
    Groups,
    ap_by_group,
    group_report,
    group_table,
    read_groups,
)
from gsmap.evaluation.analysis.prior import evaluate_prior
from gsmap.evaluation.core.chamfer_ap import (
    CHAMFER_THRESHOLDS,
    HARD_CHAMFER_THRESHOLDS,
    ChamferConfig,
)
from gsmap.evaluation.core.evaluator import ALL_NAMES, METRIC_NAMES, MapEvaluator
from gsmap.evaluation.core.file_evaluation import (
    Evaluation,
    SamplePairs,
    evaluate_files,
    match_samples,
    scenes_of,
)
from gsmap.evaluation.core.match_files import write_matches
from gsmap.evaluation.core.raster_ap import RasterConfig
from gsmap.evaluation.core.report import MetricReport, format_table, write_figures
from gsmap.evaluation.core.sample_ap import METHODS
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.grid import BEVGrid
from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.faults import nearest
from gsmap.utils.model_facts import law_of
from gsmap.utils.ray_shards import run_on_ray
from gsmap.utils.shards import add_shard_options, digest, digest_of_common, read_shard
from gsmap.utils.words import counted, markdown_table


def parse_args(argv: list[str] | None = None) -> argparse.Namespace:
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path, nargs="?", help="results in MapTR's JSON form")
    parser.add_argument(
        "ground_truth", type=Path, help="annotation file (*.arrow), or JSON with a list of GTs"
    )
    parser.add_argument(
        "--prior",
        type=Path,
        metavar="TRAIN",
        help="score the best fixed set of elements, fitted on this ground truth",
    )
    parser.add_argument("--prior-elements", type=int, default=50, help="elements in that set")
    parser.add_argument(
        "--eval",
        nargs="+",
        default=list(METRIC_NAMES),
        choices=ALL_NAMES,
        help="metrics; chamfer_hard: besides chamfer also at 0.2, 0.5 and 1.0 m, matched once; "
        "vectormapnet, vectormapnet_shrunk, hdmapnet, bemapnet: of these methods' own evaluators, "
        "not comparable",
    )
    parser.add_argument(
        "--thresholds", nargs="+", type=float, help="of AP_chamfer, in metres (0.5 1.0 1.5)"
    )
    parser.add_argument(
        "--dim",
        type=int,
        default=2,
        choices=(2, 3),
        help="coordinates of AP_chamfer; 3 needs heights in results and ground truth",
    )
    parser.add_argument("--hard", action="store_true", help="AP_chamfer at 0.2, 0.5 and 1.0 m")
    parser.add_argument("--classes", nargs="+", help="default: the annotation file's, or MapTR's")
    parser.add_argument(
        "--polygon-classes",
        nargs="*",
        default=list(AREA_CLASSES),
        help="classes that AP_raster fills",
    )
    parser.add_argument(
        "--range",
        nargs=4,
        type=float,
        metavar=("X0", "Y0", "X1", "Y1"),
        help="canvas of AP_raster in metres: the annotation file's, or nuScenes' -15 -30 15 30; "
        "Argoverse 2: -30 -15 30 15",
    )
    parser.add_argument(
        "--gt-points", type=int, help="resample ground truth to that many points first (raw)"
    )
    parser.add_argument(
        "--keep-pred-points",
        action="store_true",
        help="AP_chamfer: compare predictions at their own points, not at 100",
    )
    parser.add_argument(
        "--keep-gt-points",
        action="store_true",
        help="AP_chamfer: compare ground truth at its own vertices, not at 100 points",
    )
    parser.add_argument(
        "--allow-mismatch",
        action="store_true",
        help="samples without results count as empty, results without ground truth are left out",
    )
    parser.add_argument(
        "--allow-other-split",
        action="store_true",
        help="the model may be trained on another split, which may hold places of this one",
    )
    parser.add_argument(
        "--consistency",
        action="store_true",
        help="C-mAP of MapTracker and jitter over drives; needs an annotation file with poses",
    )
    parser.add_argument(
        "--topology",
        action="store_true",
        help="count elements in pieces, elements joined and lines that fold back; with --dim 3 "
        "also measure heights",
    )
    parser.add_argument(
        "--pld",
        action="store_true",
        help="PLD: distance of whole maps, in which the order of points and all scores count",
    )
    parser.add_argument(
        "--min-score",
        type=float,
        help="of predictions that --topology counts (0.4), and hdmapnet and bemapnet (0: all)",
    )
    parser.add_argument(
        "--tracks",
        type=output_file,
        help="with --consistency: write the results again, each element with its track_id",
    )
    parser.add_argument(
        "--bootstrap",
        type=int,
        nargs="?",
        const=1000,
        metavar="N",
        help="intervals of 95 %% of every AP, of N resamples of the scenes (1000)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the resamples")
    parser.add_argument(
        "--by",
        metavar="map|scene|distance|FILE",
        help="AP of each map or scene alone, of the map cut at 10 and 20 m from the vehicle, or "
        "of scenes by night and weather (FILE: scene.json of nuScenes' tables, or JSON with a word "
        "for each scene or each sample)",
    )
    parser.add_argument(
        "--against",
        type=Path,
        metavar="OTHER",
        help="second result file: what the first has more in every AP, with its interval",
    )
    parser.add_argument(
        "--uncertainty",
        action="store_true",
        help="whether Gaussians say how far off matched vertices are: likelihood, coverage, ranks",
    )
    parser.add_argument(
        "--law",
        choices=LAWS,
        help="with --uncertainty: distribution of the errors (that of the model's calibration, as "
        "the results say, or normal)",
    )
    parser.add_argument(
        "--reliability", type=output_file, help="with --uncertainty: draw its curves"
    )
    parser.add_argument("--workers", type=int, default=1, help="number of processes")
    parser.add_argument("--out", type=output_file, help="write all figures as flat JSON")
    parser.add_argument("--pr-curves", type=output_file, help="draw PR curves and calibration")
    add_shard_options(parser)
    args = parser.parse_args(argv)
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
        (
            args.min_score is not None and not (args.topology or {*args.eval} & {*METHODS}),
            "--min-score is of --topology, hdmapnet and bemapnet: leave it out",
        ),
        (
            args.pr_curves and not {*args.eval} - {*METHODS},
            "--pr-curves draws what counts predictions of all samples: name chamfer or raster",
        ),
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
    for name in ("consistency", "pld", "topology", "uncertainty"):
        if getattr(args, name) and (args.prior or args.shard.count):
            parser.error(f"--{name} needs a result file as a whole: leave out --prior and --shard")
    return args


def evaluator_from(args: argparse.Namespace) -> MapEvaluator:
    """Join the arguments with what the annotation file says."""
    classes, (x_range, y_range) = CLASSES, RANGES["lidar"]
    if args.ground_truth.suffix.lower() != ".json":
        meta = AnnotationFile(args.ground_truth).meta
        classes, x_range, y_range = meta.classes, meta.x_range, meta.y_range
    classes = tuple(args.classes or classes)
    for name in set(args.polygon_classes) - {*classes, *AREA_CLASSES}:
        raise ValueError(f"--polygon-classes: there is no class {name!r}{nearest(name, classes)}")
    if args.range:
        x_range, y_range = tuple(args.range[::2]), tuple(args.range[1::2])
    thresholds = HARD_CHAMFER_THRESHOLDS if args.hard else args.thresholds
    chamfer = ChamferConfig(
        classes,
        tuple(thresholds or CHAMFER_THRESHOLDS),
        resample_predictions=not args.keep_pred_points,
        resample_ground_truth=not args.keep_gt_points,
        dim=args.dim,
    )
    raster = RasterConfig(classes, BEVGrid(x_range, y_range), tuple(args.polygon_classes))
    return MapEvaluator.named(args.eval, chamfer, raster, args.gt_points, args.min_score or 0.0)


def report(outcome: Evaluation, args: argparse.Namespace) -> None:
    reports, notes = outcome
    for found in reports:
        if found.name in ("intervals", "by", "uncertainty"):  # printed
            continue
        if not found.groups:
            lines = (f"{key:<44} {value:.4f}" for key, value in found.metrics.items())
            print("\n".join(lines) + "\n")
        else:
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


def reports_of_pairs(args: argparse.Namespace, evaluator: MapEvaluator) -> list[MetricReport]:
    """Compute PLD, count breaks, false joints and folds, and measure heights if they count."""
    from gsmap.evaluation.metrics.pld import pld_figures
    from gsmap.evaluation.metrics.topology import TopologyConfig, height_figures, topology_figures

    classes = evaluator.classes
    areas = tuple(label for label, name in enumerate(classes) if name in args.polygon_classes)
    min_score = 0.4 if args.min_score is None else args.min_score
    config = TopologyConfig(classes, areas, min_score)
    inputs = args.results, args.ground_truth, classes, args.allow_mismatch, args.shard, True
    found = {}
    if args.pld:
        thresholds = HARD_CHAMFER_THRESHOLDS if args.hard else args.thresholds
        rules = ChamferConfig(classes, tuple(thresholds or CHAMFER_THRESHOLDS))
        found["pld"] = pld_figures(SamplePairs(*inputs), rules)
    if args.topology:
        found["topology"] = topology_figures(SamplePairs(*inputs), config)
    if args.topology and evaluator.chamfer is not None and evaluator.counts_heights:
        found["heights"] = height_figures(SamplePairs(*inputs), evaluator.chamfer)
    return [
        MetricReport(name, {}, {f"{name}/{key}": value for key, value in figures.items()}, {})
        for name, figures in found.items()
    ]


def consistency_report(args: argparse.Namespace) -> MetricReport:
    """Score the drives of a result file, and write its tracks if that is asked for."""
    from gsmap.evaluation.analysis.consistency import ConsistencyConfig
    from gsmap.evaluation.analysis.drive_files import evaluate_drives

    if args.ground_truth.suffix.lower() == ".json":
        raise ValueError(
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


def report_of_gaussians(args: argparse.Namespace, evaluator: MapEvaluator) -> MetricReport:
    """Print the scores of a result file's Gaussians; draw their curves if that is asked for."""
    classes = evaluator.classes
    inputs = args.results, args.ground_truth, classes, args.allow_mismatch, args.shard
    pairs = SamplePairs(*inputs, args.allow_other_split, gaussians=True)
    vertices = matched_vertices(pairs, evaluator.chamfer or ChamferConfig(classes))
    law = args.law or law_of(pairs.about)
    if args.reliability:
        from gsmap.visualization.figure import save_figure
        from gsmap.visualization.plots import plot_uncertainty

        figure = plot_uncertainty(vertices, classes, law)
        print(f"reliability: {save_figure(figure, args.reliability)}")
    found = uncertainty_report(vertices, classes, args.polygon_classes, law)
    print(format_uncertainty(found.metrics, law) + "\n")
    return found


def match_shard(args: argparse.Namespace, evaluator: MapEvaluator) -> str:
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
    path = write_matches(args.out, args.shard, matches, notes, evaluator, source)
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


def interval_report(
    outcome: Evaluation, resamples: Resamples, args: argparse.Namespace, evaluator: MapEvaluator
) -> MetricReport:
    """Print the intervals of every AP, and of what it has more than in another result file."""
    what = f"of {resamples.count} resamples of the scenes, seed {resamples.seed}"
    found = {"": ap_intervals(outcome[0], resamples)}
    print(format_intervals(found[""], f"AP with intervals of 95 % {what}") + "\n")
    if args.against:
        others, notes = evaluate(args.against, args, evaluator)
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


def groups_from(args: argparse.Namespace) -> Groups | None:
    """Read the groups of samples before anything is scored; None: bands of distances, or none."""
    return None if args.by in (None, DISTANCE) else read_groups(args.ground_truth, args.by)


def report_of_parts(
    reports: Sequence[MetricReport], groups: Groups | None, args: argparse.Namespace
) -> MetricReport:
    """Print the AP of each group of samples; without groups, of the map in bands of distances."""
    if groups is None:
        evaluator = evaluator_from(args)
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
    evaluator = evaluator_from(args)
    if args.shard.count:
        return match_shard(args, evaluator)
    groups = groups_from(args)
    resamples = None
    if args.bootstrap is not None or args.against:
        count = 1000 if args.bootstrap is None else args.bootstrap
        resamples = Resamples(scenes_of(args.ground_truth), count, args.seed)
    if args.prior:
        how = args.prior_elements, args.allow_other_split
        outcome = evaluate_prior(args.prior, args.ground_truth, evaluator, *how)
    else:
        outcome = evaluate(args.results, args, evaluator)
    if resamples is not None:
        outcome[0].append(interval_report(outcome, resamples, args, evaluator))
    if args.by:
        outcome[0].append(report_of_parts(outcome[0], groups, args))
    if args.pld or args.topology:
        outcome[0].extend(reports_of_pairs(args, evaluator))
    if args.consistency:
        outcome[0].append(consistency_report(args))
    if args.uncertainty:
        outcome[0].append(report_of_gaussians(args, evaluator))
    report(outcome, args)
    first = outcome[0][0]
    number = int(first.metrics[f"{first.name}/num_samples"])
    return f"{counted(number, 'sample')} in {time.perf_counter() - start:.1f} s"


if __name__ == "__main__":
    run_command(main)
