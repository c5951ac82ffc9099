"""Choice between plain torch and fused kernels, and registration of the kernels with torch.

A fused kernel is a compiled function that computes a whole operation. Its backend is ``"cpu"``
(compiled by numba) or ``"triton"`` (for GPUs). The backend ``"reference"`` is plain torch.
"""

import os
import warnings
from collections.abc import Callable, Collection, Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor
from torch.library import CustomOpDef, custom_op

from gsmap.utils.errors import InputError

# Package of each backend, which is also the name of the module with its kernels in `gsmap.ops`.
PACKAGES = {"cpu": "numba", "triton": "triton"}
DEVICES = {"cpu": "cpu", "triton": "cuda"}
INSTALLED = {backend: find_spec(package) is not None for backend, package in PACKAGES.items()}

# Functions with a Triton kernel, and whether backend="auto" selects the kernel for tensors on a
# GPU. This is True only for kernels that were tested against the reference on a GPU.
# backend="triton" can select every kernel.
TRITON_KERNELS = {
    "deformable_sample": True,
    "draw_polylines": True,
    "pairwise_soft_iou": True,
    "raster_loss": True,
    "render_gaussians": True,
    "render_gaussians_in_warps": False,  # replaces the kernel of render_gaussians where enabled
    "sample_kernels": True,
    "soft_rasters": True,
}
SWITCH = "GSMAP_TRITON_KERNELS"  # environment variable: further kernels for "auto", or "all"
# Triton kernels with gradients that are not deterministic, because atomics add them in any order.
UNORDERED = ("deformable_sample", "sample_kernels")


def triton_kernels(switch: str) -> set[str]:
    """Return the functions whose Triton kernels ``"auto"`` selects.

    Args:
        switch: Names of further functions, separated by commas, or ``"all"``.

    Returns:
        Names of the functions, keys of ``TRITON_KERNELS``.

    Raises:
        ValueError: If a function without a kernel is named.
    """
    names = {name.strip() for name in switch.split(",")} - {""}
    if names == {"all"}:
        return set(TRITON_KERNELS)
    unknown = names - TRITON_KERNELS.keys()
    if unknown:
        raise InputError(
            f"{SWITCH} names {sorted(unknown)}, which are no Triton kernels: choose from "
            f"{sorted(TRITON_KERNELS)}, or 'all'."
        )
    for name, is_trusted in TRITON_KERNELS.items():
        if is_trusted:
            names.add(name)
    return names


AUTO_KERNELS = triton_kernels(os.environ.get(SWITCH, ""))


def choose_backend(
    backend: str, tensor: Tensor, fused: Collection[str] = ("cpu", "triton"), kernel: str = ""
) -> str:
    """Choose the backend of an operation.

    Args:
        backend: Name of a backend, or ``"auto"``. The latter selects the fused kernels for the
            device and type of the tensor, or the reference in plain torch if there are none.
            Fused kernels compute in float32 only.
        tensor: Input of the operation, whose device and type determine the backend.
        fused: Backends for which the operation has fused kernels: ``"cpu"`` (numba), ``"triton"``.
        kernel: Name of the function in ``TRITON_KERNELS``; empty without a Triton kernel.

    Returns:
        ``"reference"``, ``"cpu"`` or ``"triton"``.

    Raises:
        ValueError: If ``backend`` is unknown, does not support the tensor, is not installed, or
            is not deterministic although torch's deterministic algorithms are enabled.
    """
    choices = ("auto", "reference", *fused)
    if backend not in choices:
        raise InputError(f"backend must be one of {choices}, got {backend!r}.")
    if backend == "reference":
        return backend
    # Whether the Triton kernel must not be used, because the user requires determinism.
    is_excluded = kernel in UNORDERED and torch.are_deterministic_algorithms_enabled()
    if backend == "auto":
        takes_triton = kernel in AUTO_KERNELS and not is_excluded
        candidates = [name for name in fused if name != "triton" or takes_triton]
        return _automatic_backend(candidates, tensor)
    if tensor.dtype != torch.float32:
        raise InputError(
            f"backend {backend!r} computes in float32, got {tensor.dtype}: use 'reference'."
        )
    if not INSTALLED[backend]:
        raise InputError(f"backend {backend!r} needs {PACKAGES[backend]}, which is not installed.")
    if backend == "triton" and is_excluded:
        raise InputError(
            f"backend 'triton' of {kernel} adds gradients up in any order: use 'reference' with "
            "torch.use_deterministic_algorithms."
        )
    # Triton's interpreter runs kernels on the CPU, for tests and debugging.
    interpreted = backend == "triton" and os.environ.get("TRITON_INTERPRET") == "1"
    if tensor.device.type != DEVICES[backend] and not interpreted:
        raise InputError(f"backend {backend!r} does not serve tensors on {tensor.device}.")
    return backend


def _automatic_backend(fused: Collection[str], tensor: Tensor) -> str:
    """Return the installed fused backend for a tensor, or ``"reference"``.

    Warns if numba is missing, because plain torch is much slower on a CPU.
    """
    candidates = [name for name in fused if DEVICES[name] == tensor.device.type]
    if tensor.dtype != torch.float32 or not candidates:
        return "reference"
    if candidates == ["cpu"] and not INSTALLED["cpu"]:
        warnings.warn(
            "numba is not installed: rasters are computed by the slow reference. "
            "Install it with `pip install numba`.",
            stacklevel=3,  # names the line that called `choose_backend`
        )
    candidate = candidates[0]  # the only one, because each backend has another device
    return candidate if INSTALLED[candidate] else "reference"


def fused_operator(
    name: str,
    arguments: str,
    shape: Callable[..., Sequence[int]],
    differentiable: int = 0,
    dtype: torch.dtype | None = None,
) -> CustomOpDef:
    """Register a function of the fused kernels as an operator of torch, ``gsmap::<function>``.

    Registered operators work under torch.compile, autocast, DistributedDataParallel and gradient
    checkpointing. Only inputs are saved for the backward pass, which can therefore run twice
    (``retain_graph``). Second derivatives are not supported and raise a RuntimeError.

    Args:
        name: ``<folder>.<function>``. The modules ``numba.py`` and ``triton.py`` of the folder are
            imported at their first use. They define the function, which returns a tensor. They also
            define ``<function>_backward``. Its first argument is the gradient of the output,
            followed by the arguments of the function. It returns a sequence of contiguous
            gradients.
        arguments: Arguments of the function in the syntax of a torch schema, tensors first. The
            operator takes the backend as a further, last argument.
        shape: Function from the arguments to the shape of the output, by which torch.compile knows
            the output without a call of the kernel.
        differentiable: Number of tensors, from the first one, that have gradients.
        dtype: Type of the output; None for the type of the first tensor.

    Returns:
        The operator.
    """
    folder, function = name.split(".")
    num_tensors = arguments.count("Tensor ")

    def load_kernel(backend: str, function: str) -> Callable[..., Any]:
        module = import_module(f"gsmap.ops.{folder}.{PACKAGES[backend]}")
        return getattr(module, function)

    # In the functions below, the last entry of `inputs` is the backend.
    def forward(*inputs: Any) -> Tensor:
        kernel = load_kernel(inputs[-1], function)
        return kernel(*inputs[:-1])

    def fake_forward(*inputs: Any) -> Tensor:
        return inputs[0].new_empty(shape(*inputs[:-1]), dtype=dtype)  # None: type of the input

    schema = f"({arguments}, str backend) -> Tensor"
    operator = custom_op(f"gsmap::{function}", forward, mutates_args=(), schema=schema)
    operator.register_fake(fake_forward)
    if not differentiable:
        return operator

    def backward(*inputs: Any) -> list[Tensor]:
        kernel = load_kernel(inputs[-1], f"{function}_backward")
        return list(kernel(*inputs[:-1]))

    schema = f"(Tensor grads, {arguments}, str backend) -> Tensor[]"
    gradient = custom_op(f"gsmap::{function}_backward", backward, mutates_args=(), schema=schema)

    @gradient.register_fake
    def fake_gradients(_: Tensor, *inputs: Any) -> list[Tensor]:
        contiguous = torch.contiguous_format
        return [torch.empty_like(x, memory_format=contiguous) for x in inputs[:differentiable]]

    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:num_tensors])
        ctx.settings = inputs[num_tensors:]  # arguments that are no tensors, and the backend

    def differentiate(ctx: Any, grads: Tensor) -> tuple[Any, ...]:
        gradients = gradient(grads, *ctx.saved_tensors, *ctx.settings)
        # One value for each input of `forward`: None for tensors and settings without a gradient.
        num_without = num_tensors + len(ctx.settings) - differentiable
        return *gradients, *(None,) * num_without

    operator.register_autograd(differentiate, setup_context=setup_context)
    return operator
