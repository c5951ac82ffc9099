"""Deformable attention over one or several feature maps."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from mmcv.ops import get_compiling_cuda_version
from mmcv.ops.multi_scale_deform_attn import MultiScaleDeformableAttnFunction
from mmdet3d.registry import MODELS
from mmengine.model import constant_init, xavier_init
from torch import Tensor, nn

from gsmap.ops.deformable_sampling import (
    bilinear_cells,
    deformable_sample,
    has_kernel,
    sum_rows,
)
from gsmap.structures.tensors import at_least_float32, constant
from gsmap.utils.errors import InputError

_IM2COL_STEP = 64  # number of batch entries that mmcv's compiled op processes at a time
_CORNERS = 4  # number of cells that bilinear sampling reads around a location


def has_compiled_op(value: Tensor) -> bool:
    """Whether the compiled deformable attention of mmcv supports a tensor.

    It must be on a GPU, and mmcv must be compiled for CUDA.
    """
    return value.is_cuda and get_compiling_cuda_version() != "not available"


def sample_map(value: Tensor, shape: tuple[int, int], locations: Tensor, weights: Tensor) -> Tensor:
    """Sample a feature map at several locations per query, and sum the weighted samples.

    The compiled op of mmcv runs if it supports the tensor, unless `deformable_sample` would select
    its fused kernel. Otherwise `deformable_sample` runs.

    Args:
        value: Cells of the map, row by row. (B, H * W, heads, C)
        shape: Rows H and columns W of the map.
        locations: Sampling locations (x, y), [0, 1] over the map. (B, Q, heads, S, 2)
        weights: Weights of the samples. (B, Q, heads, S)

    Returns:
        Sampled features of all heads. (B, Q, heads * C)
    """
    if has_kernel(value) or not has_compiled_op(value):
        return deformable_sample(value, shape, locations, weights)
    # mmcv's op samples several maps (levels). Here it has one level, hence the axes of size 1.
    # `constant` caches its tensors on the GPU, since new ones would make the host wait.
    level_shapes = constant(value, [shape], torch.long)
    level_starts = constant(value, [0], torch.long)
    return MultiScaleDeformableAttnFunction.apply(
        value.contiguous(),
        level_shapes,
        level_starts,
        locations[:, :, :, None].contiguous(),
        weights[:, :, :, None].contiguous(),
        _IM2COL_STEP,
    )


def place_samples(
    offsets: Tensor, reference: Tensor, shape: tuple[int, int], frames: Tensor | None = None
) -> Tensor:
    """Compute sampling locations around reference points.

    Args:
        offsets: Offsets (x, y) from the reference point, in cells. (B, Q, heads, S, 2)
        reference: References, which start with the point (x, y), [0, 1] over the map. (B, Q, D)
        shape: Rows and columns of the map.
        frames: Matrices that multiply the offsets of each query from the left, such as the axes of
            its Gaussian; None leaves the offsets as they are. (B, Q, 2, 2)

    Returns:
        Locations (x, y), [0, 1] over the map. (B, Q, heads, S, 2)
    """
    if frames is not None:
        matrices = frames[:, :, None, None]  # (B, Q, 1, 1, 2, 2)
        offsets = torch.sum(matrices * offsets[..., None, :], -1)  # products of matrix and vector
    size = constant(offsets, [shape[1], shape[0]])  # cells along x and y
    return reference[:, :, None, None, :2] + offsets / size


class SamplingAttention(nn.Module):
    """Base class of deformable attention: projections, sampling offsets and attention weights.

    The layers have the names and shapes of ``MultiScaleDeformableAttention`` in mmcv.

    Args:
        embed_dims: Channels C of the map and the output, divisible by ``num_heads``.
        num_heads: Number of heads.
        num_points: Samples per head and query, in each of ``num_parts`` groups.
        query_dims: Channels of the query. None means ``embed_dims``.
        dropout: Probability of setting a value of the output to zero in training.
        num_parts: Number of groups of samples, for example one group per feature map. All groups
            have equal initial offsets.

    Attributes:
        num_points: Samples S per head and query, in all groups together.

    Raises:
        ValueError: If ``num_heads`` does not divide ``embed_dims``.
    """

    def __init__(
        self,
        embed_dims: int = 256,
        num_heads: int = 8,
        num_points: int = 4,
        query_dims: int | None = None,
        dropout: float = 0.1,
        num_parts: int = 1,
    ) -> None:
        super().__init__()
        if embed_dims % num_heads:
            raise InputError(
                f"embed_dims must be divisible by num_heads, got {embed_dims} and {num_heads}."
            )
        query_dims = query_dims or embed_dims
        self.num_heads = num_heads
        self.num_parts = num_parts
        self.num_points = num_parts * num_points
        self.sampling_offsets = nn.Linear(query_dims, num_heads * self.num_points * 2)
        self.attention_weights = nn.Linear(query_dims, num_heads * self.num_points)
        self.value_proj = nn.Linear(embed_dims, embed_dims)
        self.output_proj: nn.Module = nn.Linear(embed_dims, embed_dims)
        self.dropout = nn.Dropout(dropout)
        self.init_weights()

    def init_weights(self) -> None:
        """Initialise the layers.

        Offsets have a different direction for each head, and attention weights are equal. At first,
        neither depends on the query.
        """
        constant_init(self.sampling_offsets, 0.0)
        offsets = directional_offsets(self.num_heads, self.num_points // self.num_parts)
        # The bias (heads, S, 2) repeats the offsets for each group of samples. It is changed in
        # place, because it may be on a GPU.
        with torch.no_grad():
            self.sampling_offsets.bias.copy_(offsets.repeat(1, self.num_parts, 1).flatten())
        constant_init(self.attention_weights, 0.0)
        xavier_init(self.value_proj, distribution="uniform")
        xavier_init(self.output_proj, distribution="uniform")

    def offsets_in_cells(self, query: Tensor) -> Tensor:
        """Offsets (x, y) in cells. (B, Q, C) -> (B, Q, heads, S, 2)"""
        # Under autocast, layers return half precision, which is too coarse for coordinates.
        offsets = at_least_float32(self.sampling_offsets(query))
        return offsets.unflatten(-1, (self.num_heads, self.num_points, 2))

    def weights(self, query: Tensor) -> Tensor:
        """Attention weights, with sum 1 over the samples. (B, Q, C) -> (B, Q, heads, S)"""
        logits = at_least_float32(self.attention_weights(query))
        return logits.unflatten(-1, (self.num_heads, self.num_points)).softmax(-1)

    def values(self, tokens: Tensor) -> Tensor:
        """Projected cells of a map, by head. (..., cells, C) -> (..., cells, heads, C / heads)"""
        return at_least_float32(self.value_proj(tokens)).unflatten(-1, (self.num_heads, -1))


@MODELS.register_module()
class BEVDeformableAttention(SamplingAttention):
    """Multi-head deformable attention to one map, without the residual.

    It has the arguments of :class:`SamplingAttention`.
    """

    def forward(
        self, query: Tensor, reference: Tensor, feats: Tensor, frames: Tensor | None = None
    ) -> Tensor:
        """Sample the map for each query.

        Args:
            query: Queries with their positional encoding. (B, Q, C)
            reference: References, as in `place_samples`. (B, Q, D)
            feats: Feature map. (B, C, H, W)
            frames: Matrices of the offsets, as in `place_samples`, or None. (B, Q, 2, 2)

        Returns:
            The attention output. (B, Q, C)
        """
        shape = (feats.shape[-2], feats.shape[-1])
        tokens = feats.flatten(2).transpose(1, 2)  # (B, H * W, C)
        locations = self.locations(query, reference, shape=shape, frames=frames)
        weights = self.weights(query)
        # Projection and sampling are linear, so either may come first. Sampling first is faster if
        # the heads read fewer cells than the projection of the whole map computes. With a fused
        # kernel, projection always comes first. Both numbers below count a cell once per head.
        num_cells_read = weights.numel() * _CORNERS
        num_cells_projected = tokens[..., 0].numel() * self.num_heads
        is_fused = has_kernel(tokens) or has_compiled_op(tokens)
        if num_cells_read < num_cells_projected and not is_fused:
            sampled = self._sample_then_project(tokens, shape, locations=locations, weights=weights)
        else:
            value = self.values(tokens)
            sampled = sample_map(value, shape, locations=locations, weights=weights)
        return self.dropout(self.output_proj(sampled))

    def locations(
        self, query: Tensor, reference: Tensor, shape: tuple[int, int], frames: Tensor | None
    ) -> Tensor:
        """Compute the sampling locations of each query.

        Args:
            query: Queries with their positional encoding. (B, Q, C)
            reference: References, as in `place_samples`. (B, Q, D)
            shape: Rows and columns of the map.
            frames: Matrices of the offsets, as in `place_samples`, or None. (B, Q, 2, 2)

        Returns:
            Locations (x, y), [0, 1] over the map. (B, Q, heads, S, 2)
        """
        offsets = self.offsets_in_cells(query)
        return place_samples(offsets, reference, shape=shape, frames=frames)

    def _sample_then_project(
        self, tokens: Tensor, shape: tuple[int, int], locations: Tensor, weights: Tensor
    ) -> Tensor:
        """Sample the unprojected map, then project the sample of each head. (B, Q, C)"""
        # Indices of the four cells around each location, and their weights. (B, Q, heads, 4 S) each
        cells, cell_weights = bilinear_cells(locations, weights, shape)
        batch_index = torch.arange(len(tokens), device=tokens.device).view(-1, 1, 1, 1)
        # Rows of `table`: the cells of the batch's first map, then of the second one, and so on.
        table = at_least_float32(tokens).reshape(-1, tokens.shape[-1])  # (B * H * W, C)
        rows = batch_index * tokens.shape[1] + cells
        sampled = sum_rows(table, rows, cell_weights)  # weighted sums of rows. (B, Q, heads, C)
        # If each cell were projected first, its bias would be part of the weighted sum. So the bias
        # is multiplied by the sum of the weights. This sum is less than 1 if a sample lies at the
        # border of the map or outside of it.
        weight = self.value_proj.weight.unflatten(0, (self.num_heads, -1))  # (heads, C / heads, C)
        bias = self.value_proj.bias.view(self.num_heads, -1)
        projected = torch.einsum("bqhc,hdc->bqhd", sampled, weight)
        projected_bias = cell_weights.sum(-1, keepdim=True) * bias
        return (projected + projected_bias).flatten(2)  # (B, Q, C)


@MODELS.register_module()
class MultiLevelAttention(SamplingAttention):
    """Deformable attention over several maps, with one softmax over the samples of all maps.

    Args:
        num_levels: Number of maps.
        num_points: Samples per head and map.
        kwargs: Further arguments of :class:`SamplingAttention`.
    """

    def __init__(self, num_levels: int = 4, num_points: int = 4, **kwargs: Any) -> None:
        super().__init__(num_points=num_points, num_parts=num_levels, **kwargs)

    def forward(
        self,
        query: Tensor,
        reference: Tensor,
        feats: Sequence[Tensor],
        frames: Tensor | None = None,
    ) -> Tensor:
        """Sample all maps for each query.

        Args:
            query: Queries with their positional encoding. (B, Q, C)
            reference: References, as in `place_samples`. (B, Q, D)
            feats: Feature maps. Offsets in a map are in cells of this map. (B, C, h, w) each
            frames: Matrices of the offsets, as in `place_samples`, or None. (B, Q, 2, 2)

        Returns:
            The attention output. (B, Q, C)
        """
        # Axis 3 has the samples of all maps; each map gets its group of them.
        all_offsets = self.offsets_in_cells(query).chunk(self.num_parts, 3)
        all_weights = self.weights(query).chunk(self.num_parts, 3)
        total = query.new_zeros((*query.shape[:2], self.value_proj.out_features))
        for level, offsets, weights in zip(feats, all_offsets, all_weights, strict=True):
            shape = (level.shape[-2], level.shape[-1])
            value = self.values(level.flatten(2).transpose(1, 2))
            locations = place_samples(offsets, reference, shape=shape, frames=frames)
            total = total + sample_map(value, shape, locations=locations, weights=weights)
        return self.dropout(self.output_proj(total))


def directional_offsets(num_heads: int, num_points: int) -> Tensor:
    """Create offsets on squares around the origin, with a different direction for each head.

    Args:
        num_heads: Number of heads.
        num_points: Samples S per head. The offset of sample s is s + 1 times the first offset.

    Returns:
        Offsets (x, y) in cells. (heads, S, 2)
    """
    angles = torch.arange(num_heads, dtype=torch.float32) * (2 * math.pi / num_heads)
    directions = torch.stack([angles.cos(), angles.sin()], dim=-1)
    # The larger coordinate becomes 1, which moves the directions from a circle to a square.
    directions = directions / directions.abs().amax(-1, keepdim=True)
    steps = torch.arange(1, num_points + 1, dtype=torch.float32)
    return directions[:, None] * steps[:, None]  # (heads, 1, 2) * (S, 1)
