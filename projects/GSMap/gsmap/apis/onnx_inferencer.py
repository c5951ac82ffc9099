"""Predictor for exported models on a vehicle, which requires only numpy and onnxruntime."""

import json
import logging
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

_LOGGER = logging.getLogger(__name__)
METADATA_KEY = "gsmap"  # key of the metadata, a JSON text, among the properties of the ONNX file
FORMAT = 1  # version of the metadata; files of another version are refused
# The next three texts are the values of the metadata's field ``can_bus``. They describe the vehicle
# signals that the graph needs.
CAN_BUS_RULE = (
    "the 18 values of a sample's record; the graph itself sets entries 0 to 2 and 17 to zero"
)
POSE_ONLY_RULE = (
    "the 18 values that pose_only_signals of gsmap.structures.vehicle_signals makes of the pose of "
    "the vehicle, as the model was trained"
)
NO_SIGNALS = "not needed: the model was trained without vehicle signals; zeros are taken"
# Inputs of a model with memory: the transform from the previous to the current frame, the seconds
# between the frames, and 1 if the frame continues a stream, or 0 if it starts one.
STREAM_INPUTS = ("now_from_then", "seconds", "continues")
PRIOR_INPUT = "prior"  # input of models with a map prior: the part of an earlier map at the vehicle
# Prefix of the inputs with the memory. The outputs with the new memory start with `new_memory_`.
MEMORY_PREFIX = "memory_"
# Types of numpy for the memory, by the names of ONNX Runtime.
_PRECISIONS = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_REQUIRED_OUTPUTS = {"scores", "labels", "points"}
# White pixels in float32 become up to 255.0001 when OpenCV scales them.
_ROUNDING = 0.01


class OnnxInferencer:
    """Predictor of map elements by an ONNX file of ``tools/export.py``.

    Args:
        path: The file.
        providers: Execution providers of ONNX Runtime, in order of preference.
        num_threads: Number of threads of each operator; 0 for one thread per core.

    Attributes:
        classes: Names of the classes.
        cameras: Names of the cameras, in the order of images and matrices.
        image_size: Rows and columns of the images, in pixels.
        prior_shape: Shape (classes, H, W) of the window of a map prior; None if the model reads
            no prior. The window covers ``x_range`` and ``y_range`` of the metadata.
        metadata: Metadata of the file. ``ground_from_frame`` (4, 4), if present, is the transform
            in metres from the annotation frame to the ground below the rear axle (x ahead, y left,
            z up) in the training data. The frame in which a vehicle's cameras are calibrated must
            have this pose, too.

    Raises:
        FileNotFoundError: If there is no such file.
        RuntimeError: If onnxruntime is not installed.
        ValueError: If the file is not an exported model, or was exported by another version.
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
        options.log_severity_level = 4  # only fatal errors; other errors are raised, not logged
        try:
            self.session = onnxruntime.InferenceSession(
                str(path), options, providers=list(providers)
            )
        except Exception as error:  # errors of onnxruntime have no common base class
            raise InputError(
                f"{path} cannot be run by ONNX Runtime {onnxruntime.__version__} "
                f"({error!s:.300}): export it again, or install a newer onnxruntime."
            ) from error
        try:
            self._read_graph()
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(
                f"{path} does not say that tools/export.py of this version wrote it ({error!r}): "
                "export the model again."
            ) from error
        self.classes: tuple[str, ...] = tuple(self.metadata["classes"])
        self.cameras: tuple[str, ...] = tuple(self.metadata["cameras"])
        self.image_size: tuple[int, int] = tuple(self.metadata["image_size"])
        self._noted_signals = False  # True after the note that given signals are not used

    def _read_graph(self) -> None:
        """Read and check the metadata, the inputs and the outputs of the graph."""
        metadata_text = self.session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
        self.metadata: dict[str, Any] = json.loads(metadata_text or "{}")
        if self.metadata["format"] != FORMAT:
            raise InputError("another format")
        _check_metadata(self.metadata)
        self._outputs = [output.name for output in self.session.get_outputs()]
        images, *other_inputs = self.session.get_inputs()
        shape = [len(self.metadata["cameras"]), 3, *self.metadata["image_size"]]
        if images.shape != shape or not _REQUIRED_OUTPUTS.issubset(self._outputs):
            raise InputError("its graph does not fit its metadata")
        self._initial_memory: dict[str, NDArray[Any]] = {}
        self._calibration: list[str] = []
        self.prior_shape: tuple[int, ...] | None = None
        for graph_input in other_inputs:
            name = graph_input.name
            if name.startswith(MEMORY_PREFIX):
                dtype = _PRECISIONS[graph_input.type]
                self._initial_memory[name] = np.zeros(graph_input.shape, dtype=dtype)
            elif name == PRIOR_INPUT:
                self.prior_shape = tuple(graph_input.shape)
            elif name not in STREAM_INPUTS:  # any other input is an array of the calibration
                self._calibration.append(name)
        if self.has_memory != bool(self._initial_memory):
            raise InputError("its graph and its metadata do not agree on a memory")

    # A pickled stream recognises its model by this text (`Scenes.claim`).
    def __str__(self) -> str:
        return str(self.path)

    @property
    def has_memory(self) -> bool:
        """Whether the model uses the memory of previous frames."""
        return "max_gap_s" in self.metadata

    def new_stream(self) -> MapStream:
        """Create the empty memory of a drive.

        Raises:
            ValueError: If the model has no memory.
        """
        if not self.has_memory:
            raise InputError(f"{self.path.name} has no memory: leave the stream out.")
        return MapStream(self.metadata["max_gap_s"])

    def new_scenes(self) -> Scenes:
        """Create the empty memories of several scenes.

        Raises:
            ValueError: If the model has no memory.
        """
        return Scenes(self.new_stream().max_gap_s)  # `new_stream` checks that there is a memory

    def __call__(
        self,
        images: Sequence[NDArray[Any]] | NDArray[Any],
        meta: Mapping[str, Any],
        stream: Scenes | None = None,
    ) -> MapElements:
        """Predict the map elements of one sample.

        Args:
            images: Images of ``cameras`` in their order: BGR as OpenCV reads them, values 0 to 255,
                padded and scaled to ``image_size`` as in training. (V, H, W, 3)
            meta: Calibration of the sample. In the names of its fields, ``lidar`` is the annotation
                frame.

                * All models read ``lidar2img`` (V, 4, 4): from metres in the annotation frame to
                  (u * d, v * d, d, 1), with column u and row v of a pixel of these images, and
                  depth d in metres.
                * Camera-aware LSS encoders also read ``lidar2cam`` in metres, ``cam2img`` of the
                  original images in pixels, ``img_aug_matrix`` from the original to these images,
                  (V, 4, 4) each, and ``lidar2ego`` (4, 4) in metres, by default the transform of
                  the training data.
                * GKT and BEVFormer also read ``can_bus`` (18,) of a record. If the model was
                  trained without vehicle signals, zeros are taken, even if it is given.
                * Models with a map prior also read ``prior``, values in [0, 1] of the cells in the
                  range of the map. It has the shape ``prior_shape``; the default is zeros.
                * Models with memory also read ``scene``, ``timestamp_ns`` and ``lidar2global``
                  (4, 4), from the annotation frame to the world in metres.
            stream: Memory of the drive of the sample, for a model with memory: a result of
                `new_stream`, or of `new_scenes` for samples of several scenes. The call adds this
                sample to it.

        Returns:
            The elements, best first, with scores and, if the model predicts them, Gaussians.

        Raises:
            ValueError: If images or matrices do not fit the cameras, a matrix is missing, a pixel
                is not in [0, 255], or a value is not finite. For a model with memory, also if there
                is no stream, if the stream belongs to another model, or if the frame is not later
                than the last frame of the stream. For a model without memory, also if there is a
                stream. Also if the graph fails on the inputs, or its outputs are not valid map
                elements.
        """
        outputs = self.run(self.prepare(images, meta=meta, stream=stream))
        elements = self.elements(outputs)
        if stream is not None:
            self.remember(stream, meta=meta, outputs=outputs)
        return elements

    def prepare(
        self,
        images: Sequence[NDArray[Any]] | NDArray[Any],
        meta: Mapping[str, Any],
        stream: Scenes | None = None,
    ) -> dict[str, NDArray[np.float32]]:
        """Prepare the inputs of the graph for one frame.

        Args:
            images: Images of the cameras in uint8. (V, H, W, 3)
            meta: Calibration and pose of the frame, as in `__call__`.
            stream: Memory of the drive of the frame, for a model with memory. It is read, but not
                advanced (`remember`).

        Returns:
            The inputs by their names. They are float32, except that a memory keeps its type.

        Raises:
            ValueError: If an input does not fit (see `__call__`).
        """
        self._check_images(images)
        self._check_signals(meta)
        if self.metadata.get("can_bus") == NO_SIGNALS and meta.get("can_bus") is not None:
            self._note_unused_signals()
            meta = {**meta, "can_bus": None}  # the input is then zero
        if meta.get("lidar2ego") is None:
            meta = {**meta, "lidar2ego": self.metadata.get("ego_from_frame")}
        # The arrays that the graph takes as inputs, computed from the matrices of `meta`.
        inputs = calibration_arrays(meta, names=self._calibration)
        for name, array in inputs.items():
            if name != "can_bus" and array.shape != (len(self.cameras), 4, 4):
                raise InputError(
                    f"{name} of {self.path.name} needs one 4 x 4 matrix for each of its "
                    f"{len(self.cameras)} cameras {', '.join(self.cameras)}, got shape "
                    f"{array.shape}."
                )
        stacked = np.stack(list(map(np.asarray, images)))  # (V, H, W, 3)
        for name, array in {"images": stacked, **inputs}.items():
            if np.issubdtype(array.dtype, np.inexact) and not np.isfinite(array).all():
                raise InputError(
                    f"{name} of {self.path.name} must be finite: the sample has NaN or infinity in "
                    "it, or in a matrix from which it is computed."
                )
        pixels = np.ascontiguousarray(stacked.transpose(0, 3, 1, 2), dtype=np.float32)
        if self.prior_shape is not None:
            inputs[PRIOR_INPUT] = self._read_window(meta)
        if self.has_memory or stream is not None:
            inputs |= self._stream_inputs(meta, stream=stream)
        return {"images": pixels, **inputs}

    def _read_window(self, meta: Mapping[str, Any]) -> NDArray[np.float32]:
        """Window of the map prior in the metadata of a frame; zeros if there is none.

        Raises:
            ValueError: If the window has another shape or values outside of [0, 1].
        """
        assert self.prior_shape is not None
        window = meta.get(PRIOR_INPUT)
        if window is None:
            return np.zeros(self.prior_shape, dtype=np.float32)
        values = np.asarray(window, dtype=np.float32)
        if values.shape != self.prior_shape or not ((values >= 0) & (values <= 1)).all():
            raise InputError(
                f"prior of {self.path.name} must have values in [0, 1] and shape "
                f"{self.prior_shape}, got shape {values.shape}."
            )
        return values

    def _check_signals(self, meta: Mapping[str, Any]) -> None:
        """Raise ValueError if the graph needs vehicle signals and ``meta`` has none."""
        rule = self.metadata.get("can_bus")
        has_signals = rule == NO_SIGNALS or meta.get("can_bus") is not None
        if "can_bus" not in self._calibration or has_signals:
            return
        if rule == POSE_ONLY_RULE:
            raise InputError(f"{self.path.name} needs can_bus, {POSE_ONLY_RULE}.")
        raise InputError(
            f"{self.path.name} needs can_bus, {CAN_BUS_RULE}. From poses: motion_signals of "
            "gsmap.structures.vehicle_signals; zeros for a model that was trained without signals."
        )

    def _note_unused_signals(self) -> None:
        """Log once that given vehicle signals are not used."""
        if not self._noted_signals:
            _LOGGER.warning("%s: can_bus is %s.", self.path.name, NO_SIGNALS)
            self._noted_signals = True

    def _stream_inputs(self, meta: Mapping[str, Any], stream: Scenes | None) -> dict[str, Any]:
        """Inputs with the memory after the previous frame, and with the motion since then.

        Args:
            meta: Pose and time of the frame, as in `__call__`.
            stream: Memory of the drive of the frame.

        Raises:
            ValueError: If the model or the call has no memory, the stream belongs to another model,
                or the frame is not later than the last frame of the stream.
        """
        if stream is None or not self.has_memory:
            self.new_stream()  # raises an error if the model has no memory
            raise InputError(
                f"{self.path.name} remembers the frames of a drive: give the call its stream, "
                "which new_stream() starts."
            )
        stream.claim(self)  # raises an error if the stream belongs to another model
        frame = Frame.from_meta(meta)
        (previous,) = stream.previous([frame])  # None for a frame that starts a stream
        continues = previous is not None
        if previous is None:
            # The frame is its previous frame: the motion is the identity and 0 s have passed.
            previous = StreamState(frame, values=self._initial_memory)
        motion = frame.motion_from(previous.frame)  # (4, 4)
        seconds = frame.seconds_after(previous.frame)
        return {
            "now_from_then": np.asarray(motion, dtype=np.float32),
            "seconds": np.asarray([seconds], dtype=np.float32),
            "continues": np.asarray([continues], dtype=np.float32),
            **previous.values,
        }

    def remember(
        self, stream: Scenes, meta: Mapping[str, Any], outputs: Mapping[str, NDArray[Any]]
    ) -> None:
        """Advance a stream by one frame.

        Args:
            stream: Memory of the drive of the frame; changed in place.
            meta: Pose and time of the frame, as in `__call__`.
            outputs: Outputs of `run` for the frame, which include its memory.
        """
        memory = {name: outputs[f"new_{name}"] for name in self._initial_memory}
        stream.keep([StreamState(Frame.from_meta(meta), values=memory)])

    def _check_images(self, images: Sequence[NDArray[Any]] | NDArray[Any]) -> None:
        """Raise ValueError if number, shapes or values of images do not fit the cameras."""
        if len(images) != len(self.cameras):
            raise InputError(
                f"{self.path.name} takes {len(self.cameras)} cameras, {', '.join(self.cameras)}, "
                f"got {len(images)} images: give one of each, or export for fewer cameras "
                "(test_dataloader.dataset.cameras)."
            )
        rows, columns = self.image_size
        brightest = 0.0  # of the images in floating point
        for camera, image in zip(self.cameras, images, strict=True):
            if np.shape(image) != (rows, columns, 3):
                raise InputError(
                    f"{self.path.name} takes images of {rows} x {columns} (rows x columns, three "
                    f"channels), the image of {camera} has shape {np.shape(image)}: scale it and "
                    f"lidar2img alike, or export with --size."
                )
            values = np.asarray(image)
            if values.dtype == np.uint8:  # all values are valid
                brightest = 255.0
                continue
            low = values.min()
            high = values.max()
            brightest = max(brightest, float(high))
            is_finite = np.isfinite(low) and np.isfinite(high)  # if not, `prepare` raises an error
            if is_finite and (low < -_ROUNDING or high > 255 + _ROUNDING):
                raise InputError(
                    f"{self.path.name} takes images with values from 0 to 255, the image of "
                    f"{camera} has {low} to {high}: convert it to 8 bits."
                )
        if 0 < brightest <= 1:  # images in the range of torchvision, which look black here
            raise InputError(
                f"{self.path.name} takes images with values from 0 to 255, the images have values "
                "up to 1: multiply them by 255."
            )

    def run(self, inputs: Mapping[str, NDArray[np.float32]]) -> dict[str, NDArray[Any]]:
        """Run the graph.

        Args:
            inputs: Inputs of `prepare`.

        Returns:
            The outputs by name. They include elements outside of the map, which `elements` removes.

        Raises:
            ValueError: If ONNX Runtime cannot run the graph on these inputs.
        """
        try:
            values = self.session.run(self._outputs, inputs)
        except Exception as error:  # errors of onnxruntime have no common base class
            raise InputError(
                f"{self.path} cannot be run ({error!s:.300}): if the inputs come from prepare() of "
                "this file, the file is damaged; export it again."
            ) from error
        return dict(zip(self._outputs, values, strict=True))

    def elements(self, outputs: Mapping[str, NDArray[Any]]) -> MapElements:
        """Select the elements on or near the map whose scores are high enough.

        ``margin_m`` and ``score_threshold`` of the metadata define both limits; None is no limit.

        Args:
            outputs: Outputs of `run`.

        Raises:
            ValueError: If the outputs are not valid map elements.
        """
        try:
            return self._select_elements(outputs)
        except (ValueError, TypeError, IndexError) as error:
            raise InputError(
                f"{self.path} gave no map elements ({error}): if the images are whole, the file "
                "is damaged; export it again."
            ) from error

    def _select_elements(self, outputs: Mapping[str, NDArray[Any]]) -> MapElements:
        """Implementation of `elements`, which may raise errors of numpy."""
        margin = self.metadata["margin_m"]
        threshold = self.metadata["score_threshold"]
        is_selected = np.ones(len(outputs["scores"]), dtype=bool)  # (M,)
        if margin is not None:
            # All points of an element must lie within the margin around the map. `low` and `high`
            # are the corners (x, y) of the map. (2,) each
            low, high = np.array([self.metadata["x_range"], self.metadata["y_range"]]).T
            points = outputs["points"][..., :2]  # (M, P, 2)
            is_selected = ((points >= low - margin) & (points <= high + margin)).all((1, 2))
        if threshold is not None:
            is_selected &= outputs["scores"] > threshold
        fields: dict[str, NDArray[Any]] = {}
        for name, values in outputs.items():
            if not name.startswith(f"new_{MEMORY_PREFIX}"):
                fields[name] = values[is_selected]
        if not np.isin(fields["labels"], range(len(self.classes))).all():
            raise InputError(f"a label is none of the {len(self.classes)} classes")
        self._unfold(fields)
        points = fields.pop("points")
        # Number of valid points of each element; None if all elements have P points.
        counts = fields.pop("num_pts", None)
        if counts is None:
            return MapElements.from_polylines(points, **fields)
        polylines = [line[:count] for line, count in zip(points, counts, strict=True)]
        return MapElements.from_polylines(polylines, **fields)

    def _unfold(self, fields: dict[str, NDArray[Any]]) -> None:
        """Reorder the points of each element of ``unfold_classes`` to a short line, in place.

        A predicted line of these classes may run back and forth.
        """
        unfolded = np.isin(fields["labels"], self.metadata.get("unfold_classes", []))  # (M,)
        if not unfolded.any():
            return
        orders = shortest_orders(fields["points"][unfolded])  # (n, P)
        rows = np.arange(len(orders))[:, None]  # (n, 1)
        for name in fields.keys() - {"scores", "labels", "num_pts"}:  # per point
            of_points = fields[name][unfolded]  # (n, P, ...)
            # Point j of line i is its former point ``orders[i, j]``.
            fields[name][unfolded] = of_points[rows, orders]

    def write(self, path: str | Path, samples: Iterable[tuple[str, MapElements]]) -> None:
        """Write predictions in the format of ``tools/test.py --out``.

        Args:
            path: File to write.
            samples: Token and elements of each sample.
        """
        vectors = ((token, vectors_of(elements, self.classes)) for token, elements in samples)
        write_results(path, vectors, meta={"classes": list(self.classes)})


def _check_metadata(metadata: Mapping[str, Any]) -> None:
    """Check the format of a file's metadata.

    Raises:
        KeyError: If a field is missing.
        TypeError: If a field has another type.
        ValueError: If a value is not possible.
    """
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
    labels = metadata.get("unfold_classes", [])
    # `type` instead of `isinstance`, because a bool is an instance of int.
    if not (isinstance(labels, list) and all(type(label) is int for label in labels)):
        raise InputError(f"unfold_classes must be class indices, got {labels!r:.80}")
    # A model without memory has no `max_gap_s`. The default is any valid value.
    if not 0 < metadata.get("max_gap_s", 1.0) < np.inf:
        raise InputError(f"max_gap_s must be seconds > 0, got {metadata['max_gap_s']!r:.80}")


def _check_poses(metadata: Mapping[str, Any]) -> None:
    """Raise ValueError if a transform in a file's metadata is not rigid."""
    for name in ("ground_from_frame", "ego_from_frame"):
        matrix = np.asarray(metadata.get(name, np.eye(4)), dtype=np.float64)
        if matrix.shape != (4, 4) or not is_rigid(matrix):
            raise InputError(f"{name} must be a pose, got {metadata[name]!r:.80}")
