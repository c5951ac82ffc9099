"""Frames for the page: chosen samples with their map in centimetres, cameras and thumbnails."""

import base64
from collections.abc import Sequence
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
    """Choose samples: three quarters evenly, and of the others those with the lowest F1.

    Of two results, they are those in which F1 differs most.

    Args:
        tokens: All samples, in order.
        max_frames: How many to choose at most.
        results: None, one or two; without any all samples are chosen evenly.
        score_thr: Smallest score that F1 counts.

    Returns:
        Indices, ascending.
    """
    if len(tokens) <= max_frames:
        return list(range(len(tokens)))
    even = max_frames - max_frames // 4 if results else max_frames
    chosen = set(np.linspace(0, len(tokens) - 1, even).round().astype(int).tolist())
    if results:
        f1 = np.array([[result.f1(token, score_thr) for token in tokens] for result in results])
        order = np.argsort(f1[0] if len(f1) == 1 else -abs(f1[0] - f1[1]), kind="stable")
        worst = (i for i in order.tolist() if i not in chosen)
        chosen.update(i for i, _ in zip(worst, range(max_frames - even), strict=False))
    return sorted(chosen)


def _centimetres(points: np.ndarray, view: FrameView) -> list[int]:
    """Return (right, ahead) of each point, one after another, in whole centimetres."""
    return np.rint(100 * view.display_from_frame(points)).astype(int).ravel().tolist()


def truth_of(sample: MapSample, view: FrameView) -> list[dict[str, Any]]:
    """Return a sample's ground truth: class ``c`` and points ``p`` in centimetres."""
    elements = elements_of_instances(sample.instances or [])
    return [{"c": label, "p": _centimetres(line, view)} for line, label, _ in elements.rows]


def found_of(token: str, result: ScoredResult, view: FrameView) -> list[dict[str, Any]]:
    """Return a sample's predictions that AP_raster does not drop, in descending order of score.

    Args:
        token: The sample.
        result: Predictions and their matches.
        view: Turns the annotation frame to the display.

    Returns:
        Per prediction its class ``c``, score ``s``, points ``p``, the index of the ground truth
        that it hits within 1 m or -1, and, if it has Gaussians, sigma along both axes in
        centimetres and the angle in the display in degrees per point, ``g``.
    """
    matches, hits = result.matches[token], result.hits(token)
    kept = matches.scores >= MIN_SCORE
    if not kept.any():
        return []
    elements = result.predictions[token].select(matches.pred_index[kept])
    rows = zip(elements.rows, hits[kept].tolist(), strict=True)
    found = [
        {"c": label, "s": round(score, 6), "hit": hit, "p": _centimetres(line, view)}
        for (line, label, score), hit in rows
    ]
    if elements.scales is not None and elements.rotations is not None:
        degrees = np.degrees(elements.rotations + view.display_turn_rad)[:, None]
        values = np.rint(np.hstack([100 * elements.scales, degrees])).astype(int)  # (M, 3)
        for entry, a, b in zip(found, elements.offsets, elements.offsets[1:], strict=False):
            entry["g"] = values[a:b].ravel().tolist()
    return found


def _img_from_display(camera: CameraRecord, view: FrameView) -> np.ndarray:
    """Return the homography from (right, ahead, 1) on the ground, in metres, to pixels. (3, 3)"""
    a, b, c = view.ground
    axes = np.eye(3) if view.forward == "y" else np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    lift = np.array([[1, 0, 0], [0, 1, 0], [a, b, c], [0, 0, 1]])  # (x, y, 1) -> (x, y, z, 1)
    return camera.img_from_frame[:3] @ lift @ axes


def thumbnail(path: Path, width_px: int) -> str:
    """Return an image as a small JPEG in a data URI.

    Args:
        path: The image file.
        width_px: Largest width.

    Raises:
        ValueError: If there is no image, or it is damaged.
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
        size = (width_px, max(round(height * width_px / width), 1))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    content = base64.b64encode(encode_jpeg(image, _JPEG_QUALITY))
    return f"data:image/jpeg;base64,{content.decode()}"


def cameras_of(
    sample: MapSample, view: FrameView, data_root: Path, width_px: int
) -> list[list[dict[str, Any]]]:
    """Return a sample's cameras in rows, as they stand on the car.

    Args:
        sample: The sample.
        view: Its ground and orientation.
        data_root: Folder that image paths start from.
        width_px: Largest width of the images, twice that of the camera ahead; 0 leaves them out.

    Raises:
        ValueError: If an image cannot be read.
    """
    rows: list[list[dict[str, Any]]] = []
    for row in arrange_cameras(sample.cameras, view):
        entries = []
        for camera in row:
            matrix = _img_from_display(camera, view)
            title, size = camera_title(camera.name), [camera.width, camera.height]
            entry: dict[str, Any] = {"title": title, "size": size}
            entry["matrix"] = [float(f"{value:.6g}") for value in matrix.ravel()]
            ahead = not rows and camera is row[len(row) // 2]
            largest_px = width_px * (2 if ahead else 1)
            entry["src"] = thumbnail(data_root / camera.path, largest_px) if width_px else ""
            entries.append(entry)
        rows.append(entries)
    return rows
