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
    equal, except for the calibration and the mounting of the cameras.

    Args:
        datasets: Data sets, or their configs.
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
        built = [DATASETS.build(item) if isinstance(item, dict) else item for item in datasets]
        ignored = [ignore_keys] if isinstance(ignore_keys, str) else list(ignore_keys or [])
        ignored += [MOUNT, RIG]
        first = built[0].metainfo
        for number, dataset in enumerate(built[1:], start=2):
            other = dataset.metainfo
            for key in sorted((first.keys() | other.keys()) - set(ignored)):
                if not np.array_equal(first.get(key), other.get(key)):
                    raise InputError(
                        f"data sets 1 and {number} of ConcatDataset differ in {key!r}: "
                        f"{first.get(key)!r:.100} and {other.get(key)!r:.100}: use equal "
                        f"ones, or set ignore_keys=[{key!r}] if one model fits both."
                    )
        super().__init__(built, lazy_init=lazy_init, ignore_keys=ignored)
