"""Layers of VectorMapNet's polyline generator, whose keys and values can be kept."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

Cache = tuple[Tensor, Tensor]  # keys and values, by head (n, heads, S, C / heads)


class CachedAttention(nn.MultiheadAttention):
    """Multi-head attention to keys and values that were computed before."""

    def keys_values(self, tokens: Tensor) -> Cache:
        """Return keys and values of tokens. (n, S, C)"""
        C = self.embed_dim
        both = F.linear(tokens, self.in_proj_weight[C:], self.in_proj_bias[C:]).chunk(2, -1)
        keys, values = (self.by_head(part) for part in both)
        return keys, values

    def forward(self, query: Tensor, cache: Cache, mask: Tensor | None = None) -> Tensor:  # type: ignore[override]
        """Attend to what is kept; the mask says which tokens a query sees. (n, T, C)"""
        C = self.embed_dim
        query = self.by_head(F.linear(query, self.in_proj_weight[:C], self.in_proj_bias[:C]))
        dropout = self.dropout if self.training else 0.0
        seen = F.scaled_dot_product_attention(query, *cache, mask, dropout)
        return self.out_proj(seen.transpose(1, 2).flatten(2))

    def by_head(self, tokens: Tensor) -> Tensor:
        """Split the channels among the heads. (n, S, C) -> (n, heads, S, C / heads)"""
        return tokens.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)


class GatedLayer(nn.Module):
    """Self-attention, attention to the map, feed-forward network; pre-norm, behind learned gates.

    The gates start at 0, so that the layer does nothing at first.
    """

    def __init__(self, embed_dims: int, num_heads: int, ffn_dims: int, dropout: float) -> None:
        super().__init__()
        self.self_attn, self.cross_attn = (
            CachedAttention(embed_dims, num_heads, dropout) for _ in range(2)
        )
        self.ffn = nn.Sequential(
            nn.Linear(embed_dims, ffn_dims),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(ffn_dims, embed_dims),
        )
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(3))
        self.gates = nn.ParameterList(torch.zeros(1) for _ in range(3))
        self.dropout = nn.Dropout(dropout)

    def keys_values(self, states: Tensor) -> Cache:
        """Return what later tokens attend to. (n, T, C)"""
        return self.self_attn.keys_values(self.norms[0](states))

    def forward(
        self, states: Tensor, own: Cache, memory: Cache, mask: Tensor | None = None
    ) -> Tensor:
        """Update tokens by those before them and by the map (1, heads, S, C'). (n, T, C)"""
        shape = states.shape
        shared = self.self_attn(self.norms[0](states), own, mask)
        states = states + self.gates[0] * self.dropout(shared)
        query = self.norms[1](states).flatten(0, 1)[None]  # all lines see one map
        seen = self.cross_attn(query, memory).view(shape)
        states = states + self.gates[1] * self.dropout(seen)
        return states + self.gates[2] * self.dropout(self.ffn(self.norms[2](states)))


def joined(before: Cache | None, new: Cache) -> Cache:
    """Return keys and values of all tokens so far."""
    if before is None:
        return new
    return torch.cat([before[0], new[0]], 2), torch.cat([before[1], new[1]], 2)


def most_likely(logits: Tensor, share: float) -> Tensor:
    """Return logits without the tail of the law: -1e9 where the mass before exceeds a share.

    The most likely token always stays: alone with a share of 0. (..., tokens)
    """
    ordered, index = logits.sort(dim=-1, descending=True)
    law = ordered.softmax(-1)
    cut = law.cumsum(-1) - law > share
    cut[..., 0] = False
    return logits.masked_fill(cut.gather(-1, index.argsort(-1)), -1e9)
