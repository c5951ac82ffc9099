"""What is done to all images of a sample: at once on the host, or later on a GPU.

With ``LoadCameraImages(on_device=True)`` images stay as they were decoded, uint8, and transforms
only note their steps (``results['image_steps']``). `MapDataPreprocessor` takes them on its device,
in their order and with the numbers that the transforms drew. The results equal the host's up to
rounding.
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

_EPSILON = float(np.finfo(np.float32).eps)  # what OpenCV adds to a divisor


class ImageStep(Protocol):
    """A step that all images of a sample take."""

    def on_host(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """Images after the step, as the published pipelines compute it. (H, W, 3) each"""

    def on_device(self, images: Tensor) -> Tensor:
        """Images after the step, in float32. (V, 3, H, W)"""

    def joined(self, others: "Sequence[Any]") -> "ImageStep | None":
        """One step for the images of several samples, or None if they differ in kind."""


def take_step(results: dict[str, Any], step: ImageStep) -> None:
    """Let the images of a sample take a step now, or note it for the device.

    Args:
        results: What the pipeline knows of the sample; ``image_steps`` are noted steps.
        step: The step.
    """
    if "image_steps" in results:
        results["image_steps"].append(step)
    else:
        results["img"] = step.on_host(results["img"])


def shape_after_steps(results: dict[str, Any]) -> tuple[int, int]:
    """Rows and columns of the images of a sample after all steps, noted ones included.

    Args:
        results: What the pipeline knows of the sample.
    """
    if results.get("image_steps"):
        return results["img_shape"]
    return results["img"][0].shape[:2]


def finish_on_host(results: dict[str, Any]) -> None:
    """Take all noted steps, in float32, for a transform that reads pixels.

    Args:
        results: What the pipeline knows of the sample; later steps are taken at once.
    """
    if "image_steps" not in results:
        return
    results["img"] = [image.astype(np.float32) for image in results["img"]]
    for step in results.pop("image_steps"):
        results["img"] = step.on_host(results["img"])


FILTERS = ("bilinear", "bicubic")


@dataclass(frozen=True)
class Resize:
    """Resizing.

    Args:
        size: Width and height after it, in pixels.
        rounded: Whether whole grey levels stay whole, as those of uint8 do.
        kernel: Of ``FILTERS``: ``bilinear`` is OpenCV's, which reads four pixels; ``bicubic`` is
            Pillow's, antialiased, whose results are whole grey levels.
    """

    size: tuple[int, int]
    rounded: bool = False
    kernel: str = "bilinear"

    def on_host(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """See `ImageStep`."""
        if self.kernel == "bilinear":
            return [mmcv.imresize(image, self.size) for image in images]
        whole = [np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in images]
        scaled = [
            mmcv.imresize(image, self.size, interpolation="bicubic", backend="pillow")
            for image in whole
        ]
        return [new.astype(old.dtype) for new, old in zip(scaled, images, strict=True)]

    def on_device(self, images: Tensor) -> Tensor:
        """See `ImageStep`."""
        if self.kernel == "bicubic":
            wide = _bicubic(images, (images.shape[2], self.size[0]))  # rows last, as Pillow does
            return _bicubic(wide, self.size[::-1])
        whole = self.rounded and not images.is_floating_point()
        scaled = F.interpolate(
            images.float(), self.size[::-1], mode="bilinear", align_corners=False
        )
        return (scaled + 0.5).to(torch.uint8) if whole else scaled  # a half is rounded up

    def joined(self, others: "Sequence[Any]") -> "Resize | None":
        """See `ImageStep`."""
        return self if all(other == self for other in others) else None


def _bicubic(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize to rows and columns with an antialiased bicubic kernel, to whole grey levels."""
    scaled = F.interpolate(
        images.float(), size, mode="bicubic", align_corners=False, antialias=True
    )
    return (scaled.clamp(0, 255) + 0.5).to(torch.uint8)


@dataclass(frozen=True)
class CropTop:
    """Rows cut off the top.

    Args:
        rows: Their number.
    """

    rows: int

    def on_host(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """See `ImageStep`."""
        return [image[self.rows :] for image in images]

    def on_device(self, images: Tensor) -> Tensor:
        """See `ImageStep`."""
        return images[:, :, self.rows :]

    def joined(self, others: "Sequence[Any]") -> "CropTop | None":
        """See `ImageStep`."""
        return self if all(other == self for other in others) else None


@dataclass(frozen=True)
class Distortion:
    """Photometric distortion of each image by its own numbers, see `DistortImages`.

    Args:
        numbers: Of each image what ``PhotoMetricDistortion3D`` draws: order, five flags,
            brightness, contrast, saturation, hue, order of the channels.
    """

    numbers: tuple[tuple[Any, ...], ...]

    def on_host(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """See `ImageStep`."""
        distort = PhotoMetricDistortion3D().transform
        return [
            distort({"img": image, "photometric_param": numbers})["img"]
            for image, numbers in zip(images, self.numbers, strict=True)
        ]

    def on_device(self, images: Tensor) -> Tensor:
        """See `ImageStep`."""
        table = np.array([_distortion_row(numbers) for numbers in self.numbers], np.float32)
        on_device = torch.from_numpy(table)
        if images.is_cuda:
            on_device = on_device.pin_memory().to(images.device, non_blocking=True)
        return distort_images(images, on_device.to(images.device))

    def joined(self, others: "Sequence[Any]") -> "Distortion | None":
        """See `ImageStep`."""
        if not all(isinstance(other, Distortion) for other in others):
            return None
        return Distortion(sum((other.numbers for other in others), self.numbers))


def _distortion_row(numbers: tuple[Any, ...]) -> list[float]:
    """Return factors and shifts that are neutral where a flag is not set, see `distort_images`."""
    mode, brightens, contrasts, saturates, shifts_hue, swaps = numbers[:6]
    delta, alpha, saturation, hue, order = numbers[6:]
    early, late = (alpha, 1.0) if mode == 1 else (1.0, alpha)
    return [
        delta if brightens else 0.0,
        early if contrasts else 1.0,
        saturation if saturates else 1.0,
        hue if shifts_hue else 0.0,
        late if contrasts else 1.0,
        *(order if swaps else range(3)),
    ]


def distort_images(images: Tensor, numbers: Tensor) -> Tensor:
    """Photometric distortion as OpenCV computes it in float32.

    Args:
        images: Blue, green and red of each image, 0 to 255. (N, 3, H, W)
        numbers: Brightness that is added, early contrast, factor of the saturation, degrees that
            are added to the hue, late contrast, and which channel each of the three becomes. (N, 8)

    Returns:
        The images, not clipped. (N, 3, H, W)
    """
    brightness, early, saturation, hue, late = numbers[:, :5, None, None].unbind(1)  # (N, 1, 1)
    images = (images.float() + brightness[:, None]) * early[:, None]
    blue, green, red = images.unbind(1)  # (N, H, W)
    value = images.amax(1)
    spread = value - images.amin(1)
    share = spread / (value.abs() + _EPSILON) * saturation
    slope = 60.0 / (spread + _EPSILON)
    of_blue = (red - green) * slope + 240.0
    of_green = (blue - red) * slope + 120.0
    of_red = (green - blue) * slope
    angle = torch.where(value == red, of_red, torch.where(value == green, of_green, of_blue))
    angle = torch.where(angle < 0, angle + 360.0, angle) + hue  # degrees
    chroma = value * share
    channels = []
    for sector in (1.0, 3.0, 5.0):  # blue, green, red
        turn = (angle / 60.0 + sector) % 6.0
        channels.append(value - chroma * torch.minimum(turn, 4.0 - turn).clamp(0.0, 1.0))
    distorted = torch.stack(channels, 1) * late[:, None]
    order = numbers[:, 5:].long()[:, :, None, None].expand(-1, -1, *images.shape[2:])
    return distorted.gather(1, order)


@TRANSFORMS.register_module()
class DistortImages(PhotoMetricDistortion3D):
    """Photometric distortion of all images, each by numbers of its own.

    It draws and computes what ``MultiViewWrapper`` of mmdet3d's ``PhotoMetricDistortion3D`` with
    ``override_aug_config=False`` does (MapTR).

    Args:
        swap_channels: Whether half of the images get their channels in a random order.
        kwargs: Further arguments of ``PhotoMetricDistortion3D``.
    """

    _SWAP = 5  # place of the flag among the numbers

    def __init__(self, swap_channels: bool = True, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.swap_channels = swap_channels

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Distort ``results['img']``."""
        numbers = [list(self._random_flags()) for _ in results["img"]]
        if not self.swap_channels:
            for of_image in numbers:
                of_image[self._SWAP] = 0
        take_step(results, Distortion(tuple(map(tuple, numbers))))
        return results
