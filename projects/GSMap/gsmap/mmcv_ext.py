"""Replacement of the compiled operators of mmcv (``mmcv._ext``) for an mmcv without them.

``mmcv-lite`` is mmcv without the compiled module, but mmdet and mmdet3d import ``mmcv.ops``, which
imports every operator from that module. GSMap uses two operators, the hard voxelisation of LiDAR
points and the modulated deformable convolution, which are implemented with torch. All other
operators are functions that raise an error with the name of the operator and the command that
installs it. ``gsmap/__init__.py`` adds `MmcvExtFinder` to ``sys.meta_path``.

The functions have the names and the arguments of mmcv's compiled functions, and write to the output
tensors that mmcv passes. They import GSMap's operators when they are called, because this module is
loaded while mmcv is being imported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from types import ModuleType
from typing import TYPE_CHECKING, Any, NoReturn

from gsmap.utils.errors import WorkError

if TYPE_CHECKING:
    from torch import Tensor


class MmcvExtFinder:
    """Import finder that loads this file as the module ``mmcv._ext``.

    It must be the last entry of ``sys.meta_path``, so that a compiled ``mmcv._ext`` has priority.
    """

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find the module ``mmcv._ext``.

        Args:
            name: Full name of the module.
            path: Search path of the parent package. Not used; the import system passes it.
            target: Module to reload. Not used; the import system passes it.

        Returns:
            Specification of this file as a module, or None for all other names.
        """
        if name != "mmcv._ext":
            return None
        return spec_from_file_location(name, __file__)


def get_compiling_cuda_version() -> str:
    """Return the text that an mmcv built without CUDA returns as its CUDA version."""
    return "not available"


get_compiler_version = get_compiling_cuda_version  # mmcv imports both names


def hard_voxelize_forward(
    points: Tensor,
    voxel_size: Tensor,
    coors_range: Tensor,
    voxels: Tensor,
    coors: Tensor,
    num_points_per_voxel: Tensor,
    voxel_num: Tensor,
    **_: Any,
) -> None:
    """Group points by voxel and write the results to the output tensors of mmcv.

    Further arguments of mmcv are ignored.

    Args:
        points: Points x, y, z in metres and further channels. (n, C)
        voxel_size: Sides of a voxel along x, y, z in metres. (3,)
        coors_range: Smallest x, y, z in metres, then largest x, y, z. (6,)
        voxels: Output: points of each voxel. (max_voxels, max_points, C)
        coors: Output: cell z, y, x of each voxel. (max_voxels, 3)
        num_points_per_voxel: Output: number of points of each voxel. (max_voxels,)
        voxel_num: Output: number of voxels. ()
    """
    from gsmap.ops.hard_voxelization import hard_voxelize

    max_voxels, max_points = voxels.shape[:2]
    voxel_points, cells, counts = hard_voxelize(
        points, voxel_size, extent=coors_range, max_voxels=max_voxels, max_points=max_points
    )
    num_voxels = len(voxel_points)
    voxels[:num_voxels] = voxel_points
    coors[:num_voxels] = cells
    num_points_per_voxel[:num_voxels] = counts
    voxel_num.fill_(num_voxels)


def modulated_deform_conv_forward(*tensors: Tensor, **geometry: Any) -> None:
    """Compute a modulated deformable convolution and write it to the output tensor of mmcv.

    Args:
        tensors: Images, weight, bias, ones, offset, mask, output and columns, in the order of mmcv.
            Ones and columns are working memory of the compiled operator and are not used.
        geometry: Settings of the convolution under the names of mmcv.
    """
    images, weight, bias, _ones, offset, mask, output, _columns = tensors
    inputs = (images, weight, bias, offset, mask)
    output.copy_(_deform_conv(inputs, geometry))


def modulated_deform_conv_backward(*tensors: Tensor, **geometry: Any) -> None:
    """Compute the gradients of a modulated deformable convolution and write them to mmcv's tensors.

    Args:
        tensors: Images, weight, bias, ones, offset, mask and columns; then the gradients of images,
            weight, bias, offset and mask, which are written; then the gradient of the output. Ones
            and columns are not used.
        geometry: Settings of the convolution under the names of mmcv.
    """
    import torch

    images, weight, bias, _ones, offset, mask, _columns, *grads, grad_output = tensors
    inputs = []
    for tensor in (images, weight, bias, offset, mask):
        inputs.append(tensor.detach().requires_grad_())
    with torch.enable_grad():  # gradients are off in a backward pass
        output = _deform_conv(inputs, geometry)
    # An input without influence on the output, such as an unused bias, gets zeros.
    input_grads = torch.autograd.grad(
        output, inputs, grad_outputs=grad_output, materialize_grads=True
    )
    for grad, input_grad in zip(grads, input_grads, strict=True):
        grad.copy_(input_grad)


def _deform_conv(inputs: Sequence[Tensor], geometry: dict[str, Any]) -> Tensor:
    """Convolve (images, weight, bias, offset, mask) with the settings of mmcv in ``geometry``."""
    from gsmap.ops.modulated_deform_conv import modulated_deform_conv

    images, weight, bias, offset, mask = inputs
    return modulated_deform_conv(
        images,
        weight,
        bias=bias if geometry["with_bias"] else None,
        offset=offset,
        mask=mask,
        stride=(geometry["stride_h"], geometry["stride_w"]),
        padding=(geometry["pad_h"], geometry["pad_w"]),
        dilation=(geometry["dilation_h"], geometry["dilation_w"]),
        groups=geometry["group"],
        deform_groups=geometry["deformable_group"],
    )


def __getattr__(name: str) -> Callable[..., NoReturn]:
    """Return a function that raises RuntimeError for an operator that this module lacks."""
    # The import system looks up optional attributes, such as `__path__`.
    if name.startswith("__"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def missing(*_: Any, **__: Any) -> NoReturn:
        raise WorkError(
            f"the operator {name} of mmcv is not compiled here: `GSMAP_MMCV_OPS=1 make setup` "
            "replaces mmcv-lite by an mmcv with its operators (docs/install.md)."
        )

    return missing
