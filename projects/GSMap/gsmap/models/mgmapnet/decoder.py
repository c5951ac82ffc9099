"""MGMapNet's decoder: instance queries and point queries in one stack of layers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.decoder import Decoded, MapDecoder, MapDecoderLayer
from gsmap.models.base.layers import feed_forward, mlp
from gsmap.models.mgmapnet.attention import Granularities
from gsmap.models.mgmapnet.bev_pyramid import BEVPyramid


@MODELS.register_module()
class MGMapNetDecoderLayer(MapDecoderLayer):
    """Self-attention of the instances, attention on the BEV, and a network for each granularity.

    The attention on the BEV is `MultiGranularityAttention`. Arguments besides those of
    `MapDecoderLayer`:

    Args:
        num_levels: Levels of BEV features.
        reference_dims: Entries of the reference that its position code reads; None for the learned
            position instead.
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
        sampling = {"type": "MultiGranularityAttention", "num_levels": num_levels}
        super().__init__(
            embed_dims,
            ffn_dims=ffn_dims,
            dropout=dropout,
            self_attn={"num_points": 1, **(self_attn or {})},
            cross_attn={**sampling, "num_points": num_points, **(cross_attn or {})},
            **kwargs,
        )
        self.num_points, self.reference_dims = num_points, reference_dims
        self.point_ffn = feed_forward(embed_dims, ffn_dims, dropout)
        self.point_norm = nn.LayerNorm(embed_dims)
        self.reference_code: nn.Sequential | None = None
        if reference_dims is not None:
            self.reference_code = mlp(num_points * reference_dims, embed_dims, embed_dims)

    def forward(self, state: Granularities, *inputs: Any) -> Granularities:  # type: ignore[override]
        """Update the queries that the layer before left; inputs as of `update_instances`."""
        state = self.update_instances(state, *inputs)
        return state._replace(points=self.point_norm(self.point_ffn(state.points)))

    def update_instances(
        self,
        state: Granularities,
        query_pos: Tensor,
        reference: Tensor,
        feats: Sequence[Tensor],
        attn_mask: Tensor | None,
    ) -> Granularities:
        """Run both attentions and the instances' network; the points' own network is to come.

        As in `MapDecoderLayer`, but that instances have the position (B, N, C) and the features
        have levels, the finest first.
        """
        attended = self.self_attn(state.instances, self.guided(query_pos, reference), attn_mask)
        state = state._replace(instances=self.norms[0](attended))
        by_instance = reference.unflatten(1, (-1, self.num_points))  # (B, N, P, D)
        position = query_pos
        if self.reference_code is not None:
            position = self.reference_code(by_instance[..., : self.reference_dims].flatten(2))
        frames = None
        if self.guidance is not None:  # levels halve both sides, so one frame serves all
            frames = self.guidance.frames(reference, feats[0])
        position = self.guided(position, reference)
        state = self.cross_attn(state, position, by_instance, feats, frames)
        return state._replace(instances=self.norms[2](self.ffn(self.norms[1](state.instances))))

    def guided(self, position: Tensor, reference: Tensor) -> Tensor:
        """Add the mean of what the guidance adds to the position of each point. (B, N, C)"""
        if self.guidance is None:
            return position
        by_point = position.repeat_interleave(self.num_points, 1)  # (B, N * P, C)
        by_point = self.guidance.position(by_point, reference)
        return by_point.unflatten(1, (-1, self.num_points)).mean(2)


@dataclass(eq=False)
class MGMapNetDecoded(Decoded):
    """What a layer of `MGMapNetDecoder` returns, for all samples of a batch.

    Args:
        point_states: States of the point queries; they move the references. (B, N, P, C)
        references: What the layer has refined, float32. (B, N, P, D)
        instance_states: States of the instance queries; they say the class. (B, N, C)
        mean_locations: Mean of each point's sampling locations (x, y), [0, 1] over the map, not
            clipped. (B, N, P, 2)
    """

    mean_locations: Tensor


@MODELS.register_module()
class MGMapNetDecoder(MapDecoder):
    """A stack of layers with instance and point queries that refine one reference (MGMapNet).

    It takes instance queries and one reference for each, which its points share at first.

    Args:
        layer: Config of the layer (`MGMapNetDecoderLayer`). Its ``reference_dims`` holds from the
            second layer on: before that no point has moved.
        num_levels: Levels of BEV features.
        kwargs: Further arguments of `MapDecoder`.
    """

    point_queries = False
    layer_class = MGMapNetDecoderLayer

    def __init__(
        self,
        layer: dict[str, Any] | None = None,
        embed_dims: int = 256,
        num_levels: int = 2,
        **kwargs: Any,
    ) -> None:
        kwargs |= {"embed_dims": embed_dims, "num_levels": num_levels}
        super().__init__(layer or {}, **kwargs)
        # Differs from the poster: the released model's first layer adds the learned position.
        self.layers[0].reference_code = None
        self.bev_pyramid = BEVPyramid(embed_dims, num_levels)

    def start(
        self, query: Tensor, reference: Tensor, bev_feats: Tensor
    ) -> tuple[Granularities, Tensor, list[Tensor]]:
        """Return the instances' queries, the points' references (B, N * P, D) and all levels."""
        references = reference.repeat_interleave(self.num_points, 1)
        return Granularities(query), references, self.bev_pyramid(bev_feats)

    def point_states(self, state: Granularities) -> Tensor:
        """Return the states of the points of a layer's output. (B, N * P, C)"""
        assert state.points is not None
        return state.points.flatten(1, 2)

    def read(self, state: Granularities, references: Tensor) -> MGMapNetDecoded:
        """Return a layer's output, with the references that it has refined. (B, N * P, D)"""
        assert state.points is not None
        assert state.mean_locations is not None
        references = self.by_instance(references)
        return MGMapNetDecoded(state.points, references, state.instances, state.mean_locations)
