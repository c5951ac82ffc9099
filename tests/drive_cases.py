"""A drive past a street, and a way to see it in pieces."""

from functools import cache

import numpy as np
import shapely

from drivemaps.drive import Drive, DriveFrame
from gsmap.datasets.annotations.record import MapSample
from gsmap.structures.elements import MapElements
from gsmap.structures.polylines import clip_to_box

CLASSES = ("divider", "ped_crossing", "boundary")
X_RANGE, Y_RANGE = (-15.0, 15.0), (-30.0, 30.0)


def curve(offset_m: float) -> np.ndarray:
    """A line beside a street that bends to the left, with vertices every few metres. (n, 2)"""
    angles = np.linspace(0.0, 0.8, 60)
    centre, radius = np.array([300.0, 700.0]), 200.0 + offset_m
    return centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def street() -> list[tuple[int, np.ndarray]]:
    """Two boundaries, two dividers (one ends early), a kerb island and a crossing."""
    middle = curve(0.0)[30]
    along = np.array([-np.sin(0.4), np.cos(0.4)])
    across = np.array([np.cos(0.4), np.sin(0.4)])
    corners = np.array([[-6.0, -2.0], [6.0, -2.0], [6.0, 2.0], [-6.0, 2.0], [-6.0, -2.0]])
    crossing = middle + corners[:, :1] * across + corners[:, 1:] * along
    turn = np.linspace(0.0, 2.0 * np.pi, 25)
    island = curve(9.0)[15] + 2.5 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    island[-1] = island[0]
    return [
        (2, curve(-7.0)),
        (2, curve(7.0)),
        (0, curve(-1.0)),
        (0, curve(2.5)[:40]),
        (2, island),
        (1, crossing),
    ]


def pose(angle: float) -> np.ndarray:
    """The vehicle on the curve, y ahead. (4, 4)"""
    matrix = np.eye(4)
    ahead = np.array([-np.sin(angle), np.cos(angle)])
    matrix[:2, 0], matrix[:2, 1] = [ahead[1], -ahead[0]], ahead
    matrix[:2, 3] = np.array([300.0, 700.0]) + 200.0 * np.array([np.cos(angle), np.sin(angle)])
    matrix[2, 3] = 1.84
    return matrix


def cut(label: int, line: np.ndarray) -> list[np.ndarray]:
    """What is in range, as converters cut it: areas stay closed. each (n, 2)"""
    if CLASSES[label] != "ped_crossing":
        return clip_to_box(line, X_RANGE, Y_RANGE)
    (x0, x1), (y0, y1) = X_RANGE, Y_RANGE
    area = shapely.Polygon(line) & shapely.box(x0, y0, x1, y1)
    return [shapely.get_coordinates(area.exterior)] if area.area else []


@cache
def drive_of(noise_m: float = 0.0, scored: bool = False, seed: int = 0) -> Drive:
    """The drive, 6 m from frame to frame; every line is shifted across by a normal deviate."""
    rng = np.random.default_rng(seed)
    frames = []
    for number, angle in enumerate(np.arange(0.1, 0.7, 0.03)):
        ego_from_frame = np.eye(4)
        ego_from_frame[:2, :2] = [[0, 1], [-1, 0]]  # y of the LiDAR is ahead
        ego_from_frame[2, 3] = 1.84
        sample = MapSample(
            f"token{number}", "scene", "town", 10**18 + number * 5 * 10**8, [], pose(angle),
            ego_from_frame=ego_from_frame,
        )  # fmt: skip
        empty = DriveFrame(sample, MapElements.from_polylines())
        lines, labels = [], []
        for label, line in street():
            for piece in cut(label, empty.to_frame(line)):
                lines.append(piece + noise_m * rng.normal(size=2))
                labels.append(label)
        lines = [empty.to_global(line.astype(np.float32).astype(np.float64)) for line in lines]
        scores = rng.uniform(0.5, 0.9, len(lines)) if scored else None
        frames.append(DriveFrame(sample, MapElements.from_polylines(lines, labels, scores)))
    return Drive("scene", CLASSES, X_RANGE, Y_RANGE, frames)
