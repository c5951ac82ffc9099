"""A trained model as one ONNX file: images and calibration in, map elements out."""

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
    MEMORY,
    METADATA_KEY,
    NO_SIGNALS,
    OF_STREAM,
    POSE_ONLY_RULE,
    OnnxInferencer,
)
from gsmap.structures.calibration import NUM_CAN_BUS, OF_ONE_FRAME
from gsmap.structures.elements import MapElements
from gsmap.structures.past import Past
from gsmap.utils.errors import GsmapError, InputError
from gsmap.utils.extras import import_extra
from gsmap.utils.files import write_bytes

OPSET = 18


class ExportedDetector(nn.Module):
    """A `MapDetector` of cameras as a function of tensors alone, for one sample.

    With memory it is one step of a stream: what the frame before has left is further inputs, and
    what this one leaves further outputs.

    Raises:
        ValueError: If the model reads LiDAR, or its head cannot be exported.
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
                "temporal.elements works behind the network and has no ONNX operators: set "
                "model.temporal.elements=None (temporal=None without other memory)."
            )
        self.model = model
        of_stream = () if model.temporal is None else OF_STREAM
        self.input_names = ("images", *model.bev_encoder.calibration, *of_stream)
        self.output_names = ("scores", "labels", "points", *head.reference.outputs[1:])
        self.memory: tuple[str, ...] = ()  # names of what is remembered, after `example_inputs`

    def forward(self, images: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Find the best map elements, wherever they lie.

        Args:
            images: Pixel values as the data pipeline leaves them: 0 to 255, not normalised, not
                padded. (V, 3, H, W)
            inputs: ``input_names[1:]``: what the BEV encoder reads, (V, 4, 4) or (18,). With
                memory also the motion since the frame before (4, 4), which takes metres then to
                metres now, its seconds (1,), whether the stream continues, 1 or 0 (1,), and what
                that frame has left.

        Returns:
            Scores (M,), labels (M,), points in metres (M, P, 2 or 3), and with Gaussians scales in
            metres (M, P, 2) and rotations in radians (M, P), for elements of any number of points
            how many count (M,); best first. With memory also what this frame leaves.
        """
        elements, left = self.step(images, dict(zip(self.input_names[1:], inputs, strict=True)))
        return (*elements, *left.values())

    def step(
        self, images: Tensor, given: dict[str, Tensor]
    ) -> tuple[tuple[Tensor, ...], dict[str, Tensor]]:
        """Map elements of a frame, and the new state of the memory, by name."""
        # a tensor of four axes is normalised and padded image by image
        images = self.model.data_preprocessor({"inputs": {"img": images}})["inputs"]["imgs"]
        feats = self.model.bev_encoder.levels(self.model.extract_img_feats(images[None]))
        if "can_bus" in given:  # `without_history`
            given["can_bus"] = nn.functional.pad(given["can_bus"][OF_ONE_FRAME], (3, 1))
        named = {name: value[None] for name, value in given.items()}
        head = self.model.map_head
        temporal = self.model.temporal
        outputs = self.model.bev_encoder.encode(feats, named, tuple(images.shape[-2:]))
        if temporal is None:
            predictions = head(outputs)
        else:
            memory = {name: named[f"{MEMORY}{name}"] for name in self.memory}
            motion, seconds, continues = (named[name] for name in OF_STREAM)
            batch = temporal.recall(outputs, Past(memory, motion, seconds[0], continues[0] > 0.5))
            predictions = head(batch.outputs, **batch.hooks)
        decoded = head.reference.decode(predictions[-1].references[0])
        best = head.coder.best(head.coder.weighed(predictions[-1].scores[0], decoded))
        fields = head.detected(decoded, best)
        names = ("pts", *head.reference.outputs[1:])
        elements = (best.scores, best.labels, *(fields[name] for name in names))
        left = {} if temporal is None else temporal.collect_memory(batch)
        return elements, {name: value[0] for name, value in left.items()}

    @torch.no_grad()
    def example_inputs(self, num_cams: int, image_size: tuple[int, int]) -> tuple[Tensor, ...]:
        """Return inputs of the right shapes: black images of cameras at the origin.

        With memory, a first frame says what it is, which sets ``memory`` and all names.
        """
        special = {
            "can_bus": torch.zeros(NUM_CAN_BUS),
            "now_from_then": torch.eye(4),
            "seconds": torch.zeros(1),
            "continues": torch.zeros(1),
        }
        given = {  # a tensor of its own for each: torch takes one tensor for one input
            name: special.get(name, torch.eye(4).repeat(num_cams, 1, 1))
            for name in self.input_names[1:]
            if not name.startswith(MEMORY)
        }
        images = torch.zeros(num_cams, 3, *image_size)
        if self.model.temporal is not None and not self.memory:
            _, left = self.step(images, dict(given))
            self.memory = tuple(left)
            given |= {f"{MEMORY}{name}": torch.zeros_like(value) for name, value in left.items()}
            self.input_names = ("images", *given)
            self.output_names += tuple(f"new_{MEMORY}{name}" for name in left)
        return images, *given.values()


def export_onnx(
    model: Any,
    out: str | Path,
    cameras: Sequence[str],
    image_size: tuple[int, int],
    frame: str = "lidar",
) -> None:
    """Write a model as an ONNX file that holds standard operators only.

    Args:
        model: A `MapDetector` with its weights, on the CPU; it is left in evaluation mode.
        out: File to write.
        cameras: Names of the cameras, in the order of the images.
        image_size: Rows and columns of the images as the data pipeline leaves them.
        frame: Frame of the annotations, for whoever uses the file. Where a model of ``load_model``
            has it in the vehicle is written beside it.

    Raises:
        RuntimeError: If the packages of the extra ``onnx`` are not installed.
        ValueError: If the model reads LiDAR, has another number of cameras, or does something for
            which ONNX has no operator.
    """
    onnx = import_extra("onnx", "onnx")
    import_extra("onnxscript", "onnx")  # what torch's exporter is written with
    exported = ExportedDetector(model).eval()
    inputs = exported.example_inputs(len(cameras), image_size)
    try:
        with torch.no_grad():
            program = torch.onnx.export(
                exported,
                inputs,
                dynamo=True,
                opset_version=OPSET,
                input_names=exported.input_names,
                output_names=exported.output_names,
                custom_translation_table=_translations(),
                verbose=False,
            )
    except torch.onnx.errors.OnnxExporterError as error:
        raise InputError(_reason(error)) from error
    assert program is not None  # it is None only where torch writes the file itself
    proto = program.model_proto
    for part in (proto.graph, *proto.graph.node):  # stack traces of the machine that exported
        del part.metadata_props[:]
    metadata = graph_metadata(exported, cameras, image_size, frame)
    onnx.helper.set_model_props(proto, {METADATA_KEY: json.dumps(metadata)})
    onnx.checker.check_model(proto)
    write_bytes(out, proto.SerializeToString())


def graph_metadata(
    exported: ExportedDetector, cameras: Sequence[str], image_size: tuple[int, int], frame: str
) -> dict[str, Any]:
    """Facts about a model that a file of `export_onnx` carries for `OnnxInferencer`.

    Args:
        exported: The model in its exported form.
        cameras: Names of the cameras, in the order of the images.
        image_size: Rows and columns of the images, in pixels.
        frame: Annotation frame: ``"lidar"`` or ``"ego"``.

    Returns:
        The facts, as JSON can hold them.
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
    if getattr(model, "mount", None) is not None:  # of `load_model`
        metadata["ground_z_m"] = model.mount.ground_z_m
        metadata["ground_from_frame"] = model.mount.matrix.tolist()
        metadata["ego_from_frame"] = model.mount.ego_from_frame.tolist()
    if "can_bus" in exported.input_names:
        metadata["can_bus"] = signals_rule(model)
    if model.temporal is not None:
        metadata["max_gap_s"] = model.temporal.max_gap_s
    return metadata


def signals_rule(model: Any) -> str:
    """Values of ``can_bus`` that a model of `load_model` was trained with, in words."""
    if getattr(model, "without_signals", False):
        return NO_SIGNALS
    cfg = getattr(model, "cfg", None)
    loader = {} if cfg is None else cfg.get("test_dataloader") or {}
    pose_only = loader.get("dataset", {}).get("pose_only_signals", False)
    return POSE_ONLY_RULE if pose_only else CAN_BUS_RULE


def halve_onnx(path: str | Path, out: str | Path) -> None:
    """Write a file of `export_onnx` anew, with convolutions that work in half precision.

    They are nearly all of the arithmetic. What places and scores elements stays in float32.
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
        for name in node.input[1:]:
            half = numpy_helper.to_array(weights[name]).astype(np.float16)
            weights[name].CopyFrom(numpy_helper.from_array(half, name))
        image, *parameters = node.input
        (result,) = node.output
        half_input = f"{result}_half_in"
        half_output = f"{result}_half_out"
        node.input[:] = [half_input, *parameters]
        node.output[:] = [half_output]
        before = helper.make_node("Cast", [image], [half_input], to=TensorProto.FLOAT16)
        after = helper.make_node("Cast", [half_output], [result], to=TensorProto.FLOAT)
        model.graph.node.extend([before, node, after])
    onnx.checker.check_model(model)
    write_bytes(out, model.SerializeToString())


def quantize_onnx(
    path: str | Path, out: str | Path, inputs: Iterable[dict[str, NDArray[np.float32]]]
) -> None:
    """Write a file of `export_onnx` anew, with convolutions in 8 bits, calibrated on samples.

    Args:
        path: The file of `export_onnx`.
        out: The file to write.
        inputs: Inputs of the graph for some samples, as `OnnxInferencer.prepare` returns them.

    Raises:
        ValueError: If there are no inputs.
    """
    from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static

    samples = iter(inputs)

    class Samples(CalibrationDataReader):
        """Hands over one sample at a time."""

        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            """Return the next sample's inputs, or None after the last."""
            return next(samples, None)

    with tempfile.TemporaryDirectory(prefix="gsmap-") as folder:
        quantized = Path(folder, "int8.onnx")
        quantize_static(
            path,
            quantized,
            Samples(),
            op_types_to_quantize=["Conv"],
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
        write_bytes(out, quantized.read_bytes())


def graph_inputs(
    inferencer: OnnxInferencer, dataset: Any, indices: Iterable[int]
) -> Iterator[tuple[str, dict[str, NDArray[np.float32]]]]:
    """Yield token and inputs of some samples.

    Args:
        inferencer: The exported graph.
        dataset: Data set with the test pipeline.
        indices: Samples of the data set.

    With memory the samples of a scene continue each other, in their order.

    Raises:
        ValueError: If images or matrices are not those of the file's cameras.
    """
    streams = inferencer.new_scenes() if inferencer.has_memory else None
    for index in indices:
        packed = dataset[index]
        images = packed["inputs"]["img"].permute(0, 2, 3, 1).numpy()  # (V, H, W, 3)
        meta = packed["data_samples"].metainfo
        inputs = inferencer.prepare(images, meta, streams)
        yield meta["token"], inputs
        if streams is not None:
            inferencer.remember(streams, meta, inferencer.run(inputs))


def largest_differences(
    found: MapElements, expected: MapElements, unfolded: Sequence[int] = ()
) -> tuple[float, float]:
    """Compare two predictions of one sample; elements of nearly one score may change places.

    Args:
        found: Elements of one way.
        expected: Elements of the other.
        unfolded: Class indices whose points may change places, too: where two orders are nearly as
            short, rounding decides which one ``unfold_classes`` takes.

    Returns:
        The largest difference of a score, and of a coordinate in metres between an element and the
        nearest one of its class; infinite if there are not as many elements of each class.
    """
    if sorted(found.labels) != sorted(expected.labels):
        return float("inf"), float("inf")
    if not len(found):
        return 0.0, 0.0
    scores = np.abs(np.sort(found.confidence) - np.sort(expected.confidence)).max()
    apart = np.full((len(found), len(found)), np.inf)
    for i, ours in enumerate(found.polylines):
        for j, theirs in enumerate(expected.polylines):
            if found.labels[i] == expected.labels[j] and ours.shape == theirs.shape:
                apart[i, j] = np.abs(ours - theirs).max()
                if found.labels[i] in unfolded:
                    between = np.abs(ours[:, None] - theirs).max(-1)
                    apart[i, j] = max(between.min(0).max(), between.min(1).max())
    return float(scores), float(apart.min(1).max())


def _translations() -> dict[Any, Any]:
    """Translations of torch's operators to ONNX that replace those of the exporter."""
    from onnxscript import opset18

    op: Any = opset18  # its types know tensors by element type, which no value here has yet

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
        """Sum weighted rows in bags of one size, as `sum_rows` does, without a loop."""
        if mode != 0 or weights is None or include_last_offset:
            raise NotImplementedError("embedding_bag other than weighted sums in bags of one size")
        one = op.Constant(value_ints=[1])
        size = op.Div(op.Shape(rows), op.Max(op.Shape(offsets), one))  # -1 fails without any bag
        bags = op.Concat(op.Shape(offsets), size, axis=0)
        weights = op.Unsqueeze(op.Reshape(weights, bags, allowzero=1), one)
        sums = op.MatMul(weights, op.Gather(table, op.Reshape(rows, bags, allowzero=1)))
        return op.Squeeze(sums, one), offsets, offsets, offsets

    return {torch.ops.aten.embedding_bag.padding_idx: embedding_bag}


def _reason(error: BaseException) -> str:
    """Message of the first cause of a failed export."""
    while error.__cause__ is not None:
        error = error.__cause__
    if isinstance(error, GsmapError):  # the model's own word, for instance of a number of cameras
        return str(error)
    return (
        f"the model cannot be written in ONNX's operators ({error!s:.300}): say how in "
        "_translations() of gsmap/apis/export.py, or replace that part of the model."
    )
