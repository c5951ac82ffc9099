"""BEVFormer's spatial cross-attention: deformable sampling around projected BEV pillars."""

from collections.abc import Sequence
from itertools import product

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.attention import SamplingAttention, sample_map
from gsmap.models.encoders.projection import PillarProjection
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

    fixed_sizes = False  # whether unseen pairs of cell and camera are computed too, with weight 0

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
            if self.fixed_sizes:
                summed = summed + _sample_all_pairs(
                    value, (height, width), offset, weight, projection, repeats
                )
                continue
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


def _sample_all_pairs(
    value: Tensor,
    shape: tuple[int, int],
    offsets: Tensor,
    weights: Tensor,
    projection: PillarProjection,
    repeats: int,
) -> Tensor:
    """Sum what every cell samples in every camera, without a size that depends on values.

    Args:
        value: Projected features of each camera. (B, V, h * w, heads, C)
        shape: Rows h and columns w of the features.
        offsets: From the projected pillar, in [0, 1] over the map. (B, Q, heads, S, 2)
        weights: Weight of each sample. (B, Q, heads, S)
        projection: Where pillars fall, and which cells a camera sees.
        repeats: Samples per pillar height.

    Returns:
        The sums over cameras. (B, Q, heads * C)
    """
    visible = projection.visible[..., None, None, None]  # (B, V, Q, 1, 1, 1)
    centres = projection.uv.repeat(1, 1, 1, repeats, 1)[:, :, :, None]  # (B, V, Q, 1, S, 2)
    locations = torch.where(visible, centres + offsets[:, None], 0)
    pair_weights = weights[:, None] * visible[..., 0]  # (B, V, Q, heads, S)
    sampled = sample_map(
        value.flatten(0, 1),
        shape=shape,
        locations=locations.flatten(0, 1),
        weights=pair_weights.flatten(0, 1),
    )  # (B * V, Q, heads * C)
    return sampled.unflatten(0, value.shape[:2]).sum(1)
