"""Deformable attention over one feature map, with overridable sampling locations."""

import math

import torch
import torch.nn.functional as F
from mmcv.ops import get_compiling_cuda_version
from mmcv.ops.multi_scale_deform_attn import MultiScaleDeformableAttnFunction
from mmengine.model import BaseModule, constant_init, xavier_init
from torch import Tensor, nn

_SAMPLING_WEIGHTS = ("sampling_offsets.weight", "attention_weights.weight")


def bilinear_rows(locations: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Turn sampling locations into the four surrounding cells of a map and their bilinear weights.

    The value of a cell lies at its centre; outside the map everything is zero
    (``align_corners=False`` and zero padding, as in ``grid_sample``).

    Args:
        locations: Points (x, y), [0, 1] over the map. (..., 2)
        shape: Rows and columns of the map.

    Returns:
        Row-major cell indices, clamped to the map, and weights, zero where the cell is outside. 2 x
        (..., 4)
    """
    height, width = shape
    x, y = locations[..., 0] * width - 0.5, locations[..., 1] * height - 0.5
    x0, y0 = x.detach().floor(), y.detach().floor()
    cols = torch.stack([x0, x0 + 1, x0, x0 + 1], -1)  # (..., 4)
    rows = torch.stack([y0, y0, y0 + 1, y0 + 1], -1)
    weights = (1 - (x[..., None] - cols).abs()) * (1 - (y[..., None] - rows).abs())
    inside = (cols >= 0) & (cols < width) & (rows >= 0) & (rows < height)
    cells = rows.clamp(0, height - 1) * width + cols.clamp(0, width - 1)
    return cells.long(), weights * inside


def deformable_sample(
    value: Tensor, shape: tuple[int, int], locations: Tensor, weights: Tensor
) -> Tensor:
    """Sum bilinear samples of a map, each head with its own places (Deformable DETR Eq. 2).

    mmcv's compiled op runs on a GPU where it was built; elsewhere each output row is one weighted
    bag of table rows, which needs no intermediate tensor of samples.

    Args:
        value: Flattened map, row-major. (B, H * W, heads, C)
        shape: Rows and columns of the map.
        locations: Sampling points (x, y), [0, 1] over the map. (B, Q, heads, S, 2)
        weights: Attention weights. (B, Q, heads, S)

    Returns:
        Weighted sums, heads concatenated. (B, Q, heads * C)
    """
    batch, num_cells, heads, channels = value.shape
    if value.is_cuda and get_compiling_cuda_version() != "not available":
        shapes = torch.tensor([shape], device=value.device)
        start = shapes.new_zeros(1)
        return MultiScaleDeformableAttnFunction.apply(
            value.contiguous(),
            shapes,
            start,
            locations[:, :, :, None].contiguous(),
            weights[:, :, :, None].contiguous(),
            64,
        )
    cells, corner_weights = bilinear_rows(locations, shape)  # (B, Q, heads, S, 4)
    sample = torch.arange(batch, device=value.device).view(-1, 1, 1, 1, 1)
    head = torch.arange(heads, device=value.device).view(1, 1, -1, 1, 1)
    rows = (sample * num_cells + cells) * heads + head
    bags = rows.flatten(3).flatten(0, 2)  # (B * Q * heads, 4 S)
    bag_weights = (weights[..., None] * corner_weights).flatten(3).flatten(0, 2)
    table = value.reshape(-1, channels)
    out = F.embedding_bag(bags, table, per_sample_weights=bag_weights.to(table.dtype), mode="sum")
    return out.view(batch, -1, heads * channels)


class DeformableAttention(BaseModule):
    """Multi-head deformable attention on one map.

    It has the parameters of mmcv's ``MultiScaleDeformableAttention`` for one level.

    Subclasses change where it looks by overriding :meth:`sampling_locations`. The residual is left
    to the caller.

    Args:
        embed_dims: Channels C of the map and of the output.
        num_heads: Number of heads.
        num_points: Samples per head and query, S.
        query_dims: Channels of the query; None means ``embed_dims``.
        dropout: Dropout on the output.
        init_cfg: As in mmengine.

    Raises:
        ValueError: If ``embed_dims`` is not divisible by ``num_heads``.
    """

    def __init__(
        self,
        embed_dims: int = 256,
        num_heads: int = 8,
        num_points: int = 4,
        query_dims: int | None = None,
        dropout: float = 0.1,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        if embed_dims % num_heads:
            raise ValueError(
                f"embed_dims must be divisible by num_heads, got {embed_dims} and {num_heads}."
            )
        query_dims = query_dims or embed_dims
        self.num_heads = num_heads
        self.num_points = num_points
        self.sampling_offsets = nn.Linear(query_dims, num_heads * num_points * 2)
        self.attention_weights = nn.Linear(query_dims, num_heads * num_points)
        self.value_proj = nn.Linear(embed_dims, embed_dims)
        self.output_proj = nn.Linear(embed_dims, embed_dims)
        self.dropout = nn.Dropout(dropout)
        self.init_weights()

    def init_weights(self) -> None:
        """Let each head look in its own direction, with equal weights."""
        constant_init(self.sampling_offsets, 0.0)
        self.sampling_offsets.bias.data = self.initial_offsets().flatten()
        constant_init(self.attention_weights, 0.0)
        xavier_init(self.value_proj, distribution="uniform")
        xavier_init(self.output_proj, distribution="uniform")

    def initial_offsets(self) -> Tensor:
        """Return the offsets, in cells, that every query starts with. (heads, S, 2)"""
        return directional_offsets(self.num_heads, self.num_points)

    def sampling_locations(
        self, query: Tensor, reference: Tensor, shape: tuple[int, int]
    ) -> Tensor:
        """Place the samples around the reference points; learned offsets are in cells.

        Args:
            query: Query with its position added. (B, Q, C)
            reference: Reference; the first two entries are the point, [0, 1] over the map. (B, Q,
                D)
            shape: Rows and columns of the map.

        Returns:
            Sampling points (x, y), [0, 1] over the map. (B, Q, heads, S, 2)
        """
        offsets = self.offsets_in_cells(query)
        size = offsets.new_tensor([shape[1], shape[0]])
        return reference[:, :, None, None, :2] + offsets / size

    def offsets_in_cells(self, query: Tensor) -> Tensor:
        """Return the learned offsets (x, y) in cells. (B, Q, heads, S, 2)"""
        return (
            self.sampling_offsets(query).float().unflatten(-1, (self.num_heads, self.num_points, 2))
        )

    def weights(self, query: Tensor) -> Tensor:
        """Return the attention weights, of sum one over a head's points. (B, Q, heads, S)"""
        logits = self.attention_weights(query).float()
        return logits.unflatten(-1, (self.num_heads, self.num_points)).softmax(-1)

    def forward(self, query: Tensor, reference: Tensor, feats: Tensor) -> Tensor:
        """Sample the map for each query.

        Args:
            query: Query with its position added. (B, Q, C)
            reference: Reference; the first two entries are the point, [0, 1] over the map. (B, Q,
                D)
            feats: The map. (B, C, H, W)

        Returns:
            Attended features, without the residual. (B, Q, C)
        """
        height, width = feats.shape[-2:]
        value = self.value_proj(feats.flatten(2).transpose(1, 2)).float()  # (B, H * W, C)
        value = value.unflatten(-1, (self.num_heads, -1))
        locations = self.sampling_locations(query, reference, (height, width))
        sampled = deformable_sample(value, (height, width), locations, self.weights(query))
        return self.dropout(self.output_proj(sampled))


def directional_offsets(num_heads: int, num_points: int) -> Tensor:
    """Return offsets with the heads spread over a square, sample s at s + 1. (heads, S, 2)"""
    angles = torch.arange(num_heads, dtype=torch.float32) * (2 * math.pi / num_heads)
    directions = torch.stack([angles.cos(), angles.sin()], -1)
    directions = directions / directions.abs().amax(-1, keepdim=True)
    steps = torch.arange(1, num_points + 1, dtype=torch.float32)
    return directions[:, None] * steps[:, None]


def init_matrices(module: nn.Module) -> None:
    """Initialise all matrices of a transformer (Xavier) but those that place and weigh samples."""
    for name, parameter in module.named_parameters():
        if parameter.dim() > 1 and not name.endswith(_SAMPLING_WEIGHTS):
            nn.init.xavier_uniform_(parameter)
