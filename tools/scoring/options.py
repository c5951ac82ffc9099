"""Command-line options of ``tools/evaluate.py``."""

import argparse
from pathlib import Path

from gsmap.evaluation.analysis import CHANGES_SUFFIX, DISTANCE
from gsmap.evaluation.core.evaluator import METRIC_NAMES
from gsmap.evaluation.core.metric import metric_files
from gsmap.structures.classes import AREA_CLASSES
from gsmap.utils.cli import CommandParser, output_file
from gsmap.utils.model_facts import LAW_NAMES
from gsmap.utils.shards import add_shard_options

# Options that only apply together with another one, which is their value here.
_NEEDED_OPTIONS = {
    "law": "uncertainty",
    "prior_elements": "prior",
    "reliability": "uncertainty",
    "tracks": "consistency",
}


def parse_args(description: str | None, argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options of the command and check their combinations.

    Args:
        description: Text above the options in the help.
        argv: The words of the command line; None reads the command line of the process.

    Returns:
        The options. ``eval`` is the list of metric names, without repetitions. It includes the
        metrics that ``--pld`` and ``--topology`` select.
    """
    parser = CommandParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_inputs(parser)
    add_metrics(parser)
    add_rules(parser)
    add_analysis(parser)
    add_outputs(parser)
    add_shard_options(parser)
    args = parser.parse_args(argv)
    check_combinations(parser, args)  # ends the command with a message if options do not fit
    args.eval = metric_names(args)
    return args


def add_inputs(parser: argparse.ArgumentParser) -> None:
    """Add the input files and the conditions that they must meet."""
    # Optional, because --prior replaces it. A single file is then the ground truth.
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
    group.add_argument("--prior-elements", type=int, help="elements in that set (50)")
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
    """Add the selection of metrics."""
    group = parser.add_argument_group("metrics")
    group.add_argument(
        "--eval",
        nargs="+",
        default=list(METRIC_NAMES),
        metavar="METRIC",
        help=f"names of metrics: {', '.join(metric_files())}; chamfer_hard: AP_chamfer at 0.2, "
        "0.5 and 1.0 m, too. The metrics of single methods, and their variants, are not comparable "
        "with other metrics",
    )
    group.add_argument(
        "--custom-imports",
        nargs="+",
        default=[],
        metavar="MODULE",
        help="modules that register your own metrics for --eval",
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
    """Add the rules of the metrics."""
    group = parser.add_argument_group("rules of metrics")
    group.add_argument(
        "--thresholds",
        nargs="+",
        type=float,
        help="largest distances of a match in AP_chamfer, in metres (0.5 1.0 1.5)",
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
        help="canvas of AP_raster in metres (default: the range of the annotation file, or "
        "nuScenes' -15 -30 15 30; Argoverse 2 has -30 -15 30 15)",
    )
    group.add_argument(
        "--gt-points",
        type=int,
        help="resample ground truth to this number of points first (no resampling)",
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
        help="smallest score of predictions in topology (0.4) and in metrics of AP per sample (0)",
    )


def add_analysis(parser: argparse.ArgumentParser) -> None:
    """Add analyses of the metrics, of drives and of Gaussians.

    An argument of type `output_file` is checked when it is read: its folder must be writable.
    """
    group = parser.add_argument_group("analysis")
    group.add_argument(
        "--bootstrap",
        type=int,
        nargs="?",
        const=1000,  # value of --bootstrap without a number
        metavar="N",
        help="interval of 95 %% for every AP, from N resamples of the scenes (1000)",
    )
    group.add_argument("--seed", type=int, help="seed of the resamples (0)")
    group.add_argument(
        "--against",
        type=Path,
        metavar="OTHER",
        help="second result file: every AP of the first minus the second, with its interval",
    )
    group.add_argument(
        "--by",
        metavar="map|scene|distance|FILE",
        help="AP of each group. map, scene: a group for each map or scene. distance: elements are "
        "cut at 10 and 20 m from the vehicle. FILE: scene.json of nuScenes' tables (scenes by "
        "night and weather), JSON with a word for each scene or each sample, or GeoJSON of changes "
        "(samples with and without a change in range)",
    )
    group.add_argument(
        "--changes",
        type=Path,
        metavar="TRUTH",
        help="precision and recall of a GeoJSON file of changes (build_map.py --changes), given in "
        "place of results, against the true changes",
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
        help="how well sigmas describe the errors of vertices: likelihood, coverage, ranks",
    )
    group.add_argument(
        "--law",
        choices=LAW_NAMES,
        help="with --uncertainty: distribution of the errors; default: the one that the "
        "calibration chose, or normal",
    )
    group.add_argument(
        "--reliability", type=output_file, help="with --uncertainty: draw its curves"
    )


def add_outputs(parser: argparse.ArgumentParser) -> None:
    """Add the output files."""
    group = parser.add_argument_group("outputs")
    group.add_argument("--out", type=output_file, help="write all figures as flat JSON")
    group.add_argument("--pr-curves", type=output_file, help="draw PR curves and calibration")


def check_combinations(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Refuse options that exclude each other, or that need another option."""
    if args.results and args.results.suffix == ".arrow":
        parser.error(f"{args.results} holds ground truth: name the result file before it")
    # Exactly one of the two must be given.
    if (args.results is None) == (args.prior is None):
        parser.error("name either a result file or --prior")
    if args.hard and args.thresholds:
        parser.error("--hard and --thresholds exclude each other")
    for name, needed in _NEEDED_OPTIONS.items():
        if getattr(args, name) is not None and not getattr(args, needed):
            parser.error(f"--{name.replace('_', '-')} needs --{needed}")
    if args.seed is not None and args.bootstrap is None and not args.against:
        parser.error("--seed is for resamples: give --bootstrap or --against, or leave it out")
    if args.prior:
        check_prior(parser, args)
    check_changes(parser, args)
    if args.by == DISTANCE and args.dim == 3:
        parser.error("--by distance is in the plane: leave out --dim 3")
    if args.shard.count:  # 0 for all samples, without --shard
        check_shard(parser, args)


def check_changes(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Check that changes are scored against true changes, and without other analyses."""
    is_changes = args.results is not None and args.results.suffix.lower() == CHANGES_SUFFIX
    if is_changes and not args.changes:
        parser.error(f"{args.results} is a file of changes: give the true ones as --changes")
    if not args.changes:
        return
    if not is_changes:
        parser.error(f"--changes scores a file of changes ({CHANGES_SUFFIX}), given as results")
    if args.shard.count:
        parser.error("--changes needs all changes: leave out --shard")
    for name in ("by", "bootstrap", "against", "consistency", "uncertainty", "pr_curves"):
        # None and False are the values of options that were not given.
        if getattr(args, name) not in (None, False):
            option = "--" + name.replace("_", "-")
            parser.error(f"{option} applies to elements, not to changes: leave it or --changes out")


def check_prior(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Refuse options that need a result file, which ``--prior`` replaces."""
    if args.against:
        parser.error("--against compares two result files: leave out --prior")
    if args.by == DISTANCE:
        parser.error("--by distance cuts a result file: leave out --prior")
    if args.shard.count:
        parser.error("--prior is fitted on all samples: leave out --shard")
    if args.consistency:
        parser.error("--consistency needs a result file: leave out --prior")
    if args.uncertainty:
        parser.error("--uncertainty needs a result file: leave out --prior")


def check_shard(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Refuse options that need all samples, because ``--shard`` matches only a part of them."""
    if not args.out:
        parser.error("--shard needs --out")
    for name in ("pr_curves", "bootstrap", "against", "by", "consistency", "uncertainty"):
        # None and False are the values of options that were not given.
        if getattr(args, name) not in (None, False):
            option = "--" + name.replace("_", "-")
            parser.error(f"{option} needs all samples: leave out --shard")


def metric_names(args: argparse.Namespace) -> list[str]:
    """Names of the metrics that ``--eval``, ``--pld`` and ``--topology`` select, once each.

    They are in the order in which they are selected.
    """
    names = list(args.eval)
    if args.pld:
        names.append("pld")
    if args.topology:
        names.append("topology")
        if args.dim == 3:
            names.append("heights")
    return list(dict.fromkeys(names))  # keys are unique and keep their order
