"""The data set: samples of an annotation file, with their images, for training and testing."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mmdet3d.registry import DATASETS
from mmengine.dataset import BaseDataset, Compose
from mmengine.logging import MMLogger, print_log

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import CAN_BUS_SIZE, LidarRecord, MapSample
from gsmap.datasets.errors import BrokenSampleError
from gsmap.structures.grid import BEVGrid

_BROKEN = ("raise", "skip")


def _homogeneous(intrinsics: np.ndarray) -> np.ndarray:
    """Embed a pinhole matrix (3, 3) into a (4, 4) one."""
    matrix = np.eye(4)
    matrix[:3, :3] = intrinsics
    return matrix


def _selection(indices: int | Sequence[int]) -> slice | list[int]:
    """Return what picks the first samples (an integer) or the listed ones."""
    return slice(indices) if isinstance(indices, int) else list(indices)


@DATASETS.register_module()
class VectorizedMapDataset(BaseDataset):
    """Samples with their map elements, read from a memory-mapped annotation file.

    Nothing is made or cached on the way: ``tools/create_data.py`` makes the file once, and a file
    made for another range, class list, split or frame is refused.

    Args:
        ann_file: Annotation file; relative to ``data_root`` unless absolute.
        data_root: Folder that image and LiDAR paths are relative to.
        pipeline: Transforms.
        classes: Class names that the file must have, in label order; None takes the file's.
        grid: ``x_range`` and ``y_range`` in metres, which the file must have (further keys are the
            model's affair); None takes the file's.
        split: Split that the file must hold; None takes any.
        frame: ``lidar`` or ``ego``, which the file must have; None takes any.
        cameras: Names of the cameras to use, in order; None takes all of each sample.
        test_mode: Whether every sample is delivered, in order, ground truth or not.
        filter_empty_gt: Whether training leaves out samples without any map element.
        shuffle_images_seed: If given, each sample gets the images of another one, drawn with this
            seed: what a model then still scores, it does not see in the images.
        broken_samples: ``raise`` stops at a sample with a missing or damaged file; ``skip`` takes
            another one in its place, and counts and logs it (in training only).
        indices: Number of first samples, or list of samples, to use.
        lazy_init: Whether to open the file later, with ``full_init``.
        max_refetch: How many samples in a row may be skipped.

    Raises:
        FileNotFoundError: If there is no annotation file.
        ValueError: If it does not fit, or an option is out of its domain.
    """

    def __init__(
        self,
        ann_file: str,
        data_root: str = "",
        pipeline: Sequence[dict | Callable[..., Any]] = (),
        classes: Sequence[str] | None = None,
        grid: dict[str, Any] | None = None,
        split: str | None = None,
        frame: str | None = None,
        cameras: Sequence[str] | None = None,
        test_mode: bool = False,
        filter_empty_gt: bool = True,
        shuffle_images_seed: int | None = None,
        broken_samples: str = "raise",
        indices: int | Sequence[int] | None = None,
        lazy_init: bool = False,
        max_refetch: int = 100,
    ) -> None:
        if broken_samples not in _BROKEN:
            raise ValueError(f"broken_samples must be one of {_BROKEN}, got {broken_samples!r}.")
        if broken_samples == "skip" and test_mode:
            raise ValueError("broken_samples='skip' is for training: a test must see every sample.")
        extent = None if grid is None else BEVGrid(**grid)
        self.ann_file = str(Path(data_root, ann_file))
        self.data_root = str(data_root)
        self.cameras = None if cameras is None else tuple(cameras)
        self.test_mode = test_mode
        self.max_refetch = max_refetch
        self.broken_samples = broken_samples
        self.broken_tokens: dict[str, str] = {}
        self._expected = {
            "classes": None if classes is None else tuple(classes),
            "x_range": None if extent is None else extent.x_range,
            "y_range": None if extent is None else extent.y_range,
            "split": split,
            "frame": frame,
        }
        self._filter_empty_gt = filter_empty_gt and not test_mode
        self._shuffle_images_seed = shuffle_images_seed
        self._indices = indices
        self._metainfo: dict[str, Any] = {}
        self.pipeline = Compose(pipeline)
        self._fully_initialized = False
        if not lazy_init:
            self.full_init()

    def full_init(self) -> None:
        """Open the annotation file, check it, and choose the samples."""
        if self._fully_initialized:
            return
        self.annotations = AnnotationFile(self.ann_file)
        self.annotations.require(**self._expected)
        meta = self.annotations.meta
        self._metainfo = {
            "classes": meta.classes,
            "x_range": meta.x_range,
            "y_range": meta.y_range,
            "dataset": meta.dataset,
            "split": meta.split,
            "frame": meta.frame,
        }
        self._rows = np.arange(len(self.annotations))
        if self._indices is not None:
            self._rows = self._rows[_selection(self._indices)]
        self._filter_empty()
        if not len(self._rows):
            raise ValueError(f"{self.ann_file} has no sample to use (of {len(self.annotations)}).")
        self._image_rows = self._shuffled_rows()
        self._fully_initialized = True

    def _filter_empty(self) -> None:
        if not self._filter_empty_gt:
            return
        counts = self.annotations.instance_counts()[self._rows]
        if (counts < 0).any():
            raise ValueError(
                f"{(counts < 0).sum()} samples of {self.ann_file} have no ground truth, so it "
                "cannot be trained on."
            )
        if (counts == 0).any():
            empty = int((counts == 0).sum())
            print_log(
                f"{self.ann_file}: {empty} samples without any map element are left out.", "current"
            )
            self._rows = self._rows[counts > 0]

    def _shuffled_rows(self) -> np.ndarray:
        """Return the row whose images each sample gets; no sample keeps its own. (samples,)."""
        rows = self._rows
        if self._shuffle_images_seed is None:
            return rows
        order = np.random.default_rng(self._shuffle_images_seed).permutation(len(rows))
        donors = np.empty_like(rows)
        donors[order] = rows[np.roll(order, 1)]
        return donors

    @property
    def metainfo(self) -> dict[str, Any]:
        """Classes, range and name of the data; a copy."""
        return dict(self._metainfo)

    def __len__(self) -> int:
        self.full_init()
        return len(self._rows)

    def get_subset_(self, indices: int | Sequence[int]) -> None:
        """Keep the first samples (an integer) or the listed ones."""
        self.full_init()
        chosen = _selection(indices)
        self._rows, self._image_rows = self._rows[chosen], self._image_rows[chosen]

    def sample(self, idx: int) -> MapSample:
        """Return a sample as the annotation file has it."""
        self.full_init()
        return self.annotations[int(self._rows[idx])]

    def get_data_info(self, idx: int) -> dict[str, Any]:
        """Return a sample as the pipeline takes it.

        Args:
            idx: Index of the sample.

        Returns:
            Keys of mmdet3d's multi-view pipelines (``images``, ``lidar_points``, ``lidar_sweeps``,
            ``timestamp``), the keys of the packed metainfo, and ``map_instances``: the elements at
            full resolution, or None.

        Raises:
            BrokenSampleError: If a camera that the config asks for is absent.
        """
        sample = self.sample(idx)
        info: dict[str, Any] = {
            "sample_idx": idx,
            "token": sample.token,
            "scene": sample.scene,
            "map_name": sample.map_name,
            "timestamp_ns": sample.timestamp_ns,
            "timestamp": sample.timestamp_ns / 1e9,
            "lidar2global": sample.global_from_frame,
            "lidar2ego": sample.ego_from_frame,
            "can_bus": self._can_bus(sample),
            "x_range": self._metainfo["x_range"],
            "y_range": self._metainfo["y_range"],
            "images": self._images(sample, idx),
            "map_instances": sample.instances,
            "eval_ann_info": None,
        }
        info["cam_names"] = list(info["images"])
        if sample.instances is not None:
            info["eval_ann_info"] = {
                "polylines": [instance.points[:, :2] for instance in sample.instances],
                "labels": np.array([instance.label for instance in sample.instances], np.int64),
            }
        if sample.lidar is not None:
            info.update(self._lidar(sample.lidar))
        return info

    def _can_bus(self, sample: MapSample) -> np.ndarray:
        """Return the signals as MapTR sees a single frame: position and yaw change 0. (18,)."""
        signals = np.zeros(CAN_BUS_SIZE)
        if sample.can_bus is not None:
            signals[3:17] = sample.can_bus[3:17]
        return signals

    def _images(self, sample: MapSample, idx: int) -> dict[str, dict[str, Any]]:
        """Return path and calibration of each camera; paths may come from another sample."""
        cameras = {camera.name: camera for camera in sample.cameras}
        names = tuple(cameras) if self.cameras is None else self.cameras
        paths = {camera.name: camera.path for camera in sample.cameras}
        if self._image_rows[idx] != self._rows[idx]:
            donor = self.annotations[int(self._image_rows[idx])]
            paths = {camera.name: camera.path for camera in donor.cameras}
        for name in names:
            if name not in cameras or name not in paths:
                raise BrokenSampleError(
                    f"sample {sample.token!r} has no camera {name!r}, only {list(cameras)}: name "
                    "the cameras that all samples have (`cameras=[...]`), or train with "
                    "broken_samples='skip'."
                )
        return {
            name: {
                "img_path": str(Path(self.data_root, paths[name])),
                "cam2img": _homogeneous(cameras[name].intrinsics),
                "lidar2cam": cameras[name].cam_from_frame,
            }
            for name in names
        }

    def _lidar(self, lidar: LidarRecord) -> dict[str, Any]:
        """Return LiDAR paths in the form that mmdet3d's point transforms read."""
        sweeps = []
        for sweep in lidar.sweeps:
            # mmdet3d computes points @ R - t with R, t out of "lidar2sensor"
            matrix = np.eye(4)
            matrix[:3, :3] = sweep.frame_from_lidar[:3, :3].T
            matrix[:3, 3] = -sweep.frame_from_lidar[:3, 3]
            path = str(Path(self.data_root, sweep.path))
            points = {"lidar_path": path, "lidar2sensor": matrix}
            sweeps.append({"lidar_points": points, "timestamp": sweep.timestamp_ns / 1e9})
        return {
            "lidar_points": {"lidar_path": str(Path(self.data_root, lidar.path))},
            "lidar2frame": lidar.frame_from_lidar,
            "lidar_sweeps": sweeps,
        }

    def prepare_data(self, idx: int) -> Any:
        """Run the pipeline on a sample.

        Args:
            idx: Index of the sample.

        Returns:
            What the pipeline gives, or None if the sample is broken and may be skipped.

        Raises:
            BrokenSampleError: If a file is missing or damaged and ``broken_samples`` is ``raise``.
        """
        try:
            return self.pipeline(self.get_data_info(idx))
        except BrokenSampleError as error:
            if self.broken_samples == "raise":
                raise
            self._count_broken(self.sample(idx).token, str(error))
            return None

    def _count_broken(self, token: str, reason: str) -> None:
        if token not in self.broken_tokens:
            self.broken_tokens[token] = reason
            count = len(self.broken_tokens)
            MMLogger.get_current_instance().warning(
                f"broken sample skipped ({count} so far): {reason}"
            )

    def __getitem__(self, idx: int) -> Any:
        self.full_init()
        if self.test_mode:
            return self.prepare_data(idx)
        for _ in range(self.max_refetch + 1):
            data = self.prepare_data(idx)
            if data is not None:
                return data
            idx = int(np.random.randint(len(self)))  # noqa: NPY002 - mmengine seeds this generator in each worker
        raise RuntimeError(
            f"{self.max_refetch + 1} samples in a row are broken; the latest: "
            f"{next(reversed(self.broken_tokens.values()), 'the pipeline gave None')}"
        )
