"""MapTR's decoder: point queries interact, look at the BEV and refine their reference."""

from collections.abc import Callable
from typing import Any, ClassVar

import torch
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule, ModuleList
from torch import Tensor, nn

from gsmap.models.gsmap.guidance import GaussianGuidance
from gsmap.models.maptr.layers import feed_forward
from gsmap.structures.gaussians import GaussianSpace


@MODELS.register_module()
class MapDecoderLayer(BaseModule):
    """Self-attention, cross-attention to the BEV and feed-forward, each with its LayerNorm.

    Args:
        embed_dims: Channels C.
        num_heads: Heads of both attentions.
        num_points: Points per instance P.
        ffn_dims: Hidden channels of the feed-forward network.
        dropout: Dropout of every sublayer.
        self_attn: Config of the self-attention (`PointSelfAttention`).
        cross_attn: Config of the cross-attention (`BEVDeformableAttention`).
        guidance: Settings of `GaussianGuidance`, or None for a layer that is not guided.
        space: How the reference stands for a Gaussian; ValueError if guidance does not get it.
    """

    def __init__(
        self,
        embed_dims: int = 256,
        num_heads: int = 8,
        num_points: int = 20,
        ffn_dims: int = 512,
        dropout: float = 0.1,
        self_attn: dict[str, Any] | None = None,
        cross_attn: dict[str, Any] | None = None,
        guidance: dict[str, Any] | None = None,
        space: GaussianSpace | None = None,
    ) -> None:
        super().__init__()
        shared = {"embed_dims": embed_dims, "num_heads": num_heads, "dropout": dropout}
        own = {"type": "PointSelfAttention", "num_points": num_points, **shared}
        self.self_attn = MODELS.build({**own, **(self_attn or {})})
        own = {"type": "BEVDeformableAttention", **shared}
        self.cross_attn = MODELS.build({**own, **(cross_attn or {})})
        self.ffn = feed_forward(embed_dims, ffn_dims, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(3))
        self.guidance: GaussianGuidance | None = None
        if guidance is not None:
            if space is None:
                raise ValueError("a guided decoder layer needs a reference that holds Gaussians.")
            self.guidance = GaussianGuidance(space, embed_dims, **guidance)

    def forward(
        self,
        query: Tensor,
        query_pos: Tensor,
        reference: Tensor,
        bev_feats: Tensor,
        attn_mask: Tensor | None = None,
    ) -> Tensor:
        """Update the point queries; arguments as in `MapDecoder.forward`. -> (B, N * P, C)"""
        frames = None
        if self.guidance is not None:
            query_pos = self.guidance.position(query_pos, reference)
            frames = self.guidance.frames(reference, bev_feats)
        query = self.norms[0](self.self_attn(query, query_pos, attn_mask))
        sampled = self.cross_attn(query + query_pos, reference, bev_feats, frames)
        return self.norms[2](self.ffn(self.norms[1](query + sampled)))


@MODELS.register_module()
class MapDecoder(BaseModule):
    """A stack of decoder layers that refine one reference.

    Args:
        layer: Config of the layer.
        num_layers: Number of layers L.
        detach_reference: Cut the gradient through the reference between layers, as MapTR does.
        shared: What the head hands on to every layer: ``embed_dims``, ``num_points``, ``space``.

    Attributes:
        point_queries: Whether it takes point queries (B, N * P, C), or instance queries (B, N, C).
        guided_layer: What makes its layers guided ones, in their config.
        fields: What else it returns, (L, B, N, ...) each; losses may read it of the predictions.
            ``instance_states``, if among them, say the class in place of the mean over points.
    """

    point_queries = True
    guided_layer: ClassVar[dict[str, Any]] = {"type": "GaussianDecoderLayer"}
    fields: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        layer: dict[str, Any],
        num_layers: int = 6,
        detach_reference: bool = True,
        **shared: Any,
    ) -> None:
        super().__init__()
        self.detach_reference = detach_reference
        layer = {"type": "MapDecoderLayer", **shared, **layer}
        self.layers = ModuleList(MODELS.build(layer) for _ in range(num_layers))

    def start(self, query: Tensor, reference: Tensor, bev_feats: Tensor) -> tuple[Any, Tensor, Any]:
        """Return queries, reference and features as the layers take them."""
        return query, reference, bev_feats

    def read(self, state: Any) -> dict[str, Tensor]:
        """Return ``point_states`` (B, N * P, C) and the further ``fields`` of a layer's output."""
        return {"point_states": state}

    def forward(
        self,
        query: Tensor,
        query_pos: Tensor,
        reference: Tensor,
        bev_feats: Tensor,
        refine: Callable[[int, Tensor, Tensor], Tensor],
        attn_mask: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Run all layers, each on the reference that the one before refined.

        Args:
            query: Content of the queries, Q of points (N * P) or of instances (N). (B, Q, C)
            query_pos: Their learned position. (B, Q, C)
            reference: Initial reference of each. (B, Q, D)
            bev_feats: BEV features. (B, C, H, W)
            refine: Maps a layer's number, its point states (B, N * P, C) and a reference (B, N * P,
                D) to the refined one.
            attn_mask: True where an instance may not attend to another, or None. (N, N)

        Of all layers, it returns ``point_states`` (L, B, N * P, C), the refined ``references`` (L,
        B, N * P, D), float32, and the decoder's further ``fields``.
        """
        state, reference, feats = self.start(query, reference, bev_feats)
        outputs: list[dict[str, Tensor]] = []
        for number, layer in enumerate(self.layers):
            state = layer(state, query_pos, reference, feats, attn_mask)
            outputs.append(self.read(state))
            reference = refine(number, outputs[-1]["point_states"], reference)
            outputs[-1]["references"] = reference
            if self.detach_reference:
                reference = reference.detach()
        return {name: torch.stack([output[name] for output in outputs]) for name in outputs[0]}
