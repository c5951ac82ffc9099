"""Data sets one after the other."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from mmdet3d.registry import DATASETS
from mmengine.dataset import BaseDataset
from mmengine.dataset import ConcatDataset as PlainConcatDataset

from gsmap.utils.errors import InputError
from gsmap.utils.model_facts import MOUNT, RIG


@DATASETS.register_module()
class ConcatDataset(PlainConcatDataset):
    """Data sets one after the other, as in mmengine, also of vehicles with different calibrations.

    The metainfo comes from the first data set. Classes, range, frame and all other entries must be
    equal, except for the calibration and the mounting of the cameras. Without ``cameras`` in the
    data sets, the cameras must have equal names in equal order.

    Args:
        datasets: Data sets or wrappers of data sets, or their configs.
        lazy_init: See ``ConcatDataset`` of mmengine.
        ignore_keys: Names of further entries of the metainfo that may differ.

    Raises:
        ValueError: If other entries of the metainfo differ.
    """

    def __init__(
        self,
        datasets: Sequence[BaseDataset | dict[str, Any]],
        lazy_init: bool = False,
        ignore_keys: str | list[str] | None = None,
    ) -> None:
        # Not `super().__init__`, which accepts wrappers only as configs and compares calibrations.
        self.datasets = [DATASETS.build(d) if isinstance(d, dict) else d for d in datasets]
        self.ignore_keys = [ignore_keys] if isinstance(ignore_keys, str) else ignore_keys or []
        self._metainfo = self.datasets[0].metainfo
        self._fully_initialized = False
        first = _comparable(self._metainfo)
        for number, dataset in enumerate(self.datasets[1:], start=2):
            other = _comparable(dataset.metainfo)
            for key in sorted((first.keys() | other.keys()) - set(self.ignore_keys)):
                if not _are_equal(first.get(key), other.get(key)):
                    raise InputError(
                        f"data sets 1 and {number} of ConcatDataset differ in {key!r}: "
                        f"{first.get(key)!r:.100} and {other.get(key)!r:.100}: use equal "
                        f"ones, or set ignore_keys=[{key!r}] if one model fits both."
                    )
        if not lazy_init:
            self.full_init()


def _comparable(metainfo: dict[str, Any]) -> dict[str, Any]:
    """Entries that must be equal; the names of all cameras replace the calibration."""
    entries = {key: value for key, value in metainfo.items() if key not in (MOUNT, RIG)}
    if RIG in metainfo and metainfo.get("cameras") is None:
        entries[RIG] = list(metainfo[RIG])
    return entries


def _are_equal(first: Any, other: Any) -> bool:
    """Whether two entries are equal, which may be arrays."""
    if isinstance(first, np.ndarray) or isinstance(other, np.ndarray):
        return np.array_equal(first, other)
    return bool(first == other)
