"""StreamMapNet's multi-point attention, with one sample near each point of a line."""

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.attention import BEVDeformableAttention
from gsmap.structures.tensors import constant


@MODELS.register_module()
class LinePointAttention(BEVDeformableAttention):
    """Deformable attention of instance queries with one sample near each point of their lines.

    Sample p lies at point p of the instance's reference plus a learned offset. The released weights
    count rows from the largest y of the map, so a learned offset of +1 row is a step towards
    smaller y. The arguments are described in `SamplingAttention`, the base class of
    `BEVDeformableAttention`; ``num_points`` is the number P of points per instance.
    """

    def offsets_in_cells(self, query: Tensor) -> Tensor:
        """Compute the learned offsets (x, y) in cells. (B, N, C) -> (B, N, heads, P, 2)"""
        offsets = super().offsets_in_cells(query)
        # In this library, rows are counted from the smallest y, so y changes its sign. `constant`
        # returns these numbers as a cached tensor on the device of the offsets.
        return offsets * constant(offsets, [1.0, -1.0])

    def locations(
        self, query: Tensor, reference: Tensor, shape: tuple[int, int], frames: Tensor | None
    ) -> Tensor:
        """Compute the locations of the samples.

        Args:
            query: Instance queries. (B, N, C)
            reference: References of their points, which begin with (x, y) in [0, 1] over the map.
                (B, N * P, D)
            shape: Rows and columns of the BEV features.
            frames: Matrices that multiply the offsets of each point from the left, such as the axes
                of its Gaussian; None leaves the offsets as they are. (B, N * P, 2, 2)

        Returns:
            Locations (x, y) in [0, 1] over the map. (B, N, heads, P, 2)
        """
        offsets = self.offsets_in_cells(query)  # (B, N, heads, P, 2)
        if frames is not None:
            # One matrix for all heads of a point.
            matrices = frames.unflatten(1, (-1, self.num_points))[:, :, None]  # (B, N, 1, P, 2, 2)
            # Product of each matrix with its offset.
            offsets = torch.sum(matrices * offsets[..., None, :], dim=-1)
        points = reference[..., :2].unflatten(1, (-1, self.num_points))  # (B, N, P, 2)
        # Points are in [0, 1] over the map, so offsets in cells are divided by the numbers of
        # columns (x) and rows (y).
        return points[:, :, None] + offsets / constant(offsets, [shape[1], shape[0]])
