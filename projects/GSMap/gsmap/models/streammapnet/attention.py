"""StreamMapNet's attention: an instance query looks once beside each point of its line."""

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.attention import BEVDeformableAttention
from gsmap.structures.tensors import constant


@MODELS.register_module()
class LinePointAttention(BEVDeformableAttention):
    """Deformable attention with one sample beside every point of a line (multi-point attention).

    Sample p lies at point p of the instance's reference plus a learned offset. Arguments as of
    `SamplingAttention`; ``num_points`` are the points per instance P. Offsets count rows from the
    map's largest y, as the weights of StreamMapNet do.
    """

    def offsets_in_cells(self, query: Tensor) -> Tensor:
        """Return the learned offsets (x, y) in cells. (B, N, heads, P, 2)"""
        offsets = super().offsets_in_cells(query)
        return offsets * constant(offsets, [1.0, -1.0])

    def locations(
        self, query: Tensor, reference: Tensor, shape: tuple[int, int], frames: Tensor | None
    ) -> Tensor:
        """Return where each instance looks, from references of its points (B, N * P, D)."""
        offsets = self.offsets_in_cells(query)  # (B, N, heads, P, 2)
        if frames is not None:
            turns = frames.unflatten(1, (-1, self.num_points))[:, :, None]  # (B, N, 1, P, 2, 2)
            offsets = torch.sum(turns * offsets[..., None, :], -1)
        points = reference[..., :2].unflatten(1, (-1, self.num_points))
        return points[:, :, None] + offsets / constant(offsets, [shape[1], shape[0]])
