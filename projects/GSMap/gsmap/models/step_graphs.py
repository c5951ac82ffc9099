"""Forward and backward pass of a training step as replayed CUDA graphs.

A training step consists of thousands of small operations, and a GPU waits for the host to launch
each of them. From the images to the predictions, the sizes of tensors do not depend on values, so
these operations are recorded once per size of a batch and replayed for later batches. The sizes in
matching and losses depend on the ground truth, so these are launched as usual.
"""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.utils._pytree import TreeSpec, tree_flatten, tree_unflatten

from gsmap.models.base.decoder import Decoded
from gsmap.models.base.head import MapHead
from gsmap.models.base.pairs import Predictions
from gsmap.structures.tensors import matrix_products
from gsmap.utils.errors import InputError, WorkError

SWITCH = "cuda_graphs"  # setting of `MapDetector`
_MOST_SIZES = 4  # largest number of recordings; each occupies the memory of a step
_WARM_UP = 3  # steps before a recording, in which libraries select and load kernels


def require_recordable(model: Any) -> None:
    """Require that the training steps of a model can be recorded.

    Raises:
        ValueError: If they cannot; the message has the reason.
    """
    if reason := reason_against_recording(model):
        raise InputError(f"{SWITCH}=True does not go with this model: {reason}.")


def reason_against_recording(model: Any) -> str:
    """Reason why the training steps of a model cannot be recorded.

    Args:
        model: A `MapDetector`.

    Returns:
        The reason, as a clause about the model; empty if its steps can be recorded.
    """
    head = model.map_head
    if model.lidar_encoder is not None:
        return "it reads LiDAR, whose number of voxels changes"
    if model.temporal is not None:
        return "it remembers earlier frames (temporal)"
    if model.prior is not None:
        return "it reads a map of earlier drives (prior)"
    if not isinstance(head, MapHead) or type(head).forward is not MapHead.forward:
        return f"{type(head).__name__} has another forward pass than MapHead"
    if head.flow_parts:
        return f"it adds queries in training ({', '.join(head.flow_parts)})"
    if model.compiled:
        return "its parts are compiled (compiled): use one of the two"
    for module in model.modules():
        if isinstance(module, nn.SyncBatchNorm):
            return "its batch norms wait for other processes (SyncBN)"
    return ""


class StaticStep(nn.Module):
    """Function of tensors from augmented images to the predictions of every layer of a model.

    Args:
        model: A `MapDetector` whose steps can be recorded. Its encoder is switched to operations
            of fixed sizes, whose results differ from the default operations by rounding.

    Attributes:
        names: Names of the calibration arrays that the encoder reads.
    """

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model
        self.names: tuple[str, ...] = model.bev_encoder.calibration
        # Both are set by `forward`, for `restore`.
        self._structure: TreeSpec | None = None  # nesting of the outputs
        self._kinds: list[type[Decoded]] = []  # class of the decoder output of each layer
        for part in model.bev_encoder.modules():
            if hasattr(part, "fixed_sizes"):
                part.fixed_sizes = True

    def forward(self, images: Tensor, *calibration: Tensor) -> tuple[Tensor, ...]:
        """Compute the outputs of the encoder and the predictions.

        Args:
            images: Normalised and augmented images. (B, V, 3, H, W)
            calibration: Arrays in the order of ``names``. (B, ...) each

        Returns:
            All tensors of the outputs, which `restore` takes.
        """
        arrays = dict(zip(self.names, calibration, strict=True))
        outputs = self.model.encode_images(images, arrays)
        layers = self.model.map_head(outputs)
        # A recorded function returns only tensors. So the predictions of a layer are replaced by
        # their scores and the fields of their decoder output. `restore` builds them from these.
        fields = [(layer.scores, vars(layer.decoded)) for layer in layers]
        self._kinds = [type(layer.decoded) for layer in layers]
        tensors, self._structure = tree_flatten((outputs, fields))
        return tuple(tensors)

    def restore(self, tensors: Sequence[Tensor]) -> tuple[dict[str, Any], list[Predictions]]:
        """Outputs of the encoder and predictions of every layer, from the result of `forward`.

        Args:
            tensors: Tensors in the order of `forward`, which must have been called before.
        """
        assert self._structure is not None
        outputs, fields = tree_unflatten(list(tensors), self._structure)
        layers = []
        for (scores, decoded), kind in zip(fields, self._kinds, strict=True):
            layer = self.model.map_head.predictions(
                scores, decoded=kind(**decoded), bev_feats=outputs["bev_feats"]
            )
            layers.append(layer)
        return outputs, layers


@dataclass
class _Recording:
    """Recorded step of one size.

    Attributes:
        step: The recorded function.
        forward: Graph of the forward pass.
        backward: Graph of the backward pass.
        inputs: Tensors that the forward pass reads.
        outputs: Tensors that the forward pass writes.
        output_grads: Gradients that the backward pass reads; None for outputs without gradients.
        param_grads: Gradients that the backward pass writes, one for each trained parameter; None
            for parameters that the outputs do not depend on.
    """

    step: StaticStep
    forward: torch.cuda.CUDAGraph
    backward: torch.cuda.CUDAGraph
    inputs: list[Tensor]
    outputs: tuple[Tensor, ...]
    output_grads: list[Tensor | None]
    param_grads: tuple[Tensor | None, ...]


class StepGraphs:
    """Computes the predictions of training steps; on a GPU, by recorded CUDA graphs.

    The gradients are computed by recorded graphs, too. Recording restores the buffers of the model
    and the state of the random numbers, so the result of a training does not depend on the steps at
    which it records. On a CPU, operations are computed as usual.
    """

    def __init__(self) -> None:
        self._recordings: dict[Any, _Recording] = {}

    def __call__(
        self, model: Any, images: Tensor, calibration: dict[str, Tensor]
    ) -> tuple[dict[str, Any], list[Predictions]]:
        """Compute the outputs of the encoder and the predictions of every layer.

        Args:
            model: A `MapDetector` in training mode.
            images: Normalised and augmented images. (B, V, 3, H, W)
            calibration: Arrays that the encoder reads, by name, in the order of the encoder.
                (B, ...) each

        Returns:
            Outputs of the encoder, and predictions.

        Raises:
            RuntimeError: If a step of this size cannot be recorded.
            ValueError: If the model has parts that cannot be recorded, if autocast is enabled
                around it, or if, on a GPU, gradients of an earlier step have not been set to None.
        """
        if torch.is_autocast_enabled(images.device.type):
            # Autocast caches weights cast to half precision: all later steps would use the cached
            # weights of the recorded step.
            raise InputError(
                f"{SWITCH}=True does not go with --amp: leave it out, and set "
                "model.autocast=bfloat16."
            )
        # The batch norms may have been replaced after the model was built (`sync_bn` of a config).
        if not self._recordings:
            require_recordable(model)
        inputs = [images, *calibration.values()]
        if not images.is_cuda:
            step = StaticStep(model)
            return step.restore(step(*inputs))
        params = [param for param in model.parameters() if param.requires_grad]
        if any(param.grad is not None for param in params):
            raise InputError(
                f"{SWITCH}=True writes the gradients of a step into the memory of the gradients of "
                "the previous step: set optim_wrapper.accumulative_counts=1, or leave out the "
                "switch."
            )
        # The key is the size of the step: the shapes and types of the inputs, and the number of
        # parameters, which changes if some of them are frozen during the training.
        sizes = [(tensor.shape, tensor.dtype) for tensor in inputs]
        key = (len(params), *sizes)
        recording = self._recordings.get(key)
        if recording is None:
            while len(self._recordings) >= _MOST_SIZES:
                oldest = next(iter(self._recordings))  # a dictionary has the order of insertion
                del self._recordings[oldest]
            recording = _record(model, inputs, params=params)
            self._recordings[key] = recording
        tensors = _Replay.apply(recording, len(inputs), *inputs, *params)
        return recording.step.restore(tensors)


class _Replay(torch.autograd.Function):
    """Replay of a recorded forward pass, and of its backward pass.

    The parameters are arguments of `forward` only so that autograd receives their gradients. Both
    passes return views of the recorded memory, which the next replay overwrites.
    """

    @staticmethod
    def forward(
        ctx: Any, recording: _Recording, num_inputs: int, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        for recorded_input, value in zip(recording.inputs, tensors[:num_inputs], strict=True):
            recorded_input.copy_(value, non_blocking=True)
        recording.forward.replay()
        ctx.recording = recording
        ctx.num_inputs = num_inputs
        outputs = []
        constants = []  # outputs without gradients
        for output, grad in zip(recording.outputs, recording.output_grads, strict=True):
            outputs.append(output.detach())  # a new tensor object, to which autograd adds a history
            if grad is None:
                constants.append(outputs[-1])
        ctx.mark_non_differentiable(*constants)
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        recording = ctx.recording
        for recorded_grad, grad in zip(recording.output_grads, grads, strict=True):
            if recorded_grad is not None:
                recorded_grad.copy_(grad)
        recording.backward.replay()
        param_grads = []
        for grad in recording.param_grads:
            param_grads.append(None if grad is None else grad.detach())
        # The recording, the number of inputs, and the inputs have no gradient.
        return (None, None, *[None] * ctx.num_inputs, *param_grads)


def _record(model: Any, inputs: Sequence[Tensor], params: Sequence[Tensor]) -> _Recording:
    """Record a forward and a backward pass with the sizes of the inputs.

    Args:
        model: A `MapDetector` in training mode.
        inputs: Images and calibration arrays.
        params: Trained parameters.

    Raises:
        RuntimeError: If the step cannot be recorded.
    """
    step = StaticStep(model)
    # A graph always reads the memory that it has read while it was recorded. These copies are this
    # memory. Each replay writes its inputs to them.
    recorded_inputs = [tensor.detach().clone() for tensor in inputs]
    device = recorded_inputs[0].device

    def run_backward(
        outputs: Sequence[Tensor], output_grads: Sequence[Tensor | None]
    ) -> tuple[Tensor | None, ...]:
        """Gradients of the parameters. Gradients of the outputs are None for constants."""
        differentiable = [output for output in outputs if output.requires_grad]
        grads = [grad for grad in output_grads if grad is not None]
        return torch.autograd.grad(differentiable, params, grad_outputs=grads, allow_unused=True)

    forward = torch.cuda.CUDAGraph()
    backward = torch.cuda.CUDAGraph()
    # The backward graph reads tensors of the forward graph, so both use one pool of memory.
    pool = torch.cuda.graph_pool_handle()

    def capture(graph: torch.cuda.CUDAGraph) -> AbstractContextManager[None]:
        # Threads that copy batches to the device must not disturb the recording.
        return torch.cuda.graph(graph, pool=pool, capture_error_mode="thread_local")

    with (
        torch.cuda.device(device),
        _unchanged_state(model, device),
        matrix_products(in_tf32=model.autocast is not None),  # for float32 tensors
    ):
        # As PyTorch demands, the steps before a recording run on another stream.
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UP):  # errors of the input are raised here
                outputs = step(*recorded_inputs)
                run_backward(outputs, _empty_grads(outputs))
            del outputs  # frees the tensors of the last step before the recording
        torch.cuda.current_stream().wait_stream(stream)
        try:
            with capture(forward):
                outputs = step(*recorded_inputs)
            output_grads = _empty_grads(outputs)
            with capture(backward):
                param_grads = run_backward(outputs, output_grads)
        except RuntimeError as error:
            raise WorkError(
                f"a training step could not be captured as a CUDA graph ({error!s:.300}): train "
                f"without (model.{SWITCH}=False)."
            ) from error
    return _Recording(
        step=step,
        forward=forward,
        backward=backward,
        inputs=recorded_inputs,
        outputs=tuple(output.detach() for output in outputs),
        output_grads=output_grads,
        param_grads=param_grads,
    )


def _empty_grads(outputs: Sequence[Tensor]) -> list[Tensor | None]:
    """Allocate memory for the gradient of each output; None for outputs without gradients."""
    grads: list[Tensor | None] = []
    for output in outputs:
        grad = torch.zeros_like(output) if output.requires_grad else None
        grads.append(grad)
    return grads


@contextmanager
def _unchanged_state(model: nn.Module, device: torch.device) -> Iterator[None]:
    """Context manager that restores the buffers of a model and the random numbers of a GPU."""
    copies = [buffer.clone() for buffer in model.buffers()]
    random_state = torch.cuda.get_rng_state(device)
    try:
        yield
    finally:
        with torch.no_grad():
            for buffer, copy in zip(model.buffers(), copies, strict=True):
                buffer.copy_(copy)
        torch.cuda.set_rng_state(random_state, device)
