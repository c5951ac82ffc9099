import pytest
import torch
from mmcv import _ext
from mmcv.ops import Voxelization

import gsmap.mmcv_ext
from gsmap.ops.hard_voxelization import hard_voxelize

SIZE = [0.5, 1.0, 2.0]
EXTENT = [-2.0, -3.0, -1.0, 2.0, 3.0, 3.0]  # 8 x 6 x 2 voxels
COMPILED = _ext.__file__ != gsmap.mmcv_ext.__file__


def voxelise(points, max_voxels, max_points):
    return hard_voxelize(points, torch.tensor(SIZE), torch.tensor(EXTENT), max_voxels, max_points)


def test_voxels_and_points_keep_the_order_of_the_cloud():
    """Cells in z, y, x of the points: a (0, 5, 7), b (1, 0, 0), a, none, a, c (0, 3, 4), b."""
    cloud = [
        [1.9, 2.9, 0.9, 0], [-2.0, -3.0, 1.0, 1], [1.5, 2.0, -1.0, 2], [2.0, 0.0, 0.0, 3],
        [1.6, 2.5, 0.0, 4], [0.1, 0.2, 0.3, 5], [-1.6, -2.1, 2.9, 6],
    ]  # fmt: skip
    points = torch.tensor(cloud)
    voxels, coors, counts = voxelise(points, max_voxels=9, max_points=2)
    assert coors.tolist() == [[0, 5, 7], [1, 0, 0], [0, 3, 4]]
    assert counts.tolist() == [2, 2, 1]  # the third point of a is one too many
    none = torch.zeros(4)
    rows = [points[0], points[2], points[1], points[6], points[5], none]
    torch.testing.assert_close(voxels, torch.stack(rows).view(3, 2, 4), rtol=0, atol=0)
    # with two voxels at most, c is left out, and what follows it in b is not
    voxels, coors, counts = voxelise(points, max_voxels=2, max_points=2)
    assert coors.tolist() == [[0, 5, 7], [1, 0, 0]]
    assert voxels[..., 3].tolist() == [[0, 2], [1, 6]]


@pytest.mark.parametrize("cloud", [torch.zeros(0, 5), torch.full((3, 5), torch.nan)])
def test_no_point_gives_no_voxel(cloud):
    voxels, coors, counts = voxelise(cloud, max_voxels=9, max_points=2)
    assert voxels.shape == (0, 2, 5)
    assert coors.shape == (0, 3)
    assert counts.shape == (0,)
    assert coors.dtype == counts.dtype == torch.int32


def crowded_cloud(dtype=torch.float32):
    torch.manual_seed(0)
    points = torch.rand(3000, 5, dtype=dtype) * torch.tensor([5.0, 7, 5, 1, 1])
    points[:, :3] -= torch.tensor([2.5, 3.5, 1.5])
    points[:500] = (points[:500] * 2).round() / 2  # on the edges of voxels
    points[7, 1] = torch.nan
    points[8, 0] = torch.inf
    return points


@pytest.mark.skipif(not COMPILED, reason="mmcv is installed without its compiled operators")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [SIZE, [0.15, 0.15, 4.0]], ids=["few", "many"])
@pytest.mark.parametrize(("max_voxels", "max_points"), [(4000, 99), (4000, 3), (40, 3), (1, 1)])
def test_it_equals_the_compiled_operator(monkeypatch, dtype, size, max_voxels, max_points):
    layer = Voxelization(size, EXTENT, max_points, max_voxels)
    cloud = crowded_cloud(dtype)
    theirs = layer(cloud)
    monkeypatch.setattr("mmcv.ops.voxelize.ext_module", gsmap.mmcv_ext)
    ours = layer(cloud)
    assert len(ours[0]) == min(max_voxels, len(theirs[0]))
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other, rtol=0, atol=0)


def test_mmcv_voxelises_by_it_where_it_has_no_operator(monkeypatch):
    monkeypatch.setattr("mmcv.ops.voxelize.ext_module", gsmap.mmcv_ext)
    found = Voxelization(SIZE, EXTENT, 3, (50, 40)).eval()(crowded_cloud())
    for mine, other in zip(found, voxelise(crowded_cloud(), 40, 3), strict=True):
        torch.testing.assert_close(mine, other, rtol=0, atol=0)
