"""BEVFormer's spatial cross-attention: deformable sampling around projected BEV pillars."""

from collections.abc import Sequence
from itertools import product

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.encoders.projection import PillarProjection
from gsmap.models.maptr.attention import SamplingAttention, sample_map
from gsmap.structures.tensors import constant


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
        num_levels: Levels of image features; each head has S samples in every level.
    """

    def __init__(
        self,
        embed_dims: int = 256,
        num_heads: int = 8,
        num_points: int = 8,
        num_heights: int = 4,
        num_levels: int = 1,
    ) -> None:
        if num_points % num_heights:
            raise ValueError(
                f"num_points must be a multiple of num_heights, got {num_points} and {num_heights}."
            )
        super().__init__(embed_dims, num_heads, num_points, dropout=0.0, num_parts=num_levels)
        self.num_heights = num_heights

    def forward(
        self, query: Tensor, img_feats: Tensor | Sequence[Tensor], projection: PillarProjection
    ) -> Tensor:
        """Collect camera features for every cell's query, without the residual.

        Features are (B, V, C, h, w), one or a list of levels; the projected pillars have
        ``num_heights`` points. (B, Q, C) -> (B, Q, C)
        """
        levels = [img_feats] if isinstance(img_feats, Tensor) else list(img_feats)
        offsets = self.offsets_in_cells(query).chunk(self.num_parts, 3)  # (B, Q, heads, S, 2)
        weights = self.weights(query).chunk(self.num_parts, 3)
        repeats = self.num_points // (self.num_parts * self.num_heights)
        summed = query.new_zeros(query.shape, dtype=torch.float32)
        for feats, offset, weight in zip(levels, offsets, weights, strict=True):
            height, width = feats.shape[-2:]
            offset = offset / constant(query, [width, height])
            value = self.values(feats.flatten(3).transpose(2, 3)).float()  # (B, V, hw, heads, C')
            for sample, view in product(*(range(n) for n in feats.shape[:2])):
                cell = projection.visible[sample, view].nonzero()[:, 0]  # (T,)
                centres = projection.uv[sample, view, cell].repeat(1, repeats, 1)  # (T, S, 2)
                locations = centres[:, None] + offset[sample, cell]  # (T, heads, S, 2)
                seen = sample_map(
                    value[sample, view][None],
                    shape=(height, width),
                    locations=locations[None],
                    weights=weight[sample, cell][None],
                )
                summed[sample] = summed[sample].index_add(0, cell, seen[0])
        count = projection.visible.sum(1).clamp(min=1)
        return self.output_proj(summed / count[..., None])
