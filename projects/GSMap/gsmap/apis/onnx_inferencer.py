"""An exported model on a vehicle's images: numpy and onnxruntime alone, neither torch nor mmcv."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsmap.evaluation.core.results_json import vectors_of, write_results
from gsmap.structures.calibration import calibration_arrays
from gsmap.structures.elements import MapElements
from gsmap.structures.polylines import shortest_orders
from gsmap.structures.rigid import is_rigid
from gsmap.structures.streams import Frame, MapStream, Scenes, StreamState
from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_extra

METADATA_KEY = "gsmap"
FORMAT = 1
CAN_BUS_RULE = (
    "the 18 values of a sample's record; the graph itself sets entries 0 to 2 and 17 to zero"
)
POSE_ONLY_RULE = (
    "the 18 values that pose_only_signals of gsmap.structures.vehicle_signals makes of the pose of "
    "the vehicle, as the model was trained"
)
NO_SIGNALS = "not needed: the model was trained without vehicle signals; zeros are taken"
OF_STREAM = ("now_from_then", "seconds", "continues")  # inputs of a model with memory
MEMORY = "memory_"  # how its further inputs start; what replaces them has new_ besides
_PRECISIONS = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_OUTPUTS = {"scores", "labels", "points"}


class OnnxInferencer:
    """Runs an ONNX file that ``tools/export.py`` wrote.

    Args:
        path: The file.
        providers: Execution providers of ONNX Runtime, by preference.
        num_threads: Threads of one operator; 0 for one a core.

    Attributes:
        classes: Names of the classes.
        cameras: Names of the cameras, in the order in which images and matrices are given.
        image_size: Rows and columns of the images.
        metadata: All that the file says of itself. With ``ground_from_frame`` (4, 4) it says where
            the annotation frame lay over the ground below the rear axle (x ahead, y left, z up, in
            metres) in training: a vehicle's calibration belongs into a frame that lies there.

    Raises:
        FileNotFoundError: If there is no such file.
        RuntimeError: If onnxruntime is not installed.
        ValueError: If the file is not an exported model, or of another version.
    """

    def __init__(
        self,
        path: str | Path,
        providers: Sequence[str] = ("CPUExecutionProvider",),
        num_threads: int = 0,
    ) -> None:
        onnxruntime = import_extra("onnxruntime", "onnx")
        self.path = Path(path)
        if not self.path.is_file():
            raise FileNotFoundError(f"There is no ONNX file {path}; tools/export.py writes one.")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = num_threads
        options.log_severity_level = 4  # what fails is raised as well
        try:
            self.session = onnxruntime.InferenceSession(
                str(path), options, providers=list(providers)
            )
        except Exception as error:  # onnxruntime's errors have no common class of their own
            raise InputError(
                f"{path} cannot be run by ONNX Runtime {onnxruntime.__version__} "
                f"({error!s:.300}): export it again, or install a newer onnxruntime."
            ) from error
        try:
            found = self.session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
            self.metadata: dict[str, Any] = json.loads(found or "{}")
            if self.metadata["format"] != FORMAT:
                raise InputError("another format")
            _check_metadata(self.metadata)
            self._outputs = [value.name for value in self.session.get_outputs()]
            images, *others = self.session.get_inputs()
            shape = [len(self.metadata["cameras"]), 3, *self.metadata["image_size"]]
            if images.shape != shape or not set(self._outputs) >= _OUTPUTS:
                raise InputError("its graph is not the one that its metadata tell of")
            memory = [value for value in others if value.name.startswith(MEMORY)]
            self._empty = {
                value.name: np.zeros(value.shape, _PRECISIONS[value.type]) for value in memory
            }
            if self.has_memory != bool(memory):
                raise InputError("its graph and its metadata do not agree on a memory")
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(
                f"{path} does not say that tools/export.py of this version wrote it ({error!r}): "
                "export the model again."
            ) from error
        self.classes: tuple[str, ...] = tuple(self.metadata["classes"])
        self.cameras: tuple[str, ...] = tuple(self.metadata["cameras"])
        self.image_size: tuple[int, int] = tuple(self.metadata["image_size"])
        names = [value.name for value in others]
        self._calibration = [n for n in names if n not in (*self._empty, *OF_STREAM)]

    def __str__(self) -> str:
        return str(self.path)

    @property
    def has_memory(self) -> bool:
        """Whether the model remembers the frames before."""
        return "max_gap_s" in self.metadata

    def new_stream(self) -> MapStream:
        """Return the empty memory of one drive, for calls; ValueError if the file has no memory."""
        if not self.has_memory:
            raise InputError(f"{self.path.name} has no memory: leave the stream out.")
        return MapStream(self.metadata["max_gap_s"])

    def new_scenes(self) -> Scenes:
        """Return empty memories of several scenes, as `new_stream`."""
        return Scenes(self.new_stream().max_gap_s)

    def __call__(
        self,
        images: Sequence[NDArray[Any]] | NDArray[Any],
        meta: Mapping[str, Any],
        stream: Scenes | None = None,
    ) -> MapElements:
        """Find the map elements of one sample.

        Args:
            images: One image of each of ``cameras``, in their order: BGR as OpenCV reads them,
                values 0 to 255, scaled to ``image_size``. V x (H, W, 3)
            meta: ``lidar2img`` (V, 4, 4): from metres in the annotation frame to (u * d, v * d, d,
                1) in pixels of these images. Camera-aware LSS encoders also read ``lidar2cam``,
                ``cam2img`` of the original images, ``img_aug_matrix`` (V, 4, 4) from those to
                these, and ``lidar2ego`` (4, 4), by default that of the training. GKT and BEVFormer
                read
                ``can_bus`` (18,), as a record has it; zeros if the model was trained without it.
                With memory also ``scene``, ``timestamp_ns`` and ``lidar2global`` (4, 4), from the
                annotation frame to the world.
            stream: With memory, that of the drive (`new_stream`); it is brought forward.

        Returns:
            The elements, best first, with their scores and, if the model has them, Gaussians.

        Raises:
            ValueError: If images or matrices are not those of the file's cameras, or a matrix is
                missing; with memory, if there is no stream, or the frame does not follow its last.
        """
        outputs = self.run(self.prepare(images, meta, stream))
        elements = self.elements(outputs)
        if stream is not None:
            self.remember(stream, meta, outputs)
        return elements

    def prepare(
        self,
        images: Sequence[NDArray[Any]] | NDArray[Any],
        meta: Mapping[str, Any],
        stream: Scenes | None = None,
    ) -> dict[str, NDArray[np.float32]]:
        """Inputs of the graph for one frame; errors as of a call.

        Args:
            images: One image of each camera, (H, W, 3) in uint8.
            meta: Calibration and pose of the frame, as a call takes them.
            stream: Drive of the frame, for a model with memory.

        Returns:
            The inputs by their names, in float32.
        """
        self._check_images(images)
        told = self.metadata.get("can_bus") == NO_SIGNALS or meta.get("can_bus") is not None
        if "can_bus" in self._calibration and not told:
            if self.metadata.get("can_bus") == POSE_ONLY_RULE:
                raise InputError(f"{self.path.name} needs can_bus, {POSE_ONLY_RULE}.")
            raise InputError(
                f"{self.path.name} needs can_bus, {CAN_BUS_RULE}. From poses: motion_signals of "
                "gsmap.structures.vehicle_signals; zeros for a model that was trained without."
            )
        if meta.get("lidar2ego") is None:
            meta = {**meta, "lidar2ego": self.metadata.get("ego_from_frame")}
        inputs = calibration_arrays(meta, self._calibration)
        for name, array in inputs.items():
            if name != "can_bus" and array.shape != (len(self.cameras), 4, 4):
                raise InputError(
                    f"{name} of {self.path.name} needs one 4 x 4 matrix for each of its "
                    f"{len(self.cameras)} cameras {', '.join(self.cameras)}, got shape "
                    f"{array.shape}."
                )
        stacked = np.stack([np.asarray(image) for image in images])
        pixels = np.ascontiguousarray(stacked.transpose(0, 3, 1, 2), dtype=np.float32)
        if self.has_memory or stream is not None:
            inputs |= self._of_stream(meta, stream)
        return {"images": pixels, **inputs}

    def _of_stream(self, meta: Mapping[str, Any], stream: Scenes | None) -> dict[str, Any]:
        """State after the previous frame, and the motion since then."""
        if stream is None or not self.has_memory:
            self.new_stream()  # says so if there is no memory
            raise InputError(
                f"{self.path.name} remembers the frames of a drive: give the call its stream, "
                "which new_stream() starts."
            )
        stream.claim(self)
        frame = Frame.of(meta)
        (before,) = stream.previous([frame])
        if before is None:
            before = StreamState(frame, self._empty)
        of_stream = (
            frame.motion_from(before.frame),
            [frame.seconds_after(before.frame)],
            [float(before.values is not self._empty)],
        )
        arrays = (np.asarray(values, np.float32) for values in of_stream)
        return {**dict(zip(OF_STREAM, arrays, strict=True)), **before.values}

    def remember(
        self, stream: Scenes, meta: Mapping[str, Any], outputs: Mapping[str, NDArray[Any]]
    ) -> None:
        """Advance a stream by one frame.

        Args:
            stream: Drive of the frame.
            meta: Pose and time of the frame, as a call takes them.
            outputs: Outputs of `run` for the frame.
        """
        left = {name: outputs[f"new_{name}"] for name in self._empty}
        stream.keep([StreamState(Frame.of(meta), left)])

    def _check_images(self, images: Sequence[NDArray[Any]] | NDArray[Any]) -> None:
        """Raise ValueError if the number or the form of the images is not that of the cameras."""
        if len(images) != len(self.cameras):
            raise InputError(
                f"{self.path.name} takes {len(self.cameras)} cameras, {', '.join(self.cameras)}, "
                f"got {len(images)} images: give one of each, or export for other cameras."
            )
        rows, columns = self.image_size
        for camera, image in zip(self.cameras, images, strict=True):
            if np.shape(image) != (rows, columns, 3):
                raise InputError(
                    f"{self.path.name} takes images of {rows} x {columns} (rows x columns, three "
                    f"channels), that of {camera} has shape {np.shape(image)}: scale it and "
                    f"lidar2img alike, or export with --size."
                )

    def run(self, inputs: Mapping[str, NDArray[np.float32]]) -> dict[str, NDArray[Any]]:
        """Return the outputs of the graph by name, wherever the elements lie.

        Raises:
            ValueError: If ONNX Runtime cannot run the graph on these inputs.
        """
        try:
            values = self.session.run(self._outputs, inputs)
        except Exception as error:  # onnxruntime's errors have no common class of their own
            raise InputError(
                f"{self.path} cannot be run ({error!s:.300}): if the inputs are those of its "
                "cameras, the file is damaged; export it again."
            ) from error
        return dict(zip(self._outputs, values, strict=True))

    def elements(self, outputs: Mapping[str, NDArray[Any]]) -> MapElements:
        """Keep the elements that lie on the map or close to it and score enough.

        Raises:
            ValueError: If the outputs are no map elements.
        """
        try:
            return self._kept(outputs)
        except (ValueError, TypeError, IndexError) as error:
            raise InputError(
                f"{self.path} gave no map elements ({error}): if the images are whole, the file "
                "is damaged; export it again."
            ) from error

    def _kept(self, outputs: Mapping[str, NDArray[Any]]) -> MapElements:
        """Select among the elements."""
        margin, threshold = self.metadata["margin_m"], self.metadata["score_threshold"]
        keep = np.ones(len(outputs["scores"]), dtype=bool)
        if margin is not None:
            low, high = np.array([self.metadata["x_range"], self.metadata["y_range"]]).T
            points = outputs["points"][..., :2]
            keep = ((points >= low - margin) & (points <= high + margin)).all((1, 2))
        if threshold is not None:
            keep &= outputs["scores"] > threshold
        kept = {
            name: values[keep]
            for name, values in outputs.items()
            if not name.startswith(f"new_{MEMORY}")
        }
        if not np.isin(kept["labels"], range(len(self.classes))).all():
            raise InputError(f"a label is none of the {len(self.classes)} classes")
        lines = np.isin(kept["labels"], self.metadata.get("unfold_classes", []))
        if lines.any():
            orders = shortest_orders(kept["points"][lines])
            for name in kept.keys() - {"scores", "labels", "num_pts"}:
                kept[name][lines] = kept[name][lines][np.arange(len(orders))[:, None], orders]
        points, numbers = kept.pop("points"), kept.pop("num_pts", None)
        if numbers is None:
            return MapElements.from_polylines(points, **kept)
        cut = [line[:number] for line, number in zip(points, numbers, strict=True)]
        return MapElements.from_polylines(cut, **kept)

    def write(self, path: str | Path, samples: Iterable[tuple[str, MapElements]]) -> None:
        """Write each sample's token and elements as ``tools/test.py --out`` does."""
        vectors = ((token, vectors_of(found, self.classes)) for token, found in samples)
        write_results(path, vectors, {"classes": list(self.classes)})


def _check_metadata(metadata: Mapping[str, Any]) -> None:
    """Raise an error unless a file's metadata are such as `export_onnx` writes."""
    for name in ("classes", "cameras"):
        names = metadata[name]
        if not (isinstance(names, list) and names and all(isinstance(n, str) for n in names)):
            raise InputError(f"{name} must be names, got {names!r:.80}")
    for name in ("x_range", "y_range"):
        low, high = metadata[name]
        if not -np.inf < low < high < np.inf:
            raise InputError(f"{name} must be (low, high), got {metadata[name]!r:.80}")
    for name in ("margin_m", "score_threshold"):
        if metadata[name] is not None and not np.isfinite(metadata[name]):
            raise InputError(f"{name} must be a number, got {metadata[name]!r:.80}")
    _check_poses(metadata)
    unfold = metadata.get("unfold_classes", [])
    if not (isinstance(unfold, list) and all(type(label) is int for label in unfold)):
        raise InputError(f"unfold_classes must be class indices, got {unfold!r:.80}")
    if not 0 < metadata.get("max_gap_s", 1.0) < np.inf:
        raise InputError(f"max_gap_s must be seconds > 0, got {metadata['max_gap_s']!r:.80}")


def _check_poses(metadata: Mapping[str, Any]) -> None:
    """Raise ValueError if a mount in the metadata is no rigid pose."""
    for name in ("ground_from_frame", "ego_from_frame"):
        matrix = np.asarray(metadata.get(name, np.eye(4)), np.float64)
        if matrix.shape != (4, 4) or not is_rigid(matrix):
            raise InputError(f"{name} must be a pose, got {metadata[name]!r:.80}")
