"""Speed and memory of tools/evaluate.py, and its speed relative to the reference evaluators."""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
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
from gsmap.utils.shipped import shipped_path

Record = dict[str, Any]  # a frame or a map element, in the form of JSON


@dataclass(frozen=True)
class Run:
    """Time and memory of a process and its children.

    Attributes:
        wall_s: Wall-clock time in seconds.
        cpu_s: Processor time in seconds, workers included.
        peak_mib: Largest resident memory of all processes together in MiB; shared pages count once
            per process.
    """

    wall_s: float
    cpu_s: float
    peak_mib: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks eval`` to a parser."""
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
        help="number of samples for the algorithm of the reference, whose time is linear in it",
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
    """Generate random frames that resemble a validation set, with lines and crossings.

    Each prediction is an element of the ground truth, resampled and shifted, with a random score.

    Args:
        count: Number of frames.
        seed: Seed of the generator.
        size_m: Size of the map along x and y in metres. Elements are stretched with the map, but
            their number does not depend on it.

    Returns:
        Frames with ``token``, ``gt`` and ``pred``, as in the file of ``--frames``.
    """
    rng = np.random.default_rng(seed)
    stretch = np.array(size_m) / (30.0, 60.0)  # elements are drawn for a map of 30 x 60 m
    frames = []
    for number in range(count):
        truths = []
        preds = []
        # Each pair is a label and the largest number of its elements in a frame.
        for label, max_count in ((0, 12), (1, 4), (2, 7)):
            for _ in range(rng.integers(max_count + 1)):
                line = _random_element(rng, label) * stretch
                truths.append({"label": label, "pts": np.round(line, 3).tolist()})
                points = _add_noise(line, rng)
                score = float(np.round(rng.uniform(low=0.02, high=1), 6))
                pts = np.round(points, 3).tolist()
                preds.append({"label": label, "score": score, "pts": pts})
        frames.append({"token": f"f{number:05d}", "gt": truths, "pred": preds})
    return frames


def _random_element(rng: np.random.Generator, label: int) -> np.ndarray:
    """Draw a crossing (label 1) or a line on a map of 30 x 60 m, in metres. (P, 2)

    Lines lie inside the map. A crossing may reach a few metres beyond its upper edges.
    """
    position = rng.uniform(low=[-13, -25], high=[13, 25])  # a crossing's corner, or a line's x
    if label == 1:
        w, h = rng.uniform(low=1.5, high=7, size=2)
        return position + np.array([[0, 0], [w, 0], [w, h], [0, h], [0, 0]])
    # A parabola along y, clipped to the range.
    start = -rng.uniform(low=3, high=28)
    end = rng.uniform(low=3, high=28)
    t = np.linspace(start, end, num=20)
    bend = rng.normal(scale=0.004) * t**2
    return np.clip(position[0] + np.stack([bend, t], axis=1), [-15, -30], [15, 30])


def _add_noise(line: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Resample a polyline to 20 points and shift it, in metres. (P, 2) -> (20, 2)"""
    vertices = np.arange(len(line))
    positions = np.linspace(0, len(line) - 1, num=20)
    x = np.interp(positions, vertices, line[:, 0])
    y = np.interp(positions, vertices, line[:, 1])
    # The size of the errors is random, too, so that some predictions are much better than others.
    shift_m = rng.normal(scale=rng.uniform(low=0, high=1.0), size=2)
    return np.stack([x, y], axis=1) + shift_m


def _vector(element: Record) -> Record:
    """Convert an element of a frame to the format of result files."""
    vector = {
        "pts": element["pts"],
        "pts_num": len(element["pts"]),
        "cls_name": CLASSES[element["label"]],
        "type": element["label"],
    }
    if "score" in element:
        vector["confidence_level"] = element["score"]
    return vector


def write_repeated_frames(folder: Path, frames: list[Record], count: int) -> tuple[Path, Path]:
    """Write a result and a ground-truth file of many samples by repeating frames.

    Args:
        folder: Output folder.
        frames: Frames to repeat.
        count: Number of samples.

    Returns:
        The result file and the ground-truth file.
    """

    def vectors(part: str) -> Iterator[tuple[str, list[Record]]]:
        """Yield the token and the elements of each sample; ``part`` is ``"pred"`` or ``"gt"``."""
        for k in range(count):
            frame = frames[k % len(frames)]
            # The number makes the tokens of repeated frames different.
            yield f"{frame['token']}_{k:05d}", list(map(_vector, frame[part]))

    results = folder / f"results_{count}.json"
    truth = folder / f"truth_{count}.json"
    # `key` is the name of the list of samples in the file.
    write_results(results, vectors("pred"), key="results")
    write_results(truth, vectors("gt"), key="GTs")
    return results, truth


def _resident_mib(pid: int) -> float:
    """Resident memory of a process and its children in MiB; 0 for a process that has ended."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return 0.0
    total = sum(_resident_mib(int(child)) for child in children)
    for line in status.splitlines():
        if line.startswith("VmRSS"):
            total += int(line.split()[1]) / 1024  # the file has KiB
    return total


def _evaluate(files: tuple[Path, Path], metrics: list[str], grid: BEVGrid, workers: int = 1) -> Run:
    """Run ``tools/evaluate.py`` and measure it together with all of its child processes.

    Args:
        files: Result file and ground-truth file.
        metrics: Names of the metrics.
        grid: Range of the map.
        workers: Number of worker processes of the command.

    Returns:
        Time and memory. The peak is the largest of the values that are read every 20 ms.

    Raises:
        WorkError: If the command fails.
    """
    command = [sys.executable, str(shipped_path("tools/evaluate.py")), *map(str, files)]
    command += ["--eval", *metrics]
    x_min, x_max = grid.x_range
    y_min, y_max = grid.y_range
    command += ["--range", str(x_min), str(y_min), str(x_max), str(y_max)]
    start = time.perf_counter()
    process = subprocess.Popen([*command, "--workers", str(workers)], stdout=subprocess.DEVNULL)
    peak = 0.0
    # Unlike `Popen.wait`, `os.wait4` also returns the processor time, with the workers' time.
    pid = 0
    while pid == 0:  # `os.wait4` returns 0 as long as the process runs
        peak = max(peak, _resident_mib(process.pid))
        time.sleep(0.02)
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
    wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)  # `Popen` did not wait and lacks it
    if process.returncode:
        raise WorkError(f"{' '.join(command)} ended with {process.returncode}.")
    return Run(wall_s=wall, cpu_s=usage.ru_utime + usage.ru_stime, peak_mib=peak)


def _column(elements: list[Record], key: str) -> list[Any]:
    """Values of a field of all elements."""
    return [element[key] for element in elements]


def _frame(record: Record) -> tuple[MapElements, MapElements]:
    """Convert a frame to predictions and ground truth."""
    preds = record["pred"]
    truths = record["gt"]
    pred_elements = MapElements.from_polylines(
        polylines=_column(preds, "pts"),
        labels=_column(preds, "label"),
        scores=_column(preds, "score"),
    )
    truth_elements = MapElements.from_polylines(
        polylines=_column(truths, "pts"),
        labels=_column(truths, "label"),
    )
    return pred_elements, truth_elements


def _reference_table(frames: list[Record], count: int, grid: BEVGrid) -> str:
    """Compare the algorithms of the reference and of GSMap on a few samples.

    Args:
        frames: Frames to repeat.
        count: Number of samples.
        grid: Range of the map.

    Returns:
        Markdown table of the time per sample, without the loading of files, and of the mAP of both
        algorithms.
    """
    from benchmarks import reference_evaluation as reference  # needs pycocotools

    samples = [_frame(frames[k % len(frames)]) for k in range(count)]
    chamfer = ChamferConfig(CLASSES)
    raster = RasterConfig(CLASSES, grid)

    def chamfer_by_reference() -> float:
        return reference.chamfer_map(samples, num_classes=3)

    def raster_by_reference() -> float:
        return reference.raster_map(samples, raster)

    rows = []
    for name, config, evaluate_by_reference in (
        ("chamfer", chamfer, chamfer_by_reference),
        ("raster", raster, raster_by_reference),
    ):
        evaluator = MapEvaluator(config)
        first_preds, first_truths = samples[0]
        evaluator.match("warm-up", first_preds, first_truths)  # the first call compiles kernels
        start = time.process_time()
        reference_mean_ap = evaluate_by_reference()
        reference_ms = (time.process_time() - start) / count * 1e3
        if name == "raster" and not reference.FILLS_AS_RELEASED:
            # The installed OpenCV fills polygons differently from the versions behind the published
            # figures. The mAP is therefore computed without OpenCV's filling. The time above is
            # measured with it.
            reference_mean_ap = reference.raster_map(samples, raster, by_opencv=False)
        start = time.process_time()
        matches = []
        for k, (preds, truths) in enumerate(samples):
            # Repeated frames need different tokens, because repeated tokens count once.
            matches.append(evaluator.match(f"{k:06d}", preds, truths))
        our_mean_ap = evaluator.reports(matches)[0].metrics[f"{name}/mAP"]
        our_ms = (time.process_time() - start) / count * 1e3
        row = [
            f"AP_{name}",
            f"{reference_ms:.1f}",
            f"{our_ms:.3f}",
            f"{reference_ms / our_ms:.0f} x",
            f"{reference_mean_ap:.6f}",
            f"{our_mean_ap:.6f}",
        ]
        rows.append(row)
    header = ["metric", "reference, ms", "ours, ms", "ratio", "reference mAP", "our mAP"]
    return markdown_table(header, rows)


def _print_progress(text: str) -> None:
    """Print a measurement at once, to the standard error: the output is the report alone."""
    print(text, file=sys.stderr, flush=True)


def run(args: argparse.Namespace) -> None:
    """Measure, print and write the tables.

    Args:
        args: Parsed options of ``add_arguments``.
    """
    frames = read_json(args.frames)["frames"] if args.frames else None
    if not frames:
        frames = generated_frames(320, size_m=args.size)
    x = args.size[0] / 2
    y = args.size[1] / 2
    grid = BEVGrid((-x, x), (-y, y))  # only the range is used
    reference = _reference_table(frames, args.reference_samples, grid=grid)
    _print_progress(reference)
    sections = [
        f"Matching alone, processor time a frame, {args.reference_samples} samples:\n",
        reference,
        "\nThe whole command, start, reading and printing included:\n",
    ]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        # The first run compiles the kernels.
        few_files = write_repeated_frames(Path(folder), frames, count=8)
        _evaluate(few_files, ["chamfer", "raster"], grid=grid)
        for count in args.samples:
            files = write_repeated_frames(Path(folder), frames, count=count)
            for metrics, workers in (
                (["chamfer"], 1),
                (["raster"], 1),
                (["chamfer", "raster"], 1),
                (["chamfer", "raster"], 2),
            ):
                cost = _evaluate(files, metrics, grid=grid, workers=workers)
                _print_progress(f"{count} samples, {metrics}, {workers} processes: {cost}")
                row = [
                    str(count),
                    " + ".join(metrics),
                    str(workers),
                    f"{cost.wall_s:.1f}",
                    f"{cost.cpu_s:.1f}",
                    f"{cost.cpu_s / count * 1e3:.2f}",
                    f"{cost.peak_mib:.0f}",
                ]
                rows.append(row)
            for path in files:  # large files, removed before the next ones are written
                path.unlink()
    header = ["samples", "metrics", "processes", "wall s", "CPU s", "CPU ms a frame", "peak MiB"]
    sections.append(markdown_table(header, rows))
    publish("\n".join(sections), args.out)  # prints the text and writes it to the file
