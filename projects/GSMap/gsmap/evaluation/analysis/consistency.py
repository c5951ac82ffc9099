"""Consistency over the frames of a drive: tracks, C-mAP of MapTracker, jitter of vertices.

C-mAP (consistent mAP) is an mAP in which a match must also continue the predicted track of its
ground truth. The rules follow MapTracker's public code. They differ from AP_chamfer in four ways:
predictions with a score of 0.4 or less are left out, a frame without ground truth of a class does
not count for the class, lines have 200 points, and two lines can match even if the strips of 4 m
width around them do not touch.

Masks are drawn only to create tracks. Matches with ground truth depend on Chamfer distances.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import shapely
from scipy.optimize import linear_sum_assignment

from gsmap.evaluation.core import chamfer_kernels as kernels
from gsmap.evaluation.core.average_precision import area_ap
from gsmap.evaluation.core.chamfer_ap import CHAMFER_THRESHOLDS, checked_thresholds
from gsmap.evaluation.core.report import UNDEFINED
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import resample_all
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.errors import InputError

TRACK_POINTS = 20  # number of points of a line to track
CHAMFER_POINTS = 200  # number of points of a line for Chamfer distances
_LONG_PX = 200  # longer side of a mask
_SHORT_PX = 100  # shorter side of a mask
_LINE_PX = 3  # width of a line
_SMALL_PX = 20  # masks with fewer pixels are dilated
_SIMPLIFY_M = 0.2  # tolerance of the simplification of ground truth, in metres


@dataclass(frozen=True)
class ConsistencyConfig:
    """Rules of tracks and C-mAP.

    Args:
        classes: Names of the classes; a label is an index into them.
        grid: Extent of the map in metres.
        filled_classes: Labels of the classes that are drawn as areas, not as lines, in the masks
            for tracks.
        thresholds: Largest Chamfer distances of a match, in metres.
        min_score: Score that predictions must exceed, in [0, 1].
        look_back: Number of earlier frames from which a predicted track may continue, >= 1.
        min_iou: IoU that successive predictions of a track must exceed.
        min_truth_iou: IoU that successive ground truths of a track must exceed. Tracks of ground
            truth continue from the previous frame only.

    Raises:
        ValueError: If there is no class or no threshold, a threshold is not a finite number > 0, or
            ``look_back`` is less than 1.
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
        if not self.classes:
            raise InputError("classes must not be empty.")
        # The thresholds in ascending order. The class is frozen, so they are not simply assigned.
        object.__setattr__(self, "thresholds", checked_thresholds(self.thresholds))
        if self.look_back < 1:
            raise InputError(f"look_back must be >= 1, got {self.look_back}.")


@dataclass
class DriveFrame:
    """Frame of a drive with predictions and ground truth.

    Args:
        token: Name of the frame.
        scene: Name of the scene.
        pose: Transform from the annotation frame to the world, in metres. (4, 4)
        predictions: N predicted elements with scores, in metres in the annotation frame.
        truth: Annotated elements, in metres in the annotation frame.
        track_ids: Number of the track of each prediction within scene and class, -1 for a
            prediction without a track. None means that tracks are to be created. (N,)
        lines: Lines to track, in metres in the annotation frame. They are predictions or ground
            truth, and are empty until `with_lines` sets them. (n, 20, 2)
        labels: Class index of each line to track. (n,)
    """

    token: str
    scene: str
    pose: FloatArray
    predictions: MapElements
    truth: MapElements
    track_ids: IntArray | None = None
    lines: FloatArray = field(default_factory=lambda: np.empty((0, TRACK_POINTS, 2)))
    labels: IntArray = field(default_factory=lambda: np.empty(0, np.int64))


def _resample(elements: MapElements, num_points: int) -> FloatArray:
    """Resample the lines of all elements at equal distances in the plane. (N, P, 2)"""
    points = elements.points[:, :2].astype(np.float64)
    return resample_all(points, elements.offsets, num_points=num_points)


def draw_line(line: FloatArray, filled: bool, grid: BEVGrid) -> BoolArray:
    """Draw a line to a mask, as MapTracker does to create tracks.

    Lines are 3 pixels wide. A mask of fewer than 20 pixels is dilated, so that small elements can
    overlap as well. Points outside of the map are moved to its edge.

    Args:
        line: Vertices in metres. (P, 2)
        filled: Whether the line is drawn as an area.
        grid: Extent of the map in metres; its longer side has 200 pixels, the other 100.

    Returns:
        Mask, with h rows along y and w columns along x. (h, w)
    """
    x_m, y_m = grid.extent_m
    width = _LONG_PX if x_m >= y_m else _SHORT_PX
    height = _SHORT_PX if x_m >= y_m else _LONG_PX
    norm = np.clip(grid.norm_from_metres(line), 0.0, 1.0)
    pixels = (norm * (width, height)).astype(np.int32)
    mask = np.zeros((height, width), dtype=np.uint8)
    if filled:
        cv2.fillPoly(mask, [pixels], color=(1,))
    else:
        cv2.polylines(mask, [pixels], isClosed=False, color=(1,), thickness=_LINE_PX)
    if mask.sum() < _SMALL_PX:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, ksize=(7, 7))
        return cv2.dilate(mask, disc).astype(bool)
    return mask.astype(bool)


def overlaps(
    now: Sequence[FloatArray], before: Sequence[FloatArray], filled: bool, grid: BEVGrid
) -> FloatArray:
    """Compute the IoU of the masks of current and earlier lines.

    Args:
        now: Current lines in metres. N x (P, 2)
        before: Earlier lines in metres in the current frame. M x (P, 2)
        filled: Whether lines are drawn as areas.
        grid: Extent of the map in metres.

    Returns:
        IoU in [0, 1]. (N, M)
    """
    if not len(now) or not len(before):
        return np.zeros((len(now), len(before)))
    now_masks = _draw_lines(now, filled=filled, grid=grid)
    before_masks = _draw_lines(before, filled=filled, grid=grid)
    intersections = now_masks.astype(np.float64) @ before_masks.T
    area_sums = now_masks.sum(axis=1)[:, None] + before_masks.sum(axis=1)
    unions = area_sums - intersections
    return intersections / np.maximum(unions, 1)  # in pixels; 1 avoids a division by 0


def _draw_lines(lines: Sequence[FloatArray], filled: bool, grid: BEVGrid) -> BoolArray:
    """Draw each line to a flat mask. (N, h * w)"""
    return np.stack([draw_line(line, filled=filled, grid=grid).ravel() for line in lines])


def transform_lines(lines: FloatArray, now_from_then: FloatArray) -> FloatArray:
    """Transform lines of an earlier frame to the current frame, in the plane.

    Args:
        lines: Lines in metres in the earlier frame. (N, P, 2)
        now_from_then: Transform from the earlier to the current frame, in metres. (4, 4)

    Returns:
        Lines in metres in the current frame. (N, P, 2)
    """
    return lines @ now_from_then[:2, :2].T + now_from_then[:2, 3]


def partners(
    now: DriveFrame, then: DriveFrame, label: int, config: ConsistencyConfig, min_iou: float
) -> dict[int, int]:
    """Assign the lines of a frame to the lines of an earlier frame by the IoU of their masks.

    Each line has at most one partner. The assignment has the largest sum of IoUs. Pairs with a low
    IoU are left out afterwards.

    Args:
        now: Current frame, with ``lines`` and ``labels``.
        then: Earlier frame, with ``lines`` and ``labels``.
        label: Label of the class.
        config: Rules of the tracks.
        min_iou: IoU that a pair must exceed.

    Returns:
        Index of the earlier line by index of the current line.
    """
    rows = np.flatnonzero(now.labels == label)
    columns = np.flatnonzero(then.labels == label)
    now_from_then = invert_rigid(now.pose) @ then.pose
    earlier_lines = transform_lines(then.lines[columns], now_from_then)
    ious = overlaps(
        list(now.lines[rows]),
        list(earlier_lines),
        filled=label in config.filled_classes,
        grid=config.grid,
    )
    pairs = {}
    now_indices, then_indices = linear_sum_assignment(-ious)
    for i, j in zip(now_indices, then_indices, strict=True):
        if ious[i, j] > min_iou:
            pairs[int(rows[i])] = int(columns[j])  # from indices in the class to those in the frame
    return pairs


def make_tracks(
    frames: Sequence[DriveFrame], config: ConsistencyConfig, look_back: int, min_iou: float
) -> list[IntArray]:
    """Create the tracks of the lines of one scene.

    A line continues the track of its partner, the line of an earlier frame that it is assigned to
    (`partners`), unless another line of its class in the current frame already has this track.
    The previous frame comes first, then frames further back. A line that continues no track begins
    a new one.

    Args:
        frames: Frames of the scene in the order of their times, with ``lines`` and ``labels``.
        config: Rules of the tracks.
        look_back: Number of earlier frames from which a track may continue.
        min_iou: IoU that successive lines of a track must exceed.

    Returns:
        Track of each line of each frame; numbers are unique in the scene. (n,) each
    """
    tracks: list[IntArray] = []
    num_tracks = 0
    for index, frame in enumerate(frames):
        frame_tracks = np.full(len(frame.lines), fill_value=-1)
        first = max(0, index - look_back)
        for label in range(len(config.classes)):
            used_tracks: set[int] = set()  # tracks that a line of the class already continues
            for earlier in range(index - 1, first - 1, -1):
                pairs = partners(
                    frame, frames[earlier], label=label, config=config, min_iou=min_iou
                )
                for row, column in pairs.items():
                    track = int(tracks[earlier][column])
                    if frame_tracks[row] < 0 and track not in used_tracks:
                        frame_tracks[row] = track
                        used_tracks.add(track)
        missing = np.flatnonzero(frame_tracks < 0)
        frame_tracks[missing] = np.arange(num_tracks, num_tracks + len(missing))
        num_tracks += len(missing)
        tracks.append(frame_tracks)
    return tracks


def with_lines(frame: DriveFrame, elements: MapElements) -> DriveFrame:
    """Return a copy of a frame whose ``lines`` to track are the lines of ``elements``.

    Args:
        frame: Frame of a drive.
        elements: Predictions or ground truth of the frame.
    """
    lines = _resample(elements, num_points=TRACK_POINTS)
    return replace(frame, lines=lines, labels=np.asarray(elements.labels))


def track_drive(frames: Sequence[DriveFrame], config: ConsistencyConfig) -> list[IntArray]:
    """Create the tracks of the predictions of one scene.

    Args:
        frames: Frames of the scene in the order of their times.
        config: Rules of the tracks.

    Returns:
        Track of each prediction of each frame; -1 for a score of ``min_score`` or less. (N,) each
    """
    line_frames = []
    for frame in frames:
        is_confident = frame.predictions.confidence > config.min_score
        line_frames.append(with_lines(frame, frame.predictions.select(is_confident)))
    line_tracks = make_tracks(
        line_frames, config=config, look_back=config.look_back, min_iou=config.min_iou
    )
    tracks = []
    for frame, frame_tracks in zip(frames, line_tracks, strict=True):
        ids = np.full(len(frame.predictions), fill_value=-1)
        ids[frame.predictions.confidence > config.min_score] = frame_tracks
        tracks.append(ids)
    return tracks


def tracks_of(frames: Sequence[DriveFrame], config: ConsistencyConfig) -> list[IntArray]:
    """Return the tracks of the predictions of one scene; create them where ``track_ids`` is None.

    Args:
        frames: Frames of the scene in the order of their times.
        config: Rules of the tracks.

    Returns:
        Track of each prediction of each frame, or -1. (N,) each
    """
    tracks = track_drive(frames, config)
    for index, frame in enumerate(frames):
        if frame.track_ids is not None:
            tracks[index] = frame.track_ids
    return tracks


def _chamfer_lines(elements: MapElements, simplify: bool) -> kernels.Lines:
    """Convert elements to lines of 200 points for the Chamfer distance.

    With ``simplify``, lines are simplified and resampled to 20 points first, as MapTracker does
    with ground truth. The height of the points is 0, so that distances are measured in the plane.

    Returns:
        The format of `kernels.Lines`: points (3, M), offsets (N + 1,) and labels (N,).
    """
    lines = [line[:, :2] for line in elements.polylines]
    if simplify:
        simplified = []
        for line in lines:
            curve = shapely.LineString(line).simplify(_SIMPLIFY_M)
            simplified.append(np.asarray(curve.coords))
        simplified_elements = MapElements.from_polylines(simplified, labels=elements.labels)
        lines = list(_resample(simplified_elements, num_points=TRACK_POINTS))
    elements = MapElements.from_polylines(lines, labels=elements.labels)
    points = _resample(elements, num_points=CHAMFER_POINTS).reshape(-1, 2).T
    offsets = np.arange(len(elements) + 1) * CHAMFER_POINTS
    heights = np.zeros_like(points[:1])
    return np.concatenate([points, heights]), offsets, elements.labels


@dataclass(frozen=True)
class FrameHits:
    """Predictions of one class in a frame, best first, each with its nearest ground truth.

    Args:
        scores: Score of each prediction, in descending order. (N,)
        tracks: Track of each prediction; a number below -1 for a prediction without a track. (N,)
        nearest: Track of the ground truth nearest to each prediction. (N,)
        rows: Index of this ground truth in the frame. (N,)
        distances: Chamfer distance to this ground truth in metres. (N,)
    """

    scores: FloatArray
    tracks: IntArray
    nearest: IntArray
    rows: IntArray
    distances: FloatArray

    def hits(self, threshold: float, owners: dict[int, int] | None) -> BoolArray:
        """Decide which predictions match their nearest ground truth.

        Of several predictions within the threshold of one ground truth, only the one with the
        highest score can match, even if it does not continue the track.

        Args:
            threshold: Largest Chamfer distance of a match, in metres.
            owners: For each track of ground truth, the predicted track of its first match in this
                and earlier frames. Updated in place. Later matches must have this predicted track.
                None for plain AP, which ignores tracks.

        Returns:
            Whether each prediction matches. (N,)
        """
        is_hit = np.zeros(len(self.scores), dtype=bool)
        taken_rows: set[int] = set()
        for index in range(len(self.scores)):
            row = int(self.rows[index])
            if self.distances[index] > threshold or row in taken_rows:
                continue
            taken_rows.add(row)
            if owners is None:
                is_hit[index] = True
            else:
                track = int(self.tracks[index])
                # `setdefault` makes the track the owner if the ground truth has none yet.
                owner = owners.setdefault(int(self.nearest[index]), track)
                is_hit[index] = owner == track
        return is_hit


def _number_untracked(tracks: Sequence[IntArray]) -> list[IntArray]:
    """Give each untracked prediction of a scene a unique number below -1. (N,) each

    Because the numbers differ, an untracked prediction cannot continue the track of another one.
    """
    numbered = []
    last_number = -1  # numbers fall from here on
    for frame_tracks in tracks:
        is_untracked = frame_tracks < 0
        # last_number - 1, last_number - 2, ... at the untracked predictions
        numbers = last_number - is_untracked.cumsum()
        numbered.append(np.where(is_untracked, numbers, frame_tracks))
        last_number -= int(is_untracked.sum())
    return numbered


def score_scene(
    frames: Sequence[DriveFrame], config: ConsistencyConfig
) -> tuple[list[list[FrameHits]], IntArray]:
    """Compare the predictions of one scene with its ground truth.

    Args:
        frames: Frames of the scene in the order of their times.
        config: Rules of the metric.

    Returns:
        For each class, a list with the `FrameHits` of each frame that has ground truth of the
        class; and the number of ground truths of each class (C,).
    """
    truth_frames = [with_lines(frame, frame.truth) for frame in frames]
    truth_tracks = make_tracks(
        truth_frames, config=config, look_back=1, min_iou=config.min_truth_iou
    )
    pred_tracks = _number_untracked(tracks_of(frames, config))
    class_frames: list[list[FrameHits]] = [[] for _ in config.classes]
    num_gts = np.zeros(len(config.classes), dtype=np.int64)
    for frame, gt_tracks, tracks in zip(frames, truth_tracks, pred_tracks, strict=True):
        gt_lines = _chamfer_lines(frame.truth, simplify=True)
        pred_lines = _chamfer_lines(frame.predictions, simplify=False)
        # Distances of different classes are infinite. There is one more column than ground truths.
        distances = kernels.pair_distances(pred_lines, gt=gt_lines, max_distance=np.inf)
        scores = frame.predictions.confidence
        for label in range(len(config.classes)):
            gts = np.flatnonzero(frame.truth.labels == label)
            if not len(gts):
                continue
            num_gts[label] += len(gts)
            is_of_class = frame.predictions.labels == label
            preds = np.flatnonzero(is_of_class & (scores > config.min_score))
            preds = preds[np.argsort(-scores[preds], kind="stable")]
            class_distances = distances[preds][:, gts]  # (predictions, ground truths)
            nearest_gts = gts[class_distances.argmin(axis=1)]
            frame_hits = FrameHits(
                scores=scores[preds],
                tracks=tracks[preds],
                nearest=gt_tracks[nearest_gts],
                rows=nearest_gts,
                distances=distances[preds, nearest_gts],
            )
            class_frames[label].append(frame_hits)
    return class_frames, num_gts


def jitter(frames: Sequence[DriveFrame], tracks: Sequence[IntArray], grid: BEVGrid) -> FloatArray:
    """Compute how far tracked lines move over the ground between consecutive frames.

    The distance of two lines is the mean distance from the points of the earlier line inside the
    current map range to the nearest points of the current line.

    Args:
        frames: Frames of one scene in the order of their times.
        tracks: Track of each prediction of each frame, or -1. (N,) each
        grid: Extent of the map in metres.

    Returns:
        Mean distance in metres of each pair of lines of a track in consecutive frames. Pairs whose
        earlier line lies outside the current map range are left out. (pairs,)
    """
    distances_m = []
    for index in range(1, len(frames)):
        now = frames[index]
        then = frames[index - 1]
        now_from_then = invert_rigid(now.pose) @ then.pose
        lines = _resample(now.predictions, num_points=CHAMFER_POINTS)
        earlier_lines = _resample(then.predictions, num_points=CHAMFER_POINTS)
        earlier_lines = transform_lines(earlier_lines, now_from_then)
        for row, track in enumerate(tracks[index]):
            if track < 0:
                continue
            # Tracks are numbered within a class, so the class must be equal as well.
            is_of_class = then.predictions.labels == now.predictions.labels[row]
            for earlier in np.flatnonzero(is_of_class & (tracks[index - 1] == track)):
                norm = grid.norm_from_metres(earlier_lines[earlier])
                is_inside = ((norm >= 0) & (norm <= 1)).all(axis=1)
                points = earlier_lines[earlier][is_inside]
                if len(points):
                    distances = np.linalg.norm(points[:, None] - lines[row], axis=-1)
                    distances_m.append(float(distances.min(axis=1).mean()))
    return np.array(distances_m)


def group_by_scene(frames: Iterable[DriveFrame]) -> list[list[DriveFrame]]:
    """Group frames by scene; scenes are in the order of their first frames."""
    scenes: dict[str, list[DriveFrame]] = {}
    for frame in frames:
        scenes.setdefault(frame.scene, []).append(frame)
    return list(scenes.values())


def consistency(frames: Iterable[DriveFrame], config: ConsistencyConfig) -> dict[str, float]:
    """Compute C-mAP, an mAP by equal rules that ignores tracks, and jitter.

    Args:
        frames: Frames of all scenes; the frames of a scene are in the order of their times.
        config: Rules of the metric.

    Returns:
        Figures by ``consistency/CAP@0.5/<class>`` and ``consistency/AP@0.5/<class>`` for each
        threshold and class, ``consistency/C-mAP``, ``consistency/mAP``,
        ``consistency/num_absent_classes`` and ``consistency/jitter_m``. APs are in [0, 1], or -1
        for a class without ground truth, which does not count in the means. The jitter is in
        metres, or -1 if no track has lines in two consecutive frames.
    """
    scenes = group_by_scene(frames)
    scene_hits = []  # for each scene and class, the list of `FrameHits`
    scene_counts = []  # number of ground truths of each class in each scene
    for scene in scenes:
        class_frames, num_gts = score_scene(scene, config)
        scene_hits.append(class_frames)
        scene_counts.append(num_gts)
    totals = np.sum(scene_counts, axis=0)
    figures: dict[str, float] = {}
    all_aps: dict[str, list[float]] = {"CAP": [], "AP": []}
    for label, name in enumerate(config.classes):
        class_hits = [class_frames[label] for class_frames in scene_hits]
        for threshold in config.thresholds:
            for kind, aps in all_aps.items():
                ap = _average_precision(
                    class_hits,
                    num_gts=int(totals[label]),
                    threshold=threshold,
                    consistent=kind == "CAP",
                )
                figures[f"consistency/{kind}@{threshold}/{name}"] = ap
                if ap != UNDEFINED:
                    aps.append(ap)
    for key, kind in (("C-mAP", "CAP"), ("mAP", "AP")):
        # Without ground truth of any class, both are 0, as AP_chamfer is.
        figures[f"consistency/{key}"] = float(np.mean(all_aps[kind] or [0.0]))
    figures["consistency/num_absent_classes"] = float((totals == 0).sum())
    jitters = [np.empty(0)]  # an array to concatenate even if there is no scene
    for scene in scenes:
        jitters.append(jitter(scene, tracks_of(scene, config), grid=config.grid))
    jitter_m = np.concatenate(jitters)
    figures["consistency/jitter_m"] = float(jitter_m.mean()) if len(jitter_m) else -1.0
    return figures


def _average_precision(
    scenes: Sequence[Sequence[FrameHits]], num_gts: int, threshold: float, consistent: bool
) -> float:
    """Compute the AP of one class over all scenes.

    Args:
        scenes: `FrameHits` of the class in each frame of each scene, in the order of their times.
        num_gts: Number of ground truths of the class.
        threshold: Largest Chamfer distance of a match, in metres.
        consistent: Whether matches must continue the tracks of earlier frames.

    Returns:
        AP in [0, 1]; -1 without ground truths.
    """
    if num_gts == 0:
        return UNDEFINED
    hits = [np.empty(0, dtype=bool)]
    scores = [np.empty(0)]
    for scene in scenes:
        # Owners of the tracks of ground truth in this scene (`FrameHits.hits`).
        owners: dict[int, int] | None = {} if consistent else None
        for frame in scene:
            hits.append(frame.hits(threshold, owners))
            scores.append(frame.scores)
    order = np.argsort(-np.concatenate(scores), kind="stable")
    return area_ap(np.concatenate(hits)[order], num_gts=num_gts)
