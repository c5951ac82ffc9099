"""PivotNet's and BeMapNet's line-aware decoder: points look at the cells of their line's mask."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from mmdet.models.layers import SinePositionalEncoding
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.models.base.layers import feed_forward, init_matrices, mlp


class ClassLines(NamedTuple):
    """What a layer says of the lines of one map class."""

    states: Tensor  # of their points (B, n, p, C)
    logits: Tensor  # of a line and of none (B, n, 2)
    masks: Tensor  # logits (B, n, H, W)


class AttentionLayer(nn.Module):
    """Attentions, one after another, and a feed-forward network; post-norm.

    Args:
        embed_dims: Channels C; ``num_heads``, ``ffn_dims`` and ``dropout`` as everywhere.
        to_memory: Whether there is attention to a memory beside that of the tokens.
        memory_first: Whether it comes before.
    """

    def __init__(
        self,
        embed_dims: int,
        num_heads: int,
        ffn_dims: int,
        dropout: float = 0.0,
        to_memory: bool = True,
        memory_first: bool = False,
    ) -> None:
        super().__init__()
        self.crosses = sorted((False, True)[: 1 + to_memory], reverse=memory_first)
        for cross in self.crosses:
            attn = nn.MultiheadAttention(embed_dims, num_heads, dropout, batch_first=True)
            if cross:
                self.cross_attn = attn
            else:
                self.self_attn = attn
        self.ffn = feed_forward(embed_dims, ffn_dims, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in (*self.crosses, "ffn"))
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        tokens: Tensor,
        position: Tensor,
        key: Tensor | None = None,
        memory: Tensor | None = None,
        **masks: Tensor | None,
    ) -> Tensor:
        """Update tokens by themselves, and by a memory (B, S, C) with keys of its own. (B, Q, C)

        Positions are part of queries and keys. ``masks``, as `nn.MultiheadAttention` has them, are
        of the memory, without one of the tokens.
        """
        own = masks if memory is None else {}
        *norms, last = self.norms
        for cross, norm in zip(self.crosses, norms, strict=True):
            query = tokens + position
            if cross:
                seen, _ = self.cross_attn(query, key, memory, need_weights=False, **masks)
            else:
                seen, _ = self.self_attn(query, query, tokens, need_weights=False, **own)
            tokens = norm(tokens + self.dropout(seen))
        return last(self.ffn(tokens))


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
        self.num_heads = num_heads
        total = sum(n * p for n, p in self.queries)
        self.query = nn.Embedding(total, embed_dims)
        self.query_pos = nn.Embedding(total, embed_dims)
        self.level = nn.Embedding(1, embed_dims)
        self.position = SinePositionalEncoding(embed_dims // 2, normalize=True)
        self.layers = nn.ModuleList(
            AttentionLayer(embed_dims, num_heads, ffn_dims, memory_first=True)
            for _ in range(num_layers)
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
            blocked = None
            if self.line_masks:
                blocked = self.blocked(outputs[-1]).repeat_interleave(self.num_heads, 0)
            states = layer(states, self.query_pos.weight, key, memory, attn_mask=blocked)
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
