"""The public rendering function: argument checks and the choice of a backend."""

import os
import warnings

import torch
from torch import Tensor

from ...geometry.bev_grid import BEVGrid
from .._numba import HAS_NUMBA
from .cpu import render_gaussians_cpu
from .fused import Renderer
from .reference import render_gaussians_reference
from .triton import HAS_TRITON, render_gaussians_triton

BACKENDS = ("auto", "reference", "cpu", "triton")
RENDERERS: dict[str, Renderer] = {
    "reference": render_gaussians_reference,
    "cpu": render_gaussians_cpu,
    "triton": render_gaussians_triton,
}


def render_gaussians(
    means: Tensor, scales: Tensor, rotations: Tensor, grid: BEVGrid, backend: str = "auto"
) -> Tensor:
    r"""Render each map element's 2D Gaussians to a soft occupancy raster.

    A pixel :math:`p` takes :math:`1 - \prod_i (1 - G_i(p))` (GSMap Eq. 6), with :math:`G_i` from
    Eq. 2. Half-precision inputs are computed in float32, also under autocast.

    Args:
        means: Centres (x, y) in metres, in the frame of ``grid``. (..., P, 2)
        scales: Standard deviations along each Gaussian's own axes, in metres, > 0. (..., P, 2)
        rotations: Angle of the first axis from +x, in radians, anticlockwise. (..., P)
        grid: The raster: its extent in metres and its size in pixels.
        backend: ``"reference"`` (plain torch), ``"cpu"`` or ``"triton"`` (fused kernels), or
            ``"auto"``: the fastest one that serves the inputs' device and type.

    Returns:
        Occupancy in [0, 1], differentiable in the first three inputs. (..., H, W)

    Raises:
        TypeError: If an input is not floating point.
        ValueError: If the shapes, types or devices disagree, or ``backend`` is unknown.
    """
    _check(means, scales, rotations, backend)
    dtype = torch.promote_types(means.dtype, torch.float32)
    means, scales, rotations = means.to(dtype), scales.to(dtype), rotations.to(dtype)
    with torch.autocast(means.device.type, enabled=False):
        if backend == "auto":
            backend = _fastest_backend(means)
        else:
            _check_backend(backend, means)
        return RENDERERS[backend](means, scales, rotations, grid)


def _fastest_backend(means: Tensor) -> str:
    """Name the fastest backend that serves a tensor's device and type."""
    if means.dtype != torch.float32:
        return "reference"
    if means.device.type == "cpu":
        if HAS_NUMBA:
            return "cpu"
        warnings.warn(
            "numba is not installed: Gaussians are rendered by the slow reference. "
            "Install it with `pip install numba`.",
            stacklevel=3,
        )
    elif means.is_cuda and HAS_TRITON:
        return "triton"
    return "reference"


def _check_backend(backend: str, means: Tensor) -> None:
    """Raise if a named backend does not serve a tensor's device and type, or is not installed."""
    if backend == "reference":
        return
    if means.dtype != torch.float32:
        raise ValueError(
            f"backend {backend!r} computes in float32, got {means.dtype}: use 'reference'."
        )
    package, installed, serves = {
        "cpu": ("numba", HAS_NUMBA, means.device.type == "cpu"),
        "triton": (
            "triton",
            HAS_TRITON,
            means.is_cuda or os.environ.get("TRITON_INTERPRET") == "1",
        ),
    }[backend]
    if not installed:
        raise ValueError(f"backend {backend!r} needs {package}, which is not installed.")
    if not serves:
        raise ValueError(f"backend {backend!r} does not serve tensors on {means.device}.")


def _check(means: Tensor, scales: Tensor, rotations: Tensor, backend: str) -> None:
    """Raise for inputs that do not belong together."""
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {BACKENDS}, got {backend!r}.")
    if means.ndim < 2 or means.shape[-1] != 2:
        raise ValueError(f"means must have shape (..., P, 2), got {tuple(means.shape)}.")
    for name, tensor, shape in (
        ("scales", scales, means.shape),
        ("rotations", rotations, means.shape[:-1]),
    ):
        if tensor.shape != shape:
            raise ValueError(
                f"{name} must have shape {tuple(shape)} to match means, got {tuple(tensor.shape)}."
            )
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise ValueError(
                f"{name} must be {means.dtype} on {means.device} like means, "
                f"got {tensor.dtype} on {tensor.device}."
            )
    if not means.dtype.is_floating_point:
        raise TypeError(f"means must be floating point, got {means.dtype}.")
