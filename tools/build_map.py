#!/usr/bin/env python
r"""Merge the predictions of each drive into one map, score it, and write it for other tools.

Examples:
    python tools/build_map.py results.json --ann data/minicity/gsmap_minicity_val.arrow --out maps
    python tools/build_map.py results.json --ann annotations.arrow --out maps \
        --formats geojson osm rrd mcap --origin 48.26 11.67
    python tools/build_map.py today.json --ann today.arrow --out maps --changes maps/scene.geojson
    python tools/build_map.py --map town.osm --ann annotations.arrow --prior town.prior
"""

# Imported before all libraries: this handles Ctrl-C during their imports, and keeps them from
# reading settings files in the working folder.
import gsmap  # noqa: F401

# isort: split
import argparse
import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from drivemaps.change import Pass
from drivemaps.changes import find_changes, summarize_changes, write_changes
from drivemaps.config import MergeConfig
from drivemaps.drive import Drive, places_of, read_drive, require_scenes
from drivemaps.geodetic import MapGrid, MapOrigin, known_origin, require_near
from drivemaps.geojson import write_geojson
from drivemaps.lanelet2 import SPEED_LIMIT_KMH, write_lanelet2
from drivemaps.lanelets import lane_graph_of
from drivemaps.map_files import read_map
from drivemaps.map_reading import ClassRule, describe_unused
from drivemaps.mcap import write_mcap
from drivemaps.merging import confident, merge, suppress
from drivemaps.pictures import plot_maps
from drivemaps.replay import Replay
from drivemaps.rerun import write_rerun
from drivemaps.scoring import figures_table, map_figures
from drivemaps.truth import true_map
from drivemaps.video import write_video
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.elements import elements_of_instances
from gsmap.datasets.pose_plausibility import pose_warnings
from gsmap.evaluation.core.results_json import RESULTS_KEY, THREE_D, SampleFile
from gsmap.prior.sources import PriorSources
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.utils.cli import CommandParser, EachOnce, output_file, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_extra
from gsmap.utils.files import file_names, write_text
from gsmap.utils.inputs import require_own_file
from gsmap.utils.split_lists import require_results_of
from gsmap.utils.words import format_count
from gsmap.visualization.figure import save_figure
from gsmap.visualization.style import MapStyle

FORMATS = ("geojson", "osm", "rrd", "mcap", "mp4", "png", "svg")
_LON_LAT = "_lonlat"  # ending of the names of GeoJSON files in degrees; other ones are in metres
_SCORES = "scores.json"
_NEAR_M = 1000.0  # an earlier map of a place lies at least in part this near to its samples
_LISTED_PLACES = 8  # largest number of places that are printed
_CHANGES = "changes"  # name of the file of changes, without a suffix
# Bytes that every output of this command contains. A file without them belongs to another program.
_MARK = b"gsmap"  # in maps
_MARK_OF_SCORES = b'"merged"'  # in scores
# Options without effect if the results, or the folder of the maps, are not given.
_OPTIONS_OF = {
    "results": (
        "join", "score_thr", "min_confidence", "min_area_confidence", "no_gaussians",
        "allow_other_split",
    ),
    "--out": ("formats", "speed_limit", "data_root"),
}  # fmt: skip
# Package that a format needs, and the extra of GSMap that installs it (`pip install -e .[viz]`).
EXTRAS = {"rrd": ("rerun", "viz"), "mcap": ("foxglove", "viz"), "mp4": ("av", "viz")}


def parse_args(argv: list[str] | None = None) -> argparse.Namespace:
    """Parse and check the options of the command."""
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path, nargs="?", help="results in MapTR's JSON form")
    parser.add_argument(
        "--ann", type=Path, required=True, help="annotation file (*.arrow) of the same samples"
    )
    parser.add_argument("--out", type=Path, help="folder for the maps")
    parser.add_argument(
        "--formats", nargs="+", action=EachOnce, default=["geojson"], choices=FORMATS
    )
    parser.add_argument(
        "--scene", nargs="+", action=EachOnce, help="drives to merge; all by default"
    )
    parser.add_argument(
        "--join", action="store_true", help="merge all drives of a place into one map"
    )
    parser.add_argument("--score-thr", type=float, default=0.3, help="smallest score that counts")
    parser.add_argument(
        "--min-confidence",
        type=float,
        default=MergeConfig.min_confidence,
        help="smallest confidence of a place in the map: share of the frames with the place in "
        "view that detected it, weighted by score",
    )
    parser.add_argument(
        "--min-area-confidence",
        type=float,
        default=MergeConfig.min_area_confidence,
        help="smallest confidence of areas, such as crossings",
    )
    parser.add_argument(
        "--no-gaussians",
        action="store_true",
        help="compute weights from the distance, not from Gaussians",
    )
    parser.add_argument(
        "--origin",
        nargs=2,
        type=float,
        metavar=("LAT", "LON"),
        help="latitude and longitude of the global frame's origin (x east, y north), in degrees; "
        "nuScenes' and Argoverse 2's are known",
    )
    parser.add_argument(
        "--crs", help="grid that the poses are in, such as EPSG:32650 (UTM), instead of --origin"
    )
    parser.add_argument(
        "--speed-limit",
        type=float,
        default=SPEED_LIMIT_KMH,
        metavar="KMH",
        help="speed limit of lanelets (osm) in km/h, as maps have none (default: %(default)g)",
    )
    parser.add_argument(
        "--allow-other-split",
        action="store_true",
        help="score maps even if the model was trained on another split, which may contain places "
        "of this one",
    )
    parser.add_argument(
        "--data-root",
        type=Path,
        help="folder of the images for rrd, mcap and mp4 (default: the folder of --ann)",
    )
    add_map_options(parser)
    args = parser.parse_args(argv)
    check_combinations(parser, args)
    return args


def add_map_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that read earlier maps, or write maps for a later drive."""
    group = parser.add_argument_group("earlier maps")
    group.add_argument(
        "--changes",
        type=Path,
        metavar="OLD",
        help="write what was removed, added and moved since this map of the place (GeoJSON, "
        "Lanelet2); each drive counts as one pass of the place",
    )
    group.add_argument(
        "--prior", type=output_file, metavar="OUT", help="write the maps as a MapPrior to this file"
    )
    group.add_argument(
        "--gaussians",
        action="store_true",
        help="write a GaussianPrior of the predictions of all frames in place of a MapPrior",
    )
    group.add_argument(
        "--elements",
        action="store_true",
        help="write an ElementPrior of the merged elements in place of a MapPrior",
    )
    group.add_argument(
        "--map", type=Path, metavar="FILE", help="add this map (GeoJSON, Lanelet2) to the --prior"
    )
    group.add_argument(
        "--map-classes",
        nargs="+",
        metavar=("KEY", "VALUE=CLASS"),
        help="property of the class in the map of --changes or --map, and its values",
    )


def check_combinations(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Exit with an error if options exclude each other, or need another option."""
    if args.results is None and not args.map:
        parser.error("give results, or a --map for a --prior")
    if args.results is None and (args.changes or args.out):
        parser.error("--changes and --out are for results: give them, too")
    if args.results and not (args.out or args.prior):
        parser.error("--out or --prior must name the output")
    if args.changes and not args.out:
        parser.error("--changes goes to the folder --out: give it, too")
    if args.changes and args.join:
        parser.error("--changes compares each drive with the old map: leave --join out")
    check_prior_options(parser, args)
    for source, names in _OPTIONS_OF.items():
        is_given = getattr(args, source.strip("-")) is not None
        for name in names:
            if not is_given and getattr(args, name) != parser.get_default(name):
                parser.error(f"--{name.replace('_', '-')} needs {source}: give both, or neither")
    if args.map_classes and not (args.map or args.changes):
        parser.error("--map-classes is for --map and --changes")


def check_prior_options(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Exit with an error if options do not fit ``--prior``."""
    if args.gaussians and not (args.prior and args.results):
        parser.error("--gaussians is for a --prior of results: give both, too")
    if args.gaussians and args.map:
        parser.error("a map of --map has no Gaussians: leave --gaussians out, or --map")
    if args.gaussians and args.no_gaussians:
        parser.error("--gaussians needs what --no-gaussians leaves out: give one of them")
    if args.elements and not args.prior:
        parser.error("--elements is for a --prior: give it, too")
    if args.elements and args.gaussians:
        parser.error("a prior has --gaussians or --elements: give one of them")
    if args.map and not args.prior:
        parser.error("--map is for a prior: give --prior, too")


def check_options(args: argparse.Namespace, ann: AnnotationFile) -> None:
    """Check, before the first file is written, that the formats have their packages and an origin.

    Raises:
        RuntimeError: If a package is missing.
        ValueError: If an option is out of range, options exclude each other, samples have no poses,
            their positions do not fit the origin, or the origin is unknown and a format needs it.
    """
    if not 0 < args.speed_limit < math.inf:
        raise InputError(f"--speed-limit must be > 0, got {args.speed_limit}.")
    for key in EXTRAS.keys() & set(args.formats):
        package, extra = EXTRAS[key]
        import_extra(package, extra)
    origins = {name: find_origin(args, ann, name) for name in set(ann.column("map_name"))}
    if args.crs is not None and args.origin:
        raise InputError("--crs and --origin both say where the poses lie: give one of them.")
    require_positions(ann, origins.values(), str(args.ann))
    maps_without_origin = []
    for name, origin in sorted(origins.items()):
        if origin is None:
            maps_without_origin.append(name)
    needs_poses = args.formats != ["mp4"] or args.prior or args.changes
    if needs_poses and not ann.meta.has_poses:
        raise InputError(
            f"the samples of {args.ann} have no poses, so there is no map of the drive: --formats "
            "mp4 shows the single frames."
        )
    if "osm" in args.formats and maps_without_origin:
        raise InputError(
            "Lanelet2 needs longitude and latitude, and the origin of map "
            f"{maps_without_origin[0]!r} is not known: give --origin LAT LON (any place will do; "
            "nodes keep local_x and local_y), or --crs if poses are coordinates of a grid."
        )
    has_known_origin = len(maps_without_origin) < len(origins)
    if {"osm", "geojson"} & set(args.formats) and has_known_origin:  # degrees are written
        import_extra("pyproj", "maps")


def require_positions(
    ann: AnnotationFile, origins: Iterable[MapOrigin | MapGrid | None], where: str
) -> None:
    """Check that the positions of samples fit the places of their global frames.

    A warning is printed if longitudes and latitudes of a grid are not accurate.

    Args:
        ann: The samples.
        origins: Places of the global frames; None is unknown.
        where: Name of the annotation file, for the message.

    Raises:
        ValueError: If positions are far from an origin, or outside of a grid.
    """
    positions = np.array([sample.global_from_frame[:2, 3] for sample in ann])
    for origin in set(origins):  # several maps may have one origin
        if isinstance(origin, MapOrigin):
            require_near(positions, where)
        elif isinstance(origin, MapGrid):
            origin.require_inside(positions, where)
            warning = origin.accuracy_warning(positions)
            if warning is not None:
                print(f"warning: {warning}")


def print_grid_places(crs: str, ann: AnnotationFile, scenes: Sequence[str]) -> None:
    """Print where a grid puts each place, as one grid may not fit all of them.

    A position of another UTM zone is a possible position, too, so this cannot be checked.

    Args:
        crs: Grid of ``--crs``.
        ann: The samples, with poses.
        scenes: Names of the drives.
    """
    positions_of: dict[str, list[np.ndarray]] = {}
    for sample in ann:
        if sample.scene in scenes:
            positions_of.setdefault(sample.map_name, []).append(sample.global_from_frame[:2, 3])
    names = sorted(positions_of)
    for name in names[:_LISTED_PLACES]:
        middle = np.median(positions_of[name], axis=0)
        ((longitude_deg, latitude_deg),) = MapGrid(crs).lon_lat(middle[None])
        print(f"{crs}: place {name!r} lies at {latitude_deg:.4f} {longitude_deg:.4f} (LAT LON)")
    if len(names) > _LISTED_PLACES:
        print(f"{crs}: {format_count(len(names) - _LISTED_PLACES, 'more place')}")
    if len(names) > 1:
        print(
            f"{crs}: it is taken for all {len(names)} places; if one lies elsewhere, such as in "
            "another UTM zone, choose its drives with --scene, and give its own --crs"
        )


def require_own_files(args: argparse.Namespace, names: Iterable[str], scored: bool) -> None:
    """Check, before any work, that the command replaces no file of another program.

    Args:
        args: The options of the command.
        names: Name of the files of each map, without a suffix.
        scored: Whether the maps are scored.

    Raises:
        ValueError: If a file in the folder has the name of an output and is no output of an
            earlier run.
    """
    endings = [f".{suffix}" for suffix in args.formats]
    if "geojson" in args.formats:
        endings.append(f"{_LON_LAT}.geojson")
    paths = []
    for name in names:
        for ending in endings:
            paths.append(args.out / f"{name}{ending}")
    if args.changes:
        paths.append(args.out / f"{_CHANGES}.geojson")
        paths.append(args.out / f"{_CHANGES}{_LON_LAT}.geojson")
    for path in paths:
        require_own_file(path, _MARK)
    if scored:
        require_own_file(args.out / _SCORES, _MARK_OF_SCORES)


def possible_outputs(out: Path, names: Iterable[str]) -> list[Path]:
    """Files that some options of this command write for maps, their changes and their scores.

    Args:
        out: Folder of the maps.
        names: Name of the files of each map, without a suffix.
    """
    paths = []
    for name in names:
        paths += [out / f"{name}.{suffix}" for suffix in FORMATS]
        paths.append(out / f"{name}{_LON_LAT}.geojson")
    paths += [out / f"{_CHANGES}.geojson", out / f"{_CHANGES}{_LON_LAT}.geojson", out / _SCORES]
    return paths


def stamps_of(paths: Iterable[Path]) -> dict[Path, tuple[int, int]]:
    """Inode and time of change of the files that exist. Both change if a file is written again."""
    stamps = {}
    for path in paths:
        if path.is_file():
            status = path.stat()
            stamps[path] = (status.st_ino, status.st_mtime_ns)
    return stamps


def print_old_outputs(stamps: Mapping[Path, tuple[int, int]]) -> None:
    """Print the outputs of an earlier run that lie beside the ones of this run.

    Args:
        stamps: Possible outputs that existed before this run, with their stamps (`stamps_of`).
    """
    now = stamps_of(stamps)
    old = [str(path) for path, stamp in stamps.items() if now.get(path) == stamp]
    if old:
        print(f"of an earlier run, and not written by this one: {', '.join(old)}")


def find_origin(
    args: argparse.Namespace, ann: AnnotationFile, map_name: str
) -> MapOrigin | MapGrid | None:
    """Place of the global frame on the earth, or None if it is unknown.

    The place is the latitude and longitude of the origin (`MapOrigin`), or the grid in which the
    poses are coordinates (`MapGrid`).

    Args:
        args: The options of the command; ``--crs`` and ``--origin`` have priority.
        ann: The samples.
        map_name: Name of the map of the samples. Its origin is known in nuScenes and Argoverse 2.
    """
    if args.crs is not None:
        return MapGrid(args.crs)
    if args.origin:
        latitude, longitude = args.origin
        return MapOrigin(latitude, longitude)
    return known_origin(ann.meta, map_name)


def write_map(
    stem: Path, args: argparse.Namespace, ann: AnnotationFile, drive: Drive, elements: MapElements
) -> list[str]:
    """Write a map in all formats.

    Args:
        stem: Path of the files, without a suffix.
        args: The options of the command.
        ann: The samples.
        drive: The drive of the map.
        elements: The map, in the global frame.

    Returns:
        Paths of the written files.
    """
    classes = drive.classes
    origin = find_origin(args, ann, drive.frames[0].sample.map_name)
    style = MapStyle(classes)
    root = args.data_root or args.ann.parent
    colours = [style.colour(label) for label in range(len(classes))]
    # Frames, images and the map, for the formats that show the drive over time.
    replay = Replay(
        drive,
        elements,
        frame_kind=ann.meta.frame,
        colours=colours,
        data_root=root,
        ground_z_m=ann.meta.ground_z_m,
    )
    paths = []
    for suffix in args.formats:
        path = f"{stem}.{suffix}"
        paths.append(path)
        if suffix == "geojson":
            write_geojson(path, elements, classes, origin=None)
        elif suffix == "osm":
            assert origin is not None  # `check_options` refuses the format otherwise
            lanes = lane_graph_of(drive, elements)
            print(f"{format_count(len(lanes.lanelets), 'lanelet')} {lanes.source}: {path}")
            write_lanelet2(
                path,
                elements,
                classes=classes,
                origin=origin,
                lanes=lanes,
                speed_limit_kmh=args.speed_limit,
            )
        elif suffix == "rrd":
            write_rerun(path, replay)
        elif suffix == "mcap":
            write_mcap(path, replay)
        elif suffix == "mp4":
            write_video(path, replay)
        else:  # png, svg
            draw(path, drive, elements, ann, style)
    if "geojson" in args.formats and origin is not None:
        path = f"{stem}{_LON_LAT}.geojson"
        paths.append(path)
        write_geojson(path, elements, classes, origin)
    return paths


def draw(
    path: str, drive: Drive, merged: MapElements, ann: AnnotationFile, style: MapStyle
) -> None:
    """Draw the baseline, the merged map and, with ground truth, the true map.

    Args:
        path: Picture to write.
        drive: The drive.
        merged: Its merged map, in the global frame.
        ann: The samples.
        style: Colours and titles of the classes.
    """
    # The baseline selects predictions of the frames by non-maximum suppression.
    maps = {"suppressed (baseline)": suppress(drive), "merged": merged}
    if has_truth(ann):
        maps["true"] = true_map(read_drive(ann, drive.scenes, read_truth(ann)))
    track = np.array([frame.sample.global_from_frame[:2, 3] for frame in drive.frames])
    save_figure(plot_maps(maps, track, style), path)


def has_truth(ann: AnnotationFile) -> bool:
    """Whether all samples have ground truth."""
    return bool((ann.instance_counts() >= 0).all())


def read_truth(ann: AnnotationFile) -> dict[str, MapElements]:
    """Ground truth of all samples, by token."""
    return {sample.token: elements_of_instances(sample.instances or []) for sample in ann}


def score(passes: list[Pass], ann: AnnotationFile, out: Path) -> None:
    """Score the merged maps and the baseline; write ``scores.json``.

    Args:
        passes: The drives with their merged maps.
        ann: The samples, with ground truth.
        out: Folder of ``scores.json``.
    """
    instances = read_truth(ann)
    drives = []
    merged = []
    truths = []
    baseline = []
    for one_pass in passes:  # a `Pass` has a drive and its map (`elements`)
        drive = one_pass.drive
        drives.append(drive)
        merged.append(one_pass.elements)
        truths.append(true_map(read_drive(ann, drive.scenes, instances)))
        baseline.append(suppress(drive))
    figures = {
        "merged": map_figures(merged, truths, drives),
        "suppressed": map_figures(baseline, truths, drives),
    }
    print(f"\n{figures_table(figures)}\n")
    write_text(out / _SCORES, json.dumps(figures, indent=1, allow_nan=False) + "\n")
    print(f"figures: {out / 'scores.json'}")


def place_of(ann: AnnotationFile, scenes: Sequence[str]) -> str:
    """Name of the place of drives, the ``map_name`` of their samples.

    Raises:
        ValueError: If the drives are in different places, or do not exist.
    """
    places = set(places_of(ann, scenes).values())
    if len(places) != 1:
        raise InputError(
            f"an earlier map or a prior is of one place, and the drives lie in {sorted(places)}: "
            "choose the drives of one place with --scene."
        )
    return places.pop()


def open_map(path: Path, args: argparse.Namespace, ann: AnnotationFile, place: str) -> MapElements:
    """Read an earlier map, and print the number of elements that are not used, or lie elsewhere.

    Args:
        path: GeoJSON or Lanelet2 file.
        args: The options of the command.
        ann: The samples, whose classes and global frame the map gets.
        place: Name of the map of the samples.
    """
    classes = ann.meta.classes
    rule = ClassRule.parse(args.map_classes, classes) if args.map_classes else None
    file = read_map(path, classes, origin=find_origin(args, ann, place), rule=rule)
    print(f"{format_count(len(file.elements), 'element')}: {path}")
    if file.unused:
        print(f"not used: {describe_unused(file.unused)}")
    if len(file.elements) and not lies_near(file.elements, ann, place):
        print(
            f"{path} has no element within {_NEAR_M:g} m of the samples of {args.ann}: its "
            "coordinates may be of another frame."
        )
    return file.elements


def lies_near(elements: MapElements, ann: AnnotationFile, place: str) -> bool:
    """Whether the bounding box of an element is within 1 km of the samples of a place.

    Args:
        elements: Elements of a map, in metres in the global frame.
        ann: The samples.
        place: Name of the map of the place.
    """
    positions = [sample.global_from_frame[:2, 3] for sample in ann if sample.map_name == place]
    low = np.min(positions, axis=0) - _NEAR_M
    high = np.max(positions, axis=0) + _NEAR_M
    for line in elements.polylines:
        if (line.min(axis=0) <= high).all() and (line.max(axis=0) >= low).all():
            return True
    return False


def compare(
    args: argparse.Namespace, ann: AnnotationFile, old: MapElements, passes: list[Pass]
) -> None:
    """Write and print the changes since an old map.

    Args:
        args: The options of the command.
        ann: The samples.
        old: Old map in the global frame.
        passes: The drives with their merged maps.
    """
    drive = passes[0].drive
    comparison = find_changes(old, passes, merge_config(args))
    path = args.out / f"{_CHANGES}.geojson"
    place = drive.frames[0].sample.map_name
    write_changes(path, comparison.changes, drive.classes, place=place)
    origin = find_origin(args, ann, place)
    if origin is not None:
        lon_lat_path = args.out / f"{_CHANGES}{_LON_LAT}.geojson"
        write_changes(lon_lat_path, comparison.changes, drive.classes, place=place, origin=origin)
    print(f"changes: {summarize_changes(comparison)}: {path}")


def add_sources(sources: PriorSources, passes: Iterable[Pass]) -> None:
    """Add the samples of drives to the sources of a prior that is made of them."""
    for one_pass in passes:
        for frame in one_pass.drive.frames:
            sources.add(frame.sample.token)


def write_prior(
    path: Path,
    place: str,
    classes: Sequence[str],
    maps: list[MapElements],
    passes: Iterable[Pass] = (),
) -> None:
    """Write maps of a place as a prior.

    Args:
        path: File to create or replace.
        place: Name of the map.
        classes: Class names in label order.
        maps: Maps in the global frame.
        passes: Drives of which the maps were made.
    """
    from gsmap.prior import MapPrior, PriorSettings

    with MapPrior(PriorSettings(tuple(classes), place)) as prior:
        for elements in maps:
            prior.write_map(elements)
        add_sources(prior.sources, passes)
        prior.save(path)
        print(f"prior of {place}, {format_count(prior.num_tiles, 'tile')}: {path}")


def write_element_prior(
    path: Path,
    place: str,
    classes: Sequence[str],
    maps: Sequence[MapElements],
    passes: Iterable[Pass] = (),
) -> None:
    """Write the elements of a map of a place as a prior.

    Args:
        path: File to create or replace.
        place: Name of the map.
        classes: Class names in label order.
        maps: Maps in the global frame.
        passes: Drives of which the maps were made.

    Raises:
        ValueError: If there is not exactly one map. The elements of several maps may overlap.
    """
    from gsmap.prior import ElementPrior, PriorSettings

    if len(maps) != 1:
        raise InputError(
            f"--elements needs one map, and there are {len(maps)}: --join makes one of all drives, "
            "and a --map is written without results."
        )
    prior = ElementPrior(PriorSettings(tuple(classes), place), maps[0])
    add_sources(prior.sources, passes)
    prior.save(path)
    print(f"prior of {place}, {format_count(len(prior.elements), 'element')}: {path}")


def write_gaussian_prior(
    path: Path, place: str, passes: Sequence[Pass], results: Mapping[str, MapElements], thr: float
) -> None:
    """Write the predictions of all frames of a place as a Gaussian prior.

    Args:
        path: File to create or replace.
        place: Name of the map.
        passes: Drives, whose frames are written in the order of time.
        results: Predictions in the annotation frames of the samples, by token.
        thr: Smallest score of a prediction that is written.
    """
    from gsmap.prior import GaussianPrior, PriorSettings

    drive = passes[0].drive
    prior = GaussianPrior(PriorSettings(drive.classes, place))
    extent = BEVGrid(drive.x_range, drive.y_range, height=1, width=1)  # only its range is used
    samples = []
    for one_pass in passes:
        samples += [frame.sample for frame in one_pass.drive.frames]
    samples.sort(key=lambda sample: sample.timestamp_ns)
    for sample in samples:
        elements = results[sample.token].with_coordinates(2)
        confident_elements = elements.select(elements.confidence >= thr)
        prior.write(sample.global_from_frame, extent, elements=confident_elements)
    add_sources(prior.sources, passes)
    prior.save(path)
    print(f"prior of {place}, {format_count(prior.num_gaussians, 'Gaussian')}: {path}")


def merge_config(args: argparse.Namespace) -> MergeConfig:
    """Parameters of merging from the options of the command."""
    return MergeConfig(
        gaussians=not args.no_gaussians,
        min_confidence=args.min_confidence,
        min_area_confidence=args.min_area_confidence,
    )


def group_scenes(
    args: argparse.Namespace, ann: AnnotationFile, scenes: Sequence[str]
) -> dict[str, list[str]]:
    """Scenes of each map that is written: one scene, or all scenes of a place with ``--join``.

    Args:
        args: The options of the command.
        ann: The samples.
        scenes: Names of the scenes.

    Returns:
        Scenes by the name of the scene or of the place.

    Raises:
        ValueError: If the samples of a scene lie in several places, or if drives are joined and
            the place of a drive is unknown.
    """
    place_of_scene = places_of(ann, scenes)
    if not args.join:
        return {scene: [scene] for scene in scenes}
    groups: dict[str, list[str]] = {}
    for scene in scenes:
        place = place_of_scene[scene]
        if not place:
            raise InputError(
                f"--join needs the place of each drive, and {scene!r} has no map_name: leave "
                "--join out, or choose other drives with --scene."
            )
        groups.setdefault(place, []).append(scene)
    return groups


def read_results(args: argparse.Namespace, ann: AnnotationFile) -> dict[str, MapElements]:
    """Read the predictions in the annotation frames of the samples, by token.

    Predictions of classes that the annotation file lacks are left out. These, short predictions
    and samples that one file lacks are printed.

    Raises:
        ValueError: If the file is malformed, or if maps are scored and the model was trained on
            another split.
    """
    file = SampleFile(args.results, RESULTS_KEY, ann.meta.classes, gaussians=True)
    results = {}
    for token, elements, _ in file:
        results[token] = elements.select(elements.labels >= 0)  # -1: a class that is not in `ann`
    for name, number in sorted(file.ignored.items()):
        if name != THREE_D:
            print(f"not used: {format_count(number, 'prediction')} of class {name!r}")
    if file.num_short:
        print(f"not used: {format_count(file.num_short, 'prediction')} of fewer than two points")
    scene_of = dict(zip(ann.column("token"), ann.column("scene"), strict=True))
    missing = []
    for token, scene in scene_of.items():
        if token not in results and scene in (args.scene or [scene]):
            missing.append(token)
    if missing:
        count = format_count(len(missing), "sample")
        print(f"not used: {count} without results, such as {missing[0]!r}")
    if others := [token for token in results if token not in scene_of]:
        count = format_count(len(others), "result")
        print(f"not used: {count} of samples that {args.ann} lacks, such as {others[0]!r}")
    if has_truth(ann) and not args.allow_other_split:  # maps are scored
        require_results_of(ann.meta.split_list, file.about, args.results)
    return results


def scenes_with_results(
    args: argparse.Namespace,
    ann: AnnotationFile,
    results: Mapping[str, MapElements],
    scenes: Sequence[str],
) -> list[str]:
    """Return the scenes that have results, and print how many others there are.

    Args:
        args: The options of the command.
        ann: The samples.
        results: Predictions by token.
        scenes: Names of the scenes.

    Raises:
        ValueError: If the file lacks a scene, if a scene of ``--scene`` has no results, or if none
            of the scenes has any.
    """
    require_scenes(ann, scenes)
    found = set()
    for token, scene in zip(ann.column("token"), ann.column("scene"), strict=True):
        if token in results:
            found.add(scene)
    missing = [scene for scene in scenes if scene not in found]
    if missing and (args.scene or len(missing) == len(scenes)):
        raise InputError(
            f"no sample of scene {missing[0]!r} has results: give the results of {args.ann}, or "
            "choose other drives with --scene."
        )
    if missing:
        number = format_count(len(missing), "drive")
        print(f"not used: {number} without results, such as {missing[0]!r}")
    return [scene for scene in scenes if scene in found]


def print_pose_warnings(ann: AnnotationFile, scenes: Sequence[str]) -> None:
    """Print warnings of poses of drives that cannot be right, and so their maps."""
    if ann.meta.has_poses:
        samples = (sample for sample in ann if sample.scene in scenes)
        for line in pose_warnings(samples, ann.meta.frame):
            print(f"poses: {line}")


def names_of_maps(
    args: argparse.Namespace, ann: AnnotationFile, groups: Iterable[str]
) -> dict[str, str]:
    """Name of the files of each map, without a suffix, by the name of the map.

    Args:
        args: The options of the command.
        ann: The samples.
        groups: Names of the maps: scenes, or places with ``--join``.

    Raises:
        ValueError: If a map has the file name of the changes, or an output would replace another
            program's file.
    """
    # `file_names` gives each drive a safe file name. The names are chosen for all drives of the
    # annotation file, so that the name of a drive does not depend on the selected drives. They
    # stay different when "_lonlat" is appended to some of them.
    all_names = ann.column("map_name" if args.join else "scene")
    names_of_all = file_names(sorted({*all_names, *groups}), ("", _LON_LAT))
    names = {name: names_of_all[name] for name in groups}
    if args.changes and _CHANGES in names.values():
        raise InputError(
            f"drive {_CHANGES!r} has the name of the file that --changes writes: leave "
            "--changes out, or choose other drives with --scene."
        )
    require_own_files(args, names=names.values(), scored=has_truth(ann))
    return names


def merge_drives(
    args: argparse.Namespace,
    ann: AnnotationFile,
    results: Mapping[str, MapElements],
    groups: Mapping[str, Sequence[str]],
    names: Mapping[str, str],
) -> tuple[list[Pass], float]:
    """Merge drives, and write and print their maps.

    Args:
        args: The options of the command.
        ann: The samples.
        results: Predictions in the annotation frames of the samples, by token.
        groups: Scenes of each map, by its name.
        names: Name of the files of each map, without a suffix; not used without ``--out``.

    Returns:
        Drives with their merged maps, and the processor time of merging in seconds.

    Raises:
        ValueError: If a drive has no results.
    """
    has_poses = ann.meta.has_poses
    passes = []
    processor_s = 0.0
    for name, scenes in groups.items():
        drive = confident(read_drive(ann, scenes, results, name), args.score_thr)
        start_s = time.process_time()
        # Without poses there is no map; the video shows the single frames.
        elements = merge(drive, merge_config(args)) if has_poses else MapElements.from_polylines()
        processor_s += time.process_time() - start_s
        passes.append(Pass(drive, elements))
        if args.out:
            elements_text = format_count(len(elements), "element")
            summary = f"{elements_text} of {format_count(len(drive.frames), 'frame')}"
            for path in write_map(args.out / names[name], args, ann, drive, elements):
                print(f"{summary}: {path}")
    return passes, processor_s


def main(argv: list[str] | None = None) -> str:
    """Run the command, and return the line that it prints at its end."""
    args = parse_args(argv)
    ann = AnnotationFile(args.ann)
    scenes = args.scene or sorted(set(ann.column("scene")))
    check_options(args, ann)
    results: dict[str, MapElements] = {}
    if args.results:
        results = read_results(args, ann)
        scenes = scenes_with_results(args, ann, results, scenes)
        print_pose_warnings(ann, scenes)
    if args.crs is not None and ann.meta.has_poses:
        print_grid_places(args.crs, ann, scenes)
    place = place_of(ann, scenes) if args.changes or args.prior else ""
    # Without a map_name of the samples, the prior is named after its file.
    prior_place = place or (args.prior.stem if args.prior else "")
    old = open_map(args.changes, args, ann, place) if args.changes else None
    # Maps for the prior: the map of --map, and the map of each drive.
    maps = [open_map(args.map, args, ann, place)] if args.map else []
    passes: list[Pass] = []
    earlier: dict[Path, tuple[int, int]] = {}  # outputs of earlier runs
    summary = f"a prior of {prior_place}"  # without results, the prior is the only output
    if args.results:
        groups = group_scenes(args, ann, scenes)
        names = names_of_maps(args, ann, groups) if args.out else {}
        earlier = stamps_of(possible_outputs(args.out, names.values())) if args.out else {}
        passes, processor_s = merge_drives(args, ann, results, groups, names)
        frames = sum(len(one_pass.drive.frames) for one_pass in passes)
        num_drives = sum(len(one_pass.drive.scenes) for one_pass in passes)
        numbers = f"{format_count(num_drives, 'drive')}, {format_count(frames, 'frame')}"
        summary = f"{numbers}, merged in {processor_s:.1f} s of processor time"
        maps += [one_pass.elements for one_pass in passes]
    if old is not None:
        compare(args, ann, old, passes)
    if args.gaussians:
        write_gaussian_prior(args.prior, prior_place, passes, results, args.score_thr)
    elif args.elements:
        write_element_prior(args.prior, prior_place, ann.meta.classes, maps, passes)
    elif args.prior:
        write_prior(args.prior, prior_place, ann.meta.classes, maps, passes)
    if args.out and has_truth(ann):
        score(passes, ann, args.out)
    print_old_outputs(earlier)
    return summary


if __name__ == "__main__":
    run_command(main)
