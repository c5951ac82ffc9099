"""Data preprocessor: conversion of packed samples to a batch of inputs of the detector."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from mmdet3d.models.data_preprocessors import Det3DDataPreprocessor
from mmdet3d.registry import MODELS
from mmengine.structures import BaseDataElement
from torch import Tensor

from gsmap.structures.grid import padded_size
from gsmap.structures.tensors import upload


@MODELS.register_module()
class MapDataPreprocessor(Det3DDataPreprocessor):
    """`Det3DDataPreprocessor` of mmdet3d for samples of several cameras.

    It has the arguments and results of the base class. All tensors of a batch are copied to a GPU
    without synchronisation, and the small tensors are copied as one block of memory. Images of
    equal size are converted, normalised and padded as one tensor.
    """

    def cast_data(self, data: Any) -> Any:
        """Copy the tensors of nested data to the device."""
        tensors = _collect_tensors(data)
        device_types = set()
        for tensor in tensors:
            device_types.add(tensor.device.type)
        if self.device.type == "cpu" or "cpu" not in device_types:
            return super().cast_data(data)  # nothing has to be copied from the host to a GPU
        # Copies by the `id` of their originals. `tensors` keeps the originals alive, so that no
        # `id` is used twice.
        replacements = {}
        copies = upload(tensors, device=self.device)
        for tensor, copy in zip(tensors, copies, strict=True):
            replacements[id(tensor)] = copy
        return _replace_tensors(data, replacements)

    def collate_data(self, data: dict[str, Any]) -> dict[str, Any]:
        """Copy a batch to the device and stack its images as ``imgs`` (B, V, 3, H, W)."""
        samples = data.get("data_samples") or ()
        if _have_one_size(data["inputs"].get("img")) and _have_joint_steps(samples):
            data = self.cast_data(data)
            imgs = torch.stack(data["inputs"]["img"])  # (B, V, 3, H, W)
            imgs = self.run_deferred_steps(imgs, samples=samples)
        else:
            if any(sample.metainfo.get("image_steps") for sample in samples):
                data = self._finish_one_by_one(data)
            if not _have_one_size(data["inputs"].get("img")):
                return super().collate_data(data)  # pads each image to the largest one
            imgs = torch.stack(data["inputs"]["img"])
        data["inputs"]["imgs"] = self.normalise(imgs)
        data.setdefault("data_samples", None)
        return data

    def _finish_one_by_one(self, data: dict[str, Any]) -> dict[str, Any]:
        """Copy a batch to the device and run the deferred steps of each sample by itself.

        Raw images of different sizes, as of two rigs, cannot be stacked before these steps. Steps
        that cannot be joined may lead to images of different sizes.
        """
        data = self.cast_data(data)
        images = []  # (V, 3, H', W') each
        for raw_images, sample in zip(data["inputs"]["img"], data["data_samples"], strict=True):
            images.append(self.run_deferred_steps(raw_images[None], samples=[sample])[0].float())
        data["inputs"]["img"] = images
        return data

    @staticmethod
    def run_deferred_steps(images: Tensor, samples: Sequence[Any]) -> Tensor:
        """Run the steps that the pipeline has deferred to the device (`image_steps`).

        Args:
            images: Packed pixels. (B, V, 3, H, W)
            samples: The samples, with the steps in their metainfo.

        Returns:
            Images after all steps. The pipelines of the published systems run these steps on the
            CPU instead, and pack such images. (B, V, 3, H', W')
        """
        return run_image_steps(images, _steps_of(samples))

    def normalise(self, images: Tensor) -> Tensor:
        """Convert images to float32, normalise and pad them. (..., 3, H, W) -> (..., 3, H', W')

        With ``bgr_to_rgb`` or ``rgb_to_bgr``, the order of the channels is reversed first.
        """
        if self._channel_conversion:
            images = images.flip(dims=(-3,))
        images = images.float()
        if self._enable_normalize:
            images = (images - self.mean).div_(self.std)
        height, width = images.shape[-2:]
        # Height and width, rounded up to multiples of the divisor.
        rows, columns = padded_size((height, width), divisor=self.pad_size_divisor)
        if (rows, columns) == (height, width):
            return images
        margins = (0, columns - width, 0, rows - height)  # left, right, top, bottom
        return torch.nn.functional.pad(images, pad=margins, value=self.pad_value)


def _steps_of(samples: Sequence[Any]) -> list[Sequence[Any]]:
    """Deferred steps of each sample, in their order."""
    return [sample.metainfo.get("image_steps") or () for sample in samples]


def _have_joint_steps(samples: Sequence[Any]) -> bool:
    """Whether the samples have no deferred steps, or steps that can be joined."""
    steps = _steps_of(samples)
    return not any(steps) or _join_steps(steps) is not None


def run_image_steps(images: Tensor, steps: Sequence[Sequence[Any]]) -> Tensor:
    """Run deferred steps on the device of the images.

    Args:
        images: Packed pixels. (B, V, 3, H, W)
        steps: Steps of each sample, in their order (`gsmap.datasets.transforms.image_steps`).

    Returns:
        The images, in float32 if there was a step. (B, V, 3, H', W')
    """
    if not any(steps):
        return images
    batch_shape = images.shape[:2]
    batch_steps = _join_steps(steps)
    if batch_steps is None:  # the samples have different steps and are processed one by one
        samples = []
        for index, sample_steps in enumerate(steps):
            sample_images = images[index : index + 1]  # (1, V, 3, H, W)
            samples.append(run_image_steps(sample_images, steps=[sample_steps]))
        return torch.cat(samples)
    images = images.flatten(start_dim=0, end_dim=1)  # (B * V, 3, H, W)
    for step in batch_steps:
        images = step.on_device(images)
    return images.unflatten(dim=0, sizes=batch_shape)


def _join_steps(steps: Sequence[Sequence[Any]]) -> list[Any] | None:
    """Join the steps of all samples to steps of the whole batch.

    Returns:
        Steps of the batch, one for each position in the samples' lists of steps. None if the
        samples differ in the number of steps, or in the kind of step at a position.
    """
    num_steps = len(steps[0])
    for sample_steps in steps:
        if len(sample_steps) != num_steps:
            return None
    batch_steps = []
    for position in range(num_steps):
        first, *others = [sample_steps[position] for sample_steps in steps]
        # `join` returns one step for the images of all samples, or None if the steps differ.
        step = first.join(others)
        if step is None:
            return None
        batch_steps.append(step)
    return batch_steps


def _have_one_size(images: Any) -> bool:
    """Whether images are a list of tensors (V, 3, H, W), one per sample, of one shape and type."""
    if not isinstance(images, Sequence) or not len(images):
        return False
    first = images[0]
    if not isinstance(first, Tensor) or first.dim() != 4 or first.shape[1] != 3:
        return False
    for image in images:
        if not isinstance(image, Tensor):
            return False
        if image.shape != first.shape or image.dtype != first.dtype:
            return False
    return True


def _collect_tensors(data: Any) -> list[Tensor]:
    """List all tensors in nested data."""
    tensors: list[Tensor] = []
    if isinstance(data, Tensor):
        tensors.append(data)
    elif isinstance(data, BaseDataElement | Mapping):
        for _, value in data.items():
            tensors.extend(_collect_tensors(value))
    elif isinstance(data, list | tuple):
        for value in data:
            tensors.extend(_collect_tensors(value))
    return tensors


def _replace_tensors(data: Any, replacements: Mapping[int, Tensor]) -> Any:
    """Copy nested data, and replace each tensor by the entry of ``replacements`` for its ``id``."""
    if isinstance(data, Tensor):
        return replacements[id(data)]
    if isinstance(data, BaseDataElement | Mapping):
        values = {}
        for name, value in data.items():
            values[name] = _replace_tensors(value, replacements)
        return data.new(**values) if isinstance(data, BaseDataElement) else values
    if isinstance(data, list | tuple):
        items = []
        for item in data:
            items.append(_replace_tensors(item, replacements))
        if isinstance(data, list):
            return items
        return type(data)._make(items) if hasattr(data, "_make") else tuple(items)  # NamedTuple
    return data
