"""The choice between plain torch and the fused kernels, and the gradient of a fused operator."""

import os
import warnings
from collections.abc import Collection
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor
from torch.library import CustomOpDef

HAS_NUMBA = find_spec("numba") is not None
HAS_TRITON = find_spec("triton") is not None


def choose_backend(backend: str, tensor: Tensor, fused: Collection[str] = ("cpu", "triton")) -> str:
    """Name the backend that is to work on a tensor.

    Args:
        backend: ``"auto"``: the fused kernels that serve the tensor's device and type, else the
            reference; or the backend itself.
        tensor: What is worked on.
        fused: Which fused kernels there are: ``"cpu"`` (numba), ``"triton"``.

    Returns:
        ``"reference"``, ``"cpu"`` or ``"triton"``.

    Raises:
        ValueError: If ``backend`` is unknown, does not serve the tensor, or is not installed.
    """
    known = ("auto", "reference", *fused)
    if backend not in known:
        raise ValueError(f"backend must be one of {known}, got {backend!r}.")
    if backend == "auto":
        return _fastest(tensor, fused)
    if backend != "reference":
        _check_serves(backend, tensor)
    return backend


def _fastest(tensor: Tensor, fused: Collection[str]) -> str:
    """Name the fastest backend that serves a tensor."""
    if tensor.dtype != torch.float32:
        return "reference"
    if tensor.device.type == "cpu" and "cpu" in fused:
        if HAS_NUMBA:
            return "cpu"
        warnings.warn(
            "numba is not installed: rasters are computed by the slow reference. "
            "Install it with `pip install numba`.",
            stacklevel=2,
        )
    if tensor.is_cuda and HAS_TRITON and "triton" in fused:
        return "triton"
    return "reference"


def _check_serves(backend: str, tensor: Tensor) -> None:
    """Raise if a fused backend is not installed or does not serve a tensor."""
    if tensor.dtype != torch.float32:
        raise ValueError(
            f"backend {backend!r} computes in float32, got {tensor.dtype}: use 'reference'."
        )
    if backend == "cpu":
        package, installed, serves = "numba", HAS_NUMBA, tensor.device.type == "cpu"
    else:
        interpreted = os.environ.get("TRITON_INTERPRET") == "1"
        package, installed, serves = "triton", HAS_TRITON, tensor.is_cuda or interpreted
    if not installed:
        raise ValueError(f"backend {backend!r} needs {package}, which is not installed.")
    if not serves:
        raise ValueError(f"backend {backend!r} does not serve tensors on {tensor.device}.")


def register_gradient(
    forward: CustomOpDef, backward: CustomOpDef, tensors: int, differentiable: int = 1
) -> None:
    """Make an operator the gradient of another.

    Registered operators work under torch.compile, autocast, DistributedDataParallel and gradient
    checkpointing. Only inputs are kept, so the backward pass can run twice (``retain_graph``).

    Args:
        forward: ``(*tensors, *settings) -> tensor``.
        backward: ``(grads, *tensors, *settings) -> gradients``, contiguous.
        tensors: How many of the inputs are tensors.
        differentiable: In how many of them, the first ones, there are gradients.
    """

    @backward.register_fake
    def fake(grads: Tensor, *inputs: Any) -> Any:
        gradients = tuple(
            torch.empty_like(value, memory_format=torch.contiguous_format)
            for value in inputs[:differentiable]
        )
        return gradients if differentiable > 1 else gradients[0]

    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:tensors])
        ctx.settings = inputs[tensors:]

    def differentiate(ctx: Any, grads: Tensor) -> tuple[Any, ...]:
        gradients = backward(grads, *ctx.saved_tensors, *ctx.settings)
        gradients = gradients if differentiable > 1 else (gradients,)
        return *gradients, *(None,) * (tensors + len(ctx.settings) - differentiable)

    forward.register_autograd(differentiate, setup_context=setup_context)
