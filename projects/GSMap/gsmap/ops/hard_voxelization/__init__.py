"""Hard voxelisation of a point cloud: the first points of the first cells that points fall into."""

import torch
from torch import Tensor


def hard_voxelize(
    points: Tensor, voxel_size: Tensor, extent: Tensor, max_voxels: int, max_points: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Gather points by the voxel they lie in, like mmcv's deterministic operator.

    Voxels are in the order of their first points, and a voxel's points in the order of the cloud.
    Points beyond the extent, and those without a place (NaN), are left out, then whatever exceeds
    one of the two maxima.

    Args:
        points: x, y, z in metres and other channels. (n, C)
        voxel_size: Sides of a voxel along x, y, z in metres. (3,)
        extent: Smallest x, y, z, which belongs to a voxel, then largest, which does not. (6,)
        max_voxels: Largest number of voxels.
        max_points: Largest number of points in a voxel.

    Returns:
        Points of each voxel, zero where there are fewer (M, max_points, C); its cell in z, y, x,
        int32 (M, 3); its number of points, int32 (M,).
    """
    low, high, size = (values.to(points.device) for values in (*extent.split(3), voxel_size))
    shape = torch.round((high - low) / size)
    places = torch.floor((points[:, :3] - low) / size)
    inside = ((places >= 0) & (places < shape)).all(1)
    points, cells = points[inside], places[inside].long()
    x, y, z = cells.unbind(1)
    columns, rows = shape[:2].long()
    keys, order = ((z * rows + y) * columns + x).sort(stable=True)
    _, group, counts = keys.unique_consecutive(return_inverse=True, return_counts=True)
    starts = counts.cumsum(0) - counts
    firsts, by_first = order[starts].sort()  # a voxel's place is that of its first point
    number = torch.empty_like(by_first)
    number[by_first] = torch.arange(len(by_first), device=points.device)
    voxel, slot = number[group], torch.arange(len(order), device=points.device) - starts[group]
    kept = (voxel < max_voxels) & (slot < max_points)
    num_voxels = min(max_voxels, len(firsts))
    voxels = points.new_zeros(num_voxels, max_points, points.shape[1])
    voxels[voxel[kept], slot[kept]] = points[order[kept]]
    coors = cells[firsts[:num_voxels]].flip(1).int()
    return voxels, coors, counts[by_first][:num_voxels].clamp(max=max_points).int()
