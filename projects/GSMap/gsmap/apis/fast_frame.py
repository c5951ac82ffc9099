"""Fast prediction of frames on a GPU by CUDA graphs.

The prediction of a frame consists of hundreds of small operations, and the GPU waits for the host
to launch each of them. If no tensor size depends on the values of tensors, all launches of a frame
can be recorded once per image size as a CUDA graph, and replayed for later frames. A recording
always reads and writes fixed tensors: inputs are copied to them, and results are copied from them.
"""

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.structures.calibration import stack_calibration_arrays
from gsmap.structures.grid import padded_size
from gsmap.structures.tensors import matrix_products, tensor_versions, upload
from gsmap.utils.errors import InputError, WorkError

if TYPE_CHECKING:
    from mmdet3d.structures import Det3DDataSample

SWITCH = "cuda_graphs"  # argument of `MapInferencer`; --cuda-graphs in commands
CAPTURE_BY_DEFAULT = True  # replayed and launched frames were equal on an H100
_MOST_GRAPHS = 4  # largest number of graphs, of different image sizes; each takes memory
_WARM_UP = 3  # frames before a capture, in which libraries select and load kernels


def reason_against(model: Any) -> str:
    """Reason why a model cannot be computed with tensors of fixed sizes (`StaticFrame`).

    Args:
        model: A `MapDetector`.

    Returns:
        The reason, as a clause for a message; empty if there is no reason.
    """
    head = model.map_head
    if model.lidar_encoder is not None:
        return "it reads LiDAR, whose number of voxels changes"
    if model.temporal is not None:
        return "it remembers earlier frames (temporal)"
    if model.prior is not None:
        return "it reads a map of earlier frames (prior)"
    if head.not_exported:  # the reason why the head has no ONNX export; empty if it has one
        return f"{type(head).__name__} has no fixed number of operations ({head.not_exported})"
    if not hasattr(model.data_preprocessor, "normalise"):
        return "its data_preprocessor is not MapDataPreprocessor"
    return ""


class StaticFrame(nn.Module):
    """Computes the best elements of a frame from pixels, with tensors of fixed sizes only.

    Args:
        model: A camera `MapDetector` in evaluation mode. Its encoder is switched to operations of
            fixed sizes, whose results differ from the default operations by rounding.

    Attributes:
        names: Names of the calibration arrays that the BEV encoder reads.
        layout: Shape and type of each field of an element, by name. It is empty before the first
            call, which sets it.

    Raises:
        ValueError: If the model cannot be computed with fixed sizes (`reason_against`).
    """

    def __init__(self, model: Any) -> None:
        super().__init__()
        if reason := reason_against(model):
            raise InputError(f"this model has no static form: {reason}.")
        self.model = model
        self.names: tuple[str, ...] = model.bev_encoder.calibration
        self.layout: dict[str, tuple[torch.Size, torch.dtype]] = {}
        for module in model.bev_encoder.modules():
            if hasattr(module, "fixed_sizes"):
                module.fixed_sizes = True

    def forward(self, images: Tensor, *calibration: Tensor) -> Tensor:
        """Predict the best elements of each sample, including elements outside of the map.

        Args:
            images: Pixel values of the cameras, 0 to 255. (B, V, 3, H, W)
            calibration: Arrays of ``names`` (`calibration_arrays`): matrices (B, V, 4, 4), and
                signals of the vehicle (B, 18).

        Returns:
            The M best elements, best first, each as the F numbers of its fields in the order of
            ``layout``, float32. (B, M, F)
        """
        model = self.model
        images = model.data_preprocessor.normalise(images)  # also pads the images
        feats = model.extract_img_feats(images)
        outputs = model.bev_encoder.encode(
            model.bev_encoder.levels(feats),  # the levels that this encoder reads
            calibration=dict(zip(self.names, calibration, strict=True)),
            img_shape=(images.shape[-2], images.shape[-1]),
        )
        last_layer = model.map_head(outputs)[-1]  # the head predicts after every decoder layer
        samples = []
        for scores, references in zip(last_layer.scores, last_layer.references, strict=True):
            samples.append(self._decode_elements(scores, references=references))
        return torch.stack(samples)

    def _decode_elements(self, scores: Tensor, references: Any) -> Tensor:
        """Decode the best elements of one sample, and concatenate their fields.

        Args:
            scores: Class logits of all elements. (N, classes)
            references: References (encoded geometry) of all elements, as the head predicts them.

        Returns:
            The M best elements, each as the F numbers of its fields in the order of ``layout``.
            (M, F)
        """
        head = self.model.map_head
        # Fields by name, with points in metres. Some coders change the logits by the geometry.
        weighted_scores, decoded = head.decode(scores, references)
        # `best` selects a fixed number of elements. Elements outside of the map are removed only
        # after the recorded operations (`_with_predictions`), because their number varies.
        best = head.coder.best(weighted_scores)
        fields = {"scores_3d": best.scores, "labels_3d": best.labels}
        fields |= head.select_detections(decoded, best)
        layout = {}
        columns = []
        for name, value in fields.items():
            layout[name] = (value.shape[1:], value.dtype)
            # The added axis gives a field of one number per element a column, too.
            entries = value.unsqueeze(-1).flatten(1)  # (M, entries of the field)
            columns.append(entries.float())
        self.layout = layout
        return torch.cat(columns, dim=1)

    def unpack(self, elements: Tensor) -> dict[str, Tensor]:
        """Split the elements of a sample into fields.

        Args:
            elements: Concatenated fields of ``layout``. (M, F)

        Returns:
            Fields by name. (M, ...) each
        """
        fields = {}
        start = 0
        for name, (shape, dtype) in self.layout.items():
            end = start + shape.numel()
            fields[name] = elements[:, start:end].reshape((len(elements), *shape)).to(dtype)
            start = end
        return fields


@dataclass
class _Recording:
    """Recorded prediction for inputs of fixed shapes and types.

    Attributes:
        graph: The CUDA graph.
        inputs: Tensors that the graph reads.
        output: Tensor that the graph writes.
        versions: Address and version of each weight and buffer of the model at the time of the
            recording (`tensor_versions`). A change in place raises the version.
        copies: Copies of the backbone that the graph reads (`MapDetector.backbone_copies`).
    """

    graph: Any
    inputs: list[Tensor]
    output: Tensor
    versions: list[tuple[int, int]]
    copies: list[Any]

    def is_up_to_date(self, model: Any) -> bool:
        """Whether the graph reads the present weights of a model."""
        # Copies are made again after a training.
        for recorded, present in zip(self.copies, model.backbone_copies(), strict=True):
            if recorded is not present:
                return False
        return tensor_versions(model) == self.versions


@dataclass
class FastFrames:
    """Predicts batches with a `StaticFrame` that is recorded as a CUDA graph for each input size.

    Several threads may call an instance; their batches are computed one after another.

    Args:
        frame: The model as a function of tensors.
        device: Device of the model.
        capture: Whether frames are recorded and replayed. If False, their operations are launched
            one by one.
    """

    frame: StaticFrame
    device: torch.device
    capture: bool = True
    # Recordings by camera embeddings, and shapes and types of the inputs. The least recently used
    # one is first.
    _graphs: "OrderedDict[Any, _Recording]" = field(default_factory=OrderedDict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def serves(self, batch: dict[str, Any]) -> bool:
        """Whether a batch consists of images of one size and has no other inputs."""
        inputs = batch["inputs"]
        shapes = set()
        for image in inputs.get("img") or ():
            shapes.add(tuple(image.shape))
        return len(shapes) == 1 and set(inputs) == {"img"}

    def __call__(self, batch: dict[str, Any]) -> "list[Det3DDataSample]":
        """Predict the samples of a collated batch.

        Args:
            batch: ``inputs`` with images ``img``, (V, 3, H, W) per sample, and ``data_samples``.

        Returns:
            The samples with ``pred_instances_3d``, on the CPU.

        Raises:
            RuntimeError: If a frame of this size cannot be recorded as a CUDA graph.
            ValueError: If a sample lacks a field that the encoder reads, or its number of cameras
                differs from the model.
        """
        samples = batch["data_samples"]
        images = batch["inputs"]["img"]
        # With `images_on_device`, the pipeline leaves its image steps to the data preprocessor.
        if any(sample.metainfo.get("image_steps") for sample in samples):
            preprocessor = self.frame.model.data_preprocessor
            pixels = torch.stack(upload(images, self.device))
            images = preprocessor.run_deferred_steps(pixels, samples)
        else:
            images = torch.stack(list(images))  # on the host; `_run` copies them to the device
        self._add_shapes(batch, image_size=(images.shape[-2], images.shape[-1]))
        metas = [sample.metainfo for sample in samples]
        inputs = [images]
        for stack in stack_calibration_arrays(metas, names=self.frame.names):
            inputs.append(torch.from_numpy(stack))
        with (
            self._lock,
            torch.no_grad(),
            # With mixed precision, the backbone runs in float16 and other products in TF32.
            matrix_products(in_tf32=self.frame.model.half_backbone is not None),
        ):
            batch_elements = self._run(inputs)
        predictions: list[Det3DDataSample] = []
        for sample, elements in zip(samples, batch_elements, strict=True):
            predictions.append(self._with_predictions(sample, elements=elements))
        return predictions

    def _add_shapes(self, batch: dict[str, Any], image_size: tuple[int, int]) -> None:
        """Add the sizes of the padded images to the samples, as the data preprocessor does.

        Args:
            batch: Inputs and data samples.
            image_size: Rows and columns of the images, in pixels.
        """
        preprocessor = self.frame.model.data_preprocessor
        shape = padded_size(image_size, preprocessor.pad_size_divisor)
        pad_shapes = preprocessor._get_pad_shape(batch)  # mmdet3d: padded size of each sample
        for sample, pad_shape in zip(batch["data_samples"], pad_shapes, strict=True):
            sample.set_metainfo({"batch_input_shape": shape, "pad_shape": pad_shape})

    def _run(self, inputs: Sequence[Tensor]) -> Tensor:
        """Compute the elements of a batch by replaying the recording for its sizes.

        Args:
            inputs: Images and calibration arrays.

        Returns:
            Elements on the CPU. (B, M, F)
        """
        if not self.capture:
            on_device = [tensor.to(self.device) for tensor in inputs]
            return self.frame(*on_device).cpu()
        # The recording of one rig stays while frames of another one are predicted.
        cams_embeds = getattr(self.frame.model.bev_encoder, "cams_embeds", None)
        sizes = tuple((tensor.shape, tensor.dtype) for tensor in inputs)
        key = (id(cams_embeds), sizes)
        while True:
            recording = self._graphs.get(key)
            if recording is None:
                recording = self._record(key, inputs=inputs)
            for buffer, value in zip(recording.inputs, inputs, strict=True):
                buffer.copy_(value, non_blocking=True)
            recording.graph.replay()
            # While the GPU computes, compare the versions of the weights with their versions at the
            # time of the recording. If a weight has changed, drop this result and record again.
            if recording.is_up_to_date(self.frame.model):
                self._graphs.move_to_end(key)
                return recording.output.cpu()  # a copy, as the next replay overwrites the output
            del self._graphs[key]

    def _record(self, key: Any, inputs: Sequence[Tensor]) -> _Recording:
        """Record a frame with the sizes of the inputs.

        Args:
            key: Camera embeddings, and shapes and types of the inputs: the key of the recording.
            inputs: Images and calibration arrays.

        Raises:
            RuntimeError: If the frame cannot be recorded.
        """
        while len(self._graphs) >= _MOST_GRAPHS:
            self._graphs.popitem(last=False)  # the least recently used recording
        buffers = [tensor.to(self.device) for tensor in inputs]
        with torch.cuda.device(self.device):
            # As torch requires, the frames before a capture run on a separate stream.
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(_WARM_UP):  # errors of the input are raised here
                    self.frame(*buffers)
            torch.cuda.current_stream().wait_stream(stream)
            graph = torch.cuda.CUDAGraph()
            try:
                # With "thread_local", CUDA calls of other threads do not break the capture.
                with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                    output = self.frame(*buffers)
            except RuntimeError as error:
                raise WorkError(
                    f"a frame could not be captured as a CUDA graph ({error!s:.300}): run the "
                    f"model without CUDA graphs ({SWITCH}=False, --no-{SWITCH.replace('_', '-')})."
                ) from error
        self._graphs[key] = _Recording(
            graph=graph,
            inputs=buffers,
            output=output,
            versions=tensor_versions(self.frame.model),
            copies=self.frame.model.backbone_copies(),
        )
        return self._graphs[key]

    def _with_predictions(self, sample: "Det3DDataSample", elements: Tensor) -> "Det3DDataSample":
        """Add the elements near the map with a sufficient score to a sample, as its predictions.

        Args:
            sample: The sample.
            elements: Concatenated fields of its elements, on the CPU. (M, F)
        """
        head = self.frame.model.map_head
        fields = self.frame.unpack(elements)
        is_valid = head.coder.keep_mask(fields["scores_3d"], fields["pts"])
        scores = fields.pop("scores_3d")[is_valid]
        labels = fields.pop("labels_3d")[is_valid]
        detections = {}
        for name, value in fields.items():
            detections[name] = value[is_valid]
        # For some classes, the points of lines are reordered to a short path.
        detections = head.coder.unfold_lines(detections, labels)
        detections.update(scores_3d=scores, labels_3d=labels)
        instances = InstanceData(metainfo=dict(head.reference.metainfo), **detections)
        samples = self.frame.model.add_pred_to_datasample([sample], [instances])
        return samples[0]
