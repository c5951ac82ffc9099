"""Stands in for mmcv's compiled operators (``mmcv._ext``) where mmcv was installed without them.

``mmcv-lite`` is mmcv's Python without its compiled module, but mmdet and mmdet3d import
``mmcv.ops``, which asks that module for every operator. GSMap uses two of them, the hard
voxelisation of LiDAR and the deformable convolution, and torch does both here. Every other name is
a function that says, when it is called, which operator is missing and how to get it.
``gsmap/__init__.py`` puts `MmcvExtFinder` in place.
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
    """Finds this file as ``mmcv._ext``; at the end of ``sys.meta_path``, where a compiled one wins.

    It costs nothing until mmcv is imported.
    """

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return where the module ``name`` is, if it is ``mmcv._ext``."""
        return spec_from_file_location(name, __file__) if name == "mmcv._ext" else None


def get_compiling_cuda_version() -> str:
    """Return what mmcv says where its operators were built without CUDA."""
    return "not available"


get_compiler_version = get_compiling_cuda_version


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
    """Fill mmcv's output tensors; their sizes are the largest numbers of voxels and of points."""
    from gsmap.ops.hard_voxelization import hard_voxelize

    found = hard_voxelize(points, voxel_size, coors_range, *voxels.shape[:2])
    for out, values in zip((voxels, coors, num_points_per_voxel), found, strict=True):
        out[: len(values)] = values
    voxel_num.fill_(len(found[0]))


def modulated_deform_conv_forward(*tensors: Tensor, **geometry: Any) -> None:
    """Fill mmcv's output tensor."""
    images, weight, bias, _ones, offset, mask, output, _columns = tensors
    output.copy_(_deform_conv((images, weight, bias, offset, mask), geometry))


def modulated_deform_conv_backward(*tensors: Tensor, **geometry: Any) -> None:
    """Fill mmcv's gradients of images, weight, bias, offset and mask."""
    import torch

    images, weight, bias, _ones, offset, mask, _columns, *grads, grad_output = tensors
    inputs = [t.detach().requires_grad_() for t in (images, weight, bias, offset, mask)]
    with torch.enable_grad():
        out = _deform_conv(inputs, geometry)
    found = torch.autograd.grad(out, inputs, grad_output, materialize_grads=True)
    for grad, values in zip(grads, found, strict=True):
        grad.copy_(values)


def _deform_conv(inputs: Sequence[Tensor], geometry: dict[str, Any]) -> Tensor:
    """Convolve images, weight, bias, offset and mask with mmcv's names of the settings."""
    from gsmap.ops.modulated_deform_conv import modulated_deform_conv

    images, weight, bias, offset, mask = inputs
    stride, pad, dilation = (
        (geometry[f"{name}_h"], geometry[f"{name}_w"]) for name in ("stride", "pad", "dilation")
    )
    groups, deform_groups = geometry["group"], geometry["deformable_group"]
    own = bias if geometry["with_bias"] else None
    return modulated_deform_conv(
        images, weight, own, offset, mask, stride, pad, dilation, groups, deform_groups
    )


def __getattr__(name: str) -> Callable[..., NoReturn]:
    if name.startswith("__"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def missing(*_: Any, **__: Any) -> NoReturn:
        raise WorkError(
            f"the operator {name} of mmcv is not compiled here: `GSMAP_MMCV_OPS=1 make setup` "
            "replaces mmcv-lite by an mmcv with its operators (docs/install.md)."
        )

    return missing
