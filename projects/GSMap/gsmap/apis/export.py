"""Export of a trained model to one ONNX file that computes elements from images and calibration."""

import copy
import json
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from gsmap.apis.onnx_inferencer import (
    CAN_BUS_RULE,
    FORMAT,
    MEMORY_PREFIX,
    METADATA_KEY,
    NO_SIGNALS,
    POSE_ONLY_RULE,
    PRIOR_INPUT,
    STREAM_INPUTS,
    OnnxInferencer,
)
from gsmap.apis.rig_fit import camera_names, camera_rows
from gsmap.structures.calibration import NUM_CAN_BUS, OF_ONE_FRAME
from gsmap.structures.elements import MapElements
from gsmap.structures.past import Past
from gsmap.utils.errors import GsmapError, InputError
from gsmap.utils.extras import import_extra
from gsmap.utils.files import write_bytes

OPSET = 18


class ExportedDetector(nn.Module):
    """Module that runs a camera `MapDetector` on the tensors of one sample.

    A model with memory runs one step of a stream: the memory of the previous frame is part of the
    inputs, and the new memory is part of the outputs.

    Args:
        model: A `MapDetector` of cameras.

    Attributes:
        input_names: Names of the inputs. `example_inputs` appends the names of the memory tensors.
        output_names: Names of the outputs. `example_inputs` appends the names of the new memory
            tensors.
        memory: Names of the memory tensors; empty before the first call of `example_inputs`.

    Raises:
        ValueError: If the model reads LiDAR, or its head, its memory or its map prior cannot be
            exported.
    """

    def __init__(self, model: Any) -> None:
        super().__init__()
        if model.lidar_encoder is not None:
            raise InputError(
                "only models of cameras can be exported: voxels of LiDAR have no ONNX operator. "
                "Give a config without lidar_encoder."
            )
        head = model.map_head
        if head.not_exported:
            raise InputError(
                f"{type(head).__name__} cannot be exported: {head.not_exported}. Run the model "
                "with tools/infer.py."
            )
        if model.temporal is not None and model.temporal.elements is not None:
            raise InputError(
                "temporal.elements updates the detections after the network and has no ONNX "
                "operators: set model.temporal.elements=None, or model.temporal=None if the model "
                "has no other memory."
            )
        if model.prior is not None and not model.prior.reads_window:
            raise InputError(
                f"{type(model.prior).__name__} works behind the network and has no ONNX operators: "
                "set model.prior=None."
            )
        self.model = model
        stream_inputs = () if model.temporal is None else STREAM_INPUTS
        # Names of the calibration tensors that the BEV encoder and the map prior read.
        calibration = [*model.bev_encoder.calibration]
        prior_inputs: tuple[str, ...] = ()
        if model.prior is not None:
            prior_inputs = (PRIOR_INPUT,)
            for name in model.prior.calibration:
                if name not in calibration:
                    calibration.append(name)
        self.input_names = ("images", *calibration, *prior_inputs, *stream_inputs)
        # The first output of the references is always the points.
        self.output_names = ("scores", "labels", "points", *head.reference.outputs[1:])
        self.memory: tuple[str, ...] = ()
        self._empty_memory: dict[str, Tensor] = {}

    def forward(self, images: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Predict the map elements with the highest scores, even outside of the map's range.

        Args:
            images: Pixel values of the data pipeline: 0 to 255, neither normalised nor padded.
                (V, 3, H, W)
            inputs: Tensors of ``input_names[1:]``. The first ones are the calibration of the BEV
                encoder and the map prior: matrices (V, 4, 4), or CAN bus signals (18,). A model
                with a map prior also takes the window of the prior (classes, H, W). A model with
                memory also takes the transform from the previous to the current frame in metres
                (4, 4), the seconds between both frames (1,), 1 if the stream continues or else 0
                (1,), and the memory of the previous frame.

        Returns:
            Tensors of ``output_names``, best element first: scores (M,), labels (M,), and points in
            metres (M, P, 2 or 3). Gaussian heads add scales in metres (M, P, 2) and rotations in
            radians (M, P). Heads with a variable number of points add the numbers (M,). A model
            with memory adds its new memory.
        """
        named_inputs = dict(zip(self.input_names[1:], inputs, strict=True))
        elements, new_memory = self.step(images, inputs=named_inputs)
        return (*elements, *new_memory.values())

    def step(
        self, images: Tensor, inputs: dict[str, Tensor]
    ) -> tuple[tuple[Tensor, ...], dict[str, Tensor]]:
        """Predict the map elements of a frame, and update the memory.

        Args:
            images: Pixel values of the data pipeline. (V, 3, H, W)
            inputs: Other inputs of `forward` by name. The entry ``can_bus`` is replaced in place.

        Returns:
            Fields of the elements in the order of ``output_names``, and the new memory by name.
        """
        # The preprocessor normalises and pads each of the V images separately.
        batch = self.model.data_preprocessor({"inputs": {"img": images}})
        images = batch["inputs"]["imgs"]
        all_levels = self.model.extract_img_feats(images[None])
        feats = self.model.bev_encoder.levels(all_levels)
        if "can_bus" in inputs:
            # Signals 0 to 2 and 17, which need earlier frames, become 0, as in `without_history`,
            # which is written in numpy and cannot be exported.
            inputs["can_bus"] = nn.functional.pad(inputs["can_bus"][OF_ONE_FRAME], (3, 1))
        batched = {name: value[None] for name, value in inputs.items()}
        head = self.model.map_head
        temporal = self.model.temporal
        image_size = tuple(images.shape[-2:])
        outputs = self.model.bev_encoder.encode(feats, calibration=batched, img_shape=image_size)
        further_hooks: tuple[Any, ...] = ()  # a hook can append queries to the queries of the head
        prior = self.model.prior
        if prior is not None:
            window = batched[PRIOR_INPUT]
            outputs = prior.fuse_window(outputs, window, batched, img_shape=image_size)
            further_hooks = (prior.hook(outputs),)
        if temporal is None:
            predictions = head(outputs, hooks=further_hooks) if further_hooks else head(outputs)
        else:
            past = Past(
                memory={name: batched[f"{MEMORY_PREFIX}{name}"] for name in self.memory},
                now_from_then=batched["now_from_then"],
                seconds=batched["seconds"][0],  # (1,): one value for the only sample of the batch
                continues=batched["continues"][0] > 0.5,
            )
            # The encoder outputs, fused with the memory, and a hook with the previous queries.
            recalled = temporal.recall(outputs, past)
            recalled.further_hooks = further_hooks
            predictions = head(recalled.outputs, **recalled.hooks)
        last_layer = predictions[-1]
        scores, decoded = head.decode(last_layer.scores[0], last_layer.references[0])
        best = head.coder.best(scores)
        fields = head.select_detections(decoded, best)
        elements = [best.scores, best.labels, fields["pts"]]
        for name in head.reference.outputs[1:]:
            elements.append(fields[name])
        new_memory: dict[str, Tensor] = {}
        if temporal is not None:
            for name, value in temporal.collect_memory(recalled).items():
                new_memory[name] = value[0]
        return tuple(elements), new_memory

    @torch.no_grad()
    def example_inputs(self, num_cams: int, image_size: tuple[int, int]) -> tuple[Tensor, ...]:
        """Create inputs of the right shapes, with black images of cameras at the origin.

        All matrices are identities, and all other inputs are zero.

        For a model with memory, the first call runs the model on a frame to find the names and
        shapes of the memory.

        Args:
            num_cams: Number of cameras.
            image_size: Rows and columns of the images, in pixels.

        Returns:
            Tensors of ``input_names``.
        """
        inputs: dict[str, Tensor] = {}
        for name in self.input_names[1:]:
            if name.startswith(MEMORY_PREFIX):
                continue
            if name == "can_bus":
                inputs[name] = torch.zeros(NUM_CAN_BUS)
            elif name == "now_from_then":
                inputs[name] = torch.eye(4)
            elif name == PRIOR_INPUT:
                window = self.model.prior.window
                shape = (len(self.model.map_head.classes), window.height, window.width)
                inputs[name] = torch.zeros(shape)
            elif name in STREAM_INPUTS:
                inputs[name] = torch.zeros(1)
            else:
                inputs[name] = torch.eye(4).repeat(num_cams, 1, 1)
        images = torch.zeros(num_cams, 3, *image_size)
        if self.model.temporal is not None and not self.memory:
            # A copy, because `step` replaces an entry.
            _, memory = self.step(images, inputs=dict(inputs))
            self.memory = tuple(memory)
            for name, value in memory.items():
                self._empty_memory[f"{MEMORY_PREFIX}{name}"] = torch.zeros_like(value)
            self.input_names += tuple(self._empty_memory)
            self.output_names += tuple(f"new_{name}" for name in self._empty_memory)
        for name, value in self._empty_memory.items():
            inputs[name] = value.clone()
        return images, *inputs.values()


def export_onnx(
    model: Any,
    out: str | Path,
    cameras: Sequence[str],
    image_size: tuple[int, int],
    frame: str = "lidar",
) -> None:
    """Export a model to an ONNX file with standard operators only.

    If ``model`` was loaded by ``load_model``, the metadata of the file contain the pose of the
    annotation frame on the vehicle.

    Args:
        model: A `MapDetector` with its weights on the CPU. It is set to evaluation mode.
        out: File to write.
        cameras: Names of the cameras, in the order of the images. They must be the
            ``camera_names`` of a model of ``load_model``, which has chosen these by its config.
        image_size: Rows and columns of the images of the data pipeline, in pixels.
        frame: Annotation frame, for the metadata: ``"lidar"`` or ``"ego"``.

    Raises:
        RuntimeError: If the packages of the extra ``onnx`` are not installed.
        ValueError: If the model cannot be exported (`ExportedDetector`), has other cameras, or
            needs an operator that ONNX does not have.
    """
    names = getattr(model, "camera_names", None)  # None if the cameras have no embeddings
    if names is not None and list(cameras) != list(names):
        raise InputError(
            f"the model has embeddings of the cameras {', '.join(names)}, got the cameras "
            f"{', '.join(cameras)}: set test_dataloader.dataset.cameras to all or some cameras of "
            "the model, in any order, and give the file images of your cameras in their places."
        )
    onnx = import_extra("onnx", "onnx")
    import_extra("onnxscript", "onnx")  # a dependency of torch's exporter
    exported = ExportedDetector(model).eval()
    inputs = exported.example_inputs(len(cameras), image_size=image_size)
    try:
        with torch.no_grad():
            program = torch.onnx.export(
                exported,
                inputs,
                dynamo=True,
                opset_version=OPSET,
                input_names=exported.input_names,
                output_names=exported.output_names,
                custom_translation_table=_operator_translations(),
                verbose=False,
            )
    except torch.onnx.errors.OnnxExporterError as error:
        raise InputError(_describe_export_error(error)) from error
    assert program is not None  # None is returned only if torch writes the file itself
    proto = program.model_proto
    for graph_or_node in (proto.graph, *proto.graph.node):
        del graph_or_node.metadata_props[:]  # stack traces with paths of this machine
    metadata = graph_metadata(exported, cameras=cameras, image_size=image_size, frame=frame)
    onnx.helper.set_model_props(proto, {METADATA_KEY: json.dumps(metadata)})
    onnx.checker.check_model(proto)
    write_bytes(out, proto.SerializeToString())


def graph_metadata(
    exported: ExportedDetector, cameras: Sequence[str], image_size: tuple[int, int], frame: str
) -> dict[str, Any]:
    """Create the metadata of an ONNX file, which `OnnxInferencer` reads.

    Args:
        exported: The model in its exported form.
        cameras: Names of the cameras, in the order of the images.
        image_size: Rows and columns of the images, in pixels.
        frame: Annotation frame: ``"lidar"`` or ``"ego"``.

    Returns:
        The metadata, in JSON types.
    """
    model = exported.model
    head = model.map_head
    metadata: dict[str, Any] = {
        "format": FORMAT,
        "image_size": list(image_size),
        "classes": list(head.classes),
        "x_range": list(head.grid.x_range),
        "y_range": list(head.grid.y_range),
        "frame": frame,
        "cameras": list(cameras),
        "margin_m": head.coder.margin_m,
        "score_threshold": head.coder.score_threshold,
        "unfold_classes": list(head.coder.unfold_classes),
    }
    # Pose of the annotation frame on the vehicle. Only models of `load_model` have one.
    mount = getattr(model, "mount", None)
    if mount is not None:
        metadata["ground_z_m"] = mount.ground_z_m
        metadata["ground_from_frame"] = mount.matrix.tolist()
        metadata["ego_from_frame"] = mount.ego_from_frame.tolist()
    if "can_bus" in exported.input_names:
        metadata["can_bus"] = signals_rule(model)
    if model.temporal is not None:
        metadata["max_gap_s"] = model.temporal.max_gap_s
    return metadata


def signals_rule(model: Any) -> str:
    """Describe the ``can_bus`` values with which a model from `load_model` was trained.

    The text is one of `NO_SIGNALS`, `POSE_ONLY_RULE` and `CAN_BUS_RULE`, by which `OnnxInferencer`
    decides whether a sample needs signals.
    """
    if getattr(model, "without_signals", False):
        return NO_SIGNALS
    cfg = getattr(model, "cfg", None)
    loader: Any = {}
    if cfg is not None:
        loader = cfg.get("test_dataloader") or {}
    pose_only = loader.get("dataset", {}).get("pose_only_signals", False)
    return POSE_ONLY_RULE if pose_only else CAN_BUS_RULE


def halve_onnx(path: str | Path, out: str | Path) -> None:
    """Convert the convolutions of an exported file to half precision.

    Convolutions do nearly all of the arithmetic. All other operators, which compute positions and
    scores of elements, stay in float32.

    Args:
        path: File of `export_onnx`.
        out: File to write.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    model = onnx.load(path)
    weights = {tensor.name: tensor for tensor in model.graph.initializer}
    nodes = list(model.graph.node)
    del model.graph.node[:]
    for node in nodes:
        if node.op_type not in ("Conv", "ConvTranspose"):
            model.graph.node.append(node)
            continue
        for name in node.input[1:]:  # weight and bias
            half = numpy_helper.to_array(weights[name]).astype(np.float16)
            weights[name].CopyFrom(numpy_helper.from_array(half, name=name))
        image, *parameters = node.input
        (result,) = node.output
        half_input = f"{result}_half_in"
        half_output = f"{result}_half_out"
        node.input[:] = [half_input, *parameters]
        node.output[:] = [half_output]
        # The convolution itself runs in float16, between two casts.
        before = helper.make_node("Cast", [image], [half_input], to=TensorProto.FLOAT16)
        after = helper.make_node("Cast", [half_output], [result], to=TensorProto.FLOAT)
        model.graph.node.extend([before, node, after])
    onnx.checker.check_model(model)
    write_bytes(out, model.SerializeToString())


def quantize_onnx(
    path: str | Path, out: str | Path, inputs: Iterable[dict[str, NDArray[np.float32]]]
) -> None:
    """Quantize the convolutions of an exported file to 8 bits, with value ranges from samples.

    Args:
        path: File of `export_onnx`.
        out: File to write.
        inputs: Inputs of the graph for some samples, from `OnnxInferencer.prepare`.

    Raises:
        ValueError: If there are no inputs.
    """
    from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static

    remaining_inputs = iter(inputs)

    class SampleReader(CalibrationDataReader):
        """Reader of one sample at a time."""

        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            """Inputs of the next sample, or None after the last one."""
            return next(remaining_inputs, None)

    # `quantize_static` writes its result itself. The file is complete before it gets its place.
    with tempfile.TemporaryDirectory(prefix="gsmap-") as folder:
        quantized = Path(folder, "int8.onnx")
        quantize_static(
            path,
            quantized,
            SampleReader(),
            op_types_to_quantize=["Conv"],
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
        write_bytes(out, quantized.read_bytes())


def graph_inputs(
    inferencer: OnnxInferencer, dataset: Any, indices: Iterable[int]
) -> Iterator[tuple[str, dict[str, NDArray[np.float32]]]]:
    """Yield the inputs of the exported graph for samples of a data set.

    Cameras are assigned to the cameras of the graph by name, or else by viewing direction
    (`camera_rows`). For a model with memory, the samples of a scene form a stream in the order of
    ``indices``, and the graph is run on each sample to compute its new memory.

    Args:
        inferencer: The exported graph.
        dataset: Data set with the test pipeline.
        indices: Indices of the samples.

    Yields:
        Token of a sample, and its inputs by name.

    Raises:
        ValueError: If cameras, images or matrices do not fit the cameras of the graph.
    """
    dataset = _with_cameras_of(inferencer, dataset)
    streams = inferencer.new_scenes() if inferencer.has_memory else None
    for index in indices:
        packed = dataset[index]
        images = packed["inputs"]["img"].permute(0, 2, 3, 1).numpy()  # (V, H, W, 3)
        meta = packed["data_samples"].metainfo
        inputs = inferencer.prepare(images, meta=meta, stream=streams)
        yield meta["token"], inputs
        if streams is not None:  # the next sample of this scene needs the new memory
            outputs = inferencer.run(inputs)
            inferencer.remember(streams, meta=meta, outputs=outputs)


def _with_cameras_of(inferencer: OnnxInferencer, dataset: Any) -> Any:
    """Copy of a data set whose cameras are in the order of the graph.

    Raises:
        ValueError: If there is not exactly one camera for each camera of the graph.
    """
    names = camera_names(dataset)
    # For each camera of the data set, the index of the camera of the graph that it stands for.
    rows = camera_rows(dataset, trained=inferencer.cameras)
    if sorted(rows) != list(range(len(inferencer.cameras))):
        raise InputError(
            f"{inferencer.path.name} takes the cameras {', '.join(inferencer.cameras)}; those of "
            f"the samples, {', '.join(names)}, are not one for each of them by name or direction: "
            "name them as the model does, or export for fewer cameras "
            "(test_dataloader.dataset.cameras)."
        )
    dataset = copy.copy(dataset)  # the caller's data set keeps its cameras
    dataset.cameras = tuple(names[index] for index in np.argsort(rows))
    return dataset


def largest_differences(
    found: MapElements, expected: MapElements, unfolded: Sequence[int] = ()
) -> tuple[float, float]:
    """Compare two predictions of one sample. The order of elements may differ.

    Args:
        found: Elements of the first prediction.
        expected: Elements of the second prediction.
        unfolded: Class indices of ``unfold_classes``, whose points are reordered to a short path.
            If two orders are nearly equally short, rounding decides between them. The order of
            points is therefore ignored for these classes.

    Returns:
        The largest difference of a score, and the largest distance in metres of an element of
        ``found`` from the nearest element of its class in ``expected``. The distance of two
        elements is the largest difference of a coordinate, and infinite if their numbers of points
        differ. Both returned values are infinite if the numbers of elements of a class differ.
    """
    if sorted(found.labels) != sorted(expected.labels):
        return float("inf"), float("inf")
    if not len(found):
        return 0.0, 0.0
    scores = np.abs(np.sort(found.confidence) - np.sort(expected.confidence)).max()
    distances = np.full((len(found), len(found)), fill_value=np.inf)  # (M, M)
    for i, line in enumerate(found.polylines):
        for j, expected_line in enumerate(expected.polylines):
            if found.labels[i] != expected.labels[j] or line.shape != expected_line.shape:
                continue
            distances[i, j] = np.abs(line - expected_line).max()
            if found.labels[i] in unfolded:
                # Points may be in another order: each point of a line is compared with the nearest
                # point of the other line, in both directions.
                between_points = np.abs(line[:, None] - expected_line).max(-1)  # (P, P)
                to_line = between_points.min(0).max()
                from_line = between_points.min(1).max()
                distances[i, j] = max(to_line, from_line)
    return float(scores), float(distances.min(1).max())


def _operator_translations() -> dict[Any, Any]:
    """Translations of torch's operators to ONNX that replace the translations of the exporter."""
    from onnxscript import opset18

    op: Any = opset18  # Any, as its type annotations expect element types that are unknown here

    def embedding_bag(
        table: Any,
        rows: Any,
        offsets: Any,
        _scale_grad: bool,
        mode: int,
        _sparse: bool,
        weights: Any,
        include_last_offset: bool,
        _padding_idx: int | None,
    ) -> Any:
        """Compute weighted sums of table rows for bags of equal size, without a loop over bags.

        A bag is the group of rows of one sum. Deformable sampling
        (`gsmap.ops.deformable_sampling.sum_rows`) has bags of equal size. The parameters are in the
        order of torch's operator.
        """
        is_sum = mode == 0  # the other modes are the mean and the maximum
        if not is_sum or weights is None or include_last_offset:
            raise NotImplementedError("embedding_bag other than weighted sums in bags of one size")
        one = op.Constant(value_ints=[1])
        num_bags = op.Shape(offsets)
        # The size is computed, because a Reshape to -1 would fail for 0 bags.
        bag_size = op.Div(op.Shape(rows), op.Max(num_bags, one))
        bags = op.Concat(num_bags, bag_size, axis=0)  # the shape (bags, rows of a bag)
        weights = op.Unsqueeze(op.Reshape(weights, bags, allowzero=1), one)
        # (bags, 1, rows of a bag) @ (bags, rows of a bag, C)
        sums = op.MatMul(weights, op.Gather(table, op.Reshape(rows, bags, allowzero=1)))
        # The operator has three more outputs, which only its backward pass needs.
        return op.Squeeze(sums, one), offsets, offsets, offsets

    return {torch.ops.aten.embedding_bag.padding_idx: embedding_bag}


def _describe_export_error(error: BaseException) -> str:
    """Describe the root cause of a failed export."""
    while error.__cause__ is not None:
        error = error.__cause__
    if isinstance(error, GsmapError):  # raised by the model, for example for a number of cameras
        return str(error)
    return (
        f"the model cannot be written in ONNX's operators ({error!s:.300}): add a translation to "
        "_operator_translations() of gsmap/apis/export.py, or replace this part of the model."
    )
