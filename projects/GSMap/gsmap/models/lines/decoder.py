"""Decoder of lines with masked cross-attention."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from mmdet.models.layers import SinePositionalEncoding
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.models.base.layers import feed_forward, init_matrices, mlp
from gsmap.utils.settings import check_positive


class ClassLines(NamedTuple):
    """Predictions of one decoder layer for the lines of one map class.

    Attributes:
        states: States (features) of the p points of each of n lines. (B, n, p, C)
        logits: Logits of a line and of no line. (B, n, 2)
        masks: Logits of the masks of the lines. (B, n, H, W)
    """

    states: Tensor
    logits: Tensor
    masks: Tensor


class AttentionLayer(nn.Module):
    """Transformer layer with normalisation after each residual.

    Args:
        embed_dims: Channels C.
        num_heads: Heads of each attention.
        ffn_dims: Hidden channels of the feed-forward network.
        dropout: Probability of dropping a value in training.
        to_memory: Whether to add cross-attention to further features, which `nn.Transformer` calls
            the memory.
        memory_first: Whether to apply the cross-attention before the self-attention.
    """

    self_attn: nn.MultiheadAttention
    cross_attn: nn.MultiheadAttention
    attentions: tuple[str, ...]  # names in the order of application

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
        if not to_memory:
            self.attentions = ("self_attn",)
        elif memory_first:
            self.attentions = ("cross_attn", "self_attn")
        else:
            self.attentions = ("self_attn", "cross_attn")
        for name in self.attentions:
            attention = nn.MultiheadAttention(
                embed_dims, num_heads, dropout=dropout, batch_first=True
            )
            self.add_module(name, attention)
        self.ffn = feed_forward(embed_dims, ffn_dims, dropout=dropout)
        num_norms = len(self.attentions) + 1
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(num_norms))
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        tokens: Tensor,
        position: Tensor,
        key: Tensor | None = None,
        memory: Tensor | None = None,
        **masks: Tensor | None,
    ) -> Tensor:
        """Update the tokens.

        Args:
            tokens: Tokens. (B, Q, C)
            position: Positional encoding of the tokens, added to the queries of both attentions and
                to the keys of the self-attention. (B, Q, C), or (Q, C) for all samples
            key: Keys of the S vectors of the memory, positional encoding included. None without
                cross-attention. (B, S, C)
            memory: Values of the memory. None without cross-attention. (B, S, C)
            masks: ``attn_mask`` or ``key_padding_mask`` of `nn.MultiheadAttention`, True where
                attention is blocked. They are for the cross-attention, or for the self-attention if
                there is no memory.

        Returns:
            The updated tokens. (B, Q, C)
        """
        self_masks = masks if memory is None else {}
        for index, name in enumerate(self.attentions):
            query = tokens + position
            if name == "cross_attn":
                update, _ = self.cross_attn(query, key, memory, need_weights=False, **masks)
            else:
                update, _ = self.self_attn(query, query, tokens, need_weights=False, **self_masks)
            tokens = self.norms[index](tokens + self.dropout(update))
        return self.norms[-1](self.ffn(tokens))  # `ffn` adds its input to its output


@MODELS.register_module()
class PointLineDecoder(BaseModule):
    """Decoder of point queries with masked cross-attention.

    A map class has n lines, and a line has p point queries. The class logits and the mask of each
    line, its area in the BEV, are predicted before the first layer and after each layer. In the
    next layer, the points of a line attend only to the cells of its mask.

    Args:
        queries: Number of lines n, and of points p per line, as a pair for every map class.
        embed_dims: Channels C.
        num_layers: Number of layers.
        num_heads: Heads of each attention.
        ffn_dims: Hidden channels of the feed-forward networks.
        line_masks: Whether to restrict the cross-attention to the mask of the line.
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
        self.line_masks = line_masks
        check_positive(num_layers=num_layers)
        self.num_heads = num_heads
        self.queries: list[tuple[int, int]] = []
        self.points_per_class: list[int] = []
        for n, p in queries:
            self.queries.append((int(n), int(p)))
            self.points_per_class.append(int(n) * int(p))
        total = sum(self.points_per_class)  # Q
        self.query = nn.Embedding(total, embed_dims)
        self.query_pos = nn.Embedding(total, embed_dims)
        self.level = nn.Embedding(1, embed_dims)  # embedding of the only level of BEV features
        # Half of the channels encode the row, and half the column.
        self.position = SinePositionalEncoding(embed_dims // 2, normalize=True)
        self.layers = nn.ModuleList(
            AttentionLayer(embed_dims, num_heads, ffn_dims=ffn_dims, memory_first=True)
            for _ in range(num_layers)
        )
        self.norm = nn.LayerNorm(embed_dims)
        self.cls_branches = nn.ModuleList()
        self.mask_branches = nn.ModuleList()
        for _, p in self.queries:
            line_dims = p * embed_dims
            self.cls_branches.append(nn.Linear(line_dims, 2))
            self.mask_branches.append(mlp(line_dims, embed_dims, embed_dims, embed_dims))

    def init_weights(self) -> None:
        """Initialise the matrices of the layers from Xavier's uniform distribution."""
        super().init_weights()
        init_matrices(self.layers)

    def forward(self, bev: Tensor) -> list[list[ClassLines]]:
        """Decode BEV features.

        Args:
            bev: BEV features, row 0 at the front. (B, C, H, W)

        Returns:
            Lines of every class, before the first layer and after each layer.
        """
        # The memory has S = H * W vectors, one per cell. (B, S, C)
        memory = bev.flatten(2).transpose(1, 2) + self.level.weight
        height, width = bev.shape[-2:]
        no_padding = bev.new_zeros((1, height, width))  # the encoding needs a mask of padding
        cell_position = self.position(no_padding).flatten(2).transpose(1, 2)
        key = memory + cell_position
        states = self.query.weight.expand(len(bev), -1, -1)  # (B, Q, C)
        outputs = [self.lines(states, bev)]
        for layer in self.layers:
            mask = None
            if self.line_masks:
                # `outputs[-1]` has the masks that were predicted before this layer.
                # nn.MultiheadAttention takes masks (B * heads, Q, S), in which the heads of a
                # sample are next to each other.
                mask = self.attention_mask(outputs[-1]).repeat_interleave(self.num_heads, 0)
            states = layer(states, self.query_pos.weight, key=key, memory=memory, attn_mask=mask)
            outputs.append(self.lines(states, bev))
        return outputs

    def lines(self, states: Tensor, bev: Tensor) -> list[ClassLines]:
        """Predict the lines of every class.

        Args:
            states: States of all Q points, sorted by class and then by line. (B, Q, C)
            bev: BEV features. (B, C, H, W)
        """
        states_by_class = self.norm(states).split(self.points_per_class, 1)
        lines = []
        for index, (_, p) in enumerate(self.queries):
            point_states = states_by_class[index].unflatten(1, (-1, p))  # (B, n, p, C)
            line_states = point_states.flatten(2)  # (B, n, p * C)
            logits = self.cls_branches[index](line_states)
            # The mask logit of a cell is the dot product of its features with the line's kernel.
            kernels = self.mask_branches[index](line_states)  # (B, n, C)
            masks = torch.einsum("bnc,bchw->bnhw", kernels, bev)
            lines.append(ClassLines(point_states, logits=logits, masks=masks))
        return lines

    def attention_mask(self, lines: Sequence[ClassLines]) -> Tensor:
        """Cross-attention mask of all points, from the masks of their lines.

        Args:
            lines: Lines of every class.

        Returns:
            True where attention is blocked; a line with an empty mask attends to all cells.
            (B, Q, S)
        """
        masks = []
        for (_, p), class_lines in zip(self.queries, lines, strict=True):
            # Logits below 0 are probabilities below 0.5.
            blocked = class_lines.masks.detach().flatten(2) < 0  # (B, n, S)
            is_empty = blocked.all(-1, keepdim=True)
            blocked &= ~is_empty  # for a line with an empty mask, no cell is blocked
            masks.append(blocked.repeat_interleave(p, 1))  # one row for each point of a line
        return torch.cat(masks, dim=1)
