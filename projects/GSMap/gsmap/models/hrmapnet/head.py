"""Head of HRMapNet: queries without a positional half."""

from typing import Any

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.decoder import Decoded, MapDecoder
from gsmap.models.base.head import MapHead
from gsmap.models.base.layers import init_matrices, mlp
from gsmap.models.base.parts import PartConfig
from gsmap.models.base.queries import PointTable


@MODELS.register_module()
class ContentDecoder(MapDecoder):
    """`MapDecoder` whose layers get no positional queries, as in HRMapNet.

    It has the arguments of `MapDecoder`.
    """

    def forward(self, query: Tensor, query_pos: Tensor, **inputs: Any) -> list[Decoded]:
        """Run all layers.

        Args:
            query: Content of the queries. (B, Q, C)
            query_pos: Positional queries; not used. (B, Q, C)
            inputs: Further arguments of `MapDecoder.forward`.

        Returns:
            The output of every layer.
        """
        return super().forward(query, query_pos=torch.zeros_like(query_pos), **inputs)


@MODELS.register_module()
class HRMapNetHead(MapHead):
    """Map head whose queries have no positional half, as in HRMapNet.

    A query is the sum of the embeddings of its instance and its point. A network of three layers
    predicts the first reference from it. `RasterPrior` changes the queries by the map.

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
        num_instances = sum(group.num for group in self.query_groups)
        self.instance_embedding = nn.Embedding(num_instances, embed_dims)
        self.pts_embedding = PointTable(num_points, embed_dims // 2)  # of C channels
        first: Any = self.reference.initial
        self.reference.initial = mlp(embed_dims, embed_dims, embed_dims, first.out_features)

    def init_weights(self) -> None:
        """Initialise as `MapHead`, and the network of the first references (Xavier)."""
        super().init_weights()
        init_matrices(self.reference.initial)

    def queries(self) -> tuple[Tensor, Tensor]:
        """Queries as the source of the first references, and as content. (N * P, C) each

        All query groups in training, only the first group in prediction.
        """
        embeddings = self.instance_embedding.weight
        if not self.training:
            embeddings = embeddings[: self.query_groups[0].num]
        query = self.pts_embedding(embeddings).flatten(0, 1)
        return query, query
