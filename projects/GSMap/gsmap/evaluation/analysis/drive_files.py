"""Drives of a result file: tracks read from it, made, and written beside its elements."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.elements import elements_of_instances
from gsmap.evaluation.analysis.consistency import (
    ConsistencyConfig,
    DriveFrame,
    by_scene,
    consistency,
    tracks_of,
)
from gsmap.evaluation.core.results_json import RESULTS_KEY, SampleFile, vectors_of, write_results
from gsmap.structures.elements import IntArray, MapElements
from gsmap.utils.errors import InputError
from gsmap.utils.json_items import items_of

TRACK_KEY = "track_id"


def drive_frames(
    results: Path, annotations: AnnotationFile, classes: Sequence[str]
) -> list[DriveFrame]:
    """Return the frames of an annotation file with a result file's predictions, by scene and time.

    Tracks are those of the results (``track_id`` of a vector), if they have any.

    Args:
        results: Result file, in MapTR's JSON form.
        annotations: Ground truth with poses, which has every scene's samples.
        classes: Names of the classes, in the order of their indices.

    Raises:
        FileNotFoundError: If the result file does not exist.
        ValueError: If it is malformed, lacks a sample, only some of its vectors have a track, or
            two elements of one class in one sample have the same.
    """
    return _frames_of(SampleFile(results, RESULTS_KEY, classes), annotations)


def _frames_of(samples: SampleFile, annotations: AnnotationFile) -> list[DriveFrame]:
    """Return what `drive_frames` does; then the file has said what it says of itself."""
    if not annotations.meta.options.get("poses", True):
        raise InputError(f"{annotations.path} knows no poses, which consistency needs.")
    found, results = {}, samples.path
    items = items_of(results, RESULTS_KEY, "give a result file")
    # samples first, for what they say of a bad file
    for (token, elements, _), (item, _) in zip(samples, items, strict=True):
        given = [vector.get(TRACK_KEY) for vector in item["vectors"]]
        ids = _track_ids(given, results, token)
        if ids is not None:
            _check_tracks(ids, elements, results, token)
        found[token] = elements, ids
    tracked = {ids is not None: token for token, (elements, ids) in found.items() if len(elements)}
    if len(tracked) > 1:
        raise InputError(
            f"{results}: sample {tracked[True]!r} has tracks, sample {tracked[False]!r} has none: "
            f"give every vector a {TRACK_KEY}, or none."
        )
    if missing := [token for token in annotations.column("token") if token not in found]:
        raise InputError(
            f"{results} has no sample {missing[0]!r} ({len(missing)} are missing): consistency "
            "needs whole drives."
        )
    order = zip(
        annotations.column("scene"), annotations.column("timestamp_ns"),
        range(len(annotations)), strict=True,
    )  # fmt: skip
    frames = []
    for _, _, row in sorted(order):
        sample = annotations[row]
        elements, ids = found[sample.token]
        if sample.instances is None:
            raise InputError(f"sample {sample.token!r} has no ground truth: it cannot be scored.")
        truth = elements_of_instances(sample.instances)
        frames.append(
            DriveFrame(sample.token, sample.scene, sample.global_from_frame, elements, truth, ids)
        )
    return frames


def _track_ids(ids: list[object], results: Path, token: str) -> IntArray | None:
    """Check the tracks of a sample; None if there are none."""
    if all(track is None for track in ids):
        return None
    for track in ids:
        if type(track) is not int or not -1 <= track < 2**31:
            raise InputError(
                f"{results}, sample {token!r}: {TRACK_KEY} must be an integer from -1 (no track), "
                f"got {track!r:.40}."
            )
    return np.array(ids, np.int64)


def _check_tracks(ids: IntArray, elements: MapElements, results: Path, token: str) -> None:
    """Raise ValueError if two elements of a class have one track."""
    pairs, counts = np.unique([elements.labels, ids], axis=1, return_counts=True)
    twice = pairs[1, (counts > 1) & (pairs[1] >= 0)]
    if len(twice):
        raise InputError(
            f"{results}, sample {token!r}: two elements of a class have {TRACK_KEY} {twice[0]}: a "
            "track is one element in each frame."
        )


def write_tracks(
    path: Path,
    frames: Sequence[DriveFrame],
    config: ConsistencyConfig,
    about: Mapping[str, Any],
) -> None:
    """Write results with the track of each element: ``track_id``, -1 for one of a low score.

    Tracks are those that the frames have, or made as `make_tracks` does; they persist over a
    scene's frames. ``about`` is what the results say of themselves.
    """
    samples = []
    for scene in by_scene(frames):
        for frame, tracks in zip(scene, tracks_of(scene, config), strict=True):
            vectors = vectors_of(frame.predictions, config.classes)
            ids = zip(vectors, tracks.tolist(), strict=True)
            samples.append((frame.token, [{**vector, TRACK_KEY: t} for vector, t in ids]))
    write_results(path, samples, {**about, "classes": list(config.classes)})


def evaluate_drives(
    results: Path,
    annotations: AnnotationFile,
    config: ConsistencyConfig,
    tracks_file: Path | None = None,
) -> dict[str, float]:
    """Return the figures of `consistency` of a result file; write its tracks if that is asked for.

    Args:
        results: Result file of all samples.
        annotations: Ground truth with poses.
        config: The metric's settings.
        tracks_file: Where the results are written again, each element with its ``track_id``.

    Raises:
        FileNotFoundError: If the result file does not exist.
        ValueError: If it is malformed, lacks a sample, or the annotations have no ground truth.
    """
    samples = SampleFile(results, RESULTS_KEY, config.classes)
    frames = _frames_of(samples, annotations)
    figures = consistency(frames, config)
    if tracks_file is not None:
        write_tracks(tracks_file, frames, config, samples.about)
    return figures
