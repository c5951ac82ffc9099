"""Corruptions of camera images and calibrations: failures, shifts, delays, weather and compression.

The kinds of corruptions and their five severities follow MapBench and ImageNet-C. Random numbers
depend only on the seed and the token of the sample, so they are equal for all severities of a kind.

In keys such as ``lidar2cam``, ``lidar`` is the annotation frame, as in mmdet3d.
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

# Each tuple has one value for each of the five severities.
_TURNS_DEG = (0.25, 0.5, 1.0, 2.0, 4.0)  # rotations of the extrinsics
_SHIFTS_M = (0.02, 0.05, 0.1, 0.2, 0.4)  # translations of the extrinsics
_VISIBILITY_M = (200.0, 100.0, 60.0, 40.0, 25.0)  # limit of visibility in fog
# Number of streaks of rain per pixel. Each streak covers many pixels.
_RAIN_DENSITIES = (0.001, 0.002, 0.0035, 0.0055, 0.008)
_EXPOSURES = (0.6, 0.4, 0.25, 0.15, 0.08)  # at night, relative to day
_NIGHT_NOISE = 12.0  # standard deviation in grey levels at an exposure of 0
_BLUR_LENGTHS = (0.01, 0.02, 0.03, 0.045, 0.06)  # relative to the width of the image
_JPEG_QUALITIES = (25, 18, 15, 10, 7)  # as in ImageNet-C
_FOG_GREY = 200.0  # grey level of fog
_MAX_FOG_DISTANCE_M = 60.0  # distance of pixels above the horizon, and limit for all others
_STREAK_GREY = 210  # grey level of a streak of rain
_STREAK_OPACITY = 0.4


def generator(seed: int, token: str) -> np.random.Generator:
    """Return the random number generator of a sample.

    Args:
        seed: Seed of the transform, at least 0.
        token: Token of the sample.
    """
    # Python's `hash` of a text would differ between processes.
    return np.random.default_rng([seed, crc32(token.encode())])


def lose_cameras(results: dict[str, Any], views: NDArray[np.integer[Any]]) -> None:
    """Black out views and turn them away from the map, like missing cameras at inference.

    Args:
        results: Results of the pipeline; the lists ``img``, ``lidar2cam`` and ``lidar2img`` are
            changed in place.
        views: Indices of the views.
    """
    # Image steps such as resizing may only be recorded, to run on the GPU later. They are applied
    # here, before pixels change.
    finish_on_host(results)
    for view in views.tolist():
        results["img"][view] = np.zeros_like(results["img"][view])
        # With these extrinsics, the whole map is behind the camera.
        _set_extrinsics(results, view, lidar2cam=OUT_OF_SIGHT)


def _set_extrinsics(results: dict[str, Any], view: int, lidar2cam: NDArray[np.float64]) -> None:
    """Set the extrinsics (4, 4) of a view, and update its projection from metres to pixels."""
    # `img_aug_matrix` contains the resizing and cropping of the image. All matrices are (4, 4).
    lidar2img = results["img_aug_matrix"][view] @ results["cam2img"][view] @ lidar2cam
    results["lidar2cam"][view] = lidar2cam
    results["lidar2img"][view] = lidar2img


@TRANSFORMS.register_module()
@dataclass(eq=False)
class CorruptImages(BaseTransform):
    """Transform that corrupts the images or the calibration of all cameras.

    The transform must come after ``LoadCameraImages``. The padding of smaller images (see there)
    does not change.

    Args:
        kind: Kind of corruption, one of ``KINDS``. ``camera_lost`` blacks out as many cameras as
            the severity, but at least one remains. ``rotation`` and ``translation`` change only the
            calibration of each camera: by 0.25 to 4 degrees about a random axis, or by 2 to 40 cm
            in a random direction.
        severity: Severity from 1 to 5.
        seed: Seed of the random numbers.

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
        """Corrupt ``results['img']``, or ``lidar2cam`` and ``lidar2img``."""
        finish_on_host(results)  # applies the recorded image steps, such as resizing, now
        rng = generator(self.seed, results["token"])
        level = self.severity - 1  # index into the tuples with a value for each severity
        # Entries of the lists are replaced below, and the lists of the caller must not change.
        for key in ("img", "lidar2cam", "lidar2img"):
            results[key] = list(results[key])
        views = range(len(results["img"]))
        if self.kind == "camera_lost":
            num_lost = min(self.severity, len(views) - 1)
            # A camera that is lost at one severity is also lost at all higher ones.
            lose_cameras(results, rng.permutation(len(views))[:num_lost])
        elif self.kind in _CALIBRATION_ERRORS:
            for view in views:
                axis = rng.normal(size=3)
                # Transform (4, 4) in the frame of the camera.
                error = _CALIBRATION_ERRORS[self.kind](axis / np.linalg.norm(axis), level)
                lidar2cam = error @ results["lidar2cam"][view]
                _set_extrinsics(results, view, lidar2cam=lidar2cam)
        elif self.kind == "fog":
            for view in views:
                results["img"][view] = fog(results, view, visibility_m=_VISIBILITY_M[level])
        else:
            corrupt = _IMAGE_CORRUPTIONS[self.kind]
            for view in views:
                picture = _without_padding(results, view)
                corrupted = corrupt(_grey_levels(picture), level, rng)
                results["img"][view] = _with_padding(results, view, picture=corrupted)
        return results


def _without_padding(results: dict[str, Any], view: int) -> NDArray[Any]:
    """Return the image of a view without its padding at the bottom and right. (H, W, 3)"""
    height, width = results["raw_shapes"][view]
    return np.asarray(results["img"][view][:height, :width])


def _with_padding(results: dict[str, Any], view: int, picture: NDArray[Any]) -> NDArray[Any]:
    """Return the image of a view, in which a picture replaces all but the padding. (H, W, 3)"""
    image = results["img"][view].copy()
    height, width = picture.shape[:2]
    image[:height, :width] = picture.astype(image.dtype)
    return np.asarray(image)


def _grey_levels(image: NDArray[Any]) -> Image:
    """Clip an image to [0, 255] and convert it to uint8. (H, W, 3)"""
    return np.clip(image, 0, 255).astype(np.uint8)


def fog(results: dict[str, Any], view: int, visibility_m: float) -> NDArray[Any]:
    """Add fog to a view.

    The contrast decreases exponentially with the distance and is 5 % at the limit of visibility
    (Koschmieder's law). The distance of a pixel is the distance at which its ray meets level
    ground, at most 60 m.

    Args:
        results: Results of the pipeline, with images and calibration.
        view: Index of the view.
        visibility_m: Limit of visibility in metres.

    Returns:
        Image with its padding. (H, W, 3)

    Raises:
        ValueError: If the height of the annotation frame above the road is unknown.
    """
    ground_from_frame = results["lidar2ground"]
    if ground_from_frame is None:
        raise InputError(
            f"sample {results['token']!r} has no ego_from_frame and its file no ground_z_m, one of "
            "which fog needs for the height of the cameras: set one of them (ground_z_m also in "
            "the data set of the config), or leave out fog."
        )
    image = _without_padding(results, view)
    height, width = image.shape[:2]
    cols, rows = np.meshgrid(np.arange(width), np.arange(height))
    pixels = np.stack([cols, rows, np.ones((height, width))])  # (3, H, W)
    intrinsics = results["img_aug_matrix"][view][:3, :3] @ results["cam2img"][view][:3, :3]
    ground_from_cam = ground_from_frame @ invert_rigid(results["lidar2cam"][view])
    cam_rays = np.linalg.solve(intrinsics, pixels.reshape(3, -1))  # (3, H * W)
    rays = ground_from_cam[:3, :3] @ cam_rays
    slopes = rays[2] / np.linalg.norm(rays, axis=0)  # rise per metre of distance
    slopes = np.minimum(slopes, -1e-6)  # rays above the horizon would never reach the ground
    camera_height_m = np.maximum(ground_from_cam[2, 3], 0.1)
    distance_m = np.minimum(camera_height_m / -slopes, _MAX_FOG_DISTANCE_M)
    contrast = np.exp(np.log(0.05) / visibility_m * distance_m).reshape(height, width, 1)
    foggy = image * contrast + _FOG_GREY * (1 - contrast)
    return _with_padding(results, view, picture=foggy)


def rain(image: Image, level: int, rng: np.random.Generator) -> Image:
    """Add streaks of rain to an image and reduce its contrast.

    Args:
        image: Image, uint8. (H, W, 3)
        level: Severity from 0 to 4.
        rng: Generator for the places of the streaks.
    """
    height, width = image.shape[:2]
    # Whether a pixel is the centre of a streak.
    is_centre = rng.random((height, width)) < _RAIN_DENSITIES[level]
    centres = is_centre.astype(np.float32)
    length = max(3, round(0.06 * height))  # of a streak, in pixels
    streak = np.zeros((length, length), dtype=np.float32)  # image of one streak
    top = (length * 2 // 5, 0)  # (column, row)
    bottom = (length * 3 // 5, length - 1)  # the streak is nearly vertical
    cv2.line(streak, top, bottom, color=(1.0,))
    # The filter draws a streak around each centre.
    streaks = cv2.filter2D(centres, ddepth=-1, kernel=streak)
    opacity = np.clip(streaks, 0, 1)[..., None] * _STREAK_OPACITY
    greyness = 0.04 * (level + 1)  # share of a medium grey in all pixels, which lowers the contrast
    grey_image = image * (1 - greyness) + 128 * greyness
    return _grey_levels(grey_image * (1 - opacity) + _STREAK_GREY * opacity)


def night(image: Image, level: int, rng: np.random.Generator) -> Image:
    """Darken an image and add noise.

    Args:
        image: Image, uint8. (H, W, 3)
        level: Severity from 0 to 4.
        rng: Generator for the noise.
    """
    exposure = _EXPOSURES[level]
    noise = rng.normal(scale=_NIGHT_NOISE * (1 - exposure), size=image.shape)
    return _grey_levels(image * exposure + noise)


def motion_blur(image: Image, level: int, rng: np.random.Generator) -> Image:
    """Blur an image along its rows, like the motion of a turning vehicle.

    Args:
        image: Image, uint8. (H, W, 3)
        level: Severity from 0 to 4.
        rng: Not used.
    """
    # An odd length does not shift the image.
    length = 2 * round(_BLUR_LENGTHS[level] * image.shape[1] / 2) + 1
    return np.asarray(cv2.blur(image, (length, 1)), dtype=np.uint8)


def jpeg(image: Image, level: int, rng: np.random.Generator) -> Image:
    """Compress an image as JPEG and decode it.

    Args:
        image: Image, uint8. (H, W, 3)
        level: Severity from 0 to 4.
        rng: Not used.
    """
    settings = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITIES[level]]
    _, data = cv2.imencode(".jpg", image, params=settings)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)


def _rotation(axis: NDArray[np.float64], level: int) -> NDArray[np.float64]:
    """Return a rotation about a unit vector. (3,) -> (4, 4)"""
    rotation = Rotation.from_rotvec(axis * np.deg2rad(_TURNS_DEG[level]))
    return rigid(rotation.as_matrix(), translation=np.zeros(3))


def _translation(axis: NDArray[np.float64], level: int) -> NDArray[np.float64]:
    """Return a translation along a unit vector. (3,) -> (4, 4)"""
    return rigid(np.eye(3), translation=axis * _SHIFTS_M[level])


_CALIBRATION_ERRORS: dict[str, Callable[[NDArray[np.float64], int], NDArray[np.float64]]] = {
    "rotation": _rotation,
    "translation": _translation,
}
_IMAGE_CORRUPTIONS: dict[str, Callable[[Image, int, np.random.Generator], Image]] = {
    "rain": rain, "night": night, "motion_blur": motion_blur, "jpeg": jpeg,
}  # fmt: skip
KINDS = ("camera_lost", *_CALIBRATION_ERRORS, "fog", *_IMAGE_CORRUPTIONS)


@TRANSFORMS.register_module()
@dataclass(eq=False)
class DelayCameras(BaseTransform):
    """Transform that replaces images of some cameras by images of the scene's previous sample.

    The first sample of a scene does not change, nor do cameras that the previous sample lacks. The
    transform must come before
    ``LoadCameraImages``.

    Args:
        ann_file: Annotation file of the data set, relative to ``data_root`` unless absolute.
        severity: Number of cameras from 1 to 5; at least one camera does not change.
        data_root: Folder that image paths are relative to.
        seed: Seed of the selection of the cameras.
    """

    ann_file: str
    severity: int
    data_root: str = ""
    seed: int = 0

    @cached_property
    def _previous_rows(self) -> dict[str, int]:
        """Row in the annotation file of the scene's previous sample, by the token of a sample.

        First samples of scenes have no entry.
        """
        scenes = self._file.column("scene")
        times_ns = self._file.column("timestamp_ns")
        tokens = self._file.column("token")
        rows = range(len(tokens))
        samples = sorted(zip(scenes, times_ns, tokens, rows, strict=True))  # by scene, then by time
        previous_rows = {}
        for previous, current in pairwise(samples):
            previous_scene, _, _, previous_row = previous
            scene, _, token, _ = current
            if previous_scene == scene:
                previous_rows[token] = previous_row
        return previous_rows

    @cached_property
    def _file(self) -> AnnotationFile:
        """Annotation file of the data set."""
        return AnnotationFile(Path(self.data_root, self.ann_file))

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Replace paths in ``results['images']``."""
        row = self._previous_rows.get(results["token"])
        if row is None:
            return results
        images = dict(results["images"])
        # Paths of the images of the previous sample.
        paths = {camera.name: camera.path for camera in self._file[row].cameras}
        names = [name for name in images if name in paths]
        rng = generator(self.seed, results["token"])
        num_late = min(self.severity, len(names), len(images) - 1)
        for view in rng.permutation(len(names))[:num_late].tolist():
            name = names[view]
            path = str(Path(self.data_root, paths[name]))
            images[name] = {**images[name], "img_path": path}
        return {**results, "images": images}


@TRANSFORMS.register_module()
@dataclass(eq=False)
class DropCameras(BaseTransform):
    """Augmentation that blacks out random cameras, for models that are robust to missing cameras.

    The transform must come after all image steps.

    Args:
        prob: Probability that cameras of a sample are missing, from 0 to 1.
        max_num: Largest number of missing cameras. All numbers from 1 are equally probable. At
            least one camera remains.
    """

    prob: float = 0.3
    max_num: int = 3

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Black out random views of ``results['img']``."""
        if np.random.random() < self.prob:  # noqa: NPY002 - seeded by mmengine
            # `lose_cameras` replaces entries, and the lists of the caller must not change.
            for key in ("img", "lidar2cam", "lidar2img"):
                results[key] = list(results[key])
            views = np.random.permutation(len(results["img"]))  # noqa: NPY002
            num_lost = np.random.randint(1, self.max_num + 1)  # noqa: NPY002
            lose_cameras(results, views[: min(num_lost, len(views) - 1)])
        return results
