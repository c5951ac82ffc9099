"""Render synthetic images of the ring cameras for the maps and poses of Argoverse 2 logs.

The images are written in the layout of the official data set.
"""

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
from gsmap.utils.errors import InputError
from gsmap.utils.files import partial_path
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from gsmap.utils.shards import add_shard_options
from mapdata.argoverse2.log import POSE_TABLE, RING_CAMERAS, Argoverse2Log, find_logs
from mapdata.argoverse2.map import find_map
from mapdata.argoverse2.samples import thin_out
from mapdata.command_line import add_log_options, add_workers_option, options_from
from minicity.argoverse2 import make_scene
from minicity.camera import Camera
from minicity.lighting import random_lighting
from minicity.renderer import SceneRenderer

VIEW_M = 50.0  # distance from the track of the vehicle to the edges of the painted ground
# Edge of a ground pixel in metres times the number of columns of an image. The product is constant,
# so wider images get a finer ground: for 800 columns, a ground pixel has an edge of 6.25 cm.
GROUND_PIXELS_PER_IMAGE_PIXEL = 0.0625 * 800
JPEG_QUALITY = 90


@dataclass(frozen=True)
class RenderOptions:
    """Options of ``tools/create_data.py av2-render``.

    Attributes:
        rate_hz: Pictures per second and camera, > 0; None for all poses.
        scale: Size of the pictures relative to the real images, in (0, 1].
        calibration: Folder of a log whose calibration is used for logs without one.
        max_frames: Greatest number of frames per log, >= 1; None for all.

    Raises:
        ValueError: If a value is out of range.
    """

    rate_hz: float | None = 2.0
    scale: float = 0.25
    calibration: Path | None = None
    max_frames: int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 1:
            raise InputError(f"scale must be in (0, 1], got {self.scale}.")
        if self.rate_hz is not None and not self.rate_hz > 0:
            raise InputError(f"rate_hz must be > 0, got {self.rate_hz}.")
        if self.max_frames is not None and self.max_frames < 1:
            raise InputError(f"max_frames must be >= 1, got {self.max_frames}.")


def scaled_camera(camera: PinholeCamera, scale: float) -> tuple[np.ndarray, int, int]:
    """Camera parameters for a scaled picture.

    Integer pixel coordinates lie at pixel centres, so the corner of the picture is at (-0.5, -0.5).
    Scaling keeps this corner in place.

    Args:
        camera: Camera of the log.
        scale: Size of the picture relative to the real image, in (0, 1].

    Returns:
        Intrinsic matrix (3, 3), width and height in pixels.
    """
    width = max(1, round(camera.width_px * scale))
    height = max(1, round(camera.height_px * scale))
    ratio = np.array([width / camera.width_px, height / camera.height_px])
    intrinsics = camera.intrinsics.K.copy()
    intrinsics[:2] *= ratio[:, None]  # focal lengths and principal point
    # Pixel coordinate u becomes (u + 0.5) * ratio - 0.5. The principal point is scaled already.
    intrinsics[:2, 2] += 0.5 * (ratio - 1)
    return intrinsics, width, height


def _make_photographer(
    log: Argoverse2Log, cameras: dict[str, PinholeCamera], times_ns: np.ndarray, scale: float
) -> Callable[[str, int], bytes]:
    """Make the scene around the track of a log, and a function that renders its pictures.

    Args:
        log: The log.
        cameras: Ring cameras by name.
        times_ns: Timestamps of the pictures in nanoseconds, all in the pose table. (n,)
        scale: Size of the pictures relative to the real images, in (0, 1].

    Returns:
        Function from a camera's name and a timestamp in nanoseconds to a picture in JPEG format.

    Raises:
        ValueError: If there is no ground height.
    """
    track = np.array([log.poses[time_ns][:2, 3] for time_ns in times_ns.tolist()])  # (n, 2)
    xmin, ymin = (track.min(axis=0) - VIEW_M).tolist()
    xmax, ymax = (track.max(axis=0) + VIEW_M).tolist()
    bounds = (xmin, ymin, xmax, ymax)
    static_map = ArgoverseStaticMap.from_json(find_map(log.log_dir))
    try:
        heights = GroundHeightLayer.from_file(log.log_dir / "map")
    except RuntimeError as error:  # the devkit found no file of ground heights
        raise InputError(f"{error} in {log.log_dir / 'map'}") from error
    scaled_cameras = {name: scaled_camera(camera, scale) for name, camera in cameras.items()}
    widest = max(width for _, width, _ in scaled_cameras.values())
    # The seed depends on the log alone. Python's `hash` would differ between processes.
    rng = np.random.default_rng(zlib.crc32(log.log_id.encode()))
    renderer = SceneRenderer(
        make_scene(static_map, heights, bounds=bounds),
        bounds=bounds,
        lighting=random_lighting(rng),
        resolution_m=float(np.clip(GROUND_PIXELS_PER_IMAGE_PIXEL / widest, 0.05, 0.12)),
        rng=rng,
    )

    def take_picture(name: str, timestamp_ns: int) -> bytes:
        # The world of the renderer is the city frame.
        city_from_cam = log.poses[timestamp_ns] @ cameras[name].ego_SE3_cam.transform_matrix
        intrinsics, width, height = scaled_cameras[name]
        camera = Camera(
            intrinsics=intrinsics,
            width=width,
            height=height,
            cam_from_world=np.linalg.inv(city_from_cam),
        )
        image = renderer.render_camera(camera, vehicles=[], rng=rng)
        return encode_jpeg(image, JPEG_QUALITY)

    return take_picture


def render_log(log_dir: Path, out_dir: Path, options: RenderOptions) -> int:
    """Render a log into a folder of the official layout.

    The folder appears when it is complete. It has the log's map and poses, and a calibration for
    the scaled pictures.

    Args:
        log_dir: Folder of the log.
        out_dir: Output folder, which must not exist.
        options: Rate, size and calibration of the pictures.

    Returns:
        Number of pictures.

    Raises:
        FileExistsError: If ``out_dir`` exists.
        FileNotFoundError: If map or poses are missing.
        ValueError: If there is no calibration or ground height.
        OSError: If a file cannot be written, for example on a full disk; nothing is left behind.
    """
    if out_dir.exists():
        raise FileExistsError(f"{out_dir} exists and is not replaced: delete it to render it again")
    log = Argoverse2Log(log_dir)
    calibrated_log = log
    if not log.calibration and options.calibration is not None:
        calibrated_log = Argoverse2Log(options.calibration)
    cameras = calibrated_log.calibration
    if len(cameras) < len(RING_CAMERAS):
        raise InputError(
            "no calibration of the ring cameras (--calibration-from names another log)"
        )
    # The keys of the poses are their timestamps in ns, ascending.
    times = thin_out(np.array(list(log.poses)), options.rate_hz)
    if options.max_frames is not None and len(times) > options.max_frames:
        indices = np.linspace(0, len(times) - 1, num=options.max_frames).round().astype(int)
        times = times[indices]
    take_picture = _make_photographer(log, cameras, times_ns=times, scale=options.scale)
    out_dir.parent.mkdir(parents=True, exist_ok=True)
    # A temporary folder beside `out_dir`, which is removed if an error occurs.
    with partial_path(out_dir, Path.mkdir) as partial_dir:
        _copy_log(log_dir, calibrated_log, target=partial_dir, scale=options.scale)
        for timestamp_ns in times.tolist():
            for name in RING_CAMERAS:
                path = partial_dir / f"sensors/cameras/{name}/{timestamp_ns}.jpg"
                path.write_bytes(take_picture(name, timestamp_ns))
        os.rename(partial_dir, out_dir)
    return len(times) * len(RING_CAMERAS)


def _copy_log(log_dir: Path, calibrated_log: Argoverse2Log, target: Path, scale: float) -> None:
    """Copy map and poses, write the calibration of the scaled cameras, and make image folders.

    Args:
        log_dir: Folder of the log.
        calibrated_log: Log with the calibration, often the log itself.
        target: Output folder, which exists and is empty.
        scale: Size of the pictures relative to the real images, in (0, 1].
    """
    # `copyfile` copies contents without permissions, because the files of a log may be read-only.
    shutil.copytree(log_dir / "map", target / "map", copy_function=shutil.copyfile)
    shutil.copyfile(log_dir / POSE_TABLE, target / POSE_TABLE)
    (target / "calibration").mkdir()
    extrinsics = "calibration/egovehicle_SE3_sensor.feather"
    shutil.copyfile(calibrated_log.log_dir / extrinsics, target / extrinsics)
    table = read_feather(calibrated_log.log_dir / "calibration" / "intrinsics.feather")
    table = table[table["sensor_name"].isin(RING_CAMERAS)].reset_index(drop=True)
    for row, name in enumerate(table["sensor_name"]):
        intrinsics, width, height = scaled_camera(calibrated_log.calibration[name], scale)
        table.loc[row, ["fx_px", "fy_px"]] = [intrinsics[0, 0], intrinsics[1, 1]]
        table.loc[row, ["cx_px", "cy_px"]] = [intrinsics[0, 2], intrinsics[1, 2]]
        table.loc[row, ["width_px", "height_px"]] = [width, height]
    table[["k1", "k2", "k3"]] = 0.0  # the renderer's lens has no distortion
    feather.write_feather(table, target / "calibration" / "intrinsics.feather")
    for name in RING_CAMERAS:
        (target / "sensors/cameras" / name).mkdir(parents=True)


def _try_log(log_dir: Path, out: Path, options: RenderOptions) -> int | str:
    """Render a log into a folder of ``out``.

    An unusable log is reported in the result. Other errors, such as a full disk, are raised.

    Returns:
        Number of pictures, or the reason why the log cannot be rendered.
    """
    try:
        return render_log(log_dir, out / log_dir.name, options=options)
    except (FileExistsError, FileNotFoundError, ValueError, shapely.errors.ShapelyError) as error:
        return str(error)


def render_logs(
    log_dirs: Sequence[Path], out: Path, options: RenderOptions, workers: int = 1
) -> str:
    """Render logs into a folder. A log that cannot be rendered does not stop the others.

    Args:
        log_dirs: Folders of the logs.
        out: Output folder, with one folder per log.
        options: Rate, size and calibration of the pictures.
        workers: Number of processes, >= 1.

    Returns:
        Summary for the user: the number of pictures, and the logs left out with their reasons.

    Raises:
        OSError: If a file cannot be written.
        RuntimeError: If a worker dies, or a log takes longer than an hour.
        ValueError: If ``workers`` is below 1.
    """
    render = partial(_try_log, out=out, options=options)
    workers = min(workers, max(len(log_dirs), 1))
    results = ordered_map(render, log_dirs, workers=workers, timeout_s=3600.0)
    counts = []
    reasons = []
    with Progress(log_dirs, desc="av2-render", unit="logs") as logs:
        for log_dir, result in zip(logs, results, strict=True):
            if isinstance(result, int):
                counts.append(result)
            else:
                reasons.append(f"log {log_dir.name} left out: {result}")
    return "\n".join([f"{sum(counts)} pictures of {len(counts)} logs in {out}", *reasons])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py av2-render`` to a parser."""
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
    """Render the logs of the command line.

    Args:
        arguments: Parsed options of ``add_arguments``.

    Returns:
        Summary for the user (`render_logs`).

    Raises:
        FileNotFoundError: If the split or a log is missing.
        ValueError: If an option is out of range.
    """
    root = arguments.root
    split = arguments.split
    calibration = None
    if arguments.calibration_from:
        calibration = find_logs(root, split, [arguments.calibration_from])[0]
    # The other fields of the options have the names of arguments.
    options = options_from(RenderOptions, arguments, calibration=calibration)
    log_dirs = arguments.shard.part(find_logs(root, split, arguments.logs))  # all without --shard
    out = arguments.out / (arguments.out_split or split)
    return render_logs(log_dirs, out, options=options, workers=arguments.workers)
