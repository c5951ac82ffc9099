"""Loading of frames for inference. Absent cameras get blank images; broken frames are listed."""

import copy
import errno
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from mmengine.dataset import pseudo_collate
from torch.utils.data import Dataset

from gsmap.structures.calibration import OUT_OF_SIGHT
from gsmap.utils.errors import InputError

if TYPE_CHECKING:
    from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset

# Error numbers of too many open files in the process or the system, and of too little memory.
_LACK_OF_RESOURCES = {errno.EMFILE, errno.ENFILE, errno.ENOMEM}


@dataclass(frozen=True)
class BrokenFrame:
    """A frame that cannot be used.

    Attributes:
        token: Token of the sample.
        reason: Message of the error, with the name of the file.
    """

    token: str
    reason: str


@dataclass(eq=False)
class FrameDataset(Dataset):
    """Frames of a test data set. A frame that cannot be loaded becomes a `BrokenFrame`.

    A frame is loaded by the pipeline of the data set.

    Args:
        dataset: The data set. Its ``cameras`` are the names of the cameras that the model expects;
            without names, frames are loaded as they are.
        blank_cameras: Whether absent cameras of a frame get black images, if at least one camera is
            present. Otherwise a frame with absent cameras is broken.
    """

    dataset: "VectorizedMapDataset"
    blank_cameras: bool

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, row: int) -> dict[str, Any] | BrokenFrame:
        try:
            return self._load(row)
        except (ValueError, OSError) as error:
            if isinstance(error, OSError) and error.errno in _LACK_OF_RESOURCES:
                raise  # a fault of the machine, not of the frame
            return BrokenFrame(token=self.dataset.sample(row).token, reason=str(error))

    def _load(self, row: int) -> dict[str, Any]:
        """Load a sample by the pipeline, with all cameras that the model expects.

        Args:
            row: Index of the sample.

        Raises:
            ValueError: If cameras are absent and ``blank_cameras`` is False, if all cameras are
                absent, or if the pipeline refuses the sample.
            OSError: If the pipeline cannot read a file.
        """
        cameras = self.dataset.cameras
        sample = self.dataset.sample(row)
        present = {camera.name for camera in sample.cameras}
        absent = [name for name in cameras or () if name not in present]
        if not cameras or not absent:
            return self.dataset[row]  # applies the pipeline
        if not self.blank_cameras or len(absent) == len(cameras):
            raise InputError(
                f"sample {sample.token!r} lacks the cameras {absent}, which the model expects; it "
                f"has {sorted(present)}. With --allow-missing-cameras (allow_missing_cameras=True) "
                "absent cameras are left blank if at least one camera is present."
            )
        # The pipeline loads exactly the `cameras` of its data set. Only a shallow copy is changed,
        # so that the data set itself keeps all cameras for the other frames.
        partial_dataset = copy.copy(self.dataset)
        partial_dataset.cameras = tuple(name for name in cameras if name in present)
        return _add_blank_cameras(partial_dataset[row], cameras=cameras)


def collate(items: Sequence[dict[str, Any] | BrokenFrame]) -> tuple[Any, list[BrokenFrame]]:
    """Collate frames to a batch.

    Args:
        items: Frames of a `FrameDataset`.

    Returns:
        The batch of the usable frames, as mmengine's ``pseudo_collate`` makes it (lists of inputs
        and of samples, which are not stacked), and the broken frames. The batch is None if no frame
        is usable.
    """
    broken: list[BrokenFrame] = []
    usable: list[dict[str, Any]] = []
    for item in items:
        if isinstance(item, BrokenFrame):
            broken.append(item)
        else:
            usable.append(item)
    batch = pseudo_collate(usable) if usable else None
    return batch, broken


def _add_blank_cameras(item: dict[str, Any], cameras: Sequence[str]) -> dict[str, Any]:
    """Add black images for the absent cameras of a loaded sample.

    Args:
        item: ``inputs`` and ``data_samples`` of the pipeline, for the present cameras. Images have
            shape (V present, 3, H, W).
        cameras: Names of all cameras, in the order of the result.

    Returns:
        The item with images (V, 3, H, W) and matrices (V, 4, 4) of all cameras. ``img_path`` is
        None for an absent camera.
    """
    sample = item["data_samples"].clone()
    meta = sample.metainfo
    images = item["inputs"]["img"]
    intrinsics = meta["cam2img"][0]
    augmentation = meta["img_aug_matrix"][0]
    # An absent camera has the intrinsics and the augmentation of the first present camera, and a
    # pose (`OUT_OF_SIGHT`) from which the whole map lies behind the camera.
    blank_matrices = {
        "cam2img": intrinsics,
        "img_aug_matrix": augmentation,
        "lidar2cam": OUT_OF_SIGHT,
        "lidar2img": augmentation @ intrinsics @ OUT_OF_SIGHT,
    }
    index_of_name = {name: index for index, name in enumerate(meta["cam_names"])}
    indices = [index_of_name.get(name) for name in cameras]  # None for an absent camera
    all_images: list[torch.Tensor] = []
    all_paths: list[Any] = []
    for index in indices:
        if index is None:
            all_images.append(torch.zeros_like(images[0]))
            all_paths.append(None)
        else:
            all_images.append(images[index])
            all_paths.append(meta["img_path"][index])
    metainfo: dict[str, Any] = {"img_path": all_paths, "cam_names": list(cameras)}
    for key, blank_matrix in blank_matrices.items():
        matrices: list[np.ndarray] = []
        for index in indices:
            matrix = blank_matrix if index is None else meta[key][index]
            matrices.append(matrix)
        metainfo[key] = np.stack(matrices)
    sample.set_metainfo(metainfo)
    inputs = {**item["inputs"], "img": torch.stack(all_images)}
    return {"inputs": inputs, "data_samples": sample}
