"""Deformable attention over one feature map, or over several."""

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

_IM2COL_STEP = 64
_CORNERS = 4


def has_compiled_op(value: Tensor) -> bool:
    """Return whether mmcv's compiled deformable attention can run on a tensor."""
    return value.is_cuda and get_compiling_cuda_version() != "not available"


def sample_map(value: Tensor, shape: tuple[int, int], locations: Tensor, weights: Tensor) -> Tensor:
    """Do what `deformable_sample` does, by mmcv's compiled op on a GPU where it was built.

    A kernel of `deformable_sample` that is switched on goes first.

    Args:
        value: Cells of the map, row by row. (B, H * W, heads, C)
        shape: Rows H and columns W of the map.
        locations: (x, y) in [0, 1] over the map. (B, Q, heads, S, 2)
        weights: Weight of each sample. (B, Q, heads, S)
    """
    if has_kernel(value) or not has_compiled_op(value):
        return deformable_sample(value, shape, locations, weights)
    shapes = constant(value, [shape], torch.long)
    samples = locations[:, :, :, None].contiguous(), weights[:, :, :, None].contiguous()
    arguments = value.contiguous(), shapes, constant(value, [0], torch.long), *samples, _IM2COL_STEP
    return MultiScaleDeformableAttnFunction.apply(*arguments)


def place_samples(
    offsets: Tensor, reference: Tensor, shape: tuple[int, int], frames: Tensor | None = None
) -> Tensor:
    """Place samples around reference points, (x, y) in [0, 1] over the map. (B, Q, heads, S, 2)

    Args:
        offsets: From the reference point, in cells. (B, Q, heads, S, 2)
        reference: Begins with the point (x, y) in [0, 1] over the map. (B, Q, D)
        shape: Rows and columns of the map.
        frames: Turn the offsets of a query, if given. (B, Q, 2, 2)
    """
    if frames is not None:
        offsets = torch.sum(frames[:, :, None, None] * offsets[..., None, :], -1)
    size = constant(offsets, [shape[1], shape[0]])
    return reference[:, :, None, None, :2] + offsets / size


class SamplingAttention(nn.Module):
    """The learned parts of deformable attention on one map.

    They are those of mmcv's ``MultiScaleDeformableAttention`` for one level.

    Args:
        embed_dims: Channels C of map and output; ValueError if ``num_heads`` does not divide them.
        num_heads: Number of heads.
        num_points: Samples per head and query, in each part.
        query_dims: Channels of the query; None means ``embed_dims``.
        dropout: Dropout on the output.
        num_parts: Parts of the samples, such as levels, which start with the same offsets.

    Attributes:
        num_points: Samples per head and query, of all parts, S.
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
        self.num_heads, self.num_parts = num_heads, num_parts
        self.num_points = num_parts * num_points
        self.sampling_offsets = nn.Linear(query_dims, num_heads * self.num_points * 2)
        self.attention_weights = nn.Linear(query_dims, num_heads * self.num_points)
        self.value_proj = nn.Linear(embed_dims, embed_dims)
        self.output_proj: nn.Module = nn.Linear(embed_dims, embed_dims)
        self.dropout = nn.Dropout(dropout)
        self.init_weights()

    def init_weights(self) -> None:
        """Let each head look in its own direction, with equal weights."""
        constant_init(self.sampling_offsets, 0.0)
        offsets = directional_offsets(self.num_heads, self.num_points // self.num_parts)
        with torch.no_grad():  # in place: the weights may lie on a GPU already
            self.sampling_offsets.bias.copy_(offsets.repeat(1, self.num_parts, 1).flatten())
        constant_init(self.attention_weights, 0.0)
        xavier_init(self.value_proj, distribution="uniform")
        xavier_init(self.output_proj, distribution="uniform")

    def offsets_in_cells(self, query: Tensor) -> Tensor:
        """Return the learned offsets (x, y) in cells. (B, Q, heads, S, 2)"""
        offsets = at_least_float32(self.sampling_offsets(query))
        return offsets.unflatten(-1, (self.num_heads, self.num_points, 2))

    def weights(self, query: Tensor) -> Tensor:
        """Return the attention weights, of sum one over a head's points. (B, Q, heads, S)"""
        logits = at_least_float32(self.attention_weights(query))
        return logits.unflatten(-1, (self.num_heads, self.num_points)).softmax(-1)

    def values(self, tokens: Tensor) -> Tensor:
        """Return a map's projected cells by head. (..., cells, C) -> (..., cells, heads, C')"""
        return at_least_float32(self.value_proj(tokens)).unflatten(-1, (self.num_heads, -1))


@MODELS.register_module()
class BEVDeformableAttention(SamplingAttention):
    """Multi-head deformable attention on one map; the residual is left to the caller.

    Its arguments are those of :class:`SamplingAttention`.
    """

    def forward(
        self, query: Tensor, reference: Tensor, feats: Tensor, frames: Tensor | None = None
    ) -> Tensor:
        """Sample the map (B, C, H, W) for each query. (B, Q, C) -> (B, Q, C)

        Queries have their position; references and frames are as in `place_samples`.
        """
        shape = (feats.shape[-2], feats.shape[-1])
        tokens = feats.flatten(2).transpose(1, 2)  # (B, H * W, C)
        locations = self.locations(query, reference, shape, frames)
        weights = self.weights(query)
        # Projection and sampling commute: projecting after it pays when few cells are looked at.
        few = weights.numel() * _CORNERS < tokens[..., 0].numel() * self.num_heads
        if few and not (has_kernel(tokens) or has_compiled_op(tokens)):
            sampled = self._sample_then_project(tokens, shape, locations, weights)
        else:
            sampled = sample_map(self.values(tokens), shape, locations, weights)
        return self.dropout(self.output_proj(sampled))

    def locations(
        self, query: Tensor, reference: Tensor, shape: tuple[int, int], frames: Tensor | None
    ) -> Tensor:
        """Return where each query looks, (x, y) in [0, 1] over the map. (B, Q, heads, S, 2)"""
        return place_samples(self.offsets_in_cells(query), reference, shape, frames)

    def _sample_then_project(
        self, tokens: Tensor, shape: tuple[int, int], locations: Tensor, weights: Tensor
    ) -> Tensor:
        """Return what sampling the projected map would, by projecting each head's sample."""
        cells, cell_weights = bilinear_cells(locations, weights, shape)
        sample = torch.arange(len(tokens), device=tokens.device).view(-1, 1, 1, 1)
        table = at_least_float32(tokens).reshape(-1, tokens.shape[-1])
        sampled = sum_rows(table, sample * tokens.shape[1] + cells, cell_weights)
        weight = self.value_proj.weight.unflatten(0, (self.num_heads, -1))  # (heads, C', C)
        bias = self.value_proj.bias.view(self.num_heads, -1)
        projected = torch.einsum("bqhc,hdc->bqhd", sampled, weight)
        return (projected + cell_weights.sum(-1, keepdim=True) * bias).flatten(2)  # (B, Q, C)


@MODELS.register_module()
class MultiLevelAttention(SamplingAttention):
    """Deformable attention over several maps, with one softmax over the samples in all of them.

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
        """Sample all maps (B, C, h, w), offsets in cells of each. (B, Q, C) -> (B, Q, C)

        References and frames are as in `place_samples`.
        """
        offsets = self.offsets_in_cells(query).chunk(self.num_parts, 3)
        weights = self.weights(query).chunk(self.num_parts, 3)
        seen = torch.zeros_like(query)
        for level, own, weight in zip(feats, offsets, weights, strict=True):
            shape = (level.shape[-2], level.shape[-1])
            value = self.values(level.flatten(2).transpose(1, 2))
            places = place_samples(own, reference, shape, frames)
            seen = seen + sample_map(value, shape, places, weight)
        return self.dropout(self.output_proj(seen))


def directional_offsets(num_heads: int, num_points: int) -> Tensor:
    """Return offsets with the heads spread over a square, sample s at s + 1. (heads, S, 2)"""
    angles = torch.arange(num_heads, dtype=torch.float32) * (2 * math.pi / num_heads)
    directions = torch.stack([angles.cos(), angles.sin()], -1)
    directions = directions / directions.abs().amax(-1, keepdim=True)
    steps = torch.arange(1, num_points + 1, dtype=torch.float32)
    return directions[:, None] * steps[:, None]
