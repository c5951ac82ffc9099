"""The choice between plain torch and the fused kernels, which become operators of torch."""

import os
import warnings
from collections.abc import Callable, Collection, Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor
from torch.library import CustomOpDef, custom_op

PACKAGES = {"cpu": "numba", "triton": "triton"}
DEVICES = {"cpu": "cpu", "triton": "cuda"}
INSTALLED = {backend: find_spec(package) is not None for backend, package in PACKAGES.items()}

# The functions that have a Triton kernel, and whether "auto" takes it on a GPU: only if a GPU has
# run it and found it equal to the reference. backend="triton" takes any of them.
TRITON_KERNELS = {
    "deformable_sample": True,
    "draw_polylines": True,
    "pairwise_soft_iou": True,
    "raster_loss": False,
    "render_gaussians": True,
    "render_gaussians_in_warps": False,  # in place of that of render_gaussians, "triton", too
    "sample_kernels": True,
    "soft_rasters": False,
}
SWITCH = "GSMAP_TRITON_KERNELS"  # environment: further kernels for "auto", with commas, or "all"
UNORDERED = (
    "deformable_sample",
    "sample_kernels",
)  # their gradients are added up in any order (atomics)


def triton_kernels(switch: str) -> set[str]:
    """Return the functions whose Triton kernels ``"auto"`` takes.

    Args:
        switch: Names of further ones, separated by commas, or ``"all"``.

    Raises:
        ValueError: If a name has no kernel.
    """
    names = {name.strip() for name in switch.split(",")} - {""}
    if names == {"all"}:
        return set(TRITON_KERNELS)
    if unknown := names - TRITON_KERNELS.keys():
        raise ValueError(
            f"{SWITCH} names {sorted(unknown)}, which are no Triton kernels: choose from "
            f"{sorted(TRITON_KERNELS)}, or 'all'."
        )
    return names | {name for name, trusted in TRITON_KERNELS.items() if trusted}


AUTO_KERNELS = triton_kernels(os.environ.get(SWITCH, ""))


def choose_backend(
    backend: str, tensor: Tensor, fused: Collection[str] = ("cpu", "triton"), kernel: str = ""
) -> str:
    """Name the backend that is to work on a tensor: ``"reference"``, ``"cpu"`` or ``"triton"``.

    Args:
        backend: ``"auto"``: the fused kernels that serve the tensor's device and type, else the
            reference; or the backend itself.
        tensor: What is worked on.
        fused: Which fused kernels there are: ``"cpu"`` (numba), ``"triton"``.
        kernel: Name of the function in ``TRITON_KERNELS``, if it has a Triton kernel.

    Raises:
        ValueError: If ``backend`` is unknown, does not serve the tensor, is not installed, or is
            not as deterministic as torch is told to be.
    """
    known = ("auto", "reference", *fused)
    if backend not in known:
        raise ValueError(f"backend must be one of {known}, got {backend!r}.")
    if backend == "reference":
        return backend
    unordered = kernel in UNORDERED and torch.are_deterministic_algorithms_enabled()
    if backend == "auto":
        trusted = "triton" in fused and kernel in AUTO_KERNELS and not unordered
        serving = [name for name in fused if name != "triton" or trusted]
        return _serving_backend(serving, tensor)
    if tensor.dtype != torch.float32:
        raise ValueError(
            f"backend {backend!r} computes in float32, got {tensor.dtype}: use 'reference'."
        )
    if not INSTALLED[backend]:
        raise ValueError(f"backend {backend!r} needs {PACKAGES[backend]}, which is not installed.")
    if backend == "triton" and unordered:
        raise ValueError(
            f"backend 'triton' of {kernel} adds gradients up in any order: use 'reference' with "
            "torch.use_deterministic_algorithms."
        )
    interpreted = backend == "triton" and os.environ.get("TRITON_INTERPRET") == "1"
    if tensor.device.type != DEVICES[backend] and not interpreted:
        raise ValueError(f"backend {backend!r} does not serve tensors on {tensor.device}.")
    return backend


def _serving_backend(fused: Collection[str], tensor: Tensor) -> str:
    """Return the installed backend that serves a tensor, else the reference."""
    serving = [name for name in fused if DEVICES[name] == tensor.device.type]
    if tensor.dtype != torch.float32 or not serving:
        return "reference"
    if serving == ["cpu"] and not INSTALLED["cpu"]:
        warnings.warn(
            "numba is not installed: rasters are computed by the slow reference. "
            "Install it with `pip install numba`.",
            stacklevel=3,
        )
    return serving[0] if INSTALLED[serving[0]] else "reference"


def fused_operator(
    name: str,
    arguments: str,
    shape: Callable[..., Sequence[int]],
    differentiable: int = 0,
    dtype: torch.dtype | None = None,
) -> CustomOpDef:
    """Register an operator of torch, ``gsmap::<function>``, that fused kernels compute.

    Registered operators work under torch.compile, autocast, DistributedDataParallel and gradient
    checkpointing. Only inputs are kept, so the backward pass can run twice (``retain_graph``). A
    gradient of the gradient raises a RuntimeError.

    Args:
        name: ``<folder>.<function>``. The folder's modules, imported when first used, have the
            function, which returns a tensor, and, of the gradient in it and the same arguments,
            ``<function>_backward``, which returns contiguous gradients.
        arguments: The function's arguments as in a schema of torch, tensors first; the operator
            takes the backend after them.
        shape: Of the arguments, the output's shape.
        differentiable: In how many of the tensors, the first ones, there are gradients.
        dtype: Type of the output; None is the first tensor's.
    """
    folder, function = name.split(".")
    tensors = arguments.count("Tensor ")

    def fused(backend: str, function: str) -> Callable[..., Any]:
        return getattr(import_module(f"gsmap.ops.{folder}.{PACKAGES[backend]}"), function)

    def forward(*inputs: Any) -> Tensor:
        return fused(inputs[-1], function)(*inputs[:-1])

    schema = f"({arguments}, str backend) -> Tensor"
    operator = custom_op(f"gsmap::{function}", forward, mutates_args=(), schema=schema)
    operator.register_fake(lambda *inputs: inputs[0].new_empty(shape(*inputs[:-1]), dtype=dtype))
    if not differentiable:
        return operator

    def backward(*inputs: Any) -> list[Tensor]:
        return list(fused(inputs[-1], f"{function}_backward")(*inputs[:-1]))

    schema = f"(Tensor grads, {arguments}, str backend) -> Tensor[]"
    gradient = custom_op(f"gsmap::{function}_backward", backward, mutates_args=(), schema=schema)

    @gradient.register_fake
    def fake_gradients(_: Tensor, *inputs: Any) -> list[Tensor]:
        contiguous = torch.contiguous_format
        return [torch.empty_like(x, memory_format=contiguous) for x in inputs[:differentiable]]

    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:tensors])
        ctx.settings = inputs[tensors:]

    def differentiate(ctx: Any, grads: Tensor) -> tuple[Any, ...]:
        gradients = gradient(grads, *ctx.saved_tensors, *ctx.settings)
        return *gradients, *(None,) * (tensors + len(ctx.settings) - differentiable)

    operator.register_autograd(differentiate, setup_context=setup_context)
    return operator
