"""MGMapNet's decoder of instance and point queries."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.decoder import Decoded, MapDecoder, MapDecoderLayer
from gsmap.models.base.groups import without_groups
from gsmap.models.base.layers import feed_forward, mlp
from gsmap.models.mgmapnet.attention import Granularities
from gsmap.models.mgmapnet.bev_pyramid import BEVPyramid


class InstanceMasks(NamedTuple):
    """Masks of the two attentions of a layer between instances, (N, N) each.

    True where an instance (row) may not attend to another (column); None masks nothing.
    """

    self_attn: Tensor | None = None  # between the instance queries
    p2i: Tensor | None = None  # from the points of an instance to instances


@MODELS.register_module()
class MGMapNetDecoderLayer(MapDecoderLayer):
    """Decoder layer of instance and point queries with `MultiGranularityAttention` to the BEV.

    It consists of the self-attention of the instances, the attention to the BEV features, a
    feed-forward network for the instance queries, and another one for the point queries. A
    reference has D entries for each point: its position (x, y) first, and further ones, such as the
    size of a Gaussian, if the head predicts them.

    Args:
        embed_dims: Channels C of the queries.
        num_points: Points per instance P.
        num_levels: Number of levels of BEV features.
        ffn_dims: Hidden channels of the feed-forward networks.
        dropout: Probability of setting a value to zero in training, in [0, 1].
        self_attn: Settings of the self-attention.
        cross_attn: Settings of the attention to the BEV.
        reference_dims: Number of leading entries of each reference that are encoded as the position
            of its instance in the attention to the BEV. None uses the learned position instead.
        kwargs: Further arguments of `MapDecoderLayer`.
    """

    def __init__(
        self,
        embed_dims: int = 256,
        num_points: int = 20,
        num_levels: int = 2,
        ffn_dims: int = 512,
        dropout: float = 0.1,
        self_attn: dict[str, Any] | None = None,
        cross_attn: dict[str, Any] | None = None,
        reference_dims: int | None = 2,
        **kwargs: Any,
    ) -> None:
        cross_attn_defaults = {
            "type": "MultiGranularityAttention",
            "num_levels": num_levels,
            "num_points": num_points,
        }
        super().__init__(
            embed_dims,
            ffn_dims=ffn_dims,
            dropout=dropout,
            # The self-attention has one query per instance, as if each line had one point.
            self_attn={"num_points": 1, **(self_attn or {})},
            cross_attn={**cross_attn_defaults, **(cross_attn or {})},
            **kwargs,
        )
        self.num_points = num_points
        self.reference_dims = reference_dims
        self.point_ffn = feed_forward(embed_dims, ffn_dims, dropout=dropout)
        self.point_norm = nn.LayerNorm(embed_dims)
        self.reference_code: nn.Sequential | None = None
        if reference_dims is not None:
            self.reference_code = mlp(num_points * reference_dims, embed_dims, embed_dims)

    def forward(  # type: ignore[override]
        self,
        state: Granularities,
        query_pos: Tensor,
        reference: Tensor,
        feats: Sequence[Tensor],
        masks: InstanceMasks | None,
    ) -> Granularities:
        """Update instance and point queries.

        Args:
            state: Queries of the previous layer.
            query_pos: Learned positions of the instances. (B, N, C)
            reference: References of the points. (B, N * P, D)
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            masks: Masks of the attentions, or None.

        Returns:
            Updated queries.
        """
        if masks is None:
            masks = InstanceMasks()
        state = self.update_instances(
            state,
            query_pos,
            reference=reference,
            feats=feats,
            attn_mask=masks.self_attn,
            p2i_mask=masks.p2i,
        )
        # As in mmcv, the residual is added within the feed-forward network.
        return state._replace(points=self.point_norm(self.point_ffn(state.points)))

    def update_instances(
        self,
        state: Granularities,
        query_pos: Tensor,
        reference: Tensor,
        feats: Sequence[Tensor],
        attn_mask: Tensor | None,
        p2i_mask: Tensor | None = None,
    ) -> Granularities:
        """Apply all parts of the layer except the feed-forward network of the points.

        Args:
            state: Queries of the previous layer.
            query_pos: Learned positions of the instances. (B, N, C)
            reference: References of the points. (B, N * P, D)
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            attn_mask: True where an instance does not attend to another one, or None. (N, N)
            p2i_mask: True where the points of an instance (row) do not attend to another instance
                (column), or None. (N, N)

        Returns:
            Updated queries.
        """
        self_attn_position = self.guide_position(query_pos, reference)
        attention_output = self.self_attn(state.instances, self_attn_position, attn_mask)
        state = state._replace(instances=self.norms[0](attention_output))
        by_instance = reference.unflatten(1, (-1, self.num_points))  # (B, N, P, D)
        # The attention to the BEV uses an encoding of the references instead, if the layer has one.
        position = query_pos
        if self.reference_code is not None:
            encoded_entries = by_instance[..., : self.reference_dims]
            position = self.reference_code(encoded_entries.flatten(2))
        frames = None  # matrices that transform the sampling offsets of each point
        if self.guidance is not None:
            # Each level halves both sides, so all levels share the rotations of the finest one.
            frames = self.guidance.frames(reference, feats[0])
        position = self.guide_position(position, reference)
        # Updates the instance queries and the point queries.
        state = self.cross_attn(
            state,
            position,
            reference=by_instance,
            feats=feats,
            frames=frames,
            mask=p2i_mask,
        )
        instances = self.ffn(self.norms[1](state.instances))
        return state._replace(instances=self.norms[2](instances))

    def guide_position(self, position: Tensor, reference: Tensor) -> Tensor:
        """Add embeddings of the references to the positions, if the layer has a guidance.

        The guidance (an optional part of `MapDecoderLayer`) conditions a query on its reference. It
        is applied once for each point, and the results are averaged over the points.

        Args:
            position: Positions of the instances. (B, N, C)
            reference: References of the points. (B, N * P, D)

        Returns:
            Positions of the instances. (B, N, C)
        """
        if self.guidance is None:
            return position
        by_point = position.repeat_interleave(self.num_points, dim=1)  # (B, N * P, C)
        by_point = self.guidance.position(by_point, reference)
        return by_point.unflatten(1, (-1, self.num_points)).mean(dim=2)


@dataclass(eq=False)
class MGMapNetDecoded(Decoded):
    """Output of a layer of `MGMapNetDecoder`, for all samples of a batch.

    Args:
        point_states: States of the point queries, from which the references are refined.
            (B, N, P, C)
        references: Refined references, float32. (B, N, P, D)
        instance_states: States of the instance queries, from which classes are predicted.
            (B, N, C)
        mean_locations: Mean of the sampling locations (x, y) of each point, in the scale [0, 1]
            over the map, not clipped. (B, N, P, 2)
    """

    mean_locations: Tensor


@MODELS.register_module()
class MGMapNetDecoder(MapDecoder):
    """Decoder of MGMapNet, with instance queries and point queries.

    The inputs are instance queries with one reference each. All points of an instance start from
    its reference, and each layer refines each point.

    Args:
        layer: Settings of `MGMapNetDecoderLayer`. Its ``reference_dims`` applies from the second
            layer on, because all points of an instance have one reference in the first layer.
        embed_dims: Channels C of the queries and of the BEV features.
        num_levels: Number of levels of BEV features.
        kwargs: Further arguments of `MapDecoder`.
    """

    point_queries = False  # the input has a query per instance, not per point
    layer_class = MGMapNetDecoderLayer

    def __init__(
        self,
        layer: dict[str, Any] | None = None,
        embed_dims: int = 256,
        num_levels: int = 2,
        **kwargs: Any,
    ) -> None:
        super().__init__(layer or {}, **kwargs, embed_dims=embed_dims, num_levels=num_levels)
        # Differs from the poster: as in the released model, the first layer uses the learned
        # position instead of an encoding of the references.
        self.layers[0].reference_code = None
        self.bev_pyramid = BEVPyramid(embed_dims, num_levels)

    def start(
        self, query: Tensor, reference: Tensor, bev_feats: Tensor
    ) -> tuple[Granularities, Tensor, list[Tensor]]:
        """Prepare the inputs of the layers.

        Args:
            query: Instance queries. (B, N, C)
            reference: Initial references of the instances. (B, N, D)
            bev_feats: BEV features. (B, C, H, W)

        Returns:
            Queries, references of the points (B, N * P, D), and levels of BEV features.
        """
        references = reference.repeat_interleave(self.num_points, dim=1)
        # Point queries are None here. The attention of the first layer creates them.
        return Granularities(query), references, self.bev_pyramid(bev_feats)

    def layer_mask(self, mask: Tensor | None, group_mask: Tensor | None) -> InstanceMasks:
        """Return the masks of the layers. Only the self-attention separates the query groups.

        As in the released model, points also attend to the instances of other groups.

        Args:
            mask: True where an instance (row) may not attend to another (column), or None. (N, N)
            group_mask: The mask between query groups, which ``mask`` contains, or None.
        """
        return InstanceMasks(self_attn=mask, p2i=without_groups(mask, group_mask))

    def point_states(self, state: Granularities) -> Tensor:
        """Return the states of the points of a layer's output. (B, N * P, C)"""
        assert state.points is not None
        return state.points.flatten(1, 2)

    def read(self, state: Granularities, references: Tensor) -> MGMapNetDecoded:
        """Return the output of a layer, with values of points by instance.

        Args:
            state: Queries after the layer, with point queries.
            references: Refined references of the points. (B, N * P, D)
        """
        assert state.points is not None
        assert state.mean_locations is not None
        return MGMapNetDecoded(
            point_states=state.points,
            references=self.by_instance(references),
            instance_states=state.instances,
            mean_locations=state.mean_locations,
        )
