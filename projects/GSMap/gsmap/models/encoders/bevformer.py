"""BEVFormer's spatial cross-attention: deformable sampling around projected BEV pillars."""

from itertools import product

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.encoders.projection import PillarProjection
from gsmap.models.maptr.attention import SamplingAttention, sample_map


@MODELS.register_module()
class SpatialCrossAttention(SamplingAttention):
    """Attention from BEV cells to the cameras that see them, around their projected pillars.

    Sample s belongs to pillar height ``s % num_heights``. Sums over cameras are divided by the
    number of cameras that see the cell.

    Args:
        embed_dims: Channels C.
        num_heads: Number of heads.
        num_points: Samples per head, S; ValueError if it is no multiple of ``num_heights``.
        num_heights: Points per pillar, Z.
    """

    def __init__(
        self, embed_dims: int = 256, num_heads: int = 8, num_points: int = 8, num_heights: int = 4
    ) -> None:
        if num_points % num_heights:
            raise ValueError(
                f"num_points must be a multiple of num_heights, got {num_points} and {num_heights}."
            )
        super().__init__(embed_dims, num_heads, num_points, dropout=0.0)
        self.num_heights = num_heights

    def forward(self, query: Tensor, img_feats: Tensor, projection: PillarProjection) -> Tensor:
        """Collect camera features (B, V, C, h, w) for every cell's query, without the residual.

        The projected pillars have ``num_heights`` points. (B, Q, C) -> (B, Q, C)
        """
        height, width = img_feats.shape[-2:]
        offsets = self.offsets_in_cells(query) / query.new_tensor([width, height])
        weights = self.weights(query)
        value = self.values(img_feats.flatten(3).transpose(2, 3)).float()  # (B, V, hw, heads, C')
        repeats = self.num_points // self.num_heights
        summed = query.new_zeros(query.shape, dtype=torch.float32)
        for sample, view in product(*(range(n) for n in img_feats.shape[:2])):
            cell = projection.visible[sample, view].nonzero()[:, 0]  # (T,)
            centres = projection.uv[sample, view, cell].repeat(1, repeats, 1)  # (T, S, 2)
            locations = centres[:, None] + offsets[sample, cell]  # (T, heads, S, 2)
            seen = sample_map(
                value[sample, view][None],
                shape=(height, width),
                locations=locations[None],
                weights=weights[sample, cell][None],
            )
            summed[sample] = summed[sample].index_add(0, cell, seen[0])
        count = projection.visible.sum(1).clamp(min=1)
        return self.output_proj(summed / count[..., None])
