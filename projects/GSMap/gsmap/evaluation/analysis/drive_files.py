"""Reading of the drives of a result file, writing of their tracks, and evaluation of consistency.

A track is the number of one map element over the frames of a drive. A frame is one sample. The
consistency of predictions over the frames is evaluated with tracks.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.elements import elements_of_instances
from gsmap.evaluation.analysis.consistency import (
    ConsistencyConfig,
    DriveFrame,
    consistency,
    group_by_scene,
    tracks_of,
)
from gsmap.evaluation.core.file_evaluation import file_labels
from gsmap.evaluation.core.results_json import RESULTS_KEY, SampleFile, vectors_of, write_results
from gsmap.structures.elements import IntArray, MapElements
from gsmap.utils.errors import InputError
from gsmap.utils.json_items import items_of

TRACK_KEY = "track_id"


def drive_frames(
    results: Path, annotations: AnnotationFile, classes: Sequence[str]
) -> list[DriveFrame]:
    """Read the frames of all drives, in the order of scenes and times.

    Args:
        results: Path of the result file in MapTR's JSON form. Tracks are read from the ``track_id``
            of its vectors, if they have one.
        annotations: Ground truth with poses and with all samples of each scene.
        classes: Names of the classes; a label is an index into them.

    Raises:
        FileNotFoundError: If the result file does not exist.
        ValueError: If the file is malformed or lacks a sample, if some but not all vectors have a
            track, or if two elements of a class in a sample have equal tracks. Also if the
            annotations have no poses, or a sample has no ground truth.
    """
    samples = SampleFile(results, key=RESULTS_KEY, classes=classes)
    return _read_frames(samples, annotations, classes=classes)


def _read_frames(
    samples: SampleFile, annotations: AnnotationFile, classes: Sequence[str]
) -> list[DriveFrame]:
    """Read the frames of all drives, as `drive_frames` does.

    Afterwards, ``samples.about`` (the metadata of the file) is set, because all samples are read.
    """
    if not annotations.meta.has_poses:
        raise InputError(f"{annotations.path} knows no poses, which consistency needs.")
    labels = file_labels(annotations, classes)  # of the annotations, as indices of ``classes``
    results = samples.path
    predictions: dict[str, MapElements] = {}
    track_ids: dict[str, IntArray | None] = {}  # None for a sample without tracks
    last_token: dict[bool, str] = {}  # last sample with tracks (True) and without (False)
    items = items_of(results, RESULTS_KEY, "give a result file")  # the text is advice in errors
    # The file is read by two iterators in step. `samples` checks and converts each item; `items`
    # yields the unchanged item with its tracks. `zip` advances its first argument first. This must
    # be `samples`, so that it raises the error of a malformed item before the item is used.
    for (token, elements, _), (item, _) in zip(samples, items, strict=True):
        values = [vector.get(TRACK_KEY) for vector in item["vectors"]]
        ids = _convert_tracks(values, results=results, token=token)
        if ids is not None:
            _check_tracks(ids, elements=elements, results=results, token=token)
        predictions[token] = elements
        track_ids[token] = ids
        if len(elements):  # an empty sample does not show whether the file has tracks
            last_token[ids is not None] = token
    if len(last_token) > 1:
        raise InputError(
            f"{results}: sample {last_token[True]!r} has tracks, sample {last_token[False]!r} has "
            f"none: give every vector a {TRACK_KEY}, or none."
        )
    missing = [token for token in annotations.column("token") if token not in predictions]
    if missing:
        raise InputError(
            f"{results} has no sample {missing[0]!r} ({len(missing)} are missing): consistency "
            "and films need whole drives."
        )
    scenes = annotations.column("scene")
    times = annotations.column("timestamp_ns")
    # Rows of the annotations, sorted by scene and within a scene by time.
    order = sorted(zip(scenes, times, range(len(annotations)), strict=True))
    frames = []
    for _, _, row in order:
        sample = annotations[row]
        if sample.instances is None:
            raise InputError(f"sample {sample.token!r} has no ground truth: it cannot be scored.")
        truth = elements_of_instances(sample.instances)
        truth = replace(truth, labels=labels[truth.labels])
        truth = truth.select(truth.labels >= 0)
        frame = DriveFrame(
            token=sample.token,
            scene=sample.scene,
            pose=sample.global_from_frame,
            predictions=predictions[sample.token],
            truth=truth,
            track_ids=track_ids[sample.token],
        )
        frames.append(frame)
    return frames


def _with_lines_only(frame: DriveFrame) -> DriveFrame:
    """Leave out predictions of fewer than two points, as other metrics do."""
    is_line = frame.predictions.num_points >= 2
    ids = None if frame.track_ids is None else frame.track_ids[is_line]
    return replace(frame, predictions=frame.predictions.select(is_line), track_ids=ids)


def _convert_tracks(values: list[object], results: Path, token: str) -> IntArray | None:
    """Convert the tracks of a sample to integers (N,); None if no vector has a track."""
    if all(value is None for value in values):
        return None
    for track in values:
        if type(track) is not int or not -1 <= track < 2**31:
            raise InputError(
                f"{results}, sample {token!r}: {TRACK_KEY} must be an integer >= 0 and < 2**31, "
                f"or -1 for no track, got {track!r:.40}."
            )
    return np.array(values, dtype=np.int64)


def _check_tracks(ids: IntArray, elements: MapElements, results: Path, token: str) -> None:
    """Raise ValueError if two elements of a class have equal tracks."""
    # The columns of `pairs` are the distinct pairs (label, track).
    pairs, counts = np.unique([elements.labels, ids], axis=1, return_counts=True)
    labels, tracks = pairs
    # -1 is no track, and may repeat. Elements of all classes that are not scored have the label -1.
    repeated_tracks = tracks[(counts > 1) & (tracks >= 0) & (labels >= 0)]
    if len(repeated_tracks):
        track = repeated_tracks[0]
        raise InputError(
            f"{results}, sample {token!r}: two elements of a class have {TRACK_KEY} {track}: "
            "a track is one element in each frame."
        )


def write_tracks(
    path: Path,
    frames: Sequence[DriveFrame],
    config: ConsistencyConfig,
    about: Mapping[str, Any],
) -> None:
    """Write results in which each element has its track as the integer ``track_id``.

    Args:
        path: Path of the result file.
        frames: Frames of all drives. For frames without tracks, `tracks_of` creates tracks that
            persist over the frames of a scene. Elements whose score is not above
            ``config.min_score`` then have the track -1.
        config: Rules of the tracks.
        about: Metadata of the results.
    """
    samples = []
    for scene in group_by_scene(frames):
        for frame, tracks in zip(scene, tracks_of(scene, config), strict=True):
            is_known = frame.predictions.labels >= 0  # -1: a class that is not evaluated
            vectors = vectors_of(frame.predictions.select(is_known), config.classes)
            for vector, track in zip(vectors, tracks[is_known].tolist(), strict=True):
                vector[TRACK_KEY] = track
            samples.append((frame.token, vectors))
    meta = {**about, "classes": list(config.classes)}
    write_results(path, samples=samples, meta=meta)


def evaluate_drives(
    results: Path,
    annotations: AnnotationFile,
    config: ConsistencyConfig,
    tracks_file: Path | None = None,
) -> dict[str, float]:
    """Compute the figures of `consistency` of a result file.

    Args:
        results: Path of the result file with all samples.
        annotations: Ground truth with poses.
        config: Rules of the metric.
        tracks_file: Path at which results are written with the ``track_id`` of each element, or
            None.

    Returns:
        Figures by name, such as ``consistency/C-mAP``.

    Raises:
        FileNotFoundError: If the result file does not exist.
        ValueError: If the file is malformed, lacks a sample or has invalid tracks
            (`drive_frames`), or if the annotations have no poses or no ground truth.
    """
    samples = SampleFile(results, key=RESULTS_KEY, classes=config.classes, gaussians=True)
    read_frames = _read_frames(samples, annotations, classes=config.classes)
    frames = [_with_lines_only(frame) for frame in read_frames]
    figures = consistency(frames, config)
    if tracks_file is not None:
        write_tracks(tracks_file, frames=frames, config=config, about=samples.about)
    return figures
