"""The race of the metrics: tools/evaluate.py beside the reference's way, memory, many sizes."""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import markdown_table, publish
from gsmap.datasets.annotations.record import CLASSES
from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.raster_ap import RasterConfig
from gsmap.evaluation.core.results_json import write_results
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import WorkError
from gsmap.utils.files import read_json
from gsmap.utils.shipped import shipped

Record = dict[str, Any]


@dataclass(frozen=True)
class Run:
    """One process with its children.

    Args:
        wall_s: Wall-clock time in seconds.
        cpu_s: Processor time in seconds, workers included.
        peak_mib: Largest resident memory of all its processes together, in MiB; pages that they
            share count once for each.
    """

    wall_s: float
    cpu_s: float
    peak_mib: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "--frames",
        type=Path,
        help="frames with gt and pred to repeat up to the wanted size, as JSON "
        "{frames: [{token, gt: [{label, pts}], pred: [{label, score, pts}]}]}; default: generated",
    )
    parser.add_argument("--samples", type=int, nargs="+", default=[1000, 6019, 24000])
    parser.add_argument(
        "--reference-samples",
        type=int,
        default=100,
        help="number of samples for the algorithm of the reference, which is linear in them",
    )
    parser.add_argument(
        "--size",
        nargs=2,
        type=float,
        default=(30.0, 60.0),
        metavar=("X", "Y"),
        help="the map in metres; generated lines grow with it",
    )
    parser.add_argument("--out", type=Path, help="write the tables to this file, too")


def generated_frames(
    count: int, seed: int = 0, size_m: Sequence[float] = (30.0, 60.0)
) -> list[Record]:
    """Return frames like a validation set's: lines across the range and crossings, with noise.

    Args:
        count: Number of frames.
        seed: Of the generator.
        size_m: The map's size along x and y; elements are as many and so much longer.
    """
    rng, stretch = np.random.default_rng(seed), np.array(size_m) / (30.0, 60.0)
    frames = []
    for number in range(count):
        truth, found = [], []
        for label, most in ((0, 12), (1, 4), (2, 7)):
            for _ in range(rng.integers(most + 1)):
                centre = rng.uniform([-13, -25], [13, 25])
                if label == 1:
                    w, h = rng.uniform(1.5, 7, 2)
                    line = centre + np.array([[0, 0], [w, 0], [w, h], [0, h], [0, 0]])
                else:
                    t = np.linspace(-rng.uniform(3, 28), rng.uniform(3, 28), 20)
                    bend = rng.normal(scale=0.004) * t**2
                    line = np.clip(centre[0] + np.stack([bend, t], axis=1), [-15, -30], [15, 30])
                line = line * stretch
                truth.append({"label": label, "pts": np.round(line, 3).tolist()})
                at = np.linspace(0, len(line) - 1, 20)
                points = np.stack([np.interp(at, range(len(line)), c) for c in line.T], axis=1)
                points += rng.normal(scale=rng.uniform(0, 1.0), size=2)
                score = float(np.round(rng.uniform(0.02, 1), 6))
                found.append({"label": label, "score": score, "pts": np.round(points, 3).tolist()})
        frames.append({"token": f"f{number:05d}", "gt": truth, "pred": found})
    return frames


def _vector(element: Record) -> Record:
    vector = {
        "pts": element["pts"],
        "pts_num": len(element["pts"]),
        "cls_name": CLASSES[element["label"]],
        "type": element["label"],
    }
    return {**vector, "confidence_level": element["score"]} if "score" in element else vector


def write_race(folder: Path, frames: list[Record], count: int) -> tuple[Path, Path]:
    """Write a result and a ground-truth file of many samples by repeating frames.

    Args:
        folder: Where to write.
        frames: Frames to repeat.
        count: Number of samples.

    Returns:
        The result file and the ground-truth file.
    """
    paths = folder / f"results_{count}.json", folder / f"truth_{count}.json"
    for path, part, key in zip(paths, ("pred", "gt"), ("results", "GTs"), strict=True):
        samples = (
            (f"{frame['token']}_{k:05d}", [_vector(e) for e in frame[part]])
            for k, frame in ((k, frames[k % len(frames)]) for k in range(count))
        )
        write_results(path, samples, key=key)
    return paths


def _resident_mib(pid: int) -> float:
    """Return the resident memory of a process and its children; 0 for one that is gone."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return 0.0
    own = next((line for line in status.splitlines() if line.startswith("VmRSS")), "VmRSS: 0 kB")
    return int(own.split()[1]) / 1024 + sum(_resident_mib(int(child)) for child in children)


def _evaluate(files: tuple[Path, Path], metrics: list[str], grid: BEVGrid, workers: int = 1) -> Run:
    """Run the command and measure it with everything that it starts."""
    command = [
        sys.executable,
        str(shipped("tools/evaluate.py")),
        *map(str, files),
        "--eval",
        *metrics,
    ]
    (x0, x1), (y0, y1) = grid.x_range, grid.y_range
    command += ["--range", *map(str, (x0, y0, x1, y1))]
    start = time.perf_counter()
    process = subprocess.Popen([*command, "--workers", str(workers)], stdout=subprocess.DEVNULL)
    peak, pid = 0.0, 0
    while pid == 0:
        peak = max(peak, _resident_mib(process.pid))
        time.sleep(0.02)
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
    wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise WorkError(f"{' '.join(command)} ended with {process.returncode}.")
    return Run(wall, usage.ru_utime + usage.ru_stime, peak)


def _frame(record: Record) -> tuple[MapElements, MapElements]:
    """Return predictions and ground truth of a frame."""
    pred, truth = record["pred"], record["gt"]
    return (
        MapElements.from_polylines(
            [e["pts"] for e in pred], [e["label"] for e in pred], [e["score"] for e in pred]
        ),
        MapElements.from_polylines([e["pts"] for e in truth], [e["label"] for e in truth]),
    )


def _reference_table(frames: list[Record], count: int, grid: BEVGrid) -> str:
    """Compare the reference's way with ours on a few samples, in this process, loading apart."""
    from benchmarks import reference_evaluation as reference  # needs pycocotools

    samples = [_frame(frames[k % len(frames)]) for k in range(count)]
    chamfer, raster = ChamferConfig(CLASSES), RasterConfig(CLASSES, grid)
    rows = []
    for name, evaluator, slow in (
        ("chamfer", MapEvaluator(chamfer), lambda: reference.chamfer_map(samples, 3)),
        ("raster", MapEvaluator(raster), lambda: reference.raster_map(samples, raster)),
    ):
        evaluator.match("warm-up", *samples[0])
        start = time.process_time()
        theirs = slow()
        slow_ms = (time.process_time() - start) / count * 1e3
        if name == "raster" and not reference.FILLS_AS_RELEASED:  # its pixels are not the released
            theirs = reference.raster_map(samples, raster, by_opencv=False)
        start = time.process_time()
        matches = [evaluator.match(f"{k:06d}", *sample) for k, sample in enumerate(samples)]
        ours = evaluator.reports(matches)[0].metrics[f"{name}/mAP"]
        fast_ms = (time.process_time() - start) / count * 1e3
        rows.append(
            [
                f"AP_{name}",
                f"{slow_ms:.1f}",
                f"{fast_ms:.3f}",
                f"{slow_ms / fast_ms:.0f} x",
                f"{theirs:.6f}",
                f"{ours:.6f}",
            ]
        )
    header = ["metric", "reference's way, ms", "ours, ms", "ratio", "its mAP", "our mAP"]
    return markdown_table(header, rows)


def _say(text: str) -> None:
    """Show what is measured while the rest still runs."""
    print(text, file=sys.stderr, flush=True)


def run(args: argparse.Namespace) -> None:
    """Measure, print and write the tables."""
    given = read_json(args.frames)["frames"] if args.frames else None
    x, y = (size / 2 for size in args.size)
    grid = BEVGrid((-x, x), (-y, y))
    frames = given or generated_frames(320, size_m=args.size)
    reference = _reference_table(frames, args.reference_samples, grid)
    _say(reference)
    parts = [
        f"Matching alone, processor time a frame, {args.reference_samples} samples:\n",
        reference,
        "\nThe whole command, start, reading and printing included:\n",
    ]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        _evaluate(write_race(Path(folder), frames, 8), ["chamfer", "raster"], grid)  # compiles once
        for count in args.samples:
            files = write_race(Path(folder), frames, count)
            for metrics, workers in (
                (["chamfer"], 1),
                (["raster"], 1),
                (["chamfer", "raster"], 1),
                (["chamfer", "raster"], 2),
            ):
                cost = _evaluate(files, metrics, grid, workers)
                _say(f"{count} samples, {metrics}, {workers} processes: {cost}")
                rows.append(
                    [
                        str(count),
                        " + ".join(metrics),
                        str(workers),
                        f"{cost.wall_s:.1f}",
                        f"{cost.cpu_s:.1f}",
                        f"{cost.cpu_s / count * 1e3:.2f}",
                        f"{cost.peak_mib:.0f}",
                    ]
                )
            for path in files:
                path.unlink()
    header = ["samples", "metrics", "processes", "wall s", "CPU s", "CPU ms a frame", "peak MiB"]
    parts.append(markdown_table(header, rows))
    publish("\n".join(parts), args.out)
