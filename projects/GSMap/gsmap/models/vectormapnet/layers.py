"""Layers of VectorMapNet's polyline generator, with cached keys and values."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

Cache = tuple[Tensor, Tensor]  # keys and values, split by head (n, heads, S, C / heads) each


class CachedAttention(nn.MultiheadAttention):
    """Multi-head attention to keys and values that are computed in advance.

    The arguments are described in `torch.nn.MultiheadAttention`.
    """

    def keys_values(self, tokens: Tensor) -> Cache:
        """Compute the keys and values of tokens. (n, S, C)"""
        C = self.embed_dim
        # The rows of `in_proj_weight` project to queries, keys and values, C rows each.
        keys_and_values = F.linear(tokens, self.in_proj_weight[C:], self.in_proj_bias[C:])
        keys, values = keys_and_values.chunk(2, dim=-1)
        return self.split_heads(keys), self.split_heads(values)

    def forward(self, query: Tensor, cache: Cache, mask: Tensor | None = None) -> Tensor:  # type: ignore[override]
        """Attend to cached keys and values.

        Args:
            query: Query tokens. (n, T, C)
            cache: Keys and values of S tokens. (n, heads, S, C / heads) each
            mask: True where a query attends to a key, None for all keys. (T, S)

        Returns:
            Attended values. (n, T, C)
        """
        C = self.embed_dim
        queries = F.linear(query, self.in_proj_weight[:C], self.in_proj_bias[:C])
        keys, values = cache
        attention_output = F.scaled_dot_product_attention(
            self.split_heads(queries),
            keys,
            values,
            attn_mask=mask,
            dropout_p=self.dropout if self.training else 0.0,
        )
        return self.out_proj(attention_output.transpose(1, 2).flatten(2))

    def split_heads(self, tokens: Tensor) -> Tensor:
        """Split the channels among the heads. (n, S, C) -> (n, heads, S, C / heads)"""
        return tokens.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)


class GatedLayer(nn.Module):
    """Decoder layer with learned gates: self-attention, attention to the map, feed-forward.

    Normalisation precedes each part. The gates start at 0, so a new layer is the identity.

    Args:
        embed_dims: Channels C of the tokens and of the map.
        num_heads: Number of attention heads.
        ffn_dims: Hidden channels of the feed-forward network.
        dropout: Probability of setting a value to zero in training, in [0, 1].
    """

    def __init__(self, embed_dims: int, num_heads: int, ffn_dims: int, dropout: float) -> None:
        super().__init__()
        self.self_attn = CachedAttention(embed_dims, num_heads, dropout=dropout)
        self.cross_attn = CachedAttention(embed_dims, num_heads, dropout=dropout)
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
        """Compute the keys and values of T tokens for the self-attention of this layer.

        The cache of `forward` consists of such keys and values: of all tokens in training, and of
        the new and the earlier tokens when tokens are generated one by one.

        Args:
            states: States of the tokens before this layer. (n, T, C)
        """
        return self.self_attn.keys_values(self.norms[0](states))

    def forward(
        self, states: Tensor, cache: Cache, memory: Cache, mask: Tensor | None = None
    ) -> Tensor:
        """Update the states of tokens.

        Args:
            states: States of the tokens of n lines. (n, T, C)
            cache: Keys and values (`keys_values`) of the S tokens that self-attention covers.
                (n, heads, S, C / heads) each
            memory: Keys and values of the map's cells, shared by all lines.
                (1, heads, cells, C / heads) each
            mask: True where a token attends to another one, None for all tokens. (T, S)

        Returns:
            Updated states. (n, T, C)
        """
        attention_output = self.self_attn(self.norms[0](states), cache, mask=mask)
        states = states + self.gates[0] * self.dropout(attention_output)
        # The memory is shared, so the tokens of all lines attend to it as one sequence.
        query = self.norms[1](states).flatten(0, 1)[None]  # (1, n * T, C)
        attention_output = self.cross_attn(query, memory).view(states.shape)
        states = states + self.gates[1] * self.dropout(attention_output)
        ffn_output = self.ffn(self.norms[2](states))
        return states + self.gates[2] * self.dropout(ffn_output)


def append_cache(cache: Cache | None, new: Cache) -> Cache:
    """Append keys and values of new tokens to a cache, which is None if it is empty."""
    if cache is None:
        return new
    # Dimension 2 is the dimension of the tokens.
    keys = torch.cat([cache[0], new[0]], dim=2)
    values = torch.cat([cache[1], new[1]], dim=2)
    return keys, values


def keep_most_likely(logits: Tensor, share: float) -> Tensor:
    """Mask the tail of a distribution for nucleus sampling (Holtzman et al., ICLR 2020).

    Args:
        logits: Logits of the tokens. (..., tokens)
        share: Probability mass in [0, 1]. A token is masked if the more likely tokens have a larger
            mass; the most likely token is never masked.

    Returns:
        Logits with -1e9 for masked tokens, so that their probability is 0. (..., tokens)
    """
    sorted_logits, index = logits.sort(dim=-1, descending=True)
    probs = sorted_logits.softmax(dim=-1)
    mass_before = probs.cumsum(dim=-1) - probs  # sum over the more likely tokens
    is_tail = mass_before > share
    is_tail[..., 0] = False
    ranks = index.argsort(dim=-1)  # position of each token in the sorted order
    return logits.masked_fill(is_tail.gather(-1, ranks), -1e9)
