"""Convert Argoverse 2 logs to an annotation file: seven ring cameras, ego frame, 60 x 30 m."""

import argparse
from collections.abc import Iterable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path

import shapely

from gsmap.datasets.annotations.file import AnnotationWriter
from gsmap.datasets.annotations.record import CLASSES, AnnotationMeta
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from mapdata.argoverse2.log import BROKEN_LOGS, MAP_CHANGE_LOGS, find_logs
from mapdata.argoverse2.map import COMPAT_MODES
from mapdata.argoverse2.samples import Argoverse2Options, LogSamples, read_log
from mapdata.command_line import (
    add_file_options,
    add_log_options,
    fingerprint,
    options_from,
)
from mapdata.summary import ConversionSummary


def convert_argoverse2(options: Argoverse2Options) -> ConversionSummary:
    """Convert the logs of a split to one annotation file, which appears when it is whole.

    A log that cannot be read does not stop the others: it is left out and the summary says why.

    Raises:
        FileNotFoundError: If the split or a log asked for is missing.
        RuntimeError: If no sample is left (a shard may have none), or a worker process dies; then
            nothing is written.
        OSError: If the file cannot be written, for example on a full disk; nothing is left behind.
    """
    summary = ConversionSummary(options.classes)
    target = options.path_of("av2", options.split)
    log_dirs = find_logs(options.root, options.split, options.logs)
    log_dirs = _drop_listed(log_dirs, options.keep_map_changes, summary)
    meta, log_dirs = _meta(options, log_dirs), options.shard.part(log_dirs)
    offsets_ns: list[int] = []
    bar = Progress(log_dirs, desc=f"av2 {options.split}", unit="logs")
    with bar as logs, AnnotationWriter(target, meta, options.shard) as writer:
        workers = min(options.workers, max(len(log_dirs), 1))
        results = ordered_map(partial(_try_log, options=options), log_dirs, workers)
        for log_dir, result in zip(logs, results, strict=True):
            if isinstance(result, str):
                summary.add_problem(f"log left out: {result}", log_dir.name)
                continue
            for sample in result.samples:
                writer.write(sample)
                summary.add_sample(options.split, sample)
            for reason, count in result.left_out.items():
                summary.add_problem(f"sample left out: {reason}", log_dir.name, count)
            for kind, count in result.invalid.items():
                reason = f"invalid polygon among the {kind} takes no part"
                summary.add_problem(reason, log_dir.name, count)
            named = ((s.timestamp_ns, s.lidar.path) for s in result.samples if s.lidar is not None)
            offsets_ns += [abs(int(Path(path).stem) - time_ns) for time_ns, path in named]
        if not len(writer) and not options.shard.count:
            raise RuntimeError(f"no sample is left for {target}:\n{summary.text()}")
    note = f"LiDAR sweep named by {len(offsets_ns)} of {len(writer)} samples"
    away = f", at most {max(offsets_ns) / 1e6:.0f} ms away" if offsets_ns else ""
    summary.notes += [note + away, f"written to {writer.path}"]
    return summary


def _try_log(log_dir: Path, options: Argoverse2Options) -> LogSamples | str:
    """Read a log; return the reason where that fails (a bug of ours still stops everything)."""
    try:
        return read_log(log_dir, options)
    except (OSError, ValueError, shapely.errors.ShapelyError) as error:
        return str(error)


def _drop_listed(
    log_dirs: Sequence[Path], keep_map_changes: bool, summary: ConversionSummary
) -> list[Path]:
    """Leave out the logs that are known to be unfit, and count them."""
    changed = "its map was changed on purpose and contradicts the images (Argoverse 2's own note)"
    left_out = dict.fromkeys(BROKEN_LOGS, "its map or sensor data cannot be used (known to fail)")
    if not keep_map_changes:
        left_out |= dict.fromkeys(MAP_CHANGE_LOGS, f"{changed}; --keep-map-changes keeps it")
    for name in (log_dir.name for log_dir in log_dirs):
        if name in left_out:
            summary.add_problem(f"log left out: {left_out[name]}", name)
        elif name in MAP_CHANGE_LOGS:
            summary.add_problem(f"log kept, but {changed}", name)
    return [log_dir for log_dir in log_dirs if log_dir.name not in left_out]


def _meta(options: Argoverse2Options, log_dirs: Iterable[Path]) -> AnnotationMeta:
    """Describe the file: what it holds, and what it was made from."""
    sizes = {
        f"{log_dir.name}/{path.name}": path.stat().st_size
        for log_dir in log_dirs
        for path in (*sorted(log_dir.glob("map/*.json")), *sorted(log_dir.glob("*.feather")))
    }
    versions = {name: version(name) for name in ("av2", "shapely")}
    made_with = {name: getattr(options, name) for name in ("at", "rate_hz", "compat")}
    return options.meta(
        "av2",
        "ego",
        options.split,
        dim=options.dim,
        source_fingerprint=fingerprint(sizes),
        versions={**versions, "geos": ".".join(map(str, shapely.geos_version))},
        options={**made_with, "num_sweeps": options.max_sweeps},
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the converter's options to a parser."""
    add = parser.add_argument
    add_log_options(parser, "10hz of train, 2.5hz of val and test, as published")
    add(
        "--at", default="auto",
        help="times: lidar, cameras, auto (sweeps where there are some, else images) "
        "or poses:N, every N-th row of the pose table without sensor data (default: %(default)s)",
    )  # fmt: skip
    add("--dim", type=int, default=2, choices=(2, 3), help="coordinates per point")
    add(
        "--compat", default="maptrv2", choices=COMPAT_MODES,
        help="rules of the ground truth (default: %(default)s)",
    )  # fmt: skip
    add("--centerline", action="store_true", help="add the class centerline")
    what = "keep the four logs whose map was changed on purpose"
    add("--keep-map-changes", action="store_true", help=what)
    add_file_options(parser, "ego", max_sweeps=0)


def run(arguments: argparse.Namespace) -> str:
    """Convert as the command line asks and return the summary."""
    classes = (*CLASSES, "centerline") if arguments.centerline else CLASSES
    options = options_from(Argoverse2Options, arguments, classes=classes)
    return convert_argoverse2(options).text()
