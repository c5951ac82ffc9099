"""One frame whose images and calibration lie in memory."""

from collections.abc import Mapping, Sequence

import numpy as np

from gsmap.datasets.annotations.file import check_samples
from gsmap.datasets.annotations.record import AnnotationMeta, CameraRecord, MapSample

Cameras = Mapping[str, np.ndarray] | Sequence[np.ndarray] | np.ndarray


def frame_in_memory(
    images: Cameras, intrinsics: Cameras, cam_from_frame: Cameras, frame: str
) -> tuple[MapSample, dict[str, np.ndarray]]:
    """Make a sample of one frame.

    Args:
        images: By the cameras' names, or as a list: RGB, uint8. each (H, W, 3)
        intrinsics: In the same form, in pixels. each (3, 3)
        cam_from_frame: In the same form, in metres. each (4, 4)
        frame: The annotation frame, ``lidar`` or ``ego``.

    Returns:
        The sample, and the images in BGR by the cameras' names.

    Raises:
        TypeError: If an image is not uint8.
        ValueError: If an array has another shape, a matrix is none of its kind, or the cameras of
            the arguments differ.
    """
    given = {"images": images, "intrinsics": intrinsics, "cam_from_frame": cam_from_frame}
    by_name = {name: _by_name(values) for name, values in given.items()}
    names = list(by_name["images"])
    for what, values in by_name.items():
        if set(values) != set(names) or not names:
            raise ValueError(
                f"{what} must have the cameras of images, {names}, got {list(values)}."
            )
    pixels = {name: _bgr(name, image) for name, image in by_name["images"].items()}
    cameras = [
        CameraRecord(
            name,
            path="in memory",
            width=image.shape[1],
            height=image.shape[0],
            intrinsics=by_name["intrinsics"][name],
            cam_from_frame=by_name["cam_from_frame"][name],
        )
        for name, image in pixels.items()
    ]
    sample = MapSample("in memory", "", "", 0, cameras, np.eye(4))
    check_samples([sample], AnnotationMeta("memory", frame, "test"))
    return sample, pixels


def _by_name(values: Cameras) -> dict[str, np.ndarray]:
    """Return arrays by the camera's name; those of a list are numbered."""
    if isinstance(values, Mapping):
        return {str(name): np.asarray(array) for name, array in values.items()}
    return {f"camera {number}": np.asarray(array) for number, array in enumerate(values)}


def _bgr(name: str, image: np.ndarray) -> np.ndarray:
    """Check an image, and return it in the order of channels that the pipeline has. (H, W, 3)"""
    if image.dtype != np.uint8:
        raise TypeError(f"the image of {name!r} must be uint8, RGB, got {image.dtype}.")
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise ValueError(f"the image of {name!r} must have shape (H, W, 3), got {image.shape}.")
    return np.ascontiguousarray(image[..., ::-1])
