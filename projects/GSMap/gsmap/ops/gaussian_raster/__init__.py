"""Rendering of 2D Gaussians to soft masks (GSMap Eq. 6)."""

import math

import torch
from torch import Tensor

from gsmap.ops import backends
from gsmap.ops.backends import choose_backend, fused_operator
from gsmap.ops.gaussian_raster.reference import render_gaussians_reference
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import at_least_float32
from gsmap.utils.errors import InputError, InputTypeError

# Arguments of the operators, as a schema of torch. `gaussians` (N, P, 5) are the centres, scales
# and rotations of N instances. `frame` has 4 numbers: the corner of the raster and the size of its
# pixels.
_ARGUMENTS = "Tensor gaussians, float[] frame, int height, int width"


def _masks_shape(gaussians: Tensor, frame: list[float], height: int, width: int) -> tuple[int, ...]:
    """Return the shape (N, H, W) of the masks of all N instances."""
    return len(gaussians), height, width


# Operators that call the fused kernels in the modules `numba.py` and `triton.py` of this folder.
# Only the first argument of both operators has a gradient (`differentiable=1`).
_render = fused_operator(
    "gaussian_raster.render_gaussians", _ARGUMENTS, shape=_masks_shape, differentiable=1
)
_render_in_warps = fused_operator(
    "gaussian_raster.render_gaussians_in_warps", _ARGUMENTS, shape=_masks_shape, differentiable=1
)


def render_gaussians(
    means: Tensor, scales: Tensor, rotations: Tensor, grid: BEVGrid, backend: str = "auto"
) -> Tensor:
    r"""Render the 2D Gaussians of each map element to a soft occupancy raster.

    The value of a pixel :math:`p` is :math:`1 - \prod_i (1 - G_i(p))` (GSMap Eq. 6). Here
    :math:`G_i(p)` is the value of Gaussian i, scaled to 1 at its centre (Eq. 2). The computation
    is in the widest type of the inputs, but at least in float32, even under autocast.

    Args:
        means: Centres (x, y) in metres, in the frame of ``grid``. (..., P, 2)
        scales: Standard deviations along the axes of each Gaussian, in metres, > 0. (..., P, 2)
        rotations: Angle of the first axis from +x, in radians, anticlockwise. (..., P)
        grid: Extent of the raster in metres and its size in pixels, H rows and W columns.
        backend: ``"auto"``, ``"reference"`` (plain torch), ``"cpu"`` (numba) or ``"triton"``, see
            `choose_backend`.

    Returns:
        Occupancy in [0, 1], differentiable in the first three inputs. (..., H, W)

    Raises:
        TypeError: If an input is not floating point.
        ValueError: If the shapes or devices disagree, or if ``backend`` is unknown or does not
            support the inputs.
    """
    _check(means, scales, rotations=rotations)
    gaussians = torch.cat([means, scales, rotations[..., None]], dim=-1)  # (..., P, 5)
    gaussians = at_least_float32(gaussians)
    with torch.autocast(means.device.type, enabled=False):
        backend = choose_backend(backend, gaussians, kernel="render_gaussians")
        if backend == "reference":
            return render_gaussians_reference(
                means=gaussians[..., :2],
                scales=gaussians[..., 2:4],
                rotations=gaussians[..., 4],
                grid=grid,
            )
        batch_shape = means.shape[:-2]
        # The size is given in place of -1, which is ambiguous for tensors without elements.
        flat = gaussians.reshape(math.prod(batch_shape), means.shape[-2], 5)
        # Corner of the raster with the smallest x and y, and the sides of a pixel, in metres.
        frame = [grid.x_range[0], grid.y_range[0], *grid.pixel_size_m]
        # The kernel with one warp per tile replaces the default kernel if the user has enabled it.
        # `AUTO_KERNELS` is read from its module at each call, because tests replace it.
        in_warps = backend == "triton" and "render_gaussians_in_warps" in backends.AUTO_KERNELS
        render = _render_in_warps if in_warps else _render
        masks = render(flat, frame, height=grid.height, width=grid.width, backend=backend)
        return masks.reshape((*batch_shape, grid.height, grid.width))


def _check(means: Tensor, scales: Tensor, rotations: Tensor) -> None:
    """Raise if shapes or devices of Gaussians disagree, or if a type is not floating point."""
    if means.ndim < 2 or means.shape[-1] != 2:
        raise InputError(f"means must have shape (..., P, 2), got {tuple(means.shape)}.")
    for name, tensor, shape in (
        ("means", means, means.shape),
        ("scales", scales, means.shape),
        ("rotations", rotations, means.shape[:-1]),
    ):
        if tensor.shape != shape:
            raise InputError(
                f"{name} must have shape {tuple(shape)} to match means, got {tuple(tensor.shape)}."
            )
        if tensor.device != means.device:
            raise InputError(f"{name} must be on {means.device} like means, got {tensor.device}.")
        if not tensor.dtype.is_floating_point:
            raise InputTypeError(f"{name} must be floating point, got {tensor.dtype}.")
