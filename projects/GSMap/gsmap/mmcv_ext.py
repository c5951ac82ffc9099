"""Stands in for mmcv's compiled operators (``mmcv._ext``) where mmcv was installed without them.

``mmcv-lite`` is mmcv's Python without its compiled module, but mmdet and mmdet3d import
``mmcv.ops``, which asks that module for every operator. GSMap uses a single one of them, the hard
voxelisation of LiDAR, and torch does that here. Every other name is a function that says, when it
is called, which operator is missing and how to get it. ``gsmap/__init__.py`` puts `MmcvExtFinder`
in place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from types import ModuleType
from typing import TYPE_CHECKING, Any, NoReturn

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


def __getattr__(name: str) -> Callable[..., NoReturn]:
    if name.startswith("__"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def missing(*_: Any, **__: Any) -> NoReturn:
        raise RuntimeError(
            f"the operator {name} of mmcv is not compiled here: `GSMAP_MMCV_OPS=1 make setup` "
            "replaces mmcv-lite by an mmcv with its operators (docs/install.md)."
        )

    return missing
