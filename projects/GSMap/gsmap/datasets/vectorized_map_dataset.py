"""The data set: samples of an annotation file, with their images, for training and testing."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mmdet3d.registry import DATASETS
from mmengine.dataset import BaseDataset
from mmengine.logging import MMLogger, print_log

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import LidarRecord, MapInstance, MapSample
from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.source import ground_from_frame
from gsmap.datasets.transforms.images import ScaleImages
from gsmap.structures.calibration import NUM_CAN_BUS, without_history
from gsmap.structures.grid import BEVGrid
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.structures.streams import Frame
from gsmap.utils.errors import InputError, WorkError
from gsmap.utils.model_facts import MOUNT, RIG
from gsmap.utils.split_lists import SPLIT_LIST

_BROKEN = ("raise", "skip")
_OF_FILE = (
    "classes", "x_range", "y_range", "dataset", "split", "frame", "ground_z_m", SPLIT_LIST,
)  # fmt: skip
_NEIGHBOUR_S = 5.0  # how far the next pose of a drive may be for its speed


@DATASETS.register_module()
class VectorizedMapDataset(BaseDataset):
    """Samples with their map elements, read from a memory-mapped annotation file.

    ``tools/create_data.py`` makes the file; one for another range, class list, split or frame is
    refused.

    Args:
        ann_file: Annotation file; relative to ``data_root`` unless absolute.
        data_root: Folder that image and LiDAR paths are relative to.
        pipeline: Transforms.
        classes: Class names that the file must have, in label order; None takes the file's.
        grid: ``x_range`` and ``y_range`` in metres, which the file must have (further keys are the
            model's affair); None takes the file's.
        split: Split that the file must hold; None takes any.
        frame: ``lidar`` or ``ego``, which the file must have; None takes any.
        dim: Coordinates per point of the ground truth, 2 or 3; None takes the file's. A file with
            heights also serves 2, which drops them; one without is refused for 3.
        rate_hz: Samples per second of a drive that the file must have; None takes any.
        crossings: Rule of the crossings that the file must follow (``--crossings`` of
            ``tools/create_data.py nuscenes``); None takes any.
        cameras: Names of the cameras to use, in order; None takes all of each sample.
        test_mode: Whether every sample is delivered, in order, ground truth or not.
        filter_empty_gt: Whether training leaves out samples without any map element.
        shuffle_images_seed: If given, each sample gets the images of another one, drawn with this
            seed: what a model then still scores, it does not see in the images.
        signals_from_poses: Whether vehicle signals (``can_bus``) of samples that have none are
            computed from the poses of the drive; otherwise they are zero.
        pose_only_signals: Whether vehicle signals are those that MapTR's code for Argoverse 2 makes
            of the pose (`vehicle_signals.pose_only_signals`), whatever a sample has.
        ground_z_m: Height of the road in the frame, as in ``AnnotationMeta``, for files that do not
            have it; that of others must be the same.
        broken_samples: ``raise`` stops at a sample with a missing or damaged file; ``skip`` takes
            another one in its place, and counts and logs it (in training only).
        max_refetch: How many samples in a row may be skipped.
        indices: Of the samples that are left, the first N, the last -N, or the listed ones.
        lazy_init: As in mmengine's ``BaseDataset``.
        serialize_data: As in mmengine's ``BaseDataset``.

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
        dim: int | None = 2,
        rate_hz: float | None = None,
        crossings: str | None = None,
        cameras: Sequence[str] | None = None,
        test_mode: bool = False,
        filter_empty_gt: bool = True,
        shuffle_images_seed: int | None = None,
        signals_from_poses: bool = False,
        pose_only_signals: bool = False,
        ground_z_m: float | None = None,
        broken_samples: str = "raise",
        max_refetch: int = 100,
        indices: int | Sequence[int] | None = None,
        lazy_init: bool = False,
        serialize_data: bool = True,
    ) -> None:
        if broken_samples not in _BROKEN:
            raise InputError(f"broken_samples must be one of {_BROKEN}, got {broken_samples!r}.")
        if dim not in (None, 2, 3):
            raise InputError(f"dim must be 2, 3 or None, got {dim!r}.")
        if broken_samples == "skip" and test_mode:
            raise InputError("broken_samples='skip' is for training: a test must see every sample.")
        if indices is not None and not indices:
            raise InputError(f"indices must leave at least one sample, got {indices!r}.")
        extent = None if grid is None else BEVGrid(**grid)
        self.cameras = None if cameras is None else tuple(cameras)
        self.broken_samples = broken_samples
        self.broken_tokens: dict[str, str] = {}
        self.images_in_memory: Mapping[str, np.ndarray] = {}  # BGR, by camera, in place of files
        self.can_bus_in_memory: np.ndarray | None = None  # (18,), in place of a sample's
        self.frame_in_memory: Frame | None = None  # token, scene, time and pose in place of its own
        self._broken_in_a_row = 0
        self._expected = {
            "classes": None if classes is None else tuple(classes),
            "x_range": extent and extent.x_range,
            "y_range": extent and extent.y_range,
            "split": split,
            "frame": frame,
            "dim": 3 if dim == 3 else None,
            "crossings": crossings,
        }
        self._dim = dim
        self._rate_hz = rate_hz
        self._filter_empty_gt = filter_empty_gt and not test_mode
        self._shuffle_images_seed = shuffle_images_seed
        self._signals_from_poses = signals_from_poses
        self._pose_only_signals = pose_only_signals
        self._ground_z_m = ground_z_m
        super().__init__(
            ann_file,
            data_root=str(data_root),
            pipeline=list(pipeline),
            test_mode=test_mode,
            max_refetch=max_refetch,
            indices=indices,
            lazy_init=lazy_init,
            serialize_data=serialize_data,
        )

    def load_data_list(self) -> list[dict[str, int]]:
        """Open the annotation file, check it, and list its rows."""
        self.annotations = AnnotationFile(self.ann_file)
        self.annotations.require(**self._expected)
        if self._rate_hz is not None:
            self.annotations.require_rate(self._rate_hz)
        if not self.annotations.sealed:
            print_log(
                f"{self.ann_file} is of an earlier version and has no checksum: damage to it may "
                f"go unnoticed until you {self.annotations.remedy}",
                "current",
            )
        for name in _OF_FILE:
            self._metainfo[name] = getattr(self.annotations.meta, name)
        self._metainfo["ground_z_m"] = self._height()
        self._metainfo[MOUNT] = self._mount()
        self._metainfo["dim"] = self._dim or self.annotations.meta.dim
        self._metainfo["cameras"] = self.cameras
        self._metainfo[RIG] = self._rig()
        return [{"row": row, "image_row": row} for row in range(len(self.annotations))]

    def _mount(self) -> list[list[float]] | None:
        """Return where the first sample's frame lies over the ground, if that is known. (4, 4)"""
        frame = self._metainfo["frame"]
        height_m = self._metainfo["ground_z_m"]
        if not len(self.annotations):
            return None
        sample = self.annotations[0]
        known = height_m is not None or (frame == "lidar" and sample.ego_from_frame is not None)
        return ground_from_frame(sample, frame, height_m).tolist() if known else None

    def _rig(self) -> dict[str, list[float]]:
        """Return size and focal lengths of the first sample's images, by camera, in pixels."""
        cameras = self.annotations[0].cameras if len(self.annotations) else []
        return {
            c.name: [
                float(v) for v in (c.width, c.height, *c.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]])
            ]
            for c in cameras
            if self.cameras is None or c.name in self.cameras
        }

    def _height(self) -> float | None:
        """Return the height of the road in the frame: the file's, or the config's if it has none.

        Raises:
            ValueError: If both have one, and they differ.
        """
        of_file = self.annotations.meta.ground_z_m
        of_config = self._ground_z_m
        if of_file is not None and of_config is not None and abs(of_file - of_config) > 1e-6:
            raise InputError(
                f"{self.ann_file} has the road at z = {of_file:g} m of its frame, the config at "
                f"{of_config:g} m (ground_z_m): set both to one height."
            )
        return self._ground_z_m if of_file is None else of_file

    def filter_data(self) -> list[dict[str, int]]:
        """Leave out samples without elements, and shuffle images, where that is asked for."""
        rows = np.array([entry["row"] for entry in self.data_list], np.int64)
        if self._filter_empty_gt:
            counts = self.annotations.instance_counts()[rows]
            if (counts < 0).any():
                raise InputError(
                    f"{(counts < 0).sum()} samples of {self.ann_file} have no ground truth, so it "
                    "cannot be trained on."
                )
            if empty := int((counts == 0).sum()):
                text = f"{self.ann_file}: {empty} samples without any map element are left out."
                print_log(text, "current")
            rows = rows[counts > 0]
        if not len(rows):
            raise InputError(f"{self.ann_file} has no sample to use (of {len(self.annotations)}).")
        donors = rows
        if self._shuffle_images_seed is not None:  # no sample keeps its own
            order = np.random.default_rng(self._shuffle_images_seed).permutation(len(rows))
            donors = np.empty_like(rows)
            donors[order] = rows[np.roll(order, 1)]
        pairs = zip(rows.tolist(), donors.tolist(), strict=True)
        return [{"row": row, "image_row": donor} for row, donor in pairs]

    def _copy_without_annotation(self, memo: dict[int, Any] | None = None) -> BaseDataset:
        """Copy with a memo of its own: mmengine's is shared by all calls and mixes objects up."""
        return super()._copy_without_annotation({} if memo is None else memo)

    def sample(self, idx: int) -> MapSample:
        """Return a sample as the annotation file has it."""
        row = super().get_data_info(idx)["row"]  # opens the file, if that is yet to be done
        return self.annotations[row]

    def scenes(self) -> list[list[int]]:
        """Return the samples of each scene, sorted by its name, in the order of their times."""
        self.full_init()
        names, times = (self.annotations.column(name) for name in ("scene", "timestamp_ns"))
        found: dict[str, list[tuple[int, int]]] = {}
        for index in range(len(self)):
            row = super().get_data_info(index)["row"]
            found.setdefault(names[row], []).append((times[row], index))
        return [[index for _, index in sorted(found[name])] for name in sorted(found)]

    def scaled_image_size(self) -> tuple[int, int]:
        """Return width and height that the first sample's images are scaled to, in pixels."""
        cameras = [c for c in self.sample(0).cameras if c.name in (self.cameras or [c.name])]
        size = max(c.width for c in cameras), max(c.height for c in cameras)
        for step in self.pipeline.transforms:
            size = step.scaled(*size) if isinstance(step, ScaleImages) else size
        return size

    def get_cat_ids(self, idx: int) -> list[int]:
        """Return the labels of a sample's elements, for mmengine's ``ClassBalancedDataset``."""
        return [instance.label for instance in self.sample(idx).instances or []]

    def get_data_info(self, idx: int) -> dict[str, Any]:
        """Return a sample as the pipeline takes it; BrokenSampleError if a camera is absent.

        It has the keys of mmdet3d's multi-view pipelines (``images``, ``lidar_points``,
        ``lidar_sweeps``, ``timestamp``), those of the packed metainfo, ``dim`` and
        ``map_instances``: the elements at full resolution with ``dim`` coordinates per point.
        ``map_heights`` has the heights of their points (n,), if the file has any.
        """
        entry = super().get_data_info(idx)
        sample = self.annotations[entry["row"]]
        dim = self._metainfo["dim"]
        instances = sample.instances
        heights = None
        if instances is not None and self.annotations.meta.dim == 3:
            heights = [instance.points[:, 2] for instance in instances]
        if instances is not None:
            instances = [MapInstance(i.label, i.points[:, :dim]) for i in instances]
        info: dict[str, Any] = {
            "sample_idx": entry["sample_idx"],
            **{key: getattr(sample, key) for key in ("token", "scene", "map_name", "timestamp_ns")},
            **{key: self._metainfo[key] for key in ("x_range", "y_range", "dim")},
            "seconds": self.annotations.seconds_into_scene[entry["row"]],
            "timestamp": sample.timestamp_ns / 1e9,
            "lidar2global": sample.global_from_frame if self._has_poses else None,
            "lidar2ego": sample.ego_from_frame,
            "can_bus": self._vehicle_signals(sample, entry["row"]),
            "images": self._images(sample, entry),
            "map_instances": instances,
            "map_heights": heights,
            "eval_ann_info": None,
        }
        info["cam_names"] = list(info["images"])
        if instances is not None:
            info["eval_ann_info"] = {
                "polylines": [instance.points for instance in instances],
                "labels": np.array([instance.label for instance in instances], np.int64),
            }
        if sample.lidar is not None:
            info.update(self._lidar(sample.lidar))
        if self.frame_in_memory is not None:
            frame = self.frame_in_memory
            info.update({key: getattr(frame, key) for key in ("token", "scene", "timestamp_ns")})
            info.update(timestamp=frame.timestamp_ns / 1e9, lidar2global=frame.pose)
        return info

    @property
    def _has_poses(self) -> bool:
        """Whether the samples' poses are known."""
        return bool(self.annotations.meta.options.get("poses", True))

    def _vehicle_signals(self, sample: MapSample, row: int) -> np.ndarray:
        """Return ``can_bus`` without history; of poses, or zero, where a sample has none. (18,)"""
        signals = sample.can_bus if self.can_bus_in_memory is None else self.can_bus_in_memory
        if self._pose_only_signals and self.can_bus_in_memory is None:
            from gsmap.structures.vehicle_signals import pose_only_signals

            ego_from_frame = sample.ego_from_frame
            pose_of_ego = sample.global_from_frame
            if ego_from_frame is not None:
                pose_of_ego = pose_of_ego @ invert_rigid(ego_from_frame)
            return without_history(pose_only_signals(pose_of_ego))
        if signals is not None:
            return without_history(signals)
        if not self._signals_from_poses or not self._has_poses:
            return np.zeros(NUM_CAN_BUS)
        from gsmap.structures.vehicle_signals import motion_signals

        def pose(other: MapSample) -> tuple[float, np.ndarray]:
            seconds = (other.timestamp_ns - sample.timestamp_ns) / 1e9
            frame = self._metainfo["frame"]
            height_m = self._metainfo["ground_z_m"]
            ground = ground_from_frame(other, frame, height_m)
            return seconds, other.global_from_frame @ invert_rigid(ground)

        places = [i for i in (row - 1, row + 1) if 0 <= i < len(self.annotations)]
        beside = [o for o in map(self.annotations.__getitem__, places) if o.scene == sample.scene]
        poses = [p for p in map(pose, beside) if 0 < abs(p[0]) <= _NEIGHBOUR_S]
        before, after = (next((p for p in poses if p[0] * s > 0), None) for s in (-1, 1))
        return without_history(motion_signals(pose(sample), before, after))

    def has_signals(self) -> bool:
        """Return whether samples have vehicle signals that are not computed from several poses."""
        return self._pose_only_signals or self.sample(0).can_bus is not None

    def _images(self, sample: MapSample, entry: dict[str, int]) -> dict[str, dict[str, Any]]:
        """Return path and calibration of each camera; paths may come from another sample."""
        donor = sample
        if entry["image_row"] != entry["row"]:
            donor = self.annotations[entry["image_row"]]
        cameras, images = ({c.name: c for c in s.cameras} for s in (sample, donor))
        found = {}
        for name in tuple(cameras) if self.cameras is None else self.cameras:
            if name not in cameras or name not in images:
                raise BrokenSampleError(
                    f"sample {sample.token!r} has no camera {name!r}, only {list(cameras)}: name "
                    "the cameras that all samples have (`cameras=[...]`), or train with "
                    "broken_samples='skip'."
                )
            image = images[name]
            cam2img = np.eye(4)
            cam2img[:3, :3] = cameras[name].intrinsics
            found[name] = {
                "img_path": self.images_in_memory.get(name, str(Path(self.data_root, image.path))),
                "size": (image.width, image.height),
                "cam2img": cam2img,
                "lidar2cam": cameras[name].cam_from_frame,
            }
        return found

    def _lidar(self, lidar: LidarRecord) -> dict[str, Any]:
        """Return LiDAR paths in the form that mmdet3d's point transforms read."""
        sweeps = []
        for sweep in lidar.sweeps:
            # mmdet3d computes points @ R - t with R, t out of "lidar2sensor"
            rotation = sweep.frame_from_lidar[:3, :3]
            shift = sweep.frame_from_lidar[:3, 3]
            path = str(Path(self.data_root, sweep.path))
            points = {"lidar_path": path, "lidar2sensor": rigid(rotation.T, -shift)}
            sweeps.append({"lidar_points": points, "timestamp": sweep.timestamp_ns / 1e9})
        return {
            "lidar_points": {"lidar_path": str(Path(self.data_root, lidar.path))},
            "lidar2frame": lidar.frame_from_lidar,
            "lidar_sweeps": sweeps,
        }

    def prepare_data(self, idx: int) -> Any:
        """Run the pipeline on a sample; None if that is broken and may be skipped.

        Raises:
            BrokenSampleError: If a file is missing or damaged and ``broken_samples`` is ``raise``.
            RuntimeError: If more than ``max_refetch`` samples in a row are broken.
        """
        try:
            data = self.pipeline(self.get_data_info(idx))
        except BrokenSampleError as error:
            if self.broken_samples == "raise":
                raise
            self._broken_in_a_row += 1
            if self._broken_in_a_row > self.max_refetch:
                raise WorkError(
                    f"{self._broken_in_a_row} samples in a row are broken; the latest: {error}"
                ) from error
            token = self.sample(idx).token
            if token not in self.broken_tokens:
                self.broken_tokens[token] = str(error)
                MMLogger.get_current_instance().warning(
                    f"broken sample skipped ({len(self.broken_tokens)} so far): {error}"
                )
            return None
        self._broken_in_a_row = 0
        return data
