"""MapTR's decoder: point queries interact, look at the BEV and refine their reference."""

from collections.abc import Callable
from typing import Any

import torch
from mmcv.cnn.bricks.transformer import FFN
from mmdet.models.layers import inverse_sigmoid
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.models.layers.deformable_attention import DeformableAttention, at_least_float32


def refine_reference(reference: Tensor, offsets: Tensor) -> Tensor:
    """Move a reference by predicted offsets.

    The centre moves before its sigmoid; further entries (GSMap Eq. 1: sigma, theta before their
    activation) add up.

    Args:
        reference: Reference; the first two entries are the centre in (0, 1). (..., D)
        offsets: Predicted offsets. (..., D)

    Returns:
        The refined reference, at least float32. (..., D)

    Raises:
        ValueError: If the shapes disagree.
    """
    if reference.shape != offsets.shape:
        raise ValueError(
            f"offsets must have shape {tuple(reference.shape)} of reference, got "
            f"{tuple(offsets.shape)}."
        )
    reference, offsets = at_least_float32(reference), at_least_float32(offsets)
    centres = (inverse_sigmoid(reference[..., :2], eps=1e-5) + offsets[..., :2]).sigmoid()
    return torch.cat([centres, reference[..., 2:] + offsets[..., 2:]], -1)


@MODELS.register_module()
class MapDecoderLayer(BaseModule):
    """Self-attention, deformable attention on the BEV and feed-forward, each with its LayerNorm.

    Subclasses override one of :meth:`embed_position`, :meth:`interact` and :meth:`sample_bev`, or
    build another cross-attention in :meth:`build_cross_attention`.

    Args:
        embed_dims: Channels C.
        num_heads: Heads of both attentions.
        num_sampling_points: Samples per head of the deformable attention.
        ffn_dims: Hidden channels of the feed-forward network.
        dropout: Dropout of every sublayer.
        init_cfg: As in mmengine.
    """

    num_norms = 3

    def __init__(
        self,
        embed_dims: int = 256,
        num_heads: int = 8,
        num_sampling_points: int = 4,
        ffn_dims: int = 512,
        dropout: float = 0.1,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.self_attn = nn.MultiheadAttention(embed_dims, num_heads, dropout, batch_first=True)
        self.cross_attn = self.build_cross_attention(
            embed_dims, num_heads, num_sampling_points, dropout
        )
        self.ffn = FFN(embed_dims, ffn_dims, ffn_drop=dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(self.num_norms))
        self.dropout = nn.Dropout(dropout)

    def build_cross_attention(
        self, embed_dims: int, num_heads: int, num_sampling_points: int, dropout: float
    ) -> DeformableAttention:
        """Return the attention that :meth:`sample_bev` uses."""
        return DeformableAttention(embed_dims, num_heads, num_sampling_points, dropout=dropout)

    def embed_position(self, query_pos: Tensor, reference: Tensor) -> Tensor:
        """Return the position that both attentions add; MapTR's is learned alone. (B, N * P, C)"""
        return query_pos

    def interact(self, query: Tensor, query_pos: Tensor, attn_mask: Tensor | None) -> Tensor:
        """Let all point queries attend to each other, with residual and norm. (B, N * P, C)"""
        key = query + query_pos
        attended = self.self_attn(key, key, query, attn_mask=attn_mask, need_weights=False)[0]
        return self.norms[0](query + self.dropout(attended))

    def sample_bev(
        self, query: Tensor, query_pos: Tensor, reference: Tensor, bev_feats: Tensor
    ) -> Tensor:
        """Look at the BEV around the reference, without residual and norm. (B, N * P, C)"""
        return self.cross_attn(query + query_pos, reference, bev_feats)

    def forward(
        self,
        query: Tensor,
        query_pos: Tensor,
        reference: Tensor,
        bev_feats: Tensor,
        attn_mask: Tensor | None = None,
    ) -> Tensor:
        """Update the point queries.

        Args:
            query: Content of the point queries. (B, N * P, C)
            query_pos: Their learned position. (B, N * P, C)
            reference: Their reference. (B, N * P, D)
            bev_feats: BEV features. (B, C, H, W)
            attn_mask: True where a query may not attend to another, or None. Its shape is the
                subclass's affair.

        Returns:
            Updated queries. (B, N * P, C)
        """
        position = self.embed_position(query_pos, reference)
        query = self.interact(query, position, attn_mask)
        query = self.norms[-2](query + self.sample_bev(query, position, reference, bev_feats))
        return self.norms[-1](self.ffn(query))


@MODELS.register_module()
class MapDecoder(BaseModule):
    """A stack of decoder layers that refine one reference.

    Args:
        layer: Config of the layer; it may leave out its ``type`` (:class:`MapDecoderLayer`).
        num_layers: Number of layers L.
        init_cfg: As in mmengine.
    """

    def __init__(
        self, layer: dict[str, Any] | None = None, num_layers: int = 6, init_cfg: dict | None = None
    ) -> None:
        super().__init__(init_cfg)
        layer = {"type": "MapDecoderLayer", **(layer or {})}
        self.layers = nn.ModuleList(MODELS.build(layer) for _ in range(num_layers))

    def forward(
        self,
        query: Tensor,
        query_pos: Tensor,
        reference: Tensor,
        bev_feats: Tensor,
        predict_offsets: Callable[[int, Tensor], Tensor],
        attn_mask: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Run all layers, each on the reference that the one before refined, the gradient cut.

        Args:
            query: Content of the point queries. (B, N * P, C)
            query_pos: Their learned position. (B, N * P, C)
            reference: Initial reference. (B, N * P, D)
            bev_feats: BEV features. (B, C, H, W)
            predict_offsets: Maps a layer's number and its states (B, N * P, C) to offsets (B, N *
                P, D).
            attn_mask: Passed on to every layer.

        Returns:
            The layers' states (L, B, N * P, C) and refined references (L, B, N * P, D), the latter
            float32.
        """
        states, references = [], []
        for number, layer in enumerate(self.layers):
            query = layer(query, query_pos, reference, bev_feats, attn_mask)
            refined = refine_reference(reference, predict_offsets(number, query))
            states.append(query)
            references.append(refined)
            reference = refined.detach()
        return torch.stack(states), torch.stack(references)
