"""Hard voxelization of a point cloud: a limited number of voxels and of points in each."""

import torch
from torch import Tensor


def hard_voxelize(
    points: Tensor, voxel_size: Tensor, extent: Tensor, max_voxels: int, max_points: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Group points by voxel, with the result of mmcv's deterministic operator.

    Only voxels with at least one point are returned. Voxels are in the order of their first points,
    and the points of a voxel in the order of the cloud. Points outside of the extent and NaN points
    are left out. Voxels after the first ``max_voxels`` and points after the first ``max_points`` of
    a voxel are dropped.

    Args:
        points: Points x, y, z in metres and further channels. (n, C)
        voxel_size: Sides of a voxel along x, y, z in metres. (3,)
        extent: Smallest x, y, z in metres, included, then largest x, y, z, excluded. (6,)
        max_voxels: Largest number of voxels.
        max_points: Largest number of points of a voxel.

    Returns:
        Points of each voxel, filled with zeros (M, max_points, C); indices of the cell of each
        voxel along z, y, x, int32 (M, 3); and number of points in each voxel, at most
        ``max_points``, int32 (M,).
    """
    low = extent[:3].to(points.device)
    high = extent[3:].to(points.device)
    size = voxel_size.to(points.device)
    shape = torch.round((high - low) / size)  # number of cells along x, y, z
    # A comparison with NaN is false, so NaN points count as outside.
    cells = torch.floor((points[:, :3] - low) / size)
    inside = ((cells >= 0) & (cells < shape)).all(1)
    points = points[inside]
    cells = cells[inside].long()
    x, y, z = cells.unbind(1)
    columns, rows = shape[:2].long()
    flat_cells = (z * rows + y) * columns + x
    sorted_cells, order = flat_cells.sort(stable=True)
    # A group is the run of points of one cell in the sorted order. `group` is the number of the
    # group of each sorted point, and `counts` the number of points of each group.
    _, group, counts = sorted_cells.unique_consecutive(return_inverse=True, return_counts=True)
    starts = counts.cumsum(0) - counts
    # As the sort is stable, the first point of a group in the cloud is also its first one in the
    # sorted order. Groups are ordered by these first points: `firsts` are their indices in the
    # cloud, ascending, and `by_first` are the groups in this order.
    firsts, by_first = order[starts].sort()
    rank = torch.empty_like(by_first)  # number of the voxel of each group: inverse of `by_first`
    rank[by_first] = torch.arange(len(by_first), device=points.device)
    voxel = rank[group]  # number of the voxel of each sorted point
    # Index of each sorted point among the points of its voxel.
    slot = torch.arange(len(order), device=points.device) - starts[group]
    fits = (voxel < max_voxels) & (slot < max_points)
    num_voxels = min(max_voxels, len(firsts))
    voxels = points.new_zeros(num_voxels, max_points, points.shape[1])
    voxels[voxel[fits], slot[fits]] = points[order[fits]]
    voxel_cells = cells[firsts[:num_voxels]].flip(1).int()  # x, y, z -> z, y, x
    num_points = counts[by_first][:num_voxels].clamp(max=max_points).int()
    return voxels, voxel_cells, num_points
