"""Image steps, which transform all images of a sample on the host or on a GPU.

With ``LoadCameraImages(on_device=True)``, images remain in uint8 as decoded, and transforms only
record their steps in ``results['image_steps']``. `MapDataPreprocessor` applies the steps on the GPU
in the recorded order and with the random numbers of the transforms. The results on host and GPU
agree up to rounding.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import mmcv
import numpy as np
import torch
import torch.nn.functional as F
from mmdet3d.datasets.transforms import PhotoMetricDistortion3D
from mmdet3d.registry import TRANSFORMS
from torch import Tensor

_EPSILON = float(np.finfo(np.float32).eps)  # OpenCV adds it to divisors in its colour conversion


class ImageStep(Protocol):
    """Interface of a step that transforms all images of a sample."""

    def on_host(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """Transform images like the published pipelines. V x (H, W, 3) -> V x (H', W', 3)"""

    def on_device(self, images: Tensor) -> Tensor:
        """Transform images with torch. (V, 3, H, W) -> (V, 3, H', W')"""

    def join(self, others: "Sequence[Any]") -> "ImageStep | None":
        """Join this step and the steps of the other samples of a batch to one step for all images.

        Returns:
            The joint step, or None if the steps cannot be joined. The samples are then processed
            one by one.
        """


def take_step(results: dict[str, Any], step: ImageStep) -> None:
    """Apply a step to the images of a sample, or record it for the GPU.

    Args:
        results: Results of the pipeline so far. If they have ``image_steps``, the list of recorded
            steps, the step is added there.
        step: Image step.
    """
    if "image_steps" in results:
        results["image_steps"].append(step)
    else:
        results["img"] = step.on_host(results["img"])


def shape_after_steps(results: dict[str, Any]) -> tuple[int, int]:
    """Return height and width of the images after all steps, including recorded ones, in pixels.

    Args:
        results: Results of the pipeline so far.
    """
    if results.get("image_steps"):  # transforms that record a step update `img_shape`
        return results["img_shape"]
    return results["img"][0].shape[:2]


def finish_on_host(results: dict[str, Any]) -> None:
    """Apply all recorded steps in float32, before a transform that reads pixels.

    Without ``image_steps`` in the results, `take_step` applies later steps directly.

    Args:
        results: Results of the pipeline so far; ``image_steps`` is removed.
    """
    if "image_steps" not in results:
        return
    results["img"] = [image.astype(np.float32) for image in results["img"]]
    for step in results.pop("image_steps"):
        results["img"] = step.on_host(results["img"])


FILTERS = ("bilinear", "bicubic")


@dataclass(frozen=True)
class Resize:
    """Image step that resizes images.

    Args:
        size: Width and height after the step, in pixels.
        rounded: Whether the step on a GPU rounds the values of uint8 images and returns uint8, as
            OpenCV always does on the host.
        kernel: ``bilinear``, the kernel of OpenCV, which reads four pixels, or ``bicubic``, the
            antialiased kernel of Pillow, whose results are integers.
    """

    size: tuple[int, int]
    rounded: bool = False
    kernel: str = "bilinear"

    def on_host(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """See `ImageStep`."""
        if self.kernel == "bilinear":
            return [mmcv.imresize(image, self.size) for image in images]
        resized_images = []
        for image in images:
            # Pillow resizes colour images in uint8 only.
            whole_numbers = np.clip(np.rint(image), 0, 255).astype(np.uint8)
            resized = mmcv.imresize(
                whole_numbers, self.size, interpolation="bicubic", backend="pillow"
            )
            resized_images.append(resized.astype(image.dtype))
        return resized_images

    def on_device(self, images: Tensor) -> Tensor:
        """See `ImageStep`."""
        # `size` is (width, height), and torch takes (height, width).
        if self.kernel == "bicubic":
            # Pillow resizes the width first, and rounds before it resizes the height.
            images = _resize_bicubic(images, size=(images.shape[2], self.size[0]))
            return _resize_bicubic(images, size=self.size[::-1])
        resized = F.interpolate(
            images.float(), size=self.size[::-1], mode="bilinear", align_corners=False
        )
        if self.rounded and not images.is_floating_point():
            return (resized + 0.5).to(torch.uint8)  # rounds halves up
        return resized

    def join(self, others: "Sequence[Any]") -> "Resize | None":
        """See `ImageStep`."""
        return self if all(other == self for other in others) else None


def _resize_bicubic(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize images to (height, width) with an antialiased bicubic kernel and round to uint8."""
    resized = F.interpolate(
        images.float(), size=size, mode="bicubic", align_corners=False, antialias=True
    )
    return (resized.clamp(0, 255) + 0.5).to(torch.uint8)


@dataclass(frozen=True)
class CropTop:
    """Image step that crops rows at the top.

    Args:
        rows: Number of rows to remove.
    """

    rows: int

    def on_host(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """See `ImageStep`."""
        return [image[self.rows :] for image in images]

    def on_device(self, images: Tensor) -> Tensor:
        """See `ImageStep`."""
        return images[:, :, self.rows :]

    def join(self, others: "Sequence[Any]") -> "CropTop | None":
        """See `ImageStep`."""
        return self if all(other == self for other in others) else None


@dataclass(frozen=True)
class Distortion:
    """Image step of a photometric distortion with separate parameters for each image.

    Args:
        numbers: Parameters of each image, drawn by ``PhotoMetricDistortion3D``. The first is 1 if
            the contrast changes before the colours. Then follow five flags, which select the
            parameters in use, and these parameters: brightness, contrast, saturation, hue and order
            of the channels.
    """

    numbers: tuple[tuple[Any, ...], ...]

    def on_host(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """See `ImageStep`."""
        # `photometric_param` has all random parameters, so the default ranges are not used.
        distort = PhotoMetricDistortion3D().transform
        distorted_images = []
        for image, numbers in zip(images, self.numbers, strict=True):
            distorted = distort({"img": image, "photometric_param": numbers})
            distorted_images.append(distorted["img"])
        return distorted_images

    def on_device(self, images: Tensor) -> Tensor:
        """See `ImageStep`."""
        rows = [_distortion_row(numbers) for numbers in self.numbers]
        table = torch.from_numpy(np.array(rows, dtype=np.float32))  # (V, 8)
        if images.is_cuda:  # a copy from pinned memory does not wait for the GPU
            table = table.pin_memory().to(images.device, non_blocking=True)
        return distort_images(images, table.to(images.device))

    def join(self, others: "Sequence[Any]") -> "Distortion | None":
        """See `ImageStep`."""
        if not all(isinstance(other, Distortion) for other in others):
            return None
        numbers = self.numbers
        for other in others:
            numbers += other.numbers
        return Distortion(numbers)


def _distortion_row(numbers: tuple[Any, ...]) -> list[float]:
    """Parameters of one image for `distort_images`; neutral values where a flag is not set. (8,)"""
    mode, has_brightness, has_contrast, has_saturation, has_hue, has_order = numbers[:6]
    brightness, contrast, saturation, hue, order = numbers[6:]
    contrast_first = mode == 1  # otherwise the contrast changes after the colours
    return [
        brightness if has_brightness else 0.0,
        contrast if has_contrast and contrast_first else 1.0,
        saturation if has_saturation else 1.0,
        hue if has_hue else 0.0,
        contrast if has_contrast and not contrast_first else 1.0,
        *(order if has_order else range(3)),
    ]


def distort_images(images: Tensor, numbers: Tensor) -> Tensor:
    """Apply a photometric distortion with the arithmetic of OpenCV in float32.

    Args:
        images: BGR images, from 0 to 255. (N, 3, H, W)
        numbers: Shift of the brightness; factor of the contrast before the change of colours;
            factor of the saturation; shift of the hue in degrees; factor of the contrast after the
            change of colours; and the input channel of each of the three output channels. (N, 8)

    Returns:
        Distorted images, float32, not clipped to [0, 255]. (N, 3, H, W)
    """
    factors = numbers[:, :5, None, None]
    brightness, early_contrast, saturation, hue, late_contrast = factors.unbind(1)  # (N, 1, 1)
    images = (images.float() + brightness[:, None]) * early_contrast[:, None]
    blue, green, red = images.unbind(1)  # (N, H, W)
    # From BGR to hue, saturation and value (HSV):
    value = images.amax(1)
    spread = value - images.amin(1)
    new_saturation = spread / (value.abs() + _EPSILON) * saturation
    slope = 60.0 / (spread + _EPSILON)
    hue_near_blue = (red - green) * slope + 240.0
    hue_near_green = (blue - red) * slope + 120.0
    hue_near_red = (green - blue) * slope
    hue_not_near_red = torch.where(value == green, hue_near_green, hue_near_blue)
    # If several channels have the largest value, red precedes green, and green precedes blue.
    angle = torch.where(value == red, hue_near_red, hue_not_near_red)
    angle = torch.where(angle < 0, angle + 360.0, angle) + hue  # degrees
    # Back to BGR:
    # Each channel is value - chroma * max(0, min(turn, 4 - turn, 1)) with
    # turn = (angle / 60 + sector) mod 6, where the sector is 1 for blue, 3 for green and 5 for red.
    chroma = value * new_saturation
    channels = []
    for sector in (1.0, 3.0, 5.0):
        turn = (angle / 60.0 + sector) % 6.0
        weight = torch.minimum(turn, 4.0 - turn).clamp(0.0, 1.0)
        channels.append(value - chroma * weight)
    distorted = torch.stack(channels, dim=1) * late_contrast[:, None]
    height, width = images.shape[2:]
    order = numbers[:, 5:].long()[:, :, None, None]  # input channel of each output (N, 3, 1, 1)
    return distorted.gather(1, order.expand(-1, -1, height, width))


@TRANSFORMS.register_module()
class DistortImages(PhotoMetricDistortion3D):
    """Photometric distortion of all images with separate random parameters for each image.

    The random numbers and the results are equal to ``PhotoMetricDistortion3D`` of mmdet3d in a
    ``MultiViewWrapper`` with ``override_aug_config=False``, as in MapTR.

    Args:
        swap_channels: Whether the channels of half of the images are permuted at random.
        kwargs: Further arguments of ``PhotoMetricDistortion3D``.
    """

    _SWAP_FLAG = 5  # index among the parameters of an image

    def __init__(self, swap_channels: bool = True, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.swap_channels = swap_channels

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Distort ``results['img']``, or record the distortion for the GPU."""
        numbers = []
        for _ in results["img"]:
            image_numbers = list(self._random_flags())
            # The flag is cleared after all numbers are drawn, so that later images get equal random
            # numbers with and without the permutation.
            if not self.swap_channels:
                image_numbers[self._SWAP_FLAG] = 0
            numbers.append(tuple(image_numbers))
        take_step(results, Distortion(tuple(numbers)))
        return results
