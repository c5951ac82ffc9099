"""Convert Argoverse 2 logs to an annotation file: seven ring cameras, ego frame, 60 x 30 m."""

import argparse
from collections.abc import Collection, Iterable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path

import shapely

from gsmap.datasets.annotations.file import AnnotationWriter
from gsmap.datasets.annotations.record import CLASSES, AnnotationMeta
from gsmap.datasets.errors import naming
from gsmap.utils.errors import InputError, WorkError
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from gsmap.utils.split_lists import SPLIT_LIST
from mapdata.argoverse2.log import BROKEN_LOGS, MAP_CHANGE_LOGS, find_all_logs, find_logs
from mapdata.argoverse2.map import COMPAT_MODES
from mapdata.argoverse2.samples import (
    THIN_OVER,
    Argoverse2Options,
    LogSamples,
    read_log,
    spread_over_split,
    usable_times,
)
from mapdata.command_line import (
    add_file_options,
    add_log_options,
    add_split_options,
    fingerprint,
    options_from,
)
from mapdata.splits import OFFICIAL, SplitList, asked_split, resolve_scenes, split_names
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
    wanted = asked_split(options, "av2")
    if wanted is None:
        log_dirs = find_logs(options.root, options.split, options.logs)
    else:
        log_dirs = _listed_logs(wanted, options, summary)
    log_dirs = _drop_listed(log_dirs, options.keep_map_changes, summary)
    identity = OFFICIAL if wanted is None else wanted.identity
    passed = _passed_over(log_dirs, options)
    meta, log_dirs = _meta(options, log_dirs, identity), options.shard.part(log_dirs)
    offsets_ns: list[int] = []
    bar = Progress(log_dirs, desc=f"av2 {options.split}", unit="logs")
    with bar as logs, AnnotationWriter(target, meta, options.shard) as writer:
        workers = min(options.workers, max(len(log_dirs), 1))
        jobs = [(log_dir, passed.get(log_dir.name, ())) for log_dir in log_dirs]
        results = ordered_map(partial(_try_log, options=options), jobs, workers)
        for log_dir, result in zip(logs, results, strict=True):
            if isinstance(result, str):
                summary.add_problem(f"log left out: {result}", log_dir.name)
                continue
            for sample in result.samples:
                writer.write(sample)
                summary.add_sample(options.split, sample)
            for reason, count in result.left_out.items():
                summary.add_problem(f"sample left out: {reason}", log_dir.name, count)
            for reason, numbers in result.elements.items():
                for number in numbers:
                    summary.add_problem(reason.rstrip("."), f"{number} of {log_dir.name}")
            for kind, count in result.invalid.items():
                reason = f"invalid polygon among the {kind} takes no part"
                summary.add_problem(reason, log_dir.name, count)
            named = ((s.timestamp_ns, s.lidar.path) for s in result.samples if s.lidar is not None)
            offsets_ns += [abs(int(Path(path).stem) - time_ns) for time_ns, path in named]
        if not len(writer) and not options.shard.count:
            raise WorkError(f"no sample is left for {target}:\n{summary.text()}")
    note = f"LiDAR sweep named by {len(offsets_ns)} of {len(writer)} samples"
    away = f", at most {max(offsets_ns) / 1e6:.0f} ms away" if offsets_ns else ""
    summary.notes += [note + away, f"written to {writer.path}"]
    return summary


def _listed_logs(
    wanted: SplitList, options: Argoverse2Options, summary: ConversionSummary
) -> list[Path]:
    """Return the logs of a list, wherever they are: published lists mix the official folders."""
    if options.split not in wanted.scenes:
        raise InputError(
            f"split {wanted.name!r} has no part {options.split!r}: name one of "
            f"{', '.join(wanted.scenes)} with --split."
        )
    by_name = {log.name: log for log in find_all_logs(options.root)}
    with naming(options.split_file or f"split {wanted.name!r}", "list each log in one split"):
        part_of, absent = resolve_scenes(wanted.scenes, {name: name for name in by_name})
    listed = set(wanted.scenes[options.split])
    if missing := listed.intersection(absent):
        where, allowed = str(options.root), options.allow_missing
        summary.notes.append(wanted.missing_note(missing, len(listed), where, allowed))
    found = [by_name[name] for name in sorted(listed.intersection(part_of))]
    chosen = [log for log in found if not options.logs or log.name.startswith(tuple(options.logs))]
    if not chosen:
        raise FileNotFoundError(f"no log of split {wanted.name!r} as asked for in {options.root}.")
    return chosen


def _passed_over(log_dirs: list[Path], options: Argoverse2Options) -> dict[str, set[int]]:
    """Return the times of each log that samples of the whole split leave out, by its name."""
    if options.thin_over == "log":
        return {}
    assert options.rate_hz is not None  # checked by the options
    workers = min(options.workers, max(len(log_dirs), 1))
    found = ordered_map(partial(usable_times, options=options), log_dirs, workers)
    names = [log_dir.name for log_dir in log_dirs]
    return spread_over_split(dict(zip(names, found, strict=True)), options.rate_hz)


def _try_log(job: tuple[Path, Collection[int]], options: Argoverse2Options) -> LogSamples | str:
    """Read a log; return the reason where that fails (a bug of ours still stops everything).

    The job is its folder, with the times that are passed over.
    """
    log_dir, passed_ns = job
    try:
        return read_log(log_dir, options, passed_ns=passed_ns)
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


def _meta(options: Argoverse2Options, log_dirs: Iterable[Path], identity: str) -> AnnotationMeta:
    """Describe the file: what it holds, and what it was made from."""
    sizes = {
        f"{log_dir.name}/{path.name}": path.stat().st_size
        for log_dir in log_dirs
        for path in (*sorted(log_dir.glob("map/*.json")), *sorted(log_dir.glob("*.feather")))
    }
    versions = {name: version(name) for name in ("av2", "shapely")}
    made_with = {name: getattr(options, name) for name in ("at", "rate_hz", "compat")}
    if options.thin_over != "log":
        made_with["thin_over"] = options.thin_over
    return options.meta(
        "av2",
        "ego",
        options.split,
        dim=options.dim,
        source_fingerprint=fingerprint(sizes),
        versions={**versions, "geos": ".".join(map(str, shapely.geos_version))},
        options={**made_with, "num_sweeps": options.max_sweeps, SPLIT_LIST: identity},
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
    add(
        "--thin-over", default="log", choices=THIN_OVER,
        help="what --rate thins out: each log alone, or the samples of all logs sorted by time, "
        "as MapTR and MapTRv2 validate (default: %(default)s)",
    )  # fmt: skip
    add("--dim", type=int, default=2, choices=(2, 3), help="coordinates per point")
    add(
        "--compat", default="maptrv2", choices=COMPAT_MODES,
        help="rules of the ground truth (default: %(default)s)",
    )  # fmt: skip
    add("--centerline", action="store_true", help="add the class centerline")
    what = "keep the four logs whose map was changed on purpose"
    add("--keep-map-changes", action="store_true", help=what)
    add_split_options(parser, split_names("av2"))
    add_file_options(parser, "ego", max_sweeps=0)


def run(arguments: argparse.Namespace) -> str:
    """Convert as the command line asks and return the summary."""
    classes = (*CLASSES, "centerline") if arguments.centerline else CLASSES
    options = options_from(Argoverse2Options, arguments, classes=classes)
    return convert_argoverse2(options).text()
