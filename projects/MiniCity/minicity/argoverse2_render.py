"""Render the ring cameras of real Argoverse 2 logs, in the layout of the official data set."""

import argparse
import os
import shutil
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.feather as feather
import shapely
from av2.geometry.camera.pinhole_camera import PinholeCamera
from av2.map.map_api import ArgoverseStaticMap, GroundHeightLayer
from av2.utils.io import read_feather

from gsmap.datasets.image_files import encode_jpeg
from gsmap.utils.files import partial_path
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from gsmap.utils.shards import add_shard_options
from mapdata.argoverse2.log import POSES, RING_CAMERAS, Argoverse2Log, find_logs
from mapdata.argoverse2.map import find_map
from mapdata.argoverse2.samples import thin_out
from mapdata.command_line import add_log_options, add_workers_option, options_from
from minicity.argoverse2 import make_scene
from minicity.camera import Camera
from minicity.lighting import random_lighting
from minicity.renderer import SceneRenderer

VIEW_M = 50.0
GROUND_PIXELS_PER_IMAGE_PIXEL = 0.0625 * 800  # metres times image width, as MiniCity has it
JPEG_QUALITY = 90


@dataclass(frozen=True)
class RenderOptions:
    """How logs are rendered: the options of ``tools/create_data.py av2-render``.

    ``scale`` is in (0, 1], ``rate_hz`` > 0 in pictures per second; None, as of ``max_frames``, is
    all. The log in the folder ``calibration`` lends its own to logs that have none.
    """

    rate_hz: float | None = 2.0
    scale: float = 0.25
    calibration: Path | None = None
    max_frames: int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 1:
            raise ValueError(f"scale must be in (0, 1], got {self.scale}.")
        if self.rate_hz is not None and not self.rate_hz > 0:
            raise ValueError(f"rate_hz must be > 0, got {self.rate_hz}.")
        if self.max_frames is not None and self.max_frames < 1:
            raise ValueError(f"max_frames must be >= 1, got {self.max_frames}.")


def scaled_camera(camera: PinholeCamera, scale: float) -> tuple[np.ndarray, int, int]:
    """Return a camera's intrinsics (3, 3), width and height for pictures of ``scale`` its size.

    Integer pixel coordinates lie at pixel centres, so the picture's corner (-0.5, -0.5) stays put.
    """
    width, height = (max(1, round(n * scale)) for n in (camera.width_px, camera.height_px))
    ratio = np.array([width / camera.width_px, height / camera.height_px])
    intrinsics = camera.intrinsics.K.copy()
    intrinsics[:2] *= ratio[:, None]
    intrinsics[:2, 2] += 0.5 * (ratio - 1)
    return intrinsics, width, height


def _prepare(
    log: Argoverse2Log, cameras: dict[str, PinholeCamera], times_ns: np.ndarray, scale: float
) -> Callable[[str, int], bytes]:
    """Lay out the ground around a log's track and return what takes a picture there, as JPEG.

    It takes the name of a camera and a row's time in the pose table.
    """
    track = np.array([log.poses[time][:2, 3] for time in times_ns.tolist()])  # (n, 2)
    bounds = (*(track.min(0) - VIEW_M).tolist(), *(track.max(0) + VIEW_M).tolist())
    static_map = ArgoverseStaticMap.from_json(find_map(log.log_dir))
    try:
        heights = GroundHeightLayer.from_file(log.log_dir / "map")
    except RuntimeError as error:
        raise ValueError(f"{error} in {log.log_dir / 'map'}") from error
    pinholes = {name: scaled_camera(camera, scale) for name, camera in cameras.items()}
    widest = max(width for _, width, _ in pinholes.values())
    rng = np.random.default_rng(zlib.crc32(log.log_id.encode()))
    renderer = SceneRenderer(
        make_scene(static_map, heights, bounds),
        bounds,
        random_lighting(rng),
        float(np.clip(GROUND_PIXELS_PER_IMAGE_PIXEL / widest, 0.05, 0.12)),
        rng,
    )

    def take(name: str, timestamp_ns: int) -> bytes:
        city_from_cam = log.poses[timestamp_ns] @ cameras[name].ego_SE3_cam.transform_matrix
        camera = Camera(*pinholes[name], np.linalg.inv(city_from_cam))
        image = renderer.render_camera(camera, [], rng)
        return encode_jpeg(image, JPEG_QUALITY)

    return take


def render_log(log_dir: Path, out_dir: Path, options: RenderOptions) -> int:
    """Render a log into a folder of the official layout, which appears when it is whole.

    The map, the poses and the calibration (for the scaled pictures) are written along.

    Returns the number of pictures.

    Raises:
        FileExistsError: If ``out_dir`` exists.
        FileNotFoundError: If map or poses are missing.
        ValueError: If there is no calibration or ground height.
        OSError: If a file cannot be written, for example on a full disk; nothing is left behind.
    """
    if out_dir.exists():
        raise FileExistsError(f"{out_dir} is there already and kept: delete it to render it again")
    source = log = Argoverse2Log(log_dir)
    if not log.calibration and options.calibration is not None:
        source = Argoverse2Log(options.calibration)
    if len(source.calibration) < len(RING_CAMERAS):
        raise ValueError(
            "no calibration of the ring cameras (--calibration-from names another log)"
        )
    times = thin_out(np.array(list(log.poses)), options.rate_hz)
    if options.max_frames is not None and len(times) > options.max_frames:
        times = times[np.linspace(0, len(times) - 1, options.max_frames).round().astype(int)]
    take = _prepare(log, source.calibration, times, options.scale)
    out_dir.parent.mkdir(parents=True, exist_ok=True)
    with partial_path(out_dir, Path.mkdir) as partial_dir:
        _copy_log(log_dir, source, partial_dir, options.scale)
        for timestamp_ns in times.tolist():
            for name in RING_CAMERAS:
                path = partial_dir / f"sensors/cameras/{name}/{timestamp_ns}.jpg"
                path.write_bytes(take(name, timestamp_ns))
        os.rename(partial_dir, out_dir)
    return len(times) * len(RING_CAMERAS)


def _copy_log(log_dir: Path, source: Argoverse2Log, target: Path, scale: float) -> None:
    """Copy map and poses, write the calibration of the scaled cameras, make the image folders."""
    shutil.copytree(log_dir / "map", target / "map", copy_function=shutil.copyfile)
    shutil.copyfile(log_dir / POSES, target / POSES)
    (target / "calibration").mkdir()
    extrinsics = "calibration/egovehicle_SE3_sensor.feather"
    shutil.copyfile(source.log_dir / extrinsics, target / extrinsics)
    table = read_feather(source.log_dir / "calibration" / "intrinsics.feather")
    table = table[table["sensor_name"].isin(RING_CAMERAS)].reset_index(drop=True)
    for row, name in enumerate(table["sensor_name"]):
        intrinsics, width, height = scaled_camera(source.calibration[name], scale)
        table.loc[row, ["fx_px", "fy_px"]] = intrinsics[0, 0], intrinsics[1, 1]
        table.loc[row, ["cx_px", "cy_px"]] = intrinsics[0, 2], intrinsics[1, 2]
        table.loc[row, ["width_px", "height_px"]] = width, height
    table[["k1", "k2", "k3"]] = 0.0  # the renderer's lens is perfect
    feather.write_feather(table, target / "calibration" / "intrinsics.feather")
    for name in RING_CAMERAS:
        (target / "sensors/cameras" / name).mkdir(parents=True)


def _try_log(log_dir: Path, out: Path, options: RenderOptions) -> int | str:
    """Render a log; return the reason where it cannot be rendered. A full disk stops everything."""
    try:
        return render_log(log_dir, out / log_dir.name, options)
    except (FileExistsError, FileNotFoundError, ValueError, shapely.errors.ShapelyError) as error:
        return str(error)


def render_logs(
    log_dirs: Sequence[Path], out: Path, options: RenderOptions, workers: int = 1
) -> str:
    """Render logs into the folder ``out``; one that cannot be rendered does not stop the others.

    Returns what was rendered and what was left out, for people.
    """
    render = partial(_try_log, out=out, options=options)
    results = ordered_map(render, log_dirs, min(workers, max(len(log_dirs), 1)), timeout_s=3600.0)
    with Progress(log_dirs, desc="av2-render", unit="logs") as logs:
        done = {log_dir.name: result for log_dir, result in zip(logs, results, strict=True)}
    counts = [result for result in done.values() if isinstance(result, int)]
    lines = [f"log {name} left out: {why}" for name, why in done.items() if isinstance(why, str)]
    return "\n".join([f"{sum(counts)} pictures of {len(counts)} logs in {out}", *lines])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the renderer's options to a parser."""
    add = parser.add_argument
    add_log_options(parser, "2hz")
    add("--out", type=Path, required=True, help="data root to write")
    splits = ("train", "val", "test")
    add("--out-split", choices=splits, help="split in --out (default: the same)")
    add("--scale", type=float, default=0.25, help="size relative to the real images")
    add("--calibration-from", metavar="LOG", help="log whose calibration replaces a missing one")
    add("--max-frames", type=int, help="frames per log, evenly spread")
    add_workers_option(parser)
    add_shard_options(parser)


def run(arguments: argparse.Namespace) -> str:
    """Render as the command line asks and return the summary."""
    root, split, log = arguments.root, arguments.split, arguments.calibration_from
    calibration = find_logs(root, split, [log])[0] if log else None
    options = options_from(RenderOptions, arguments, calibration=calibration)
    log_dirs = arguments.shard.part(find_logs(root, split, arguments.logs))
    out = arguments.out / (arguments.out_split or split)
    return render_logs(log_dirs, out, options, arguments.workers)
