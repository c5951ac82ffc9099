"""From what the data pipeline packs to what the detector takes: a whole batch at once."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from mmdet3d.models.data_preprocessors import Det3DDataPreprocessor
from mmdet3d.registry import MODELS
from mmengine.structures import BaseDataElement
from torch import Tensor

from gsmap.structures.grid import padded_size
from gsmap.structures.tensors import uploaded


@MODELS.register_module()
class MapDataPreprocessor(Det3DDataPreprocessor):
    """mmdet3d's `Det3DDataPreprocessor`, whose arguments and results it has, for cameras in a ring.

    What a batch consists of goes to a GPU without a wait for it, ground truths as one block of
    memory. Images of one size are turned to the network's channels, normalised and padded together.
    """

    def cast_data(self, data: Any) -> Any:
        """Return nested data with its tensors on the device."""
        found = list(_tensors(data))
        if self.device.type == "cpu" or not any(each.device.type == "cpu" for each in found):
            return super().cast_data(data)
        moved = uploaded(found, self.device)
        return _replaced(data, {id(old): new for old, new in zip(found, moved, strict=True)})

    def collate_data(self, data: dict[str, Any]) -> dict[str, Any]:
        """Move a batch to the device and make one tensor ``imgs`` (B, V, 3, H, W) of its images."""
        images = data["inputs"].get("img")
        if not _of_one_size(images):  # each on its own, padded to the largest
            return super().collate_data(data)
        data = self.cast_data(data)
        imgs = self.finished(torch.stack(data["inputs"]["img"]), data.get("data_samples") or ())
        data["inputs"]["imgs"] = self.normalised(imgs)
        data.setdefault("data_samples", None)
        return data

    @staticmethod
    def finished(images: Tensor, samples: Sequence[Any]) -> Tensor:
        """Take the steps that the pipeline has noted for the device (`image_steps`).

        Args:
            images: Pixels as they were packed. (B, V, 3, H, W)
            samples: The samples.

        Returns:
            The images that the published pipelines pack. (B, V, 3, H', W')
        """
        steps = [sample.metainfo.get("image_steps") or () for sample in samples]
        return take_noted_steps(images, steps) if any(steps) else images

    def normalised(self, images: Tensor) -> Tensor:
        """Turn pixel values to the network's input. (..., 3, H, W) -> (..., 3, H', W') float32"""
        if self._channel_conversion:
            images = images.flip(-3)
        images = images.float()
        if self._enable_normalize:
            images = (images - self.mean).div_(self.std)
        height, width = images.shape[-2:]
        rows, columns = padded_size((height, width), self.pad_size_divisor)
        if (rows, columns) == (height, width):
            return images
        margins = (0, columns - width, 0, rows - height)
        return torch.nn.functional.pad(images, margins, value=self.pad_value)


def take_noted_steps(images: Tensor, steps: Sequence[Sequence[Any]]) -> Tensor:
    """Take the noted steps of a batch on its device.

    Args:
        images: Pixels as they were packed. (B, V, 3, H, W)
        steps: Steps of each sample, in their order (`gsmap.datasets.transforms.image_steps`).

    Returns:
        The images, in float32 if there was a step. (B, V, 3, H', W')
    """
    if not any(steps):
        return images
    batch = images.shape[:2]
    together = []
    for each in zip(*steps, strict=False):
        step = each[0].joined(each[1:])
        if step is None or len({len(own) for own in steps}) > 1:
            alone = [take_noted_steps(images[i : i + 1], [own]) for i, own in enumerate(steps)]
            return torch.cat(alone)
        together.append(step)
    images = images.flatten(0, 1)
    for step in together:
        images = step.on_device(images)
    return images.unflatten(0, batch)


def _of_one_size(images: Any) -> bool:
    """Return whether images are a list of samples' cameras (V, 3, H, W), all of one shape."""
    if not isinstance(images, Sequence) or not all(isinstance(each, Tensor) for each in images):
        return False
    kinds = {(each.shape, each.dtype) for each in images}
    return len(kinds) == 1 and images[0].dim() == 4 and images[0].shape[1] == 3


def _tensors(data: Any) -> Iterator[Tensor]:
    """Yield all tensors in nested data."""
    if isinstance(data, Tensor):
        yield data
    elif isinstance(data, BaseDataElement | Mapping):
        for _, value in data.items():
            yield from _tensors(value)
    elif isinstance(data, list | tuple):
        for value in data:
            yield from _tensors(value)


def _replaced(data: Any, moved: Mapping[int, Tensor]) -> Any:
    """Return a copy of nested data with other tensors, by the ``id`` of the old ones."""
    if isinstance(data, Tensor):
        return moved[id(data)]
    if isinstance(data, BaseDataElement):
        return data.new(**{name: _replaced(value, moved) for name, value in data.items()})
    if isinstance(data, Mapping):
        return {name: _replaced(value, moved) for name, value in data.items()}
    if isinstance(data, list):
        return [_replaced(value, moved) for value in data]
    if isinstance(data, tuple):
        parts = (_replaced(value, moved) for value in data)
        return type(data)(*parts) if hasattr(data, "_fields") else tuple(parts)
    return data
