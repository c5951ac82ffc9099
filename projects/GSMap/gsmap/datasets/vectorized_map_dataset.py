"""Data set of annotated samples with camera images and LiDAR sweeps."""

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
from gsmap.utils.faults import user_message
from gsmap.utils.model_facts import MOUNT, RIG
from gsmap.utils.overrides import describe_override
from gsmap.utils.split_lists import SPLIT_LIST
from gsmap.utils.worker_seeds import follow_epoch

_BROKEN_MODES = ("raise", "skip")
# Metadata of the annotation file that are copied to the metainfo of the data set. `SPLIT_LIST` is
# the key of the list by which the samples were split.
_METAINFO_OF_FILE = (
    "classes", "x_range", "y_range", "dataset", "split", "frame", "ground_z_m", SPLIT_LIST,
)  # fmt: skip
_MAX_SAMPLES_WITHOUT_CAMERAS = 100  # before a data set counts as one without images
_MAX_POSE_GAP_S = 5.0  # longest time between two poses for computing vehicle signals


@DATASETS.register_module()
class VectorizedMapDataset(BaseDataset):
    """Samples of a memory-mapped annotation file, with map elements as ground truth.

    ``tools/create_data.py`` writes the annotation file. An error is raised if the range, classes,
    split or frame of the file differ from the expected ones.

    Args:
        ann_file: Annotation file; relative to ``data_root`` unless absolute.
        data_root: Folder that image and LiDAR paths are relative to.
        pipeline: Transforms or their configs.
        classes: Expected class names of the file in label order; None for any.
        grid: Arguments of `BEVGrid`. The file is expected to have its ``x_range`` and ``y_range``
            in metres; None for any.
        split: Expected split of the file; None for any.
        frame: Expected annotation frame of the file, ``lidar`` or ``ego``; None for any.
        dim: Coordinates per point of the ground truth, 2 or 3; None for the number in the file.
            With 2, heights in the file are left out; with 3, a file without heights is an error.
        rate_hz: Expected number of samples per second of a drive; None for any.
        crossings: Expected rule for pedestrian crossings (``--crossings`` of
            ``tools/create_data.py nuscenes``); None for any.
        cameras: Names of the cameras to use, in order; None for all cameras of each sample.
        test_mode: Whether to return all samples in order, with or without ground truth.
        filter_empty_gt: Whether to leave out samples without map elements in training.
        shuffle_images_seed: Seed of a shuffle that gives each sample the images of another sample,
            to measure the score of a model without matching images. None does not shuffle.
        signals_from_poses: Whether to compute missing vehicle signals (``can_bus``) from the poses
            of the drive; otherwise they are zero.
        pose_only_signals: Whether to replace the vehicle signals of all samples by signals that
            are computed from the pose alone, as in MapTR's code for Argoverse 2
            (`vehicle_signals.pose_only_signals`).
        zero_signals: Whether the vehicle signals of all samples are zero, whatever other arguments
            and the samples say. A test of a checkpoint that was trained without signals sets it.
        ground_z_m: Height of the road in the frame in metres, for a file that does not have it. For
            other files it must agree with the file.
        broken_samples: ``raise`` for an error at a sample with a missing or damaged file; ``skip``
            to log and count the sample and use another one instead, in training only.
        max_refetch: Largest number of consecutive samples to skip.
        indices: Samples to use, after filtering: a list of indices, or a number N for the first N
            samples (the last -N if N is negative); None for all samples.
        lazy_init: See ``BaseDataset`` of mmengine.
        serialize_data: See ``BaseDataset`` of mmengine.

    Raises:
        FileNotFoundError: If there is no annotation file.
        ValueError: If the file differs from an expected value, or an argument is not valid.
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
        zero_signals: bool = False,
        ground_z_m: float | None = None,
        broken_samples: str = "raise",
        max_refetch: int = 100,
        indices: int | Sequence[int] | None = None,
        lazy_init: bool = False,
        serialize_data: bool = True,
    ) -> None:
        if broken_samples not in _BROKEN_MODES:
            raise InputError(
                f"broken_samples must be one of {_BROKEN_MODES}, got {broken_samples!r}."
            )
        if dim not in (None, 2, 3):
            raise InputError(f"dim must be 2, 3 or None, got {dim!r}.")
        if broken_samples == "skip" and test_mode:
            raise InputError("broken_samples='skip' is for training: a test must see every sample.")
        if indices is not None and not indices:
            raise InputError(f"indices must leave at least one sample, got {indices!r}.")
        x_range = None
        y_range = None
        if grid is not None:
            extent = BEVGrid(**grid)
            x_range = extent.x_range
            y_range = extent.y_range
        self.cameras = None if cameras is None else tuple(cameras)
        self.broken_samples = broken_samples
        self.broken_tokens: dict[str, str] = {}  # error of each skipped sample, by token
        # Values in memory, which replace the values of the annotation file:
        self.images_in_memory: Mapping[str, np.ndarray] = {}  # BGR images by camera, (H, W, 3)
        self.can_bus_in_memory: np.ndarray | None = None  # vehicle signals, (18,)
        self.frame_in_memory: Frame | None = None  # token, scene, time and pose
        self._broken_in_a_row = 0
        self._expected = {
            "classes": None if classes is None else tuple(classes),
            "x_range": x_range,
            "y_range": y_range,
            "split": split,
            "frame": frame,
            "dim": 3 if dim == 3 else None,  # for dim 2, heights in the file are left out
            "crossings": crossings,
        }
        self._dim = dim
        self._rate_hz = rate_hz
        self._filter_empty_gt = filter_empty_gt and not test_mode
        self._shuffle_images_seed = shuffle_images_seed
        self._signals_from_poses = signals_from_poses
        self._pose_only_signals = pose_only_signals
        self._zero_signals = zero_signals
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
        """Open and check the annotation file, set the metainfo, and list the rows of the file.

        Returns:
            For each sample, its ``row`` in the file and ``image_row``, the row of the sample whose
            images it gets. Both are equal here; `filter_data` may change ``image_row``.

        Raises:
            FileNotFoundError: If there is no annotation file.
            ValueError: If the file is damaged, or differs from an expected value.
        """
        self.annotations = AnnotationFile(self.ann_file)
        self.annotations.require(**self._expected)
        if self._rate_hz is not None:
            self.annotations.require_rate(self._rate_hz)
        if not self.annotations.sealed:
            print_log(
                f"{self.ann_file} comes from an earlier version and has no checksum: damage may "
                f"go unnoticed until you {self.annotations.remedy}",
                logger="current",
            )
        for name in _METAINFO_OF_FILE:
            self._metainfo[name] = getattr(self.annotations.meta, name)
        self._metainfo["ground_z_m"] = self._ground_height()
        # Checkpoints store the metainfo. From `MOUNT` and `RIG`, a later inference knows where the
        # frame is in the vehicle, and with which cameras the model was trained.
        self._metainfo[MOUNT] = self._ground_from_first_frame()
        self._metainfo["dim"] = self._dim or self.annotations.meta.dim
        self._metainfo["cameras"] = self.cameras
        self._metainfo[RIG] = self._first_rig()
        return [{"row": row, "image_row": row} for row in range(len(self.annotations))]

    def _ground_from_first_frame(self) -> list[list[float]] | None:
        """Return the transform in metres from the frame of the first sample to the ground. (4, 4)

        It is None if neither the height of the road nor the mounting of the LiDAR is known.
        """
        if not len(self.annotations):
            return None
        frame = self._metainfo["frame"]
        ground_z_m = self._metainfo["ground_z_m"]
        sample = self.annotations[0]
        has_mounting = frame == "lidar" and sample.ego_from_frame is not None
        if ground_z_m is None and not has_mounting:
            return None
        return ground_from_frame(sample, frame=frame, ground_z_m=ground_z_m).tolist()

    def _first_rig(self) -> dict[str, list[float]]:
        """Return the intrinsics of the cameras of the first sample, by the name of the camera.

        Returns:
            Width, height, fx, fy, cx and cy in pixels for each camera.
        """
        rig = {}
        cameras = self.annotations[0].cameras if len(self.annotations) else []
        for camera in cameras:
            if self.cameras is not None and camera.name not in self.cameras:
                continue
            matrix = camera.intrinsics.tolist()
            fx = matrix[0][0]
            fy = matrix[1][1]
            cx = matrix[0][2]
            cy = matrix[1][2]
            rig[camera.name] = [float(camera.width), float(camera.height), fx, fy, cx, cy]
        return rig

    def _ground_height(self) -> float | None:
        """Return the height of the road in metres, from the file or else from the config.

        Raises:
            ValueError: If the heights in the file and in the config differ.
        """
        file_z_m = self.annotations.meta.ground_z_m
        config_z_m = self._ground_z_m
        if file_z_m is None:
            return config_z_m
        if config_z_m is not None and abs(file_z_m - config_z_m) > 1e-6:
            raise InputError(
                f"{self.ann_file} has the road at z = {file_z_m:g} m of its frame, the config at "
                f"{config_z_m:g} m (ground_z_m): set both to one height."
            )
        return file_z_m

    def filter_data(self) -> list[dict[str, int]]:
        """Leave out samples without map elements and shuffle images, depending on the arguments.

        Returns:
            Entries of the remaining samples, in the form of `load_data_list`.

        Raises:
            ValueError: If samples for training have no ground truth, or no sample is left.
        """
        rows = np.array([entry["row"] for entry in self.data_list], dtype=np.int64)
        if self._filter_empty_gt:
            counts = self.annotations.instance_counts()[rows]  # -1 without ground truth
            if (counts < 0).any():
                raise InputError(
                    f"{(counts < 0).sum()} samples of {self.ann_file} have no ground truth, so it "
                    "cannot be trained on."
                )
            num_empty = int((counts == 0).sum())
            if num_empty:
                text = f"{self.ann_file}: {num_empty} samples without any map element are left out."
                print_log(text, logger="current")
            rows = rows[counts > 0]
        if not len(rows):
            raise InputError(f"{self.ann_file} has no sample to use (of {len(self.annotations)}).")
        image_rows = rows
        if self._shuffle_images_seed is not None:
            # In a random order, each sample gets the images of the sample before it, and the first
            # sample gets the images of the last one. So no sample keeps its images.
            order = np.random.default_rng(self._shuffle_images_seed).permutation(len(rows))
            image_rows = np.empty_like(rows)
            image_rows[order] = rows[np.roll(order, shift=1)]
        entries = []
        for row, image_row in zip(rows.tolist(), image_rows.tolist(), strict=True):
            entries.append({"row": row, "image_row": image_row})
        return entries

    def _copy_without_annotation(self, memo: dict[int, Any] | None = None) -> BaseDataset:
        """Copy the data set without its samples, as mmengine does for a subset.

        The memo is the dictionary of ``copy.deepcopy`` for objects that are already copied. All
        calls share the default memo of mmengine, so a second copy would get objects of the first.
        """
        return super()._copy_without_annotation({} if memo is None else memo)

    def sample(self, idx: int) -> MapSample:
        """Read the record of a sample from the annotation file."""
        row = super().get_data_info(idx)["row"]  # opens the file on first use
        return self.annotations[row]

    def _rows(self) -> list[int]:
        """Return the row of each sample in the annotation file."""
        self.full_init()
        rows = []
        for index in range(len(self)):
            rows.append(super().get_data_info(index)["row"])
        return rows

    def instance_counts(self) -> np.ndarray:
        """Return the number of map elements of each sample, -1 without ground truth. (samples,)"""
        rows = self._rows()
        return self.annotations.instance_counts()[rows]

    def tokens(self) -> list[str]:
        """Return the token of each sample."""
        rows = self._rows()
        tokens = self.annotations.column("token")
        return [tokens[row] for row in rows]

    def scenes(self) -> list[list[int]]:
        """Return the indices of the samples of each scene in the order of their times.

        Returns:
            One list for each scene, sorted by the names of the scenes.
        """
        rows = self._rows()
        names = self.annotations.column("scene")
        times_ns = self.annotations.column("timestamp_ns")
        # Time and index of each sample, by the name of the scene.
        samples: dict[str, list[tuple[int, int]]] = {}
        for index, row in enumerate(rows):
            scene = samples.setdefault(names[row], [])
            scene.append((times_ns[row], index))
        scenes = []
        for name in sorted(samples):
            scenes.append([index for _, index in sorted(samples[name])])
        return scenes

    def scaled_image_size(self) -> tuple[int, int] | None:
        """Return the width and height of scaled images in pixels.

        They are those of the first sample that has one of the cameras; None if there is none among
        the first samples, as in a data set without images.
        """
        widths: list[int] = []
        heights: list[int] = []
        for index in range(min(len(self), _MAX_SAMPLES_WITHOUT_CAMERAS)):
            for camera in self.sample(index).cameras:
                if self.cameras is None or camera.name in self.cameras:
                    widths.append(camera.width)
                    heights.append(camera.height)
            if widths:
                break
        else:
            return None
        width = max(widths)
        height = max(heights)
        for step in self.pipeline.transforms:
            if isinstance(step, ScaleImages):
                width, height = step.output_size(width, height)
        return width, height

    def get_cat_ids(self, idx: int) -> list[int]:
        """Return the labels of a sample's elements for ``ClassBalancedDataset`` of mmengine."""
        return [instance.label for instance in self.sample(idx).instances or []]

    def get_data_info(self, idx: int) -> dict[str, Any]:
        """Return the input of the pipeline for a sample.

        Args:
            idx: Index of the sample.

        Returns:
            Values by key. ``images``, ``lidar_points``, ``lidar_sweeps`` and ``timestamp`` have
            the form of mmdet3d's multi-view pipelines. ``map_instances`` has the elements at full
            resolution, with ``dim`` coordinates per point in metres. ``map_heights`` has the
            heights of the n points of each element in metres, (n,), or None for a file without
            heights. ``lidar2ground`` leads to the ground below the rear axle (x ahead, y left, z
            up), or is None if the height of a LiDAR above it is unknown. ``eval_ann_info`` has
            labels and polylines for evaluation; it and ``map_instances`` are None without ground
            truth. Further keys are ``dim`` and the metainfo of the packed sample. In names such as
            ``lidar2global``, ``lidar`` is the annotation frame, as in mmdet3d.

        Raises:
            BrokenSampleError: If the sample lacks a camera of ``cameras``.
        """
        entry = super().get_data_info(idx)
        sample = self.annotations[entry["row"]]
        dim = self._metainfo["dim"]
        instances = sample.instances
        heights = None  # kept separately, because the points may lose their z below
        if instances is not None and self.annotations.meta.dim == 3:
            heights = [instance.points[:, 2] for instance in instances]
        ground_truth = None
        if instances is not None:
            instances = [MapInstance(i.label, points=i.points[:, :dim]) for i in instances]
            labels = [instance.label for instance in instances]
            ground_truth = {
                "polylines": [instance.points for instance in instances],
                "labels": np.array(labels, dtype=np.int64),
            }
        images = self._images(sample, entry)
        info: dict[str, Any] = {
            "sample_idx": entry["sample_idx"],
            "token": sample.token,
            "scene": sample.scene,
            "map_name": sample.map_name,
            "timestamp_ns": sample.timestamp_ns,
            "x_range": self._metainfo["x_range"],
            "y_range": self._metainfo["y_range"],
            "dim": dim,
            "seconds": self.annotations.seconds_into_scene[entry["row"]],
            "timestamp": sample.timestamp_ns / 1e9,
            "lidar2global": sample.global_from_frame if self.annotations.meta.has_poses else None,
            "lidar2ego": sample.ego_from_frame,
            "lidar2ground": self._ground_from_frame(sample),
            "can_bus": self._vehicle_signals(sample, entry["row"]),
            "images": images,
            "cam_names": list(images),
            "map_instances": instances,
            "map_heights": heights,
            "eval_ann_info": ground_truth,
        }
        if sample.lidar is not None:
            info.update(self._lidar(sample.lidar))
        if self.frame_in_memory is not None:  # replaces the values of the file
            frame = self.frame_in_memory
            info["token"] = frame.token
            info["scene"] = frame.scene
            info["timestamp_ns"] = frame.timestamp_ns
            info["timestamp"] = frame.timestamp_ns / 1e9
            info["lidar2global"] = frame.pose
        return info

    def _ground_from_frame(self, sample: MapSample) -> np.ndarray | None:
        """Return the transform in metres from the frame of a sample to the ground. (4, 4)

        It is None if the frame is that of a LiDAR, and neither the height of the road nor the
        mounting of the LiDAR is known. The frame ``ego`` has a usual height.
        """
        frame = self._metainfo["frame"]
        ground_z_m = self._metainfo["ground_z_m"]
        if frame == "lidar" and ground_z_m is None and sample.ego_from_frame is None:
            return None
        return ground_from_frame(sample, frame=frame, ground_z_m=ground_z_m)

    def _vehicle_signals(self, sample: MapSample, row: int) -> np.ndarray:
        """Return the vehicle signals of a sample, zero if unknown. (18,)

        Signals that depend on an earlier frame are zero, too (`without_history`).
        """
        if self._zero_signals:
            return np.zeros(NUM_CAN_BUS)
        if self.can_bus_in_memory is not None:
            return without_history(self.can_bus_in_memory)
        if self._pose_only_signals:
            # Imported here, because only few configs need the library of quaternions.
            from gsmap.structures.vehicle_signals import pose_only_signals

            global_from_ego = sample.global_from_frame
            if sample.ego_from_frame is not None:
                global_from_ego = global_from_ego @ invert_rigid(sample.ego_from_frame)
            return without_history(pose_only_signals(global_from_ego))
        if sample.can_bus is not None:
            return without_history(sample.can_bus)
        if not self._signals_from_poses or not self.annotations.meta.has_poses:
            return np.zeros(NUM_CAN_BUS)
        return without_history(self._signals_of_motion(sample, row))

    def _signals_of_motion(self, sample: MapSample, row: int) -> np.ndarray:
        """Compute vehicle signals from the poses of a sample and its neighbours. (18,)"""
        from gsmap.structures.vehicle_signals import motion_signals

        before = None
        after = None
        for neighbour_row in self.annotations.neighbours_in_scene(row):
            neighbour = self.annotations[neighbour_row]
            seconds = (neighbour.timestamp_ns - sample.timestamp_ns) / 1e9
            if abs(seconds) > _MAX_POSE_GAP_S:
                continue
            pose = (seconds, self._global_from_ground(neighbour))
            if seconds < 0 and before is None:
                before = pose
            if seconds > 0 and after is None:
                after = pose
        now = (0.0, self._global_from_ground(sample))
        # Each argument is a time relative to the sample in seconds, and a pose; None if unknown.
        return motion_signals(now, before=before, after=after)

    def _global_from_ground(self, sample: MapSample) -> np.ndarray:
        """Return the pose of the ground below the rear axle of a sample, in metres. (4, 4)"""
        frame = self._metainfo["frame"]
        ground_z_m = self._metainfo["ground_z_m"]
        ground = ground_from_frame(sample, frame=frame, ground_z_m=ground_z_m)
        return sample.global_from_frame @ invert_rigid(ground)

    def has_signals(self) -> bool:
        """Test whether any sample has vehicle signals, from its record or computed from poses."""
        if self._zero_signals:
            return False
        if self._pose_only_signals:
            return True
        from_poses = self._signals_from_poses and self.annotations.meta.has_poses
        return from_poses or self.annotations.has_signals()

    def _images(self, sample: MapSample, entry: dict[str, int]) -> dict[str, dict[str, Any]]:
        """Return path, size and calibration of the images, by camera.

        Paths and sizes are from the sample at ``image_row``, calibration is from ``sample``.
        """
        cameras = {camera.name: camera for camera in sample.cameras}
        image_cameras = cameras
        if entry["image_row"] != entry["row"]:
            image_sample = self.annotations[entry["image_row"]]
            image_cameras = {camera.name: camera for camera in image_sample.cameras}
        images = {}
        names = tuple(cameras) if self.cameras is None else self.cameras
        for name in names:
            if name not in cameras or name not in image_cameras:
                raise BrokenSampleError(
                    f"sample {sample.token!r} has no camera {name!r}, only {list(cameras)}: name "
                    "the cameras that all samples have (`cameras=[...]`), or train with "
                    "broken_samples='skip'."
                )
            image = image_cameras[name]
            path = str(Path(self.data_root, image.path))
            cam2img = np.eye(4)
            cam2img[:3, :3] = cameras[name].intrinsics
            images[name] = {
                # An image in memory takes the place of its path.
                "img_path": self.images_in_memory.get(name, path),
                "size": (image.width, image.height),
                "cam2img": cam2img,
                "lidar2cam": cameras[name].cam_from_frame,
            }
        return images

    def _lidar(self, lidar: LidarRecord) -> dict[str, Any]:
        """Return LiDAR paths and transforms in the format of mmdet3d's point transforms."""
        sweeps = []
        for sweep in lidar.sweeps:
            # mmdet3d computes points @ R - t with R and t of "lidar2sensor". For this reason, the
            # rotation is transposed and the translation negated.
            rotation = sweep.frame_from_lidar[:3, :3]
            shift = sweep.frame_from_lidar[:3, 3]
            path = str(Path(self.data_root, sweep.path))
            points = {"lidar_path": path, "lidar2sensor": rigid(rotation.T, translation=-shift)}
            sweeps.append({"lidar_points": points, "timestamp": sweep.timestamp_ns / 1e9})
        return {
            "lidar_points": {"lidar_path": str(Path(self.data_root, lidar.path))},
            "lidar2frame": lidar.frame_from_lidar,
            "lidar_sweeps": sweeps,
        }

    def prepare_data(self, idx: int) -> Any:
        """Apply the pipeline to a sample.

        Args:
            idx: Index of the sample.

        Returns:
            Output of the pipeline, or None for a broken sample that is skipped. mmengine then takes
            another sample at random.

        Raises:
            BrokenSampleError: If a file is missing or damaged, or a transform returns None, and
                ``broken_samples`` is ``raise``.
            RuntimeError: If more than ``max_refetch`` consecutive samples are broken.
            ValueError: If an override of the command (``--cfg-options``) causes an error.
        """
        follow_epoch()
        try:
            data = self.pipeline(self.get_data_info(idx))
            if data is None:  # mmengine would take another sample in silence
                raise BrokenSampleError(
                    f"sample {self.sample(idx).token!r}: a transform of the pipeline returned "
                    "None: let it return the results, or train with broken_samples='skip'."
                )
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
        except Exception as error:
            # `user_message` is None for errors that look like a bug. Such an error may come from an
            # override of the command. `describe_override` finds the override in the frames of the
            # error. This is done here, because a worker process sends only the text of an error.
            description = None if user_message(error) else describe_override(error)
            if description is None:
                raise
            raise InputError(description) from error
        self._broken_in_a_row = 0
        return data
