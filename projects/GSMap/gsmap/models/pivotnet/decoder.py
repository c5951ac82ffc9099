"""PivotNet's line-aware point decoder: points look at the cells of their line's mask."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from mmdet.models.layers import SinePositionalEncoding
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.models.maptr.layers import feed_forward, init_matrices, mlp


class ClassLines(NamedTuple):
    """What a layer says of the lines of one map class."""

    states: Tensor  # of their points (B, n, p, C)
    logits: Tensor  # of a line and of none (B, n, 2)
    masks: Tensor  # logits (B, n, H, W)


class PointLayer(nn.Module):
    """Masked cross-attention, self-attention of all points, feed-forward network, post-norm."""

    def __init__(self, embed_dims: int, num_heads: int, ffn_dims: int) -> None:
        super().__init__()
        self.cross_attn, self.self_attn = (
            nn.MultiheadAttention(embed_dims, num_heads, batch_first=True) for _ in range(2)
        )
        self.ffn = feed_forward(embed_dims, ffn_dims, dropout=0.0)
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(3))

    def forward(
        self, states: Tensor, pos: Tensor, key: Tensor, memory: Tensor, blocked: Tensor | None
    ) -> Tensor:
        """Update points by the cells (B, S, C) that are not blocked (B, Q, S). (B, Q, C)"""
        if blocked is not None:
            blocked = blocked.repeat_interleave(self.cross_attn.num_heads, 0)
        seen, _ = self.cross_attn(states + pos, key, memory, attn_mask=blocked, need_weights=False)
        states = self.norms[0](states + seen)
        query = states + pos
        shared, _ = self.self_attn(query, query, states, need_weights=False)
        return self.norms[2](self.ffn(self.norms[1](states + shared)))


@MODELS.register_module()
class PointLineDecoder(BaseModule):
    """Layers of points, each with lines' classes and masks that say what the next one may see.

    Args:
        queries: Lines, and points of each, of every map class.
        line_masks: Whether a point sees the cells of its line alone, as in the paper.
        embed_dims: Channels C; ``num_layers``, ``num_heads`` and ``ffn_dims`` are the layers'.
    """

    def __init__(
        self,
        queries: Sequence[tuple[int, int]],
        embed_dims: int = 256,
        num_layers: int = 6,
        num_heads: int = 8,
        ffn_dims: int = 2048,
        line_masks: bool = True,
    ) -> None:
        super().__init__()
        self.queries, self.line_masks = [(int(n), int(p)) for n, p in queries], line_masks
        total = sum(n * p for n, p in self.queries)
        self.query = nn.Embedding(total, embed_dims)
        self.query_pos = nn.Embedding(total, embed_dims)
        self.level = nn.Embedding(1, embed_dims)
        self.position = SinePositionalEncoding(embed_dims // 2, normalize=True)
        self.layers = nn.ModuleList(
            PointLayer(embed_dims, num_heads, ffn_dims) for _ in range(num_layers)
        )
        self.norm = nn.LayerNorm(embed_dims)
        joined, dims = [p * embed_dims for _, p in self.queries], [embed_dims] * 3
        self.cls_branches = nn.ModuleList(nn.Linear(inputs, 2) for inputs in joined)
        self.mask_branches = nn.ModuleList(mlp(inputs, *dims) for inputs in joined)

    def init_weights(self) -> None:
        """Initialise the layers' matrices (Xavier)."""
        super().init_weights()
        init_matrices(self.layers)

    def forward(self, bev: Tensor) -> list[list[ClassLines]]:
        """Return the lines of every class, before the first layer and after each. (B, C, H, W)"""
        memory = bev.flatten(2).transpose(1, 2) + self.level.weight
        nowhere = bev.new_zeros(1, *bev.shape[-2:])
        key = memory + self.position(nowhere).flatten(2).transpose(1, 2)
        states = self.query.weight.expand(len(bev), -1, -1)
        outputs = [self.lines(states, bev)]
        for layer in self.layers:
            blocked = self.blocked(outputs[-1]) if self.line_masks else None
            states = layer(states, self.query_pos.weight, key, memory, blocked)
            outputs.append(self.lines(states, bev))
        return outputs

    def lines(self, states: Tensor, bev: Tensor) -> list[ClassLines]:
        """Return what the states of all points (B, Q, C) say."""
        found = []
        points = self.norm(states).split([n * p for n, p in self.queries], 1)
        parts = zip(points, self.queries, self.cls_branches, self.mask_branches, strict=True)
        for own, (_, p), cls_branch, mask_branch in parts:
            by_line = own.unflatten(1, (-1, p))
            joined = by_line.flatten(2)
            masks = torch.einsum("bnc,bchw->bnhw", mask_branch(joined), bev)
            found.append(ClassLines(by_line, cls_branch(joined), masks))
        return found

    def blocked(self, lines: Sequence[ClassLines]) -> Tensor:
        """Return which cells no point of a line may see; a line without any sees all. (B, Q, S)"""
        by_class = []
        for (_, p), own in zip(self.queries, lines, strict=True):
            hidden = own.masks.detach().flatten(2) < 0
            hidden &= ~hidden.all(-1, keepdim=True)
            by_class.append(hidden.repeat_interleave(p, 1))
        return torch.cat(by_class, 1)
