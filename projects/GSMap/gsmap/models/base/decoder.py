"""Decoder of map elements: layers with attention among queries and to the BEV features.

A reference is the geometry of a predicted point, which each layer refines. It has D numbers: the
coordinates of the point and, if points are Gaussians, also the parameters of the Gaussian.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule, ModuleList
from torch import Tensor, nn

from gsmap.models.base.layers import feed_forward
from gsmap.models.base.parts import build_part
from gsmap.structures.gaussians import GaussianSpace
from gsmap.utils.settings import check_positive

Refine = Callable[[int, Tensor, Tensor], Tensor]
"""Function (index of a layer, point states, references) -> refined references."""


class Guidance(nn.Module):
    """Base class of modules that condition a decoder layer on the references of the queries."""

    def position(self, query_pos: Tensor, reference: Tensor) -> Tensor:
        """Add embeddings of references to the positional queries.

        Args:
            query_pos: Positional queries. (B, Q, C)
            reference: References. (B, Q, D)

        Returns:
            Positional queries. (B, Q, C)
        """
        raise NotImplementedError

    def frames(self, reference: Tensor, feats: Tensor) -> Tensor | None:
        """Matrices that transform the sampling offsets of each query.

        Args:
            reference: References. (B, Q, D)
            feats: Feature map (B, C, H, W) that the cross-attention samples, or several maps.

        Returns:
            Matrices that multiply the offsets, column vectors in cells, from the left. None leaves
            the offsets unchanged. (B, Q, 2, 2)
        """
        raise NotImplementedError


class Queries(NamedTuple):
    """Queries between two decoder layers.

    Attributes:
        state: States of points (B, N * P, C) or instances (B, N, C), or another type that the
            layers of the decoder exchange.
        position: Positional queries, which attention adds to the states. One for each point
            (B, N * P, C) or instance (B, N, C).
        reference: References of the points. (B, N * P, D)
    """

    state: Any
    position: Tensor
    reference: Tensor


@dataclass(eq=False)
class Decoded:
    """Output of a decoder layer for a batch.

    Decoders with further outputs return a subclass. All fields have the leading dimensions (B, N).

    Args:
        point_states: States of the points, from which references are refined. (B, N, P, C)
        references: Refined references in float32. (B, N, P, D)
        instance_states: States of the instances, from which classes are predicted. (B, N, C)
    """

    point_states: Tensor
    references: Tensor
    instance_states: Tensor

    def of_queries(self, queries: slice) -> "Decoded":
        """Select the output of some of the instance queries."""
        # `vars` also has the fields that a subclass adds.
        fields = {name: values[:, queries] for name, values in vars(self).items()}
        return type(self)(**fields)


class JoinedDecoded(Decoded):
    """Outputs of several layers, concatenated along the queries.

    Fields are concatenated on first access and cached.

    Args:
        layers: Output of each of L layers, with fields (B, N, ...).
    """

    def __init__(self, layers: Sequence[Decoded]) -> None:
        # `Decoded.__init__` is not called: it would need the concatenated fields at once.
        self._layers = layers

    def __getattr__(self, name: str) -> Tensor:
        """Field of all layers. (B, L * N, ...)"""
        values = torch.cat([getattr(layer, name) for layer in self._layers], dim=1)
        setattr(self, name, values)  # this method is not called for existing attributes
        return values


@MODELS.register_module()
class MapDecoderLayer(BaseModule):
    """Decoder layer: self-attention, cross-attention to the BEV features, feed-forward network.

    Each of the three is followed by LayerNorm. With guidance, the references of the queries change
    the positional queries and transform the sampling offsets of the cross-attention.

    Args:
        embed_dims: Channels C.
        num_heads: Heads of each attention.
        num_points: Points per instance P.
        ffn_dims: Hidden channels of the feed-forward network.
        dropout: Probability to drop a value in training, in every sublayer.
        self_attn: Config of the self-attention. Default: `PointSelfAttention`.
        cross_attn: Config of the cross-attention. Default: `BEVDeformableAttention`.
        guidance: Config of a `Guidance`, or None for a layer without guidance.
        space: Encoding of Gaussians in references, an argument of the guidance.
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
        self.self_attn = build_part(
            self_attn, type="PointSelfAttention", num_points=num_points, **shared
        )
        self.cross_attn = build_part(cross_attn, type="BEVDeformableAttention", **shared)
        self.ffn = feed_forward(embed_dims, ffn_dims, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(3))
        self.guidance: Guidance | None = None
        if guidance is not None:
            self.guidance = build_part(guidance, space=space, embed_dims=embed_dims)

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
            query: States of the points. (B, N * P, C)
            query_pos: Positional queries. (B, N * P, C)
            reference: References. (B, N * P, D)
            bev_feats: BEV features. (B, C, H, W)
            attn_mask: True where an instance (row) may not attend to another (column), or None.
                (N, N)

        Returns:
            The updated states. (B, N * P, C)
        """
        frames = None  # matrices that transform the sampling offsets, or None for unchanged offsets
        if self.guidance is not None:
            query_pos = self.guidance.position(query_pos, reference)
            frames = self.guidance.frames(reference, bev_feats)
        # The self-attention and the feed-forward network add their residual themselves. The
        # residual of the cross-attention is added here.
        attended = self.self_attn(query, query_pos, attn_mask)
        query = self.norms[0](attended)
        sampled = self.cross_attn(query + query_pos, reference, bev_feats, frames)
        query = self.norms[1](query + sampled)
        return self.norms[2](self.ffn(query))


@MODELS.register_module()
class MapDecoder(BaseModule):
    """Stack of decoder layers, each followed by the refinement of the references.

    Args:
        layer: Config of the layers.
        num_layers: Number of layers L.
        num_points: Points per instance P.
        detach_reference: Stop the gradient through the references between layers, as in MapTR.
        shared: Arguments of every layer that are set by the head: ``embed_dims`` and ``space``.

    Attributes:
        point_queries: True if the queries are of points (B, N * P, C), False if they are of
            instances (B, N, C).
        layer_class: Class of the layers if their config has no type.
        has_query_masks: Whether outputs have a mask of each query of the first layer, so that
            queries must not be replaced between layers.
        branches: For each output, the index of the prediction branches that are applied to it.
    """

    point_queries = True
    layer_class: ClassVar[type[MapDecoderLayer]] = MapDecoderLayer
    has_query_masks: ClassVar[bool] = False

    def __init__(
        self,
        layer: dict[str, Any],
        num_layers: int = 6,
        num_points: int = 20,
        detach_reference: bool = True,
        **shared: Any,
    ) -> None:
        super().__init__()
        check_positive(num_layers=num_layers)
        self.num_points = num_points
        self.detach_reference = detach_reference
        # Settings in the config of the layer take precedence over these.
        defaults = {"type": self.layer_class, "num_points": num_points, **shared}
        self.layers = ModuleList(build_part(layer, **defaults) for _ in range(num_layers))
        self.branches = list(range(num_layers))

    @classmethod
    def reference_settings(cls, num_points: int) -> dict[str, Any]:
        """Settings of the reference that depend on the decoder. This class has none.

        For example, a decoder in which the state of an instance refines all P points returns
        ``{"points_per_state": P}``.

        Args:
            num_points: Points per instance P.
        """
        return {}

    def start(self, query: Tensor, reference: Tensor, bev_feats: Tensor) -> tuple[Any, Tensor, Any]:
        """Convert the inputs of the decoder to the types that its layers exchange.

        Args:
            query: Content of the queries. (B, Q, C)
            reference: Initial references. (B, N * P, D)
            bev_feats: BEV features. (B, C, H, W)

        Returns:
            States, references and features for the first layer. This class returns the inputs.
        """
        return query, reference, bev_feats

    def layer_mask(self, mask: Tensor | None, group_mask: Tensor | None) -> Any:
        """Convert an attention mask to the type that the layers take. This class returns ``mask``.

        A decoder in which query groups attend to each other removes the mask between them
        (`without_groups`), but keeps what hooks have blocked.

        Args:
            mask: True where an instance (row) may not attend to another (column), or None. It
                includes the queries that hooks have appended. (N, N)
            group_mask: The mask between query groups, which ``mask`` contains, or None.
        """
        return mask

    def point_states(self, state: Any) -> Tensor:
        """Extract the states of the points from the states of a layer. (B, N * P, C)"""
        return state

    def read(self, state: Any, references: Tensor) -> Decoded:
        """Create the output of a layer. The state of an instance is the mean over its points.

        Args:
            state: States after the layer.
            references: Refined references. (B, N * P, D)
        """
        points = self.by_instance(self.point_states(state))
        instances = points.mean(2)
        return Decoded(points, self.by_instance(references), instance_states=instances)

    def by_instance(self, values: Tensor) -> Tensor:
        """Split values of points by instance. (B, N * P, ...) -> (B, N, P, ...)"""
        return values.unflatten(1, (-1, self.num_points))

    def forward(
        self,
        query: Tensor,
        query_pos: Tensor,
        reference: Tensor,
        bev_feats: Tensor,
        refine: Refine,
        attn_mask: Any = None,
        between: Callable[[int, Queries], Queries] | None = None,
    ) -> list[Decoded]:
        """Run all layers, each with the references of the previous one.

        Args:
            query: Content of the queries, of points (Q = N * P) or instances (Q = N). (B, Q, C)
            query_pos: Positional queries. (B, Q, C)
            reference: Initial references. (B, N * P, D)
            bev_feats: BEV features. (B, C, H, W)
            refine: Function of the index of a layer, its point states (B, N * P, C) and references
                (B, N * P, D). It returns the refined references.
            attn_mask: Result of `layer_mask`; None masks nothing.
            between: Function of the index of a layer and the queries after it. It returns the
                queries of the next layer. None leaves the queries unchanged.

        Returns:
            The output of every layer.
        """
        state, reference, feats = self.start(query, reference, bev_feats)
        outputs: list[Decoded] = []
        for number, layer in enumerate(self.layers):
            state = layer(state, query_pos, reference, feats, attn_mask)
            reference = refine(number, self.point_states(state), reference)
            outputs.append(self.read(state, reference))  # with the gradient of the references
            if self.detach_reference:
                reference = reference.detach()
            if between is not None:
                queries = Queries(state, query_pos, reference)
                state, query_pos, reference = between(number, queries)
        return outputs
