"""MapTR's decoder: point queries interact, look at the BEV and refine their reference."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule, ModuleList
from torch import Tensor, nn

from gsmap.models.base.layers import feed_forward
from gsmap.structures.gaussians import GaussianSpace

Refine = Callable[[int, Tensor, Tensor], Tensor]  # layer, point states, reference -> reference


class Guidance(nn.Module):
    """What a decoder layer takes from its references, for whichever attentions it has."""

    def position(self, query_pos: Tensor, reference: Tensor) -> Tensor:
        """Add what references (B, Q, D) say to the queries' position. (B, Q, C) -> (B, Q, C)"""
        raise NotImplementedError

    def frames(self, reference: Tensor, feats: Tensor) -> Tensor | None:
        """Return what turns sampling offsets in cells of the features, if anything. (B, Q, 2, 2)"""
        raise NotImplementedError


class Queries(NamedTuple):
    """The queries between two decoder layers, as the layers hand them on."""

    state: Any  # of points (B, N * P, C), of instances (B, N, C), or what the decoder's layers take
    position: Tensor  # of the same shape
    reference: Tensor  # (B, N * P, D)


@dataclass(eq=False)
class Decoded:
    """What a decoder layer returns, for all samples of a batch.

    A decoder that returns more has a subclass, whose fields all start with (B, N).

    Args:
        point_states: They move the references. (B, N, P, C)
        references: What the layer has refined, float32. (B, N, P, D)
        instance_states: They say the class. (B, N, C)
    """

    point_states: Tensor
    references: Tensor
    instance_states: Tensor

    def of_queries(self, queries: slice) -> "Decoded":
        """Return what belongs to some of the instance queries."""
        return type(self)(**{name: value[:, queries] for name, value in vars(self).items()})


class JoinedDecoded(Decoded):
    """What several layers returned: each field is joined along the queries when it is first read.

    Args:
        layers: What each layer returned, L of them, with fields (B, N, ...).
    """

    def __init__(self, layers: Sequence[Decoded]) -> None:
        self._layers = layers

    def __getattr__(self, name: str) -> Tensor:
        """Return a field of all layers. (B, L * N, ...)"""
        joined = torch.cat([getattr(layer, name) for layer in self._layers], 1)
        setattr(self, name, joined)
        return joined


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
        guidance: Config of a `Guidance`, or None for a layer that is not guided.
        space: How the reference stands for a Gaussian; the guidance takes it.
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
        self.guidance: Guidance | None = None
        if guidance is not None:
            self.guidance = MODELS.build({"space": space, "embed_dims": embed_dims, **guidance})

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
        num_points: Points per instance P.
        detach_reference: Cut the gradient through the reference between layers, as MapTR does.
        shared: What the head hands on to every layer: ``embed_dims`` and ``space``.

    Attributes:
        point_queries: Whether it takes point queries (B, N * P, C), or instance queries (B, N, C).
        layer_class: Class of its layers, where their config names none.
        branches: For each output, the number of the branches that read it.
    """

    point_queries = True
    layer_class: ClassVar[type[MapDecoderLayer]] = MapDecoderLayer

    def __init__(
        self,
        layer: dict[str, Any],
        num_layers: int = 6,
        num_points: int = 20,
        detach_reference: bool = True,
        **shared: Any,
    ) -> None:
        super().__init__()
        self.num_points, self.detach_reference = num_points, detach_reference
        layer = {"type": self.layer_class, "num_points": num_points, **shared, **layer}
        self.layers = ModuleList(MODELS.build(layer) for _ in range(num_layers))
        self.branches = list(range(num_layers))

    @classmethod
    def reference_settings(cls, num_points: int) -> dict[str, Any]:
        """Return settings of the reference that follow from what the states stand for.

        Args:
            num_points: Points per instance P.
        """
        return {}

    def start(self, query: Tensor, reference: Tensor, bev_feats: Tensor) -> tuple[Any, Tensor, Any]:
        """Return queries, reference and features as the layers take them."""
        return query, reference, bev_feats

    def point_states(self, state: Any) -> Tensor:
        """Return the states of the points of a layer's output. (B, N * P, C)"""
        return state

    def read(self, state: Any, references: Tensor) -> Decoded:
        """Return a layer's output, with the references that it has refined. (B, N * P, D)"""
        points = self.by_instance(self.point_states(state))
        return Decoded(points, self.by_instance(references), points.mean(2))

    def by_instance(self, values: Tensor) -> Tensor:
        """Sort values of points by their instance. (B, N * P, ...) -> (B, N, P, ...)"""
        return values.unflatten(1, (-1, self.num_points))

    def forward(
        self,
        query: Tensor,
        query_pos: Tensor,
        reference: Tensor,
        bev_feats: Tensor,
        refine: Refine,
        attn_mask: Tensor | None = None,
        between: Callable[[int, Queries], Queries] | None = None,
    ) -> list[Decoded]:
        """Run all layers, each on the reference that the one before refined.

        Args:
            query: Content of the queries, Q of points (N * P) or of instances (N). (B, Q, C)
            query_pos: Their learned position. (B, Q, C)
            reference: Initial reference of each. (B, Q, D)
            bev_feats: BEV features. (B, C, H, W)
            refine: Maps a layer's number, its point states (B, N * P, C) and a reference (B, N * P,
                D) to the refined one.
            attn_mask: True where an instance may not attend to another, or None. (N, N)
            between: Takes a layer's number and the queries after it, and returns those of the next
                layer; None leaves them.

        Returns:
            The output of every layer.
        """
        state, reference, feats = self.start(query, reference, bev_feats)
        outputs: list[Decoded] = []
        for number, layer in enumerate(self.layers):
            state = layer(state, query_pos, reference, feats, attn_mask)
            reference = refine(number, self.point_states(state), reference)
            outputs.append(self.read(state, reference))
            if self.detach_reference:
                reference = reference.detach()
            if between is not None:
                queries = Queries(state, query_pos, reference)
                state, query_pos, reference = between(number, queries)
        return outputs
