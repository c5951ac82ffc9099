"""Data sets one after the other."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from mmdet3d.registry import DATASETS
from mmengine.dataset import BaseDataset, RepeatDataset
from mmengine.dataset import ConcatDataset as PlainConcatDataset

from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset
from gsmap.utils.errors import InputError
from gsmap.utils.model_facts import MOUNT, RIG
from gsmap.utils.words import format_count


@DATASETS.register_module()
class ConcatDataset(PlainConcatDataset):
    """Data sets one after the other, as in mmengine, also of vehicles with different calibrations.

    The metainfo comes from the first data set. Classes, range, frame and all other entries must be
    equal, except for the calibration and the mounting of the cameras. Without ``cameras`` in the
    data sets, the cameras must have equal names in equal order.

    Metrics and result files know a sample by its token. So no two data sets with ``test_mode`` may
    have samples of equal tokens. Training may repeat tokens.

    Args:
        datasets: Data sets or wrappers of data sets, or their configs.
        lazy_init: See ``ConcatDataset`` of mmengine.
        ignore_keys: Names of further entries of the metainfo that may differ.

    Raises:
        ValueError: If other entries of the metainfo differ, or if two data sets for tests have
            samples of equal tokens.
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

    def full_init(self) -> None:
        """Load all data sets, and compare the tokens of the data sets for tests.

        Raises:
            ValueError: If two data sets for tests have samples of equal tokens.
        """
        if not self._fully_initialized:
            super().full_init()
            _require_other_tokens(_tested_datasets(self.datasets))


def _tested_datasets(datasets: Iterable[Any]) -> Iterator[VectorizedMapDataset]:
    """Yield the data sets for tests, also of nested wrappers."""
    for dataset in datasets:
        if isinstance(dataset, PlainConcatDataset):
            yield from _tested_datasets(dataset.datasets)
        elif isinstance(dataset, RepeatDataset):
            yield from _tested_datasets([dataset.dataset])
        elif isinstance(dataset, VectorizedMapDataset) and dataset.test_mode:
            yield dataset


def _require_other_tokens(datasets: Iterable[VectorizedMapDataset]) -> None:
    """Raise a ``ValueError`` if two data sets have samples of equal tokens."""
    file_of: dict[str, str] = {}  # annotation file by token
    for dataset in datasets:
        tokens = dataset.tokens()
        repeated = [token for token in tokens if token in file_of]
        if repeated:
            raise InputError(
                f"{file_of[repeated[0]]} and {dataset.ann_file} both have the sample "
                f"{repeated[0]!r} ({format_count(len(repeated), 'sample')} in all), and a test "
                "counts one sample of each token: give the samples of one file other tokens, such "
                "as with the name of the vehicle, or test the files one by one."
            )
        file_of.update(dict.fromkeys(tokens, str(dataset.ann_file)))


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
