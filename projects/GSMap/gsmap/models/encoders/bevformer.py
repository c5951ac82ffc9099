"""BEVFormer's spatial cross-attention: deformable sampling around projected BEV pillars."""

from collections.abc import Sequence
from itertools import product

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.attention import SamplingAttention, sample_map
from gsmap.models.encoders.projection import PillarProjection
from gsmap.structures.tensors import constant, upload
from gsmap.utils.errors import InputError


@MODELS.register_module()
class SpatialCrossAttention(SamplingAttention):
    """Deformable attention from BEV cells to the cameras, around the projected pillars.

    A pillar consists of points at several heights above a cell. Sample s of a head is taken near
    the projection of the point with index ``s % num_heights``. Sums over cameras are divided by the
    number of cameras in which the cell is visible.

    Args:
        embed_dims: Channels C.
        num_heads: Number of heads.
        num_points: Samples per head, S.
        num_heights: Points per pillar, Z.
        num_levels: Levels of image features; each head has S samples in every level.

    Raises:
        ValueError: If ``num_points`` is not a multiple of ``num_heights``.
    """

    # Whether pairs of a cell and a camera that does not show it are computed as well, with weight
    # 0. `StaticStep` (training) and `StaticFrame` (inference) set this before they record a CUDA
    # graph, in which the sizes of tensors are fixed.
    fixed_sizes = False

    def __init__(
        self,
        embed_dims: int = 256,
        num_heads: int = 8,
        num_points: int = 8,
        num_heights: int = 4,
        num_levels: int = 1,
    ) -> None:
        if num_points % num_heights:
            raise InputError(
                f"num_points must be a multiple of num_heights, got {num_points} and {num_heights}."
            )
        super().__init__(embed_dims, num_heads, num_points, dropout=0.0, num_parts=num_levels)
        self.num_heights = num_heights

    def forward(
        self, query: Tensor, img_feats: Tensor | Sequence[Tensor], projection: PillarProjection
    ) -> Tensor:
        """Attend from the cells to the cameras. The residual is not added.

        Args:
            query: Queries of the cells. (B, Q, C)
            img_feats: Image features. (B, V, C, h, w), or a list with one such tensor per level
            projection: Image coordinates ``uv`` of pillars with Z points (B, V, Q, Z, 2), and
                whether a cell is ``visible`` in a camera (B, V, Q).

        Returns:
            Camera features of every cell. (B, Q, C)
        """
        levels = [img_feats] if isinstance(img_feats, Tensor) else list(img_feats)
        # One chunk per level.
        offsets = self.offsets_in_cells(query).chunk(self.num_parts, 3)  # (B, Q, heads, S, 2) each
        weights = self.weights(query).chunk(self.num_parts, 3)
        # `self.num_points` counts the samples of all levels, S * num_parts.
        repeats = self.num_points // (self.num_parts * self.num_heights)
        summed = query.new_zeros(query.shape, dtype=torch.float32)
        visible_cells = [] if self.fixed_sizes else _visible_cells(projection.visible)
        for feats, offset, weight in zip(levels, offsets, weights, strict=True):
            height, width = feats.shape[-2:]
            offset = offset / constant(query, [width, height])  # from cells to shares of the map
            # The shape of `value` is (B, V, h * w, heads, C / heads).
            value = self.values(feats.flatten(3).transpose(2, 3)).float()
            if self.fixed_sizes:
                summed = summed + _sample_all_pairs(
                    value,
                    (height, width),
                    offsets=offset,
                    weights=weight,
                    projection=projection,
                    repeats=repeats,
                )
                continue
            batch, num_views = feats.shape[:2]
            for sample, view in product(range(batch), range(num_views)):
                cell = visible_cells[sample * num_views + view]  # indices (T,)
                # Repeated as a whole: sample s lies near the pillar's point s % num_heights.
                centres = projection.uv[sample, view, cell].repeat(1, repeats, 1)  # (T, S, 2)
                locations = centres[:, None] + offset[sample, cell]  # (T, heads, S, 2)
                sampled = sample_map(
                    value[sample, view][None],
                    shape=(height, width),
                    locations=locations[None],
                    weights=weight[sample, cell][None],
                )
                summed[sample] = summed[sample].index_add(0, cell, sampled[0])
        count = projection.visible.sum(1).clamp(min=1)
        return self.output_proj(summed / count[..., None])


def _visible_cells(visible: Tensor) -> list[Tensor]:
    """List the visible cells of each camera. The host waits for the GPU once.

    Args:
        visible: Whether a cell is visible in a camera. (B, V, Q)

    Returns:
        Indices of the T visible cells for each camera of each sample. B * V tensors (T,)
    """
    pairs = visible.flatten(0, 1).cpu()
    indices = [pair.nonzero()[:, 0] for pair in pairs.unbind()]
    return upload(indices, visible.device)


def _sample_all_pairs(
    value: Tensor,
    shape: tuple[int, int],
    offsets: Tensor,
    weights: Tensor,
    projection: PillarProjection,
    repeats: int,
) -> Tensor:
    """Sum the samples of every cell over all cameras, with tensor sizes independent of values.

    Args:
        value: Projected features of each camera, with C channels per head.
            (B, V, h * w, heads, C)
        shape: Rows h and columns w of the features.
        offsets: Offsets from the projected pillar, as fractions of the feature map.
            (B, Q, heads, S, 2)
        weights: Weight of each sample. (B, Q, heads, S)
        projection: Image coordinates of the pillars, and the visible cells of each camera.
        repeats: Samples per pillar height.

    Returns:
        The sums over cameras. (B, Q, heads * C)
    """
    visible = projection.visible[..., None, None, None]  # (B, V, Q, 1, 1, 1)
    centres = projection.uv.repeat(1, 1, 1, repeats, 1)[:, :, :, None]  # (B, V, Q, 1, S, 2)
    # Image coordinates may have any value where a cell is not visible, also NaN.
    locations = torch.where(visible, centres + offsets[:, None], 0)
    pair_weights = weights[:, None] * visible[..., 0]  # (B, V, Q, heads, S)
    sampled = sample_map(
        value.flatten(0, 1),
        shape=shape,
        locations=locations.flatten(0, 1),
        weights=pair_weights.flatten(0, 1),
    )  # (B * V, Q, heads * C)
    return sampled.unflatten(0, value.shape[:2]).sum(1)
