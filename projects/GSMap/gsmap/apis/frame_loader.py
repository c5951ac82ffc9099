"""Frames for inference: absent cameras are blank, and broken frames set apart."""

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

_LACKS = {errno.EMFILE, errno.ENFILE, errno.ENOMEM}  # open files and memory


@dataclass(frozen=True)
class BrokenFrame:
    """A frame that cannot be used, and why, with the file's name."""

    token: str
    reason: str


@dataclass(eq=False)
class FrameDataset(Dataset):
    """Frames of a test data set, or what is wrong with them.

    Args:
        dataset: The data set; its ``cameras`` say which ones the model expects.
        blank_cameras: Whether a camera that a frame lacks is there, but sees nothing, as long as
            the frame has another one; else the frame is broken.
    """

    dataset: "VectorizedMapDataset"
    blank_cameras: bool

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, row: int) -> dict[str, Any] | BrokenFrame:
        try:
            return self._frame(row)
        except (ValueError, OSError) as error:
            if isinstance(error, OSError) and error.errno in _LACKS:
                raise  # no frame is to blame
            return BrokenFrame(self.dataset.sample(row).token, str(error))

    def _frame(self, row: int) -> dict[str, Any]:
        """Return what the pipeline packs, with the cameras that the model expects."""
        wanted, sample = self.dataset.cameras, self.dataset.sample(row)
        present = {camera.name for camera in sample.cameras}
        absent = [name for name in wanted or () if name not in present]
        if not wanted or not absent:
            return self.dataset[row]
        if not self.blank_cameras or len(absent) == len(wanted):
            raise InputError(
                f"sample {sample.token!r} lacks the cameras {absent}, which the model expects; it "
                f"has {sorted(present)}. With --allow-missing-cameras (allow_missing_cameras=True) "
                "absent ones are left blank, as long as one is there."
            )
        partial = copy.copy(self.dataset)
        partial.cameras = tuple(name for name in wanted if name in present)
        return _with_blank_cameras(partial[row], wanted)


def collate(items: Sequence[dict[str, Any] | BrokenFrame]) -> tuple[Any, list[BrokenFrame]]:
    """Put frames into one batch, None if there is none, and name the broken ones."""
    broken = [item for item in items if isinstance(item, BrokenFrame)]
    good = [item for item in items if not isinstance(item, BrokenFrame)]
    return (pseudo_collate(good) if good else None), broken


def _with_blank_cameras(item: dict[str, Any], wanted: Sequence[str]) -> dict[str, Any]:
    """Return an item with all wanted cameras; ``img_path`` is None for the blank ones."""
    sample = item["data_samples"].clone()
    meta = sample.metainfo
    position = {name: index for index, name in enumerate(meta["cam_names"])}
    order = [position.get(name) for name in wanted]
    images = item["inputs"]["img"]  # (V present, 3, H, W)
    stacked = torch.stack([torch.zeros_like(images[0]) if i is None else images[i] for i in order])
    blank = {"cam2img": meta["cam2img"][0], "img_aug_matrix": meta["img_aug_matrix"][0]}
    blank["lidar2cam"] = OUT_OF_SIGHT
    blank["lidar2img"] = blank["img_aug_matrix"] @ blank["cam2img"] @ OUT_OF_SIGHT
    changed = {
        key: np.stack([value if i is None else meta[key][i] for i in order])
        for key, value in blank.items()
    }
    paths = [None if i is None else meta["img_path"][i] for i in order]
    sample.set_metainfo({**changed, "img_path": paths, "cam_names": list(wanted)})
    return {"inputs": {**item["inputs"], "img": stacked}, "data_samples": sample}
