"""Time, memory and size of a map prior."""

import argparse
import math
import tempfile
from collections.abc import Iterator
from itertools import cycle
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.measure import MIB, Cost, in_own_process, markdown_table, measure, publish
from benchmarks.prior_kinds import compare
from gsmap.prior import HitMissCounts, KeepMaximum, LastSeen, MapPrior, PriorSettings
from gsmap.prior.rules import WriteRule
from gsmap.structures.grid import BEVGrid

GRID = BEVGrid(x_range=(-15, 15), y_range=(-30, 30), height=200, width=100)
SETTINGS = PriorSettings(classes=("divider", "boundary", "ped_crossing"), place="benchmark")
# Each rule combines the raster of a new frame with the stored cells in another way.
RULES: tuple[WriteRule, ...] = (KeepMaximum(), LastSeen(), HitMissCounts())
LINES_M = (-10.0, -3.5, 0.0, 3.5, 10.0)  # x of each line in the frame, across the road
STEP_M = 5.0  # distance between frames
ROW_M = 10_000.0  # extent of a piece of the road along y; the next piece is 200 m beside it


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks prior`` to a parser."""
    parser.add_argument("--km", type=float, default=20.0, help="length of the driven road")
    parser.add_argument("--repeats", type=int, default=30, help="timed frames")
    parser.add_argument(
        "--compared-km", type=float, default=0.5, help="road of the comparison with Gaussians"
    )
    parser.add_argument("--out", type=Path, help="write the table to this file, too")


def run(args: argparse.Namespace) -> None:
    """Measure, print and write the table.

    Args:
        args: Parsed options of ``add_arguments``.
    """
    torch.set_num_threads(1)  # the priors are compared by the time of one thread
    header = ["rule", "read (ms)", "write (ms)", "drive, per frame (ms)"]
    header += ["file, GB per 1,000 km", "peak memory (MiB)"]
    rows = []
    for rule in RULES:
        read_ms, write_ms = frame_times_ms(rule, repeats=args.repeats)
        # A fresh process: memory of earlier rules would disturb the peak memory.
        file_bytes, cost = in_own_process(drive, rule, args.km)
        size_gb = file_bytes / 1e9 / args.km * 1000
        num_frames = 1000 * args.km / STEP_M
        frame_ms = 1e3 * cost.cpu_s / num_frames
        row = [type(rule).__name__, f"{read_ms:.2f}", f"{write_ms:.2f}", f"{frame_ms:.2f}"]
        row += [f"{size_gb:.2f}", f"{cost.peak_bytes / MIB:.0f}"]
        rows.append(row)
    text = (
        f"One thread, {GRID.height} x {GRID.width} cells, {len(SETTINGS.classes)} classes. Reading "
        "and writing: processor time, the shortest of several frames, each at another pose. Drive: "
        f"{args.km:g} km with a frame every {STEP_M:g} m are written, saved, opened and read; "
        "processor time and peak memory of this whole work.\n"
    )
    table = markdown_table(header, rows)
    # `compare` returns a second table, of rasters and the priors that store Gaussians or elements.
    publish(f"{text}\n{table}\n\n{compare(args.compared_km)}", args.out)


def prediction(index: int) -> NDArray[np.float32]:
    """Raster of noisy lines along the road, which change from frame to frame. (C, H, W)"""
    rng = np.random.default_rng(index)
    values = np.zeros((len(SETTINGS.classes), GRID.height, GRID.width), dtype=np.float32)
    for number, line_m in enumerate(LINES_M):
        shifts_m = 0.3 * np.sin(np.arange(GRID.height) / 20 + rng.uniform(0, 6))
        columns = np.round((line_m + shifts_m - GRID.x_range[0]) / GRID.pixel_size_m[0])
        for offset in (-1, 0, 1):  # each line is three pixels wide
            column = columns.astype(np.int64) + offset
            # One cell of each row, in class 0 or 1: the classes of the lines alternate.
            values[number % 2, np.arange(GRID.height), column] = rng.uniform(0.4, 1)
    if index % 20 == 0:
        values[2, 90:105, 20:80] = 0.9  # a crossing every 100 m
    return values


def pose_at(distance_m: float) -> NDArray[np.float64]:
    """Pose at a distance along a road, which consists of parallel winding pieces along y. (4, 4)"""
    piece, along_m = divmod(distance_m, ROW_M)  # index of the piece, and the position on it
    yaw = 0.3 * math.sin(distance_m / 300)
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    aside_m = 200 * piece + 90 * (1 - math.cos(distance_m / 300))
    pose[:2, 3] = [aside_m, along_m]
    return pose


def cycle_poses(number: int, offset_m: float) -> Iterator[NDArray[np.float64]]:
    """Yield the poses of the first frames of a road in an endless cycle.

    The cycle has no end, because `measure` makes further calls in addition to the timed ones.

    Args:
        number: Number of frames.
        offset_m: Distance in metres by which each pose lies ahead of its frame, as on another drive
            along the road.
    """
    for index in cycle(range(number)):
        yield pose_at(STEP_M * index + offset_m)


def frame_times_ms(rule: WriteRule, repeats: int) -> tuple[float, float]:
    """Measure reading and writing on a road that has been driven once.

    Args:
        rule: Rule of writing.
        repeats: Number of timed frames.

    Returns:
        Processor time in milliseconds of a read, and of a write, each the shortest of all frames.
    """
    prior = MapPrior(SETTINGS, rule)
    values = prediction(0)
    for index in range(repeats):
        prior.write(pose_at(STEP_M * index), GRID, values)
    cpu = torch.device("cpu")
    read_poses = cycle_poses(repeats, offset_m=0.1)
    read = measure(lambda: prior.read(next(read_poses), GRID), cpu, repeats=repeats)
    write_poses = cycle_poses(repeats, offset_m=0.2)
    write = measure(lambda: prior.write(next(write_poses), GRID, values), cpu, repeats=repeats)
    return 1e3 * read.cpu_s, 1e3 * write.cpu_s


def drive(rule: WriteRule, length_km: float) -> tuple[int, Cost]:
    """Drive a road once, save the prior, and read it back from the file.

    Args:
        rule: Rule of writing.
        length_km: Length of the road in kilometres.

    Returns:
        Size of the file in bytes, and time and peak memory of the whole work.
    """
    torch.set_num_threads(1)  # again, because this function runs in a fresh process
    distances_m = np.arange(0, 1000 * length_km, STEP_M)
    poses = [pose_at(distance_m) for distance_m in distances_m.tolist()]
    # 40 rasters are used again and again. They are made here, so that their time is not measured.
    rasters = [prediction(index) for index in range(40)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.prior"

        def work() -> None:
            with MapPrior(SETTINGS, rule) as prior:
                for index, pose in enumerate(poses):
                    prior.write(pose, GRID, rasters[index % len(rasters)])
                prior.save(path)
            with MapPrior.load(path) as prior:
                for pose in poses:
                    prior.read(pose, GRID)

        cost = measure(work, torch.device("cpu"), repeats=1)
        return path.stat().st_size, cost
