"""Consistency over the frames of a drive: tracks, C-mAP of MapTracker, jitter of vertices.

The rules are those of MapTracker's released tools, which differ from AP_chamfer: predictions of
score 0.4 or less are left out, a frame without ground truth of a class does not count for it, lines
have 200 points, and no strips must touch.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import shapely
from scipy.optimize import linear_sum_assignment

from gsmap.evaluation.core import chamfer_kernels as kernels
from gsmap.evaluation.core.average_precision import area_ap
from gsmap.evaluation.core.chamfer_ap import CHAMFER_THRESHOLDS
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import resample_all
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.errors import InputError

TRACK_POINTS, CHAMFER_POINTS = 20, 200
_LONG_PX, _SHORT_PX, _LINE_PX, _SMALL_PX = 200, 100, 3, 20
_SIMPLIFY_M = 0.2


@dataclass(frozen=True)
class ConsistencyConfig:
    """Rules of tracks and C-mAP.

    Args:
        classes: Names of the classes; a label is an index into them.
        grid: The map's extent.
        filled_classes: Labels that are drawn as areas when tracks are made.
        thresholds: Largest Chamfer distances of a match, in metres.
        min_score: Predictions must have a higher score.
        look_back: Earlier frames in which a predicted track may continue.
        min_iou: Smallest overlap, exclusive, of two predictions of a track.
        min_truth_iou: The same for ground truth, whose tracks continue from the frame before.

    Raises:
        ValueError: If a value is out of its range.
    """

    classes: tuple[str, ...]
    grid: BEVGrid
    filled_classes: tuple[int, ...] = ()
    thresholds: tuple[float, ...] = CHAMFER_THRESHOLDS
    min_score: float = 0.4
    look_back: int = 5
    min_iou: float = 1e-3
    min_truth_iou: float = 1e-2

    def __post_init__(self) -> None:
        if not self.classes or not self.thresholds or min(self.thresholds) <= 0:
            raise InputError(
                "classes and thresholds must not be empty and thresholds must be > 0 m, got "
                f"{self.classes} and {self.thresholds}."
            )
        if self.look_back < 1:
            raise InputError(f"look_back must be >= 1, got {self.look_back}.")


@dataclass
class DriveFrame:
    """A frame of a drive; frames of a scene are given in the order of their times.

    Args:
        token: Its name.
        scene: Name of its scene.
        pose: From the annotation frame to the world. (4, 4)
        predictions: What the model predicts.
        truth: What is annotated.
        track_ids: Track of each prediction, of one scene and class, -1 for none; None to make
            tracks. (N,)
    """

    token: str
    scene: str
    pose: FloatArray
    predictions: MapElements
    truth: MapElements
    track_ids: IntArray | None = None
    lines: FloatArray = field(default_factory=lambda: np.empty((0, TRACK_POINTS, 2)))
    labels: IntArray = field(default_factory=lambda: np.empty(0, np.int64))


def _resampled(elements: MapElements, num_points: int) -> FloatArray:
    """Return all lines in the plane, at equal arc length. (N, P, 2)"""
    return resample_all(elements.points[:, :2].astype(np.float64), elements.offsets, num_points)


def draw_line(line: FloatArray, filled: bool, grid: BEVGrid) -> BoolArray:
    """Draw a line as MapTracker's tracks see it: an area, or 3 pixels wide. (P, 2) -> (h, w)

    The longer side has 200 pixels; what covers less than 20 pixels is made thicker.
    """
    along_x = grid.extent_m[0] >= grid.extent_m[1]
    width, height = (_LONG_PX, _SHORT_PX) if along_x else (_SHORT_PX, _LONG_PX)
    norm = np.clip(grid.norm_from_metres(line), 0.0, 1.0)
    pixels = (norm * (width, height)).astype(np.int32)
    mask = np.zeros((height, width), np.uint8)
    if filled:
        cv2.fillPoly(mask, [pixels], (1,))
    else:
        cv2.polylines(mask, [pixels], isClosed=False, color=(1,), thickness=_LINE_PX)
    if mask.sum() < _SMALL_PX:
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
        return cv2.dilate(mask, kernel).astype(bool)
    return mask.astype(bool)


def overlaps(
    now: Sequence[FloatArray], before: Sequence[FloatArray], filled: bool, grid: BEVGrid
) -> FloatArray:
    """Return the IoU of lines now with earlier ones that were moved here. (N, M)"""
    if not len(now) or not len(before):
        return np.zeros((len(now), len(before)))
    first, second = (
        np.stack([draw_line(line, filled, grid).ravel() for line in lines])
        for lines in (now, before)
    )
    shared = first.astype(np.float64) @ second.T
    return shared / np.maximum(first.sum(1)[:, None] + second.sum(1) - shared, 1)


def moved(lines: FloatArray, now_from_then: FloatArray) -> FloatArray:
    """Move lines in the plane by the vehicle's motion (4, 4). (N, P, 2) -> (N, P, 2)"""
    return lines @ now_from_then[:2, :2].T + now_from_then[:2, 3]


def partners(
    now: DriveFrame, then: DriveFrame, label: int, config: ConsistencyConfig, min_iou: float
) -> dict[int, int]:
    """Return which line now continues which line then, of one class."""
    rows, cols = (np.flatnonzero(frame.labels == label) for frame in (now, then))
    here = moved(then.lines[cols], invert_rigid(now.pose) @ then.pose)
    filled = label in config.filled_classes
    ious = overlaps(list(now.lines[rows]), list(here), filled, config.grid)
    pairs = zip(*linear_sum_assignment(-ious), strict=True)
    return {int(rows[i]): int(cols[j]) for i, j in pairs if ious[i, j] > min_iou}


def make_tracks(
    frames: Sequence[DriveFrame], config: ConsistencyConfig, look_back: int, min_iou: float
) -> list[IntArray]:
    """Give each line of a scene's frames a track.

    A line takes the track of its partner in the nearest earlier frame whose track is still free in
    its own frame, else a new one.

    Returns:
        The tracks of each frame's lines; numbers are of one scene. (N,) each
    """
    tracks: list[IntArray] = []
    new = 0
    for index, frame in enumerate(frames):
        own = np.full(len(frame.lines), -1)
        for label in range(len(config.classes)):
            earlier = range(index - 1, max(-1, index - 1 - look_back), -1)
            found = [(t, partners(frame, frames[t], label, config, min_iou)) for t in earlier]
            used: set[int] = set()
            for t, pairs in found:
                for row, col in pairs.items():
                    track = int(tracks[t][col])
                    if own[row] < 0 and track not in used:
                        own[row] = track
                        used.add(track)
        missing = np.flatnonzero(own < 0)
        own[missing] = np.arange(new, new + len(missing))
        new += len(missing)
        tracks.append(own)
    return tracks


def with_lines(frame: DriveFrame, elements: MapElements) -> DriveFrame:
    """Return a frame whose tracks are those of some elements."""
    lines = _resampled(elements, TRACK_POINTS)
    return replace(frame, lines=lines, labels=np.asarray(elements.labels))


def track_drive(frames: Sequence[DriveFrame], config: ConsistencyConfig) -> list[IntArray]:
    """Give the predictions of a scene's frames tracks; those of a low score get -1. (N,) each"""
    kept = [frame.predictions.confidence > config.min_score for frame in frames]
    drawn = [with_lines(f, f.predictions.select(k)) for f, k in zip(frames, kept, strict=True)]
    made = make_tracks(drawn, config, config.look_back, config.min_iou)
    tracks = []
    for frame, keep, own in zip(frames, kept, made, strict=True):
        ids = np.full(len(frame.predictions), -1)
        ids[keep] = own
        tracks.append(ids)
    return tracks


def tracks_of(frames: Sequence[DriveFrame], config: ConsistencyConfig) -> list[IntArray]:
    """Return the tracks of a scene's predictions, their own or made."""
    made = track_drive(frames, config)
    pairs = zip(frames, made, strict=True)
    return [own if frame.track_ids is None else frame.track_ids for frame, own in pairs]


def _chamfer_lines(elements: MapElements, simplify: bool) -> kernels.Lines:
    """Return lines of 200 points for the Chamfer distance; ground truth is simplified first."""
    lines = elements.polylines
    if simplify:
        simple = [
            np.asarray(shapely.LineString(line[:, :2]).simplify(_SIMPLIFY_M).coords)
            for line in lines
        ]
        twenty = MapElements.from_polylines(simple, elements.labels)
        lines = list(_resampled(twenty, TRACK_POINTS))
    elements = MapElements.from_polylines([line[:, :2] for line in lines], elements.labels)
    points = _resampled(elements, CHAMFER_POINTS).reshape(-1, 2).T
    offsets = np.arange(len(elements) + 1) * CHAMFER_POINTS
    return np.concatenate([points, np.zeros_like(points[:1])]), offsets, elements.labels


@dataclass(frozen=True)
class FrameHits:
    """Predictions of one class in one frame that has ground truth of it, best first."""

    scores: FloatArray  # (N,)
    tracks: IntArray  # (N,)
    nearest: IntArray  # its track of the nearest ground truth (N,)
    rows: IntArray  # number of that ground truth in the frame (N,)
    distances: FloatArray  # to it, in metres (N,)

    def hits(self, threshold: float, owners: dict[int, int] | None) -> BoolArray:
        """Return which predictions count; owners of ground-truth tracks are kept in place. (N,)

        Without owners they count as in plain AP.
        """
        found = np.zeros(len(self.scores), bool)
        taken: set[int] = set()
        for index, (row, distance) in enumerate(zip(self.rows, self.distances, strict=True)):
            if distance > threshold or row in taken:
                continue
            taken.add(int(row))
            track = int(self.tracks[index])
            owner = owners.setdefault(int(self.nearest[index]), track) if owners is not None else 0
            found[index] = owners is None or owner == track
        return found


def _told_apart(tracks: Sequence[IntArray]) -> list[IntArray]:
    """Give each prediction of a scene that has no track (-1) one of its own, below -1. (N,) each"""
    found, last = [], -1
    for own in tracks:
        none = own < 0
        found.append(np.where(none, last - none.cumsum(), own))
        last -= int(none.sum())
    return found


def score_scene(
    frames: Sequence[DriveFrame], config: ConsistencyConfig
) -> tuple[list[list[FrameHits]], IntArray]:
    """Compare the predictions of a scene with its ground truth.

    Returns:
        For each class the frames that have ground truth of it; the elements of each class.
    """
    truths = make_tracks([with_lines(f, f.truth) for f in frames], config, 1, config.min_truth_iou)
    predicted = _told_apart(tracks_of(frames, config))
    of_class: list[list[FrameHits]] = [[] for _ in config.classes]
    counts = np.zeros(len(config.classes), np.int64)
    for frame, gt_tracks, tracks in zip(frames, truths, predicted, strict=True):
        gts = _chamfer_lines(frame.truth, simplify=True)
        preds = _chamfer_lines(frame.predictions, simplify=False)
        distances = kernels.pair_distances(preds, gts, np.inf)
        scores = frame.predictions.confidence
        for label, found in enumerate(of_class):
            rows = np.flatnonzero(frame.truth.labels == label)
            if not len(rows):
                continue
            counts[label] += len(rows)
            chosen = (frame.predictions.labels == label) & (scores > config.min_score)
            best = np.flatnonzero(chosen)
            best = best[np.argsort(-scores[best], kind="stable")]
            nearest = rows[distances[best][:, rows].argmin(1)]
            found.append(
                FrameHits(
                    scores[best], tracks[best], gt_tracks[nearest], nearest,
                    distances[best, nearest],
                )
            )  # fmt: skip
    return of_class, counts


def jitter(frames: Sequence[DriveFrame], tracks: Sequence[IntArray], grid: BEVGrid) -> FloatArray:
    """Return how far the lines of tracks move over the ground between consecutive frames.

    Points of the earlier line that lie on the map now are compared with the nearest point of the
    line now: the mean of each pair, in metres. (pairs,)
    """
    found = []
    for index in range(1, len(frames)):
        now, then = frames[index], frames[index - 1]
        motion = invert_rigid(now.pose) @ then.pose
        lines = _resampled(now.predictions, CHAMFER_POINTS)
        before = moved(_resampled(then.predictions, CHAMFER_POINTS), motion)
        for row, track in enumerate(tracks[index]):
            same = then.predictions.labels == now.predictions.labels[row]
            for earlier in np.flatnonzero(same & (tracks[index - 1] == track) & (track >= 0)):
                norm = grid.norm_from_metres(before[earlier])
                points = before[earlier][((norm >= 0) & (norm <= 1)).all(1)]
                if len(points):
                    steps = np.linalg.norm(points[:, None] - lines[row], axis=-1)
                    found.append(float(steps.min(1).mean()))
    return np.array(found)


def by_scene(frames: Iterable[DriveFrame]) -> list[list[DriveFrame]]:
    """Return the frames of each scene, in the order in which they come."""
    scenes: dict[str, list[DriveFrame]] = {}
    for frame in frames:
        scenes.setdefault(frame.scene, []).append(frame)
    return list(scenes.values())


def consistency(frames: Iterable[DriveFrame], config: ConsistencyConfig) -> dict[str, float]:
    """Return C-mAP, mAP of the same predictions without its rule, and jitter.

    Keys are ``consistency/CAP@0.5/<class>``, ``consistency/C-mAP``, ``consistency/mAP`` and
    ``consistency/jitter_m`` (-1 without tracks).
    """
    scenes = by_scene(frames)
    scored = [score_scene(scene, config) for scene in scenes]
    totals = np.sum([counts for _, counts in scored], axis=0)
    figures: dict[str, float] = {}
    means: dict[str, list[float]] = {"CAP": [], "AP": []}
    for label, name in enumerate(config.classes):
        for threshold in config.thresholds:
            for kind, aps in means.items():
                hits, scores = _ranked(scored, label, threshold, kind == "CAP")
                order = np.argsort(-scores, kind="stable")
                ap = area_ap(hits[order], int(totals[label]))
                figures[f"consistency/{kind}@{threshold}/{name}"] = ap
                aps.append(ap)
    figures["consistency/C-mAP"], figures["consistency/mAP"] = (
        float(np.mean(aps)) for aps in means.values()
    )
    steps = [jitter(scene, tracks_of(scene, config), config.grid) for scene in scenes]
    every = np.concatenate([np.empty(0), *steps])
    figures["consistency/jitter_m"] = float(every.mean()) if len(every) else -1.0
    return figures


def _ranked(
    scored: Sequence[tuple[list[list[FrameHits]], IntArray]],
    label: int,
    threshold: float,
    consistent: bool,
) -> tuple[BoolArray, FloatArray]:
    """Return hits and scores of a class in all frames. 2 x (N,)"""
    hits, scores = [np.empty(0, bool)], [np.empty(0)]
    for of_class, _ in scored:
        owners: dict[int, int] | None = {} if consistent else None
        for frame in of_class[label]:
            hits.append(frame.hits(threshold, owners))
            scores.append(frame.scores)
    return np.concatenate(hits), np.concatenate(scores)
