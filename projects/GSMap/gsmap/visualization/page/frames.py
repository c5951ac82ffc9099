"""Frames of the report page: choice of samples, maps in centimetres, cameras and thumbnails.

The values of a frame become JSON in the page. Short keys and whole centimetres keep the page small.
"""

import base64
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsmap.datasets.annotations.record import CameraRecord, MapSample
from gsmap.datasets.elements import elements_of_instances
from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.image_files import encode_jpeg, read_image
from gsmap.evaluation.core.raster_ap import MIN_SCORE
from gsmap.structures.frames import FrameView
from gsmap.utils.errors import InputError
from gsmap.visualization.camera_view import arrange_cameras, camera_title
from gsmap.visualization.page.scores import ScoredResult

_JPEG_QUALITY = 70


def choose_frames(
    tokens: Sequence[str], max_frames: int, results: Sequence[ScoredResult], score_thr: float
) -> list[int]:
    """Choose samples for the page.

    Without results, the samples are evenly spread. With results, three quarters of them are evenly
    spread. The others have the lowest F1 of one result, or the largest difference between the F1 of
    two results.

    Args:
        tokens: Tokens of all samples, in order.
        max_frames: Largest number of chosen samples.
        results: No, one or two results.
        score_thr: Smallest score of a prediction that counts in F1.

    Returns:
        Indices of the samples, ascending.
    """
    if len(tokens) <= max_frames:
        return list(range(len(tokens)))
    num_even = max_frames  # number of evenly spread samples
    if results:
        num_even -= max_frames // 4
    even = np.linspace(0, len(tokens) - 1, num_even).round().astype(int)
    chosen = set(even.tolist())
    if results:
        f1 = []
        for result in results:
            f1.append(np.array([result.f1(token, score_thr) for token in tokens]))
        # The samples with the lowest ranking values are chosen.
        ranking = f1[0] if len(f1) == 1 else -abs(f1[0] - f1[1])
        num_chosen = len(chosen) + max_frames - num_even  # samples so far, and the last quarter
        for index in np.argsort(ranking, kind="stable").tolist():
            if len(chosen) == num_chosen:
                break
            chosen.add(index)
    return sorted(chosen)


def to_centimetres(points: np.ndarray, view: FrameView) -> list[int]:
    """Convert points (n, 2) in metres to alternating values right and ahead in whole centimetres.

    Returns a flat list of 2 n values.
    """
    centimetres = np.rint(100 * view.display_from_frame(points)).astype(int)
    return centimetres.ravel().tolist()


def truth_of(sample: MapSample, view: FrameView) -> list[dict[str, Any]]:
    """Convert the ground truth of a sample to plain values.

    Args:
        sample: Sample of the annotation file.
        view: Orientation of the annotation frame.

    Returns:
        Class index ``c`` and points ``p`` (`to_centimetres`) of each element.
    """
    elements = elements_of_instances(sample.instances or [])
    entries = []
    for line, label, _ in elements.rows:
        entries.append({"c": label, "p": to_centimetres(line, view)})
    return entries


def predictions_of(token: str, result: ScoredResult, view: FrameView) -> list[dict[str, Any]]:
    """Convert the predictions of a sample to plain values, in descending order of scores.

    Predictions with scores too small for AP_raster are dropped.

    Args:
        token: Token of the sample.
        result: Predictions and their matches.
        view: Orientation of the annotation frame.

    Returns:
        For each prediction, its class index ``c``, score ``s``, points ``p`` (`to_centimetres`) and
        ``hit``, the index of the ground truth that it hits within 1 m, or -1. With Gaussians, also
        ``g``: for each point, sigma along both axes in centimetres and the angle of the first axis
        in the display in degrees, in one flat list.
    """
    # Matches are sorted by score. `pred_index` has the indices of the predictions in this order.
    matches = result.matches[token]
    is_shown = matches.scores >= MIN_SCORE
    if not is_shown.any():
        return []
    elements = result.predictions[token].select(matches.pred_index[is_shown])
    hits = result.hits(token)[is_shown].tolist()
    entries: list[dict[str, Any]] = []
    for (line, label, score), hit in zip(elements.rows, hits, strict=True):
        points = to_centimetres(line, view)
        entries.append({"c": label, "s": round(score, 6), "hit": hit, "p": points})
    if elements.scales is not None and elements.rotations is not None:
        degrees = np.degrees(elements.rotations + view.display_turn_rad)
        columns = np.column_stack([100 * elements.scales, degrees])
        gaussians = np.rint(columns).astype(int)  # (M, 3)
        for entry, (start, end) in zip(entries, pairwise(elements.offsets), strict=True):
            entry["g"] = gaussians[start:end].ravel().tolist()
    return entries


def _img_from_display(camera: CameraRecord, view: FrameView) -> np.ndarray:
    """Homography from (right, ahead, 1) on the ground, in metres, to pixels. (3, 3)"""
    a, b, c = view.ground  # the plane z = a x + b y + c
    frame_from_display = np.eye(3)
    if view.forward == "x":  # x is ahead and y is left, so x = ahead and y = -right
        frame_from_display = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    lift = np.array([[1, 0, 0], [0, 1, 0], [a, b, c], [0, 0, 1]])  # (x, y, 1) -> (x, y, z, 1)
    return camera.img_from_frame[:3] @ lift @ frame_from_display


def thumbnail(path: Path, width_px: int) -> str:
    """Read an image and encode it as a small JPEG in a data URI.

    Args:
        path: Image file.
        width_px: Largest width in pixels; wider images are reduced to it.

    Returns:
        Data URI.

    Raises:
        ValueError: If the image is missing or damaged.
    """
    try:
        image = read_image(str(path), "page")
    except BrokenSampleError as error:
        raise InputError(
            f"no readable image at {path} ({error}): give the folder that image paths start from "
            "as --data-root, or leave the images out with --no-images."
        ) from error
    height, width = image.shape[:2]
    if width > width_px:
        height_px = max(round(height * width_px / width), 1)
        image = cv2.resize(image, (width_px, height_px), interpolation=cv2.INTER_AREA)
    content = base64.b64encode(encode_jpeg(image, _JPEG_QUALITY))
    return f"data:image/jpeg;base64,{content.decode()}"


def cameras_of(
    sample: MapSample, view: FrameView, data_root: Path, width_px: int
) -> list[list[dict[str, Any]]]:
    """Convert the cameras of a sample to plain values, in rows as on the vehicle.

    Args:
        sample: Sample of the annotation file.
        view: Orientation and ground plane of the annotation frame.
        data_root: Folder that image paths are relative to.
        width_px: Largest width of the images in pixels, doubled for the camera in the middle of the
            first row; 0 leaves images out.

    Returns:
        A row of the cameras that look ahead, then a row of the cameras that look back, each from
        left to right and without empty rows. An entry has the ``title`` of a camera, its ``size``
        (width, height) in pixels, its homography ``matrix`` from metres on the ground in the
        display to pixels, (9,), and its image ``src`` as a data URI. ``src`` is empty without
        images.

    Raises:
        ValueError: If an image is missing or damaged.
    """
    rows: list[list[dict[str, Any]]] = []
    for row in arrange_cameras(sample.cameras, view):
        entries = []
        for index, camera in enumerate(row):
            matrix = _img_from_display(camera, view)
            is_first_row = not rows
            is_main_camera = is_first_row and index == len(row) // 2  # usually looks straight ahead
            largest_px = 2 * width_px if is_main_camera else width_px
            entry = {
                "title": camera_title(camera.name),
                "size": [camera.width, camera.height],
                "matrix": [float(f"{value:.6g}") for value in matrix.ravel()],
                "src": thumbnail(data_root / camera.path, largest_px) if width_px else "",
            }
            entries.append(entry)
        rows.append(entries)
    return rows
