"""Samples that lack a camera, for models that are built for a fixed rig."""

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset

# A camera 1 km ahead of the vehicle that looks further ahead: everything in range is behind it, and
# its frustum lies out of range. So both ways of making BEV features get nothing from it.
_OUT_OF_SIGHT = np.array(
    [[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, -1000.0], [0, 0, 0, 1.0]]
)  # cam_from_frame


def with_blank_cameras(item: dict[str, Any], wanted: Sequence[str]) -> dict[str, Any]:
    """Insert blank images for absent cameras into what a pipeline has packed.

    Args:
        item: ``inputs`` and ``data_samples`` of a sample with at least one camera; not changed.
        wanted: Names of all cameras, in the order that the model expects.

    Returns:
        The item with V = len(wanted) cameras; ``img_path`` is None for the blank ones.
    """
    sample = item["data_samples"].clone()
    meta = sample.metainfo
    position = {name: index for index, name in enumerate(meta["cam_names"])}
    order = [position.get(name) for name in wanted]
    images = item["inputs"]["img"]  # (V present, 3, H, W)
    stacked = torch.stack([torch.zeros_like(images[0]) if i is None else images[i] for i in order])
    blank = {"cam2img": meta["cam2img"][0], "img_aug_matrix": meta["img_aug_matrix"][0]}
    blank["lidar2cam"] = _OUT_OF_SIGHT
    blank["lidar2img"] = blank["img_aug_matrix"] @ blank["cam2img"] @ _OUT_OF_SIGHT
    changed = {
        key: np.stack([value if i is None else meta[key][i] for i in order])
        for key, value in blank.items()
    }
    paths = [None if i is None else meta["img_path"][i] for i in order]
    sample.set_metainfo({**changed, "img_path": paths, "cam_names": list(wanted)})
    return {"inputs": {**item["inputs"], "img": stacked}, "data_samples": sample}


class BlankCameraDataset(Dataset):
    """A test data set in which absent cameras are there, but see nothing.

    Args:
        dataset: The data set; its ``cameras`` say which ones the model expects.
        allowed: Whether a camera may be absent at all.

    Raises:
        ValueError: On reading a sample that lacks a camera, unless that is allowed.
    """

    def __init__(self, dataset: VectorizedMapDataset, allowed: bool):
        self.dataset = dataset
        self.allowed = allowed

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> dict[str, Any]:
        wanted = self.dataset.cameras
        sample = self.dataset.sample(index)
        present = {camera.name for camera in sample.cameras}
        if wanted is None or present.issuperset(wanted):
            return self.dataset[index]
        absent = [name for name in wanted if name not in present]
        if not self.allowed or len(absent) == len(wanted):
            raise ValueError(
                f"sample {sample.token!r} lacks the cameras {absent}, which the model expects; it "
                f"has {sorted(present)}. With --allow-missing-cameras (allow_missing_cameras=True) "
                "absent ones are left blank, as long as one is there."
            )
        partial = copy.copy(self.dataset)
        partial.cameras = tuple(name for name in wanted if name in present)
        return with_blank_cameras(partial[index], wanted)
