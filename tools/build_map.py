#!/usr/bin/env python
r"""Merge the predictions of each drive into one map, score it, and write it for other tools.

Examples:
    python tools/build_map.py results.json --ann data/minicity/gsmap_minicity_val.arrow --out maps
    python tools/build_map.py results.json --ann annotations.arrow --out maps \
        --formats geojson osm rrd mcap --origin 48.26 11.67
"""

import gsmap  # noqa: F401 - first: Ctrl-C is one line from here on, foreign settings are kept out

# isort: split
import argparse
import json
import math
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from drivemaps.config import MergeConfig
from drivemaps.drive import Drive, read_drive
from drivemaps.geodetic import MapGrid, MapOrigin, known_origin, require_near
from drivemaps.geojson import write_geojson
from drivemaps.lanelet2 import SPEED_LIMIT_KMH, write_lanelet2
from drivemaps.lanelets import lane_graph_of
from drivemaps.mcap import write_mcap
from drivemaps.merging import confident, merge, suppress
from drivemaps.replay import Replay
from drivemaps.rerun import write_rerun
from drivemaps.scoring import figures_table, map_figures
from drivemaps.truth import true_map
from drivemaps.video import write_video
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.elements import elements_of_instances
from gsmap.evaluation.core.results_json import RESULTS_KEY, SampleFile
from gsmap.structures.elements import MapElements
from gsmap.utils.cli import CommandParser, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_extra
from gsmap.utils.files import file_names, write_text
from gsmap.utils.split_lists import require_results_of
from gsmap.utils.words import counted
from gsmap.visualization.bev_view import draw_lines
from gsmap.visualization.figure import save_figure
from gsmap.visualization.plots import WIDTH_IN, finish_panel, panel_grid
from gsmap.visualization.style import MapStyle

FORMATS = ("geojson", "osm", "rrd", "mcap", "mp4", "png", "svg")
_LON_LAT = "_lonlat"  # ends the name of a map in degrees
EXTRAS = {"rrd": ("rerun", "viz"), "mcap": ("foxglove", "viz"), "mp4": ("av", "viz")}


def parse_args(argv: list[str] | None = None) -> argparse.Namespace:
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path, help="results in MapTR's JSON form")
    parser.add_argument(
        "--ann", type=Path, required=True, help="annotation file (*.arrow) of the same samples"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the maps")
    parser.add_argument("--formats", nargs="+", default=["geojson"], choices=FORMATS)
    parser.add_argument("--scene", nargs="+", help="drives to merge; all by default")
    parser.add_argument("--score-thr", type=float, default=0.3, help="smallest score that counts")
    parser.add_argument(
        "--min-confidence",
        type=float,
        default=MergeConfig.min_confidence,
        help="keep a place if this share of the frames that see it found it, weighted by score",
    )
    parser.add_argument(
        "--min-area-confidence",
        type=float,
        default=MergeConfig.min_area_confidence,
        help="the same for areas, such as crossings",
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
        help="score maps of a model that was trained on another split, whose places it may share",
    )
    parser.add_argument(
        "--data-root", type=Path, help="folder of the images for rrd, mcap and mp4: that of --ann"
    )
    return parser.parse_args(argv)


def check_formats(args: argparse.Namespace, ann: AnnotationFile) -> None:
    """Raise an error, before anything is written, if a format lacks its package or an origin."""
    if not 0 < args.speed_limit < math.inf:
        raise InputError(f"--speed-limit must be > 0, got {args.speed_limit}.")
    for key in EXTRAS.keys() & set(args.formats):
        import_extra(*EXTRAS[key])
    origins = {name: origin_of(args, ann, name) for name in set(ann.column("map_name"))}
    if args.crs and args.origin:
        raise InputError("--crs and --origin both say where the poses lie: give one of them.")
    if any(isinstance(origin, MapOrigin) for origin in origins.values()):
        require_near(np.array([sample.global_from_frame[:2, 3] for sample in ann]), str(args.ann))
    unknown = sorted(name for name, origin in origins.items() if origin is None)
    if "osm" in args.formats and unknown:
        raise InputError(
            f"Lanelet2 needs longitude and latitude, and the origin of map {unknown[0]!r} is not "
            "known: give --origin LAT LON (any place will do; nodes keep local_x and local_y), or "
            "--crs if poses are coordinates of a grid."
        )
    if {"osm", "geojson"} & set(args.formats) and len(unknown) < len(origins):
        import_extra("pyproj", "maps")


def origin_of(
    args: argparse.Namespace, ann: AnnotationFile, map_name: str
) -> MapOrigin | MapGrid | None:
    """Return where the global frame lies, if that is known."""
    if args.crs:
        return MapGrid(args.crs)
    return MapOrigin(*args.origin) if args.origin else known_origin(ann.meta, map_name)


def write_map(
    stem: Path, args: argparse.Namespace, ann: AnnotationFile, drive: Drive, elements: MapElements
) -> list[str]:
    """Write a map in all formats; return the files."""
    classes = drive.classes
    origin = origin_of(args, ann, drive.frames[0].sample.map_name)
    style, root = MapStyle(classes), args.data_root or args.ann.parent
    colours = [style.colour(label) for label in range(len(classes))]
    replay = Replay(drive, elements, ann.meta.frame, colours, root, ann.meta.ground_z_m)
    writers = {
        "geojson": partial(write_geojson, classes=classes, origin=None),
        "osm": lambda path, _: write_lanelet2(
            path,
            elements,
            classes=classes,
            origin=origin,
            lanes=lanes,
            speed_limit_kmh=args.speed_limit,
        ),
        "rrd": lambda path, _: write_rerun(path, replay),
        "mcap": lambda path, _: write_mcap(path, replay),
        "mp4": lambda path, _: write_video(path, replay),
    }
    for key in {"png", "svg"} & set(args.formats):
        writers[key] = lambda path, _: draw(path, drive, elements, ann, style)
    lanes = None
    if "osm" in args.formats:
        lanes = lane_graph_of(drive, elements)
        print(f"{counted(len(lanes.lanelets), 'lanelet')} of centre lines: {stem}.osm")
    paths = []
    for key in args.formats:
        paths.append(f"{stem}.{key}")
        writers[key](paths[-1], elements)
    if "geojson" in args.formats and origin is not None:
        paths.append(f"{stem}{_LON_LAT}.geojson")
        write_geojson(paths[-1], elements, classes, origin)
    return paths


def draw(
    path: str, drive: Drive, merged: MapElements, ann: AnnotationFile, style: MapStyle
) -> None:
    """Draw the baseline, the merged and, where it is known, the true map."""
    maps = {"suppressed (baseline)": suppress(drive), "merged": merged}
    if has_truth(ann):
        annotated = {s.token: elements_of_instances(s.instances or []) for s in ann}
        maps["true"] = true_map(read_drive(ann, drive.scene, annotated))
    track = np.array([frame.sample.global_from_frame[:2, 3] for frame in drive.frames])
    save_figure(plot_maps(maps, track, style), path)


def plot_maps(maps: Mapping[str, MapElements], track: np.ndarray, style: MapStyle) -> Figure:
    """Draw maps of one drive side by side (long ones one below the other), with the way driven.

    ``maps`` are in the global frame, by their titles; ``track`` holds the vehicle's positions in
    metres. (n, 2)
    """
    points = np.concatenate([track, *(elements.points[:, :2] for elements in maps.values())])
    low, high = points.min(axis=0) - 5, points.max(axis=0) + 5
    width, height = high - low
    rows = len(maps) if width > 2.5 * height else 1
    figure, axes = panel_grid(rows, len(maps) // rows)
    across = WIDTH_IN * rows / len(maps) - 0.5  # without the labels
    figure.set_figheight(0.4 + rows * (across * min(height / width, 2) + 0.5))
    for ax, (title, elements) in zip(axes.ravel(), maps.items(), strict=True):
        lines = [line[:, :2] - low for line in elements.polylines]
        draw_lines(ax, lines, elements.labels, style, style.colours(elements.labels), 0.8)
        ax.plot(*(track - low).T, ".", color=style.ink, markersize=1.2)
        ax.set(xlim=(0, width), ylim=(0, height), aspect="equal")
        finish_panel(ax, title)
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter("{x:g} m")
    labels = sorted({int(label) for elements in maps.values() for label in elements.labels})
    lines = [Line2D([], [], color=style.colour(i), lw=2, label=style.title(i)) for i in labels]
    figure.legend(handles=lines, loc="outside upper right", ncols=4, fontsize=8, frameon=False)
    return figure


def has_truth(ann: AnnotationFile) -> bool:
    return bool((ann.instance_counts() >= 0).all())


def score(drives: list[Drive], merged: list[MapElements], ann: AnnotationFile, out: Path) -> None:
    """Compare the merged maps and the plain baseline with the true maps."""
    instances = {s.token: elements_of_instances(s.instances or []) for s in ann}
    truths = [true_map(read_drive(ann, drive.scene, instances)) for drive in drives]
    maps = {"merged": merged, "suppressed": [suppress(drive) for drive in drives]}
    figures = {way: map_figures(found, truths, drives) for way, found in maps.items()}
    print(f"\n{figures_table(figures)}\n")
    write_text(out / "scores.json", json.dumps(figures, indent=1) + "\n")
    print(f"figures: {out / 'scores.json'}")


def main(argv: list[str] | None = None) -> str:
    args = parse_args(argv)
    ann = AnnotationFile(args.ann)
    check_formats(args, ann)
    file = SampleFile(args.results, RESULTS_KEY, ann.meta.classes, gaussians=True)
    results = {token: elements for token, elements, _ in file}
    if has_truth(ann) and not args.allow_other_split:  # maps are scored
        require_results_of(ann.meta.split_list, file.about, args.results)
    config = MergeConfig(
        gaussians=not args.no_gaussians,
        min_confidence=args.min_confidence,
        min_area_confidence=args.min_area_confidence,
    )
    has_poses = ann.meta.options.get("poses", True)
    if not has_poses and args.formats != ["mp4"]:
        raise InputError(
            f"the samples of {args.ann} have no poses, so there is no map of the drive: --formats "
            "mp4 shows the single frames."
        )
    drives, merged, spent_s = [], [], 0.0
    names = file_names(sorted(set(ann.column("scene"))), ("", _LON_LAT))
    for scene in args.scene or names:
        drives.append(confident(read_drive(ann, scene, results), args.score_thr))
        start_s = time.process_time()
        merged.append(merge(drives[-1], config) if has_poses else MapElements.from_polylines())
        spent_s += time.process_time() - start_s
        for path in write_map(args.out / names[scene], args, ann, drives[-1], merged[-1]):
            seen = counted(len(drives[-1].frames), "frame")
            print(f"{counted(len(merged[-1]), 'element')} of {seen}: {path}")
    if has_truth(ann):
        score(drives, merged, ann, args.out)
    frames = sum(len(drive.frames) for drive in drives)
    done = f"{counted(len(drives), 'drive')}, {counted(frames, 'frame')}"
    return f"{done}, merged in {spent_s:.1f} s of processor time"


if __name__ == "__main__":
    run_command(main)
