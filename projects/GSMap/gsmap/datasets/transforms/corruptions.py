"""What goes wrong with cameras on the road: lost, moved and late ones, weather, blur, compression.

The kinds and their five severities follow MapBench and ImageNet-C. A sample's corruption depends on
seed and token alone, and a severer one is the same one, stronger.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any
from zlib import crc32

import cv2
import numpy as np
from mmcv.transforms import BaseTransform
from mmdet3d.registry import TRANSFORMS
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.transforms.image_steps import finish_on_host
from gsmap.structures.calibration import OUT_OF_SIGHT
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.utils.errors import InputError

SEVERITIES = (1, 2, 3, 4, 5)
Image = NDArray[np.uint8]

_TURNS_DEG = (0.25, 0.5, 1.0, 2.0, 4.0)
_SHIFTS_M = (0.02, 0.05, 0.1, 0.2, 0.4)
_SIGHT_M = (200.0, 100.0, 60.0, 40.0, 25.0)  # in fog
_DROPS = (0.001, 0.002, 0.0035, 0.0055, 0.008)  # share of pixels in which a streak of rain begins
_EXPOSURES = (0.6, 0.4, 0.25, 0.15, 0.08)  # at night
_NOISE = 12.0  # grey levels, of the darkest night
_BLURS = (0.01, 0.02, 0.03, 0.045, 0.06)  # of the image's width
_QUALITIES = (25, 18, 15, 10, 7)  # of JPEG, as ImageNet-C
_FOG = 200.0  # its grey level
_FARTHEST_M = 60.0  # of what stands on the ground


def generator(seed: int, token: str) -> np.random.Generator:
    """Return the random numbers of a sample."""
    return np.random.default_rng([seed, crc32(token.encode())])


def lose_cameras(results: dict[str, Any], lost: NDArray[np.integer[Any]]) -> None:
    """Black out views, and let them look where nothing of the map is, as inference does."""
    finish_on_host(results)
    for view in lost.tolist():
        results["img"][view] = np.zeros_like(results["img"][view])
        _place(results, view, OUT_OF_SIGHT)


def _place(results: dict[str, Any], view: int, lidar2cam: NDArray[np.float64]) -> None:
    """Give a view another calibration. (4, 4)"""
    matrices = results["img_aug_matrix"][view] @ results["cam2img"][view] @ lidar2cam
    results["lidar2cam"][view], results["lidar2img"][view] = lidar2cam, matrices


@TRANSFORMS.register_module()
@dataclass(eq=False)
class CorruptImages(BaseTransform):
    """Corrupt the images of all cameras, or their calibration; behind ``LoadCameraImages``.

    Args:
        kind: One of ``KINDS``. ``camera_lost``: as many cameras as the severity says, all but one
            at most. ``rotation`` and ``translation``: each camera is turned by 0.25 to 4 degrees or
            shifted by 2 to 40 cm in a direction of its own, and the model does not know it.
        severity: From 1 to 5.
        seed: Of what is drawn.

    Raises:
        ValueError: If the kind or the severity is unknown.
    """

    kind: str
    severity: int
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in KINDS or self.severity not in SEVERITIES:
            raise InputError(
                f"kind must be one of {KINDS} and severity one of {SEVERITIES}, got "
                f"{self.kind!r} and {self.severity!r}."
            )

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Corrupt ``results['img']`` or its matrices."""
        finish_on_host(results)
        rng, level = generator(self.seed, results["token"]), self.severity - 1
        for key in ("img", "lidar2cam", "lidar2img"):
            results[key] = list(results[key])
        views = range(len(results["img"]))
        if self.kind == "camera_lost":
            lose_cameras(results, rng.permutation(len(views))[: min(self.severity, views[-1])])
        elif self.kind in _CALIBRATIONS:
            for view in views:
                axis = rng.normal(size=3)
                moved = _CALIBRATIONS[self.kind](axis / np.linalg.norm(axis), level)
                _place(results, view, moved @ results["lidar2cam"][view])
        elif self.kind == "fog":
            for view in views:
                results["img"][view] = fog(results, view, _SIGHT_M[level])
        else:
            for view, image in enumerate(results["img"]):
                done = _IMAGES[self.kind](_grey_levels(image), level, rng)
                results["img"][view] = done.astype(image.dtype)
        return results


def _grey_levels(image: NDArray[Any]) -> Image:
    """Return an image as whole grey levels. (H, W, 3)"""
    return np.clip(image, 0, 255).astype(np.uint8)


def fog(results: dict[str, Any], view: int, sight_m: float) -> NDArray[Any]:
    """Return a view in fog in which one sees so far. (H, W, 3)

    The distance of a pixel is that of the level ground there, at most 60 m. A contrast of 5 % is
    left at the end of sight (Koschmieder's law).
    """
    image = results["img"][view]
    height, width = image.shape[:2]
    pixels = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.ones(image.shape[:2])])
    inner = results["img_aug_matrix"][view][:3, :3] @ results["cam2img"][view][:3, :3]
    ego_from_cam = results["lidar2ego"] @ invert_rigid(results["lidar2cam"][view])
    rays = ego_from_cam[:3, :3] @ np.linalg.solve(inner, pixels.reshape(3, -1))
    falls = np.minimum(rays[2] / np.linalg.norm(rays, axis=0), -1e-6)  # of a ray of 1 m
    distance = np.minimum(np.maximum(ego_from_cam[2, 3], 0.1) / -falls, _FARTHEST_M)
    seen = np.exp(np.log(0.05) / sight_m * distance).reshape(height, width, 1)
    return (image * seen + _FOG * (1 - seen)).astype(image.dtype)


def rain(image: Image, level: int, rng: np.random.Generator) -> Image:
    """Return an image with streaks of rain, and greyer. (H, W, 3)"""
    height, width = image.shape[:2]
    drops = (rng.random((height, width)) < _DROPS[level]).astype(np.float32)
    length = max(3, round(0.06 * height))
    streak = np.zeros((length, length), np.float32)
    cv2.line(streak, (length * 2 // 5, 0), (length * 3 // 5, length - 1), (1.0,))  # nearly upright
    veil = np.clip(cv2.filter2D(drops, -1, streak), 0, 1)[..., None] * 0.4
    grey = 0.04 * (level + 1)
    return _grey_levels((image * (1 - grey) + 128 * grey) * (1 - veil) + 210 * veil)


def night(image: Image, level: int, rng: np.random.Generator) -> Image:
    """Return an image that got less light, with the noise of that. (H, W, 3)"""
    exposure = _EXPOSURES[level]
    noise = rng.normal(scale=_NOISE * (1 - exposure), size=image.shape)
    return _grey_levels(image * exposure + noise)


def motion_blur(image: Image, level: int, rng: np.random.Generator) -> Image:
    """Return an image blurred along its rows, as of a vehicle that turns. (H, W, 3)"""
    length = 2 * round(_BLURS[level] * image.shape[1] / 2) + 1  # odd: nothing is shifted
    return np.asarray(cv2.blur(image, (length, 1)), np.uint8)


def jpeg(image: Image, level: int, rng: np.random.Generator) -> Image:
    """Return an image after compression. (H, W, 3)"""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITIES[level]])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


_CALIBRATIONS: dict[str, Callable[[NDArray[np.float64], int], NDArray[np.float64]]] = {
    "rotation": lambda axis, level: rigid(
        Rotation.from_rotvec(axis * np.deg2rad(_TURNS_DEG[level])).as_matrix(), np.zeros(3)
    ),
    "translation": lambda axis, level: rigid(np.eye(3), axis * _SHIFTS_M[level]),
}
_IMAGES: dict[str, Callable[[Image, int, np.random.Generator], Image]] = {
    "rain": rain, "night": night, "motion_blur": motion_blur, "jpeg": jpeg,
}  # fmt: skip
KINDS = ("camera_lost", *_CALIBRATIONS, "fog", *_IMAGES)


@TRANSFORMS.register_module()
@dataclass(eq=False)
class DelayCameras(BaseTransform):
    """Let cameras show the sample before, of the same scene; in front of ``LoadCameraImages``.

    The first sample of a scene stays as it is.

    Args:
        ann_file: Annotation file of the data set.
        severity: How many cameras, from 1 to 5; all but one at most.
        data_root: Folder that image paths are relative to.
        seed: Of which ones.
    """

    ann_file: str
    severity: int
    data_root: str = ""
    seed: int = 0

    @cached_property
    def _before(self) -> dict[str, int]:
        """Row of the sample before, by token."""
        file = self._file
        columns = (file.column(name) for name in ("scene", "timestamp_ns", "token"))
        order = sorted((*entry, row) for row, entry in enumerate(zip(*columns, strict=True)))
        return {late[2]: early[3] for early, late in pairwise(order) if early[0] == late[0]}

    @cached_property
    def _file(self) -> AnnotationFile:
        return AnnotationFile(Path(self.data_root, self.ann_file))

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Replace paths in ``results['images']``."""
        row = self._before.get(results["token"])
        if row is None:
            return results
        names, images = list(results["images"]), dict(results["images"])
        paths = {camera.name: camera.path for camera in self._file[row].cameras}
        rng = generator(self.seed, results["token"])
        for view in rng.permutation(len(names))[: min(self.severity, len(names) - 1)].tolist():
            path = str(Path(self.data_root, paths[names[view]]))
            images[names[view]] = {**images[names[view]], "img_path": path}
        return {**results, "images": images}


@TRANSFORMS.register_module()
@dataclass(eq=False)
class DropCameras(BaseTransform):
    """Lose cameras in training, so that a model learns to do without; behind the images' steps.

    Args:
        prob: Share of the samples that lose cameras.
        max_num: Largest number of lost cameras; each number is as probable. One is always left.
    """

    prob: float = 0.3
    max_num: int = 3

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Black out some of ``results['img']``."""
        if np.random.random() < self.prob:  # noqa: NPY002 - mmengine seeds the global numbers
            for key in ("img", "lidar2cam", "lidar2img"):
                results[key] = list(results[key])
            views = np.random.permutation(len(results["img"]))  # noqa: NPY002
            number = np.random.randint(1, self.max_num + 1)  # noqa: NPY002
            lose_cameras(results, views[: min(number, len(views) - 1)])
        return results
