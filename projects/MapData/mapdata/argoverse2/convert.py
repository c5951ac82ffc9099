"""Conversion of Argoverse 2 logs to an annotation file (seven ring cameras, ego frame)."""

import argparse
from collections.abc import Collection, Iterable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import shapely

from gsmap.datasets.annotations.file import AnnotationWriter
from gsmap.datasets.annotations.record import CLASSES, AnnotationMeta
from gsmap.datasets.errors import explain_errors
from gsmap.utils.errors import InputError, WorkError
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from gsmap.utils.split_lists import SPLIT_LIST
from mapdata.argoverse2.log import (
    BROKEN_LOGS,
    MAP_CHANGE_LOGS,
    chosen_logs,
    find_all_logs,
    find_logs,
)
from mapdata.argoverse2.map import COMPAT_MODES, DEFAULT_RULES
from mapdata.argoverse2.samples import (
    THIN_OVER,
    Argoverse2Options,
    LogSamples,
    read_log,
    thin_out_split,
    usable_times,
)
from mapdata.command_line import (
    add_file_options,
    add_log_options,
    add_split_options,
    fingerprint,
    options_from,
)
from mapdata.splits import OFFICIAL, SplitList, requested_split, resolve_scenes, split_names
from mapdata.summary import ConversionSummary


def convert_argoverse2(options: Argoverse2Options) -> ConversionSummary:
    """Convert the logs of a split to one annotation file.

    The file appears only once it is complete. A log that cannot be read is left out, and the
    summary names the reason; the remaining logs are converted.

    Args:
        options: Options of the conversion.

    Returns:
        Counts of the samples and map elements in the file, and of the problems.

    Raises:
        FileNotFoundError: If the split, its list or a requested log is missing.
        ValueError: If the options name two lists of splits, the list is unknown or malformed, it
            does not contain ``options.split``, it puts a log into two splits, or its logs are
            missing though it must be complete.
        RuntimeError: If no sample is left (allowed for a shard), a worker process dies, or a log
            exceeds the time limit. In these cases, no file is written.
        OSError: If the file cannot be written, for example on a full disk. No partial file remains.
    """
    summary = ConversionSummary(options.classes)
    target = options.path_of("av2", options.split)
    split_list = requested_split(options, "av2")  # None for the official split
    if split_list is None:
        identity = OFFICIAL
        log_dirs = find_logs(options.root, options.split, logs=options.logs)
    else:
        identity = split_list.identity
        log_dirs = _listed_logs(split_list, options, summary=summary)
    log_dirs = _remove_unfit_logs(log_dirs, options.keep_map_changes, summary=summary)
    # This may depend on the logs of all shards, so it precedes the choice of the shard.
    excluded_times = _excluded_times(log_dirs, options)
    # A shard is the share of one of several machines. The metadata describe the logs of all shards,
    # because the files of the shards are merged to one file and must have equal metadata.
    meta = _meta(options, log_dirs, identity=identity)
    log_dirs = options.shard.part(log_dirs)
    jobs = [(log_dir, excluded_times.get(log_dir.name, ())) for log_dir in log_dirs]
    convert_log = partial(_try_log, options=options)  # can be sent to worker processes
    offsets_ns: list[int] = []  # time between each sample and its LiDAR sweep
    progress = Progress(log_dirs, desc=f"av2 {options.split}", unit="logs")
    # `logs` yields the folders in `log_dirs` and shows the progress.
    with progress as logs, AnnotationWriter(target, meta, shard=options.shard) as writer:
        # Results come in the order of the jobs.
        results = ordered_map(convert_log, jobs, workers=_worker_count(options, log_dirs))
        for log_dir, result in zip(logs, results, strict=True):
            if isinstance(result, str):  # reason why the log cannot be read
                summary.add_problem(f"log left out: {result}", log_dir.name)
                continue
            for sample in result.samples:
                writer.write(sample)
                summary.add_sample(options.split, sample)
                if sample.lidar is not None:
                    sweep_ns = int(Path(sample.lidar.path).stem)  # a file is named by its time
                    offsets_ns.append(abs(sweep_ns - sample.timestamp_ns))
            _add_problems(summary, log_dir.name, result=result)
        is_whole = not options.shard.count  # 0 without shards; only a shard may be empty
        if not len(writer) and is_whole:
            raise WorkError(f"no sample is left for {target}:\n{summary.text()}")
    note = f"{len(offsets_ns)} of {len(writer)} samples have a LiDAR sweep"
    if offsets_ns:
        note += f", at most {max(offsets_ns) / 1e6:.0f} ms before or after the sample"
    summary.notes.append(note)
    summary.notes.append(f"written to {writer.path}")
    return summary


def _listed_logs(
    split_list: SplitList, options: Argoverse2Options, summary: ConversionSummary
) -> list[Path]:
    """Find the logs of one part, such as ``train``, of a split list.

    All official folders are searched, since published lists mix logs of ``train``, ``val`` and
    ``test``. If listed logs are missing, a note is added to the summary.

    Args:
        split_list: Names of the logs of each part.
        options: Options of the conversion. ``options.split`` is the name of the part.
        summary: Summary of the conversion, changed in place.

    Returns:
        Folders of the logs, sorted by name. If ``options.logs`` is not empty, only the logs whose
        names begin with one of its entries.

    Raises:
        FileNotFoundError: If no log remains.
        ValueError: If the list has no such part, a log is in two parts, or logs of a list that must
            be complete are missing.
    """
    if options.split not in split_list.scenes:
        raise InputError(
            f"split {split_list.name!r} has no part {options.split!r}: name one of "
            f"{', '.join(split_list.scenes)} with --split."
        )
    log_by_name = {log.name: log for log in find_all_logs(options.root)}
    # `resolve_scenes` takes names by token (id in the data set). A log's name is also its token.
    name_by_token = {name: name for name in log_by_name}
    list_title = options.split_file or f"split {split_list.name!r}"
    with explain_errors(list_title, remedy="list each log in one split"):
        # Part of each log that the list names, and the listed names that the data set lacks. A log
        # in two parts raises an error.
        part_by_name, absent = resolve_scenes(split_list.scenes, name_by_token)
    listed = set(split_list.scenes[options.split])
    missing = listed.intersection(absent)
    if missing:
        # Raises an error if the list must be complete and the options do not allow missing logs.
        note = split_list.missing_note(
            missing,
            len(listed),
            where=str(options.root),
            allowed=options.allow_missing,
        )
        summary.notes.append(note)
    log_dirs = [log_by_name[name] for name in sorted(listed.intersection(part_by_name))]
    where = f"part {options.split!r} of split {split_list.name!r} in {options.root}"
    if not log_dirs:
        raise FileNotFoundError(f"no log of {where}.")
    return chosen_logs(log_dirs, options.logs, where=where)


def _worker_count(options: Argoverse2Options, log_dirs: Sequence[Path]) -> int:
    """Number of processes: ``options.workers``, but at most one per log, and at least one."""
    return min(options.workers, max(len(log_dirs), 1))


def _excluded_times(log_dirs: list[Path], options: Argoverse2Options) -> dict[str, set[int]]:
    """Times in nanoseconds, by name of the log, of the samples to drop.

    With ``thin_over="split"``, the samples of all logs are thinned out together. With ``"log"``,
    each log is thinned out when it is read, so no times are returned here.
    """
    if options.thin_over == "log":
        return {}
    assert options.rate_hz is not None  # checked by the options
    read_times = partial(usable_times, options=options)
    results = ordered_map(read_times, log_dirs, workers=_worker_count(options, log_dirs))
    times = {}
    for log_dir, log_times in zip(log_dirs, results, strict=True):
        times[log_dir.name] = log_times
    return thin_out_split(times, options.rate_hz)


def _try_log(job: tuple[Path, Collection[int]], options: Argoverse2Options) -> LogSamples | str:
    """Read a log, or return the reason why its files cannot be read.

    Only errors of the input are caught; any other error stops the conversion.

    Args:
        job: Folder of the log, and the times in nanoseconds to leave out.
        options: Options of the conversion.
    """
    log_dir, excluded_ns = job
    try:
        return read_log(log_dir, options, excluded_ns=excluded_ns)
    except (OSError, ValueError, shapely.errors.ShapelyError) as error:
        return str(error)


def _add_problems(summary: ConversionSummary, log_id: str, result: LogSamples) -> None:
    """Count the samples, map elements and polygons of a log that are left out."""
    # `add_problem` counts by the reason, with the log or the element as an example. `left_out` and
    # `invalid` have numbers of samples and of polygons. `elements` has lists of ids of unusable map
    # elements, by a sentence with the reason. Its full stop is removed, because other reasons have
    # none.
    for reason, count in result.left_out.items():
        summary.add_problem(f"sample left out: {reason}", log_id, count=count)
    for reason, element_ids in result.elements.items():
        for element_id in element_ids:
            summary.add_problem(reason.rstrip("."), f"{element_id} of {log_id}")
    for kind, count in result.invalid.items():
        reason = f"invalid polygon among the {kind} left out"
        summary.add_problem(reason, log_id, count=count)


def _remove_unfit_logs(
    log_dirs: Sequence[Path], keep_map_changes: bool, summary: ConversionSummary
) -> list[Path]:
    """Remove logs with unusable data and, by default, logs with a changed map.

    The summary gets a problem for each removed log, and for each log with a changed map.
    """
    broken = "its map or sensor data cannot be used (known to fail)"
    changed = "its map was changed on purpose and contradicts the images (Argoverse 2's own note)"
    fit_logs = []
    for log_dir in log_dirs:
        name = log_dir.name
        has_map_change = name in MAP_CHANGE_LOGS
        if name in BROKEN_LOGS:
            summary.add_problem(f"log left out: {broken}", name)
            continue
        if has_map_change and not keep_map_changes:
            summary.add_problem(f"log left out: {changed}; --keep-map-changes keeps it", name)
            continue
        if has_map_change:
            summary.add_problem(f"log kept, but {changed}", name)
        fit_logs.append(log_dir)
    return fit_logs


def _meta(options: Argoverse2Options, log_dirs: Iterable[Path], identity: str) -> AnnotationMeta:
    """Describe the content of the annotation file and its sources.

    Args:
        options: Options of the conversion.
        log_dirs: Folders of all logs of the split.
        identity: Name and digest of the split list, or ``OFFICIAL`` without a list.
    """
    sizes = {}  # of the maps and tables in bytes, from which the digest of the sources is computed
    for log_dir in log_dirs:
        maps = sorted(log_dir.glob("map/*.json"))
        tables = sorted(log_dir.glob("*.feather"))
        for path in maps + tables:
            sizes[f"{log_dir.name}/{path.name}"] = path.stat().st_size
    choices: dict[str, Any] = {
        "at": options.at,
        "rate_hz": options.rate_hz,
        "compat": options.compat,
    }
    # The default is not written, so files with the default keep the metadata of files that were
    # made before this option existed.
    if options.thin_over != "log":
        choices["thin_over"] = options.thin_over
    choices["num_sweeps"] = options.max_sweeps
    choices[SPLIT_LIST] = identity
    return options.meta(
        dataset="av2",
        frame="ego",
        split=options.split,
        dim=options.dim,
        source_fingerprint=fingerprint(sizes),
        versions={
            "av2": version("av2"),
            "shapely": version("shapely"),
            "geos": ".".join(map(str, shapely.geos_version)),
        },
        options=choices,
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py av2`` to a parser."""
    add = parser.add_argument
    add_log_options(parser, usual_rate="10hz of train, 2.5hz of val and test, as published")
    add(
        "--at", default="auto",
        help="times: lidar, cameras, auto (sweeps where there are some, else images) "
        "or poses:N, every N-th row of the pose table without sensor data (default: %(default)s)",
    )  # fmt: skip
    add(
        "--thin-over", default="log", choices=THIN_OVER,
        help="what --rate thins out: each log alone, or the samples of all logs sorted by time, "
        "as the published systems choose their validation samples (default: %(default)s)",
    )  # fmt: skip
    add("--dim", type=int, default=2, choices=(2, 3), help="coordinates per point")
    add(
        "--compat", default=DEFAULT_RULES, choices=COMPAT_MODES,
        help="rules of the ground truth (default: %(default)s)",
    )  # fmt: skip
    add("--centerline", action="store_true", help="add the class centerline")
    add(
        "--keep-map-changes", action="store_true",
        help="keep the four logs whose map was changed on purpose",
    )  # fmt: skip
    add_split_options(parser, split_names("av2"))
    add_file_options(parser, "ego", max_sweeps=0)


def run(arguments: argparse.Namespace) -> str:
    """Convert with the options of a command line and return the summary as text."""
    classes: tuple[str, ...] = CLASSES
    if arguments.centerline:
        classes = (*CLASSES, "centerline")
    options = options_from(Argoverse2Options, arguments, classes=classes)
    return convert_argoverse2(options).text()
