"""Head of HRMapNet: queries without the positional half that the queries of MapTR have."""

from collections.abc import Callable
from typing import Any

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.decoder import Decoded, MapDecoder, Queries, Refine
from gsmap.models.base.head import MapHead
from gsmap.models.base.layers import init_matrices, mlp
from gsmap.models.base.parts import PartConfig
from gsmap.models.base.queries import PointTable
from gsmap.utils.errors import InputError


@MODELS.register_module()
class ContentDecoder(MapDecoder):
    """`MapDecoder` whose layers get no positional queries, as in HRMapNet.

    The layers add positional queries to the content. Here they are zero. The constructor has the
    arguments of `MapDecoder`.
    """

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
        """Run all layers as `MapDecoder.forward`, without positional queries.

        Args:
            query: Content of the queries. (B, Q, C)
            query_pos: Positional queries; only their shape is used. (B, Q, C)
            reference: Initial references, D entries for each point. (B, N * P, D)
            bev_feats: BEV features. (B, C, H, W)
            refine: Function that refines the references after each layer. Its arguments are the
                index of the layer, the states of the points, and the references.
            attn_mask: True where an instance may not attend to another, or None. (N, N)
            between: Function (index of a layer, queries) -> queries that changes the queries
                between layers, or None.

        Returns:
            The output of every layer: states of points and instances, and refined references.
        """
        return super().forward(
            query,
            query_pos=torch.zeros_like(query_pos),
            reference=reference,
            bev_feats=bev_feats,
            refine=refine,
            attn_mask=attn_mask,
            between=between,
        )


@MODELS.register_module()
class HRMapNetHead(MapHead):
    """Map head whose queries have no positional half, as in HRMapNet.

    A reference is the current estimate of the location of a point, which each decoder layer
    refines. MapTR splits the embedding of a query into two halves of C channels. A linear layer
    predicts the first reference from the positional half, and the other half is the content. Here a
    query is one vector of C channels: the sum of the embeddings of its instance and its point. A
    network of three layers predicts the first reference from it. `RasterPrior` can condition the
    queries on a map of earlier predictions.

    Args:
        decoder: Settings of `ContentDecoder`.
        num_points: Points per instance P.
        embed_dims: Channels C.
        kwargs: Further arguments of `MapHead`.
    """

    def __init__(
        self, decoder: PartConfig, num_points: int = 20, embed_dims: int = 256, **kwargs: Any
    ) -> None:
        super().__init__(
            decoder={"type": "ContentDecoder", **decoder},
            num_points=num_points,
            embed_dims=embed_dims,
            **kwargs,
        )
        # The embeddings of `MapHead` have 2 C channels, for both halves. They are replaced by
        # embeddings of C channels.
        num_instances = sum(group.num for group in self.query_groups)
        self.instance_embedding = nn.Embedding(num_instances, embed_dims)
        # `PointTable` has twice as many channels as its second argument, here C.
        self.pts_embedding = PointTable(num_points, embed_dims // 2)
        # `initial` is the layer of MapTR that predicts the first references.
        reference: Any = self.reference
        out_dims = reference.initial.out_features
        reference.initial = mlp(embed_dims, embed_dims, embed_dims, out_dims)

    def _build_point_embedding(self, config: PartConfig | None) -> nn.Module | None:
        """Build the embeddings of `MapHead`, and refuse a config of others."""
        if config is not None:
            raise InputError(
                "HRMapNetHead has embeddings of points of half the channels: leave out "
                "point_queries and points_from_instances."
            )
        return super()._build_point_embedding(config)

    def init_weights(self) -> None:
        """Initialise the head as `MapHead` does, and the network of the first references."""
        super().init_weights()
        reference: Any = self.reference
        init_matrices(reference.initial)

    def queries(self) -> tuple[Tensor, Tensor]:
        """Queries of all query groups in training, and of the first group in prediction.

        Further groups exist only to train the decoder.

        Returns:
            The vectors that predict the first references, and the content of the queries. Both are
            one tensor. (N * P, C)
        """
        embeddings = self.instance_embedding.weight
        if not self.training:
            embeddings = embeddings[: self.query_groups[0].num]
        assert self.pts_embedding is not None  # set in the constructor
        query = self.pts_embedding(embeddings).flatten(0, 1)  # (N, P, C) -> (N * P, C)
        return query, query
