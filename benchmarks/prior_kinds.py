"""Comparison of map priors that store rasters or Gaussians, on the same simulated drives."""

import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.measure import markdown_table
from gsmap.ops.polyline_raster import draw_polylines
from gsmap.prior import GaussianPrior, HitMissCounts, KeepMaximum, LastSeen, MapPrior, PriorSettings
from gsmap.prior.rules import WriteRule
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import clip_to_box

GRID = BEVGrid((-15, 15), (-30, 30), height=200, width=100)  # range of a frame in metres
SETTINGS = PriorSettings(("divider", "boundary"), place="benchmark")
# Rules by which a frame changes the cells of a raster: each gives a prior to compare.
RULES: tuple[WriteRule, ...] = (KeepMaximum(), LastSeen(), HitMissCounts())
PASSES = 3  # drives along the road
STEP_M = 5.0  # distance between frames
NOISE_M = 0.25  # standard deviation of the error of a predicted line, across its direction
MISSED = 0.15  # share of the true lines that a frame does not predict
FALSE = 0.3  # average number of false lines that a frame predicts
WIDTH_M = 0.6  # width of lines in rasters and in the truth
# Lines of the road: offset from its middle in metres (positive to the right), index of the class.
_LINES = ((-7.0, 1), (-3.5, 0), (0.0, 0), (3.5, 0), (7.0, 1))
_NUM_POINTS = 20  # number of points of a predicted line
Frame = tuple[NDArray[np.float64], MapElements]
"""Pose of the vehicle in the global frame (4, 4), and predicted elements in the vehicle frame."""


def road(distance_m: NDArray[np.float64], offset_m: float) -> NDArray[np.float64]:
    """Points along a winding road, in metres in the global frame. (n,) -> (n, 2)

    Args:
        distance_m: Position of each point along y, in metres.
        offset_m: Distance of the points from the middle of the road, positive to the right.
    """
    x = 90 * (1 - np.cos(distance_m / 300))
    slope = 0.3 * np.sin(distance_m / 300)  # derivative of x: the road runs along (slope, 1)
    right = np.stack([np.ones_like(slope), -slope], axis=1)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([x, distance_m], axis=1) + offset_m * right


def true_lines(length_m: float) -> list[tuple[NDArray[np.float64], int]]:
    """Lines of the road in the global frame, with their classes.

    They extend beyond both ends of the drives, so that they fill the range of every frame.
    """
    distances_m = np.arange(-60.0, length_m + 60.0, 1.0)
    return [(road(distances_m, offset_m), label) for offset_m, label in _LINES]


def pose_on_road(distance_m: float, beside_m: float) -> NDArray[np.float64]:
    """Pose of a vehicle on the road, with the y axis of its frame pointing ahead. (4, 4)

    Args:
        distance_m: Position along the road, in metres.
        beside_m: Distance from the middle of the road, positive to the right.
    """
    # Angle of the road from the y axis: the road runs along (slope, 1), as in `road`.
    yaw_rad = -math.atan(0.3 * math.sin(distance_m / 300))
    cos = math.cos(yaw_rad)
    sin = math.sin(yaw_rad)
    pose = np.eye(4)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    pose[:2, 3] = road(np.array([distance_m]), beside_m)[0]
    return pose


def elements_in_range(
    lines: list[tuple[NDArray[np.float64], int]], pose: NDArray[np.float64]
) -> MapElements:
    """Transform lines to a frame and cut them to its range.

    Args:
        lines: Lines in the global frame, with their classes.
        pose: Pose of the frame in the global frame. (4, 4)
    """
    pieces = []
    labels = []
    for line, label in lines:
        # Points farther away are outside of the range of the frame.
        is_near = np.abs(line - pose[:2, 3]).max(axis=1) < 60
        # The product of row vectors with a rotation matrix is the inverse rotation.
        local = (line[is_near] - pose[:2, 3]) @ pose[:2, :2]
        for piece in clip_to_box(local, GRID.x_range, GRID.y_range):
            pieces.append(piece)
            labels.append(label)
    return MapElements.from_polylines(pieces, labels)


def predict(truth: MapElements, rng: np.random.Generator) -> MapElements:
    """Make noisy predictions: lines that are shifted and bent, missed, or false.

    Args:
        truth: True lines of a frame.
        rng: Source of random numbers.
    """
    lines = []
    labels = []
    for line, label, _ in truth.rows:
        if rng.random() < MISSED:
            continue
        index = np.linspace(0, len(line) - 1, _NUM_POINTS)
        x = np.interp(index, np.arange(len(line)), line[:, 0])
        y = np.interp(index, np.arange(len(line)), line[:, 1])
        # The error is a constant plus a wave along the line, each of variance 1. The factors after
        # them scale the standard deviation of the sum to NOISE_M.
        phase = rng.uniform(0, 2 * math.pi)
        bend = math.sqrt(2) * np.sin(np.linspace(0, 6, _NUM_POINTS) + phase)
        shift = NOISE_M * (rng.normal() + bend) / math.sqrt(2)
        # Lines run nearly along y, so a shift along x is an error across the line.
        lines.append(np.stack([x + shift, y], axis=1))
        labels.append(label)
    for _ in range(rng.poisson(FALSE)):
        # A false line is straight, about 15 m long, and of a random class.
        start = np.array([rng.uniform(-12, 12), rng.uniform(-30, 15)])
        step = np.array([rng.normal(), 15.0])
        lines.append(np.stack([start, start + step]))
        labels.append(int(rng.integers(2)))
    return MapElements.from_polylines(lines, labels, rng.uniform(0.4, 1.0, len(lines)))


def drives(length_m: float) -> list[Frame]:
    """Simulate predictions of several drives along the road, each with frames at other places."""
    lines = true_lines(length_m)
    rng = np.random.default_rng(0)
    frames = []
    for number in range(PASSES):
        for distance_m in np.arange(0.0, length_m, STEP_M).tolist():
            # Drive i starts i metres along the road, so its frames lie at other places.
            pose = pose_on_road(distance_m + number, beside_m=rng.normal())
            truth = elements_in_range(lines, pose)
            frames.append((pose, predict(truth, rng)))
    return frames


def draw(elements: MapElements) -> Tensor:
    """Draw the lines of each class to a raster of their scores. (C, H, W)"""
    masks = torch.zeros(len(SETTINGS.classes), GRID.height, GRID.width)
    for line, label, score in elements.rows:
        mask = draw_polylines(torch.from_numpy(line)[None].float(), GRID, width_m=WIDTH_M)[0]
        masks[label] = torch.maximum(masks[label], score * mask)
    return masks


def compare(length_km: float) -> str:
    """Measure all kinds of priors on the same drives.

    Args:
        length_km: Length of the road in kilometres.

    Returns:
        Text and Markdown table.
    """
    length_m = 1000 * length_km
    frames = drives(length_m)
    lines = true_lines(length_m)
    # Compile the kernels of drawing and of reading before anything is timed.
    draw(frames[0][1])
    GaussianPrior(SETTINGS).read(frames[0][0], GRID)
    rows = []
    for rule in RULES:
        raster = MapPrior(SETTINGS, rule)

        def write_raster(pose: NDArray[np.float64], elements: MapElements) -> None:
            raster.write(pose, GRID, draw(elements))  # noqa: B023 - called in this iteration

        def read_raster(pose: NDArray[np.float64]) -> Tensor:
            return raster.read(pose, GRID)  # noqa: B023 - called in this iteration

        figures = _figures(frames, lines, write=write_raster, read=read_raster, save=raster.save)
        rows.append([type(rule).__name__, *figures, "-"])  # rasters have no sigmas
    prior = GaussianPrior(SETTINGS)
    figures = _figures(
        frames,
        lines,
        write=lambda pose, elements: prior.write(pose, GRID, elements),
        read=lambda pose: prior.read(pose, GRID),
        save=prior.save,
    )
    rows.append(["Gaussians", *figures, f"{_share_within_2_sigma(prior, length_m):.0%}"])
    header = ["prior", "write (ms)", "read (ms)", "file, MB per 1,000 km", "IoU with the truth"]
    header.append("errors within 2 sigma")
    text = (
        f"The same {len(frames)} frames of {PASSES} drives along {length_km:g} km of road with "
        f"{len(_LINES)} lines: predictions err by {NOISE_M:g} m, {MISSED:.0%} are missed and "
        f"{FALSE:g} a frame are false. Times are mean processor times of a frame; for rasters, "
        "writing includes drawing the predictions. IoU with true lines of "
        f"{WIDTH_M:g} m, at the best threshold.\n"
    )
    return f"{text}\n{markdown_table(header, rows)}"


def _figures(
    frames: list[Frame],
    lines: list[tuple[NDArray[np.float64], int]],
    write: Callable[[NDArray[np.float64], MapElements], None],
    read: Callable[[NDArray[np.float64]], Tensor],
    save: Callable[[Path], None],
) -> list[str]:
    """Measure a prior: write all frames to it, and read it at the frames of the last drive.

    Args:
        frames: Poses and predictions.
        lines: True lines in the global frame, with their classes.
        write: Writes a frame to the prior.
        read: Reads the prior at a pose. (4, 4) -> (C, H, W)
        save: Saves the prior.

    Returns:
        Cells of the table: milliseconds of a write and of a read, megabytes per 1,000 km, and the
        largest IoU with the true lines and its threshold.
    """
    start_s = time.process_time()
    for pose, elements in frames:
        write(pose, elements)
    write_s = time.process_time() - start_s
    frames_per_drive = len(frames) // PASSES
    read_s = 0.0
    thresholds = np.arange(1, 10) / 10
    intersections = np.zeros(len(thresholds))
    unions = np.zeros(len(thresholds))
    for pose, _ in frames[-frames_per_drive:]:
        start_s = time.process_time()
        values = read(pose)
        read_s += time.process_time() - start_s
        truth = draw(elements_in_range(lines, pose)) >= 0.5
        for index, threshold in enumerate(thresholds.tolist()):
            is_predicted = values >= threshold
            intersections[index] += int((is_predicted & truth).sum())
            unions[index] += int((is_predicted | truth).sum())
    iou = intersections / np.maximum(unions, 1)
    best = int(iou.argmax())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "prior"
        save(path)
        size_mb = path.stat().st_size / 1e6
    length_km = frames_per_drive * STEP_M / 1000
    return [
        f"{1e3 * write_s / len(frames):.2f}",
        f"{1e3 * read_s / frames_per_drive:.2f}",
        f"{1000 * size_mb / length_km:.0f}",
        f"{iou[best]:.3f} at {thresholds[best]:.1f}",
    ]


def _share_within_2_sigma(prior: GaussianPrior, length_m: float) -> float:
    """Share of the Gaussians near a true line whose error is at most two standard deviations.

    The error is the distance along x, which is about the distance across the road. Only Gaussians
    that are drawn when the prior is read are counted.
    """
    distances_m = np.arange(-60.0, length_m + 60.0, 0.1)
    num_within = 0
    num_near = 0
    for label in range(len(SETTINGS.classes)):
        means, covariances, values = prior.gaussians(label)
        is_drawn = values >= prior.rule.least_value
        means = means[is_drawn]
        # Gaussians are long along the line: the smallest eigenvalue is the variance across it.
        sigmas = np.sqrt(np.linalg.eigvalsh(covariances)[is_drawn, 0])
        errors = np.full(len(means), np.inf)
        for offset_m, line_label in _LINES:
            if line_label == label:
                line = road(distances_m, offset_m)
                nearest = np.abs(line[:, 1] - means[:, 1, None]).argmin(axis=1)
                errors = np.minimum(errors, np.abs(line[nearest, 0] - means[:, 0]))
        is_near = errors < 1.5  # metres; Gaussians farther away are of false lines
        num_near += int(is_near.sum())
        num_within += int((errors <= 2 * sigmas)[is_near].sum())
    return num_within / max(num_near, 1)
