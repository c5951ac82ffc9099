"""A trained model on the cameras of one vehicle, whose images come frame by frame."""

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from mmengine.config import Config

from gsmap.datasets.memory import VEHICLE, Cameras, bgr_by_name, source_in_memory
from gsmap.datasets.plausibility import calibration_warnings
from gsmap.datasets.source import Source, ground_from_frame
from gsmap.structures.elements import MapElements
from gsmap.structures.rigid import invert_rigid
from gsmap.structures.streams import Frame, MapStream
from gsmap.utils.errors import InputError

_LOGGER = logging.getLogger(__name__)
_ALONE = Frame("in memory", "", 0, np.eye(4))

if TYPE_CHECKING:
    from mmdet3d.structures import Det3DDataSample

    from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset


class Predictor(Protocol):
    """What a `LiveMap` needs of the `MapInferencer` that makes it."""

    cfg: Config
    model: Any  # with its ``mount``

    def dataset(self, source: Source) -> "VectorizedMapDataset":
        """Open samples as the config's test data set."""

    def predict(
        self, dataset: "VectorizedMapDataset", *, allow_missing_cameras: bool, stream: Any
    ) -> "Iterator[Det3DDataSample]":
        """Run the model on the samples of a data set."""

    def elements(self, data_sample: "Det3DDataSample") -> MapElements:
        """Return a predicted sample's map."""


class LiveMap:
    """The map around a vehicle, frame by frame, from images in memory.

    ``MapInferencer.live`` makes it. The calibration is fitted to the model once, with the first
    frame. Nothing else is kept from one to the next: a model with memory (``temporal``) keeps what
    it remembers in the caller's stream, and without one sees each frame as a first one.

    Args:
        inferencer: The trained model.
        intrinsics: By the cameras' names, or as a list: pinhole matrices, in pixels. each (3, 3)
        cam_from_frame: In the same form: from the frame to the camera (x right, y down, z ahead),
            in metres. each (4, 4)
        frame: ``vehicle`` (x ahead, y left, on the road below the rear axle), or an annotation
            frame: ``lidar`` (x right, y ahead, at a roof LiDAR) or ``ego`` (x ahead, y left, at the
            rear axle); the config's by default. The model's own frame lies where it lay in
            training, the other one where nuScenes and Argoverse 2 have it.
        allow_missing_cameras: Whether cameras of the model may be absent.
    """

    def __init__(
        self,
        inferencer: Predictor,
        intrinsics: Cameras,
        cam_from_frame: Cameras,
        frame: str | None = None,
        allow_missing_cameras: bool = False,
    ):
        self._inferencer = inferencer
        self._config = inferencer.cfg.test_dataloader.dataset
        self._rig = intrinsics, cam_from_frame
        self._frame = frame or self._config.get("frame") or "lidar"
        self._allow_missing_cameras = allow_missing_cameras
        self._sizes: dict[str, tuple[int, ...]] = {}
        self._said: set[str] = set()
        self._dataset: VectorizedMapDataset

    def __call__(
        self,
        images: Cameras,
        can_bus: np.ndarray | None = None,
        at: Frame | None = None,
        stream: MapStream | None = None,
    ) -> MapElements:
        """Return the map elements of one frame, in the frame of the calibration, as `predict`."""
        found = self._inferencer.elements(self.predict(images, can_bus, at, stream))
        return found.to_frame(self._frame_from_models)

    def predict(
        self,
        images: Cameras,
        can_bus: np.ndarray | None = None,
        at: Frame | None = None,
        stream: MapStream | None = None,
    ) -> "Det3DDataSample":
        """Run the model on one frame.

        Args:
            images: RGB, uint8, at about the size that the model was trained on. each (H, W, 3)
            can_bus: Signals of the vehicle, as `motion_signals` makes them of poses; models that
                were trained with signals see a standing vehicle without. (18,)
            at: With a stream, the frame's name, scene, time and pose, the latter from the frame of
                the calibration to the world.
            stream: With a model that remembers, the drive that the frame continues
                (``MapInferencer.new_stream``).

        Returns:
            The sample, with ``pred_instances_3d`` on the CPU in the frame of the config.

        Raises:
            TypeError: If an image is not uint8.
            ValueError: If an array has another shape, a matrix is none of its kind, a signal is not
                finite, the cameras of the arguments differ, or they are not those of the model; if
                only one of ``at`` and ``stream`` is given, the model has no memory for them, or the
                frame does not follow the stream's last.
        """
        if (at is None) != (stream is None):
            raise InputError(
                "a frame that continues a stream needs both at=Frame(...) and stream=..., got "
                f"at={at} and stream={stream}."
            )
        if can_bus is not None and not np.isfinite(can_bus).all():
            raise InputError(f"can_bus must be finite, got {can_bus}.")
        pixels = bgr_by_name(images)
        sizes = {name: image.shape for name, image in pixels.items()}
        if sizes != self._sizes:
            self._open(pixels)
            self._sizes = sizes
        self._dataset.images_in_memory = pixels
        self._dataset.can_bus_in_memory = None if can_bus is None else np.asarray(can_bus, float)
        frame = None if self._inferencer.model.temporal is None else _ALONE
        if at is not None:
            frame = replace(at, pose=at.pose @ self._frame_from_models)
        self._dataset.frame_in_memory = frame
        allowed = self._allow_missing_cameras
        (found,) = self._inferencer.predict(
            self._dataset, allow_missing_cameras=allowed, stream=stream
        )
        return found

    def _open(self, pixels: dict[str, np.ndarray]) -> None:
        """Check the calibration, and make a data set of one sample that has it."""
        mount = self._inferencer.model.mount
        own = mount if self._frame == mount.frame else None
        source = source_in_memory(pixels, *self._rig, self._frame, own)
        for line in calibration_warnings(source.samples, source.frame, source.ground_z_m):
            if line not in self._said:
                _LOGGER.warning("calibration: %s", line)
                self._said.add(line)
        foreign = set(pixels) - set(self._config.get("cameras") or pixels)
        if foreign and foreign != set(pixels):
            raise InputError(
                f"the model has the cameras {list(self._config.cameras)}, but not "
                f"{sorted(foreign)}: name all cameras as it does, or none."
            )
        self._dataset = dataset = self._inferencer.dataset(source)
        Path(dataset.ann_file).unlink()  # it is read, and a rig may be opened often
        ground_from_given = np.eye(4)
        if self._frame != VEHICLE:
            ground_from_given = ground_from_frame(
                source.samples[0], source.frame, source.ground_z_m
            )
        meta = dataset.metainfo
        ground_from_models = ground_from_frame(dataset.sample(0), meta["frame"], meta["ground_z_m"])
        self._frame_from_models = invert_rigid(ground_from_given) @ ground_from_models
