"""Predictions of a trained model from the camera images of one vehicle, frame by frame."""

import logging
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from mmengine.config import Config

from gsmap.apis.map_priors import maps_for
from gsmap.datasets.memory import VEHICLE, Cameras, bgr_by_name, source_in_memory
from gsmap.datasets.plausibility import calibration_warnings
from gsmap.datasets.pose_plausibility import MotionCheck
from gsmap.datasets.source import Source, ground_from_frame
from gsmap.structures.elements import MapElements
from gsmap.structures.rigid import invert_rigid
from gsmap.structures.streams import Frame, MapStream
from gsmap.utils.errors import InputError

# Poses of streams are checked once, after so many steps of the vehicle, or so many frames of a
# vehicle that stands.
_MOTION_STEPS = 20
_MOTION_FRAMES = 1000
_LOGGER = logging.getLogger(__name__)
# Frame of a temporal model without a stream. The model requires a scene, a time and a pose, but
# does not use them for an independent sample.
_SINGLE_FRAME = Frame(token="in memory", scene="", timestamp_ns=0, pose=np.eye(4))
_NO_SIGNALS_TEXT = (
    "the model was trained with vehicle signals, and without them its maps are worse: give "
    "can_bus. From poses, motion_signals of gsmap.structures.vehicle_signals makes it "
    "(pose_only_signals for configs that have it)."
)
_UNUSED_SIGNALS_TEXT = (
    "the model was trained without vehicle signals: can_bus is not used, zeros are taken."
)
_NOTHING_NEAR_TEXT = (
    "the prior of {place!r} has nothing in the range of a frame. If the vehicle is in this place, "
    "compare the global frame of the prior with that of the poses."
)

if TYPE_CHECKING:
    from mmdet3d.structures import Det3DDataSample

    from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset
    from gsmap.prior.opening import AnyPrior


class Predictor(Protocol):
    """Interface of `MapInferencer` that a `LiveMap` uses."""

    cfg: Config
    model: Any  # MapDetector from `load_model`

    def dataset(self, source: Source) -> "VectorizedMapDataset":
        """Create the test data set of the config with the samples and the calibration of a source.

        The samples are written to a temporary annotation file, which the data set reads.
        """

    def predict(
        self,
        dataset: "VectorizedMapDataset",
        *,
        allow_missing_cameras: bool,
        stream: Any,
        priors: "Sequence[AnyPrior]",
        update_priors: bool,
    ) -> "Iterator[Det3DDataSample]":
        """Predict the samples of a data set.

        Args:
            dataset: Data set from the method ``dataset``.
            allow_missing_cameras: Whether cameras of the model may be absent.
            stream: Memory of the earlier frames of the drive, which is updated; None for
                independent samples.
            priors: Maps of earlier drives, one for each place.
            update_priors: Whether to write the prediction of each sample to ``priors``.
        """

    def elements(self, data_sample: "Det3DDataSample") -> MapElements:
        """Map elements of a predicted sample, in the annotation frame of the config, in metres."""


class LiveMap:
    """Predictor of the map around a vehicle, from images in memory.

    Use ``MapInferencer.live`` to create it. The calibration is prepared at the first frame, and
    again if an image size changes. Frames are independent of each other unless a stream is given. A
    stream is the memory of a temporal model between frames. Several threads may call a `LiveMap`;
    it predicts one frame at a time.

    Args:
        inferencer: The trained model.
        intrinsics: Pinhole matrix of each camera in pixels, by name or as a list. (3, 3) each
        cam_from_frame: Transform from the frame to each camera (x right, y down, z ahead) in
            metres, by name or as a list. (4, 4) each
        frame: Frame of the calibration. Either ``vehicle`` (x ahead, y left, origin on the road
            below the rear axle), or an annotation frame: ``lidar`` (x right, y ahead, origin at a
            roof LiDAR) or ``ego`` (x ahead, y left, origin at the rear axle). By default the frame
            of the config. The pose of an annotation frame on the vehicle is taken from the training
            data if the model was trained in this frame, and otherwise from nuScenes (``lidar``) or
            Argoverse 2 (``ego``).
        allow_missing_cameras: Whether cameras of the model may be absent. If the calibration is
            given by name, a frame may then lack images of its cameras, too.
        prior: Map of earlier drives, for a model that reads a prior.
        update_prior: Whether to write the prediction of each frame to ``prior``.

    Raises:
        ValueError: If a prior is given or is to be updated and the model reads no prior, the prior
            does not fit it, or none is given and it is to be updated.
    """

    def __init__(
        self,
        inferencer: Predictor,
        intrinsics: Cameras,
        cam_from_frame: Cameras,
        frame: str | None = None,
        allow_missing_cameras: bool = False,
        prior: "AnyPrior | None" = None,
        update_prior: bool = False,
    ):
        self._priors = () if prior is None else (prior,)
        self._update_prior = update_prior
        if self._priors or update_prior:  # called for its errors; the result is not needed here
            maps_for(inferencer.model, self._priors, update=update_prior)
        self._inferencer = inferencer
        self._config = inferencer.cfg.test_dataloader.dataset
        self._intrinsics = intrinsics
        self._cam_from_frame = cam_from_frame
        self._frame = frame or self._config.get("frame") or "lidar"  # frame of the calibration
        self._allow_missing_cameras = allow_missing_cameras
        self._lock = threading.Lock()  # held while the data set has the images of a frame
        self._sizes: dict[str, tuple[int, ...]] = {}  # shape of the last image of each camera
        self._logged_warnings: set[str] = set()
        self._motion: MotionCheck | None = MotionCheck()  # None after enough frames
        # Set by `_prepare`: the data set of one sample, and the transform from the annotation frame
        # of the model to the frame of the calibration, and from there to the ground. (4, 4)
        self._dataset: VectorizedMapDataset
        self._calibration_from_model: np.ndarray
        self._ground_from_calibration: np.ndarray

    def __getstate__(self) -> dict[str, Any]:
        """Attributes of a copy, which prepares the calibration at its first frame."""
        attributes = {**self.__dict__, "_sizes": {}}
        del attributes["_lock"]  # locks cannot be copied
        attributes.pop("_dataset", None)  # its file is removed (`_prepare`)
        return attributes

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()

    def __call__(
        self,
        images: Cameras,
        can_bus: np.ndarray | None = None,
        at: Frame | None = None,
        stream: MapStream | None = None,
    ) -> MapElements:
        """Predict the map elements of one frame.

        Args:
            images: Images of the cameras, as `predict` takes them. (H, W, 3) each
            can_bus: Vehicle signals, as `predict` takes them. (18,)
            at: Place of the frame in the stream, as `predict` takes it.
            stream: Memory of the earlier frames of the drive, as `predict` takes it.

        Returns:
            The elements in the frame of the calibration, in metres.

        Raises:
            TypeError: As in `predict`.
            ValueError: As in `predict`.
        """
        data_sample = self.predict(images, can_bus=can_bus, at=at, stream=stream)
        elements = self._inferencer.elements(data_sample)
        return elements.to_frame(self._calibration_from_model)

    def predict(
        self,
        images: Cameras,
        can_bus: np.ndarray | None = None,
        at: Frame | None = None,
        stream: MapStream | None = None,
    ) -> "Det3DDataSample":
        """Predict one frame.

        Args:
            images: RGB images of the cameras in uint8, by name or as a list, of about the size of
                the training images. (H, W, 3) each
            can_bus: Vehicle signals, as `motion_signals` computes them from poses. Without them, a
                model that was trained with signals assumes a standing vehicle. (18,)
            at: Name, scene, time and pose of the frame. Required with ``stream``, and always if
                this `LiveMap` has a prior. The pose is the transform from the frame of the
                calibration to the world, in metres.
            stream: Memory of the earlier frames of the drive, from ``MapInferencer.new_stream``.
                For temporal models only.

        Returns:
            The sample with ``pred_instances_3d`` on the CPU, in the annotation frame of the config.

        Raises:
            TypeError: If an image is not uint8.
            ValueError: If an array has another shape, a matrix is not a valid intrinsic matrix or
                pose, or a signal is not finite. If the cameras of the arguments differ from each
                other or from the cameras of the model. If only one of ``at`` and ``stream`` is
                given (``at`` alone is valid with a prior), a stream is given for a model that is
                not temporal, or the frame is not later than the last frame of the stream.
        """
        has_stream = stream is not None
        has_pose = at is not None
        if self._priors and not has_pose:
            raise InputError("a frame reads the prior at its pose: give it at=Frame(...).")
        # `at` and `stream` belong together, but a model that reads the prior may have `at` alone.
        allows_pose_alone = bool(self._priors) and not has_stream
        if has_stream != has_pose and not allows_pose_alone:
            raise InputError(
                "a frame that continues a stream needs both at=Frame(...) and stream=..., got "
                f"at={at} and stream={stream}."
            )
        if can_bus is not None and not np.isfinite(can_bus).all():
            raise InputError(f"can_bus must be finite, got {can_bus}.")
        pixels = bgr_by_name(images)
        with self._lock:
            return self._predict_frame(pixels, can_bus=can_bus, at=at, stream=stream)

    def _predict_frame(
        self,
        pixels: dict[str, np.ndarray],
        can_bus: np.ndarray | None,
        at: Frame | None,
        stream: MapStream | None,
    ) -> "Det3DDataSample":
        """Predict one frame, with checked BGR images and arguments as in `predict`."""
        sizes = {name: image.shape for name, image in pixels.items()}
        if sizes != self._sizes:  # also at the first frame
            self._prepare(pixels)
            self._sizes = sizes
        # The data set reads these values in place of the image files and the annotation file.
        self._dataset.images_in_memory = pixels
        signals = None if can_bus is None else np.asarray(can_bus, dtype=float)
        if signals is None and self._expects_signals():
            self._warn_once(_NO_SIGNALS_TEXT)
        reads_signals = "can_bus" in self._inferencer.model.bev_encoder.calibration
        if signals is not None and reads_signals and self._config.get("zero_signals"):
            self._warn_once(_UNUSED_SIGNALS_TEXT)
        self._dataset.can_bus_in_memory = signals
        if at is not None:
            # Pose of the annotation frame of the model instead of the frame of the calibration.
            frame = replace(at, pose=at.pose @ self._calibration_from_model)
        elif self._inferencer.model.temporal is not None:
            frame = _SINGLE_FRAME
        else:
            frame = None
        self._dataset.frame_in_memory = frame
        num_empty = sum(prior.reads.empty for prior in self._priors)
        predictions = self._inferencer.predict(
            self._dataset,
            allow_missing_cameras=self._allow_missing_cameras,
            stream=stream,
            priors=self._priors,
            update_priors=self._update_prior,
        )
        (data_sample,) = predictions  # the data set has one sample
        if at is not None and stream is not None:
            self._check_motion(at)
        for prior in self._priors:  # one at most
            is_empty = prior.reads.empty > num_empty
            # A prior that is updated has nothing where the vehicle is for the first time.
            if is_empty and not self._update_prior:
                self._warn_once(_NOTHING_NEAR_TEXT.format(place=prior.settings.place))
        return data_sample

    def _expects_signals(self) -> bool:
        """Whether the model reads vehicle signals and was trained with some."""
        if "can_bus" not in self._inferencer.model.bev_encoder.calibration:
            return False
        if self._config.get("zero_signals"):
            return False
        # `adopt_settings` sets the first key if the checkpoint records signals.
        keys = ("signals_from_poses", "pose_only_signals")
        return any(self._config.get(key) for key in keys)

    def _check_motion(self, at: Frame) -> None:
        """Log a warning if the poses of the first frames of streams cannot be right.

        Args:
            at: A frame, with the pose of the frame of the calibration.
        """
        if self._motion is None:
            return
        self._motion.add(
            at.scene,
            at.timestamp_ns,
            token=at.token,
            global_from_frame=at.pose,
            ground_from_frame=self._ground_from_calibration,
        )
        has_moved = self._motion.num_steps >= _MOTION_STEPS
        if has_moved or self._motion.num_poses >= _MOTION_FRAMES:
            for text in self._motion.warnings():
                self._warn_once(f"poses: {text}")
            self._motion = None if has_moved else MotionCheck()

    def _warn_once(self, text: str) -> None:
        """Log a warning, unless it was logged before."""
        if text not in self._logged_warnings:
            _LOGGER.warning(text)
            self._logged_warnings.add(text)

    def _prepare(self, pixels: dict[str, np.ndarray]) -> None:
        """Check the calibration, and create a data set of one sample with it.

        Args:
            pixels: BGR images by the name of the camera. (H, W, 3) each

        Raises:
            ValueError: If the calibration is not valid, or its cameras differ from the cameras of
                the images or of the model.
        """
        # Pose of the annotation frame on the vehicle of the training data. It is used only if the
        # calibration is in this annotation frame. None selects the usual pose of the frame.
        training_mount = self._inferencer.model.mount
        mount = training_mount if self._frame == training_mount.frame else None
        intrinsics = self._intrinsics
        cam_from_frame = self._cam_from_frame
        if self._allow_missing_cameras:
            intrinsics = _of_cameras(intrinsics, names=pixels)
            cam_from_frame = _of_cameras(cam_from_frame, names=pixels)
        # One sample with names and sizes of the images, and the calibration.
        source = source_in_memory(
            pixels,
            intrinsics=intrinsics,
            cam_from_frame=cam_from_frame,
            frame=self._frame,
            mount=mount,
        )
        # Texts about implausible values. The image sizes may change, so each is logged once.
        for text in calibration_warnings(source.samples, source.frame, source.ground_z_m):
            self._warn_once(f"calibration: {text}")
        model_cameras = self._config.get("cameras") or pixels  # a config without names allows all
        unknown = set(pixels) - set(model_cameras)
        # If the model has none of the given names, the cameras are assigned to the cameras of the
        # model by their directions.
        if unknown and unknown != set(pixels):
            raise InputError(
                f"the model has the cameras {list(self._config.cameras)}, but not "
                f"{sorted(unknown)}: name all cameras as the model does, or none of them."
            )
        dataset = self._inferencer.dataset(source)
        # The inferencer has written a temporary annotation file and the data set has read it. The
        # file is removed now, because each change of the image sizes writes another one.
        Path(dataset.ann_file).unlink()
        # The frame of the calibration and the annotation frame of the model are related by the
        # ground frame of the vehicle (x ahead, y left, origin on the road below the rear axle).
        if self._frame == VEHICLE:  # which is the ground frame
            ground_from_calibration = np.eye(4)
        else:
            ground_from_calibration = ground_from_frame(
                source.samples[0], frame=source.frame, ground_z_m=source.ground_z_m
            )
        ground_from_model = ground_from_frame(
            dataset.sample(0),
            frame=dataset.metainfo["frame"],
            ground_z_m=dataset.metainfo["ground_z_m"],
        )
        self._dataset = dataset
        self._ground_from_calibration = ground_from_calibration
        self._calibration_from_model = invert_rigid(ground_from_calibration) @ ground_from_model


def _of_cameras(values: Cameras, names: Collection[str]) -> Cameras:
    """Arrays of the cameras with these names; all arrays if they are in a list or lack a name."""
    if not isinstance(values, Mapping) or not set(names) <= set(map(str, values)):
        return values
    return {name: value for name, value in values.items() if str(name) in names}
