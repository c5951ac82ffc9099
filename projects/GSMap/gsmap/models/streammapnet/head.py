"""StreamMapNet's head, with one query per element and one class branch for all layers.

The layers also share one regression branch, which is part of `LineReference`. The memory of
earlier frames is implemented in `gsmap.models.streams`.
"""

from typing import Any

from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.checkpoints.class_axes import mark_classes
from gsmap.models.base.coder import Detections, MapCoder
from gsmap.models.base.head import MapHead
from gsmap.models.base.parts import PartConfig
from gsmap.models.streammapnet.decoder import StreamMapNetDecoder
from gsmap.models.streammapnet.reference import LineReference


class BestClassCoder(MapCoder):
    """Selects queries with their best class, so that no query occurs with two classes.

    The base class `MapCoder` selects pairs of query and class. It calls `best` and then drops
    detections with points far outside of the map, if ``margin_m`` is not None.
    """

    def best(self, scores: Tensor) -> Detections:
        """Select up to ``max_num`` queries, highest score first, from class logits (N, classes)."""
        best_scores, labels = scores.float().sigmoid().max(dim=-1)
        top_scores, order = best_scores.topk(min(self.max_num, len(best_scores)))
        return Detections(top_scores, labels[order], query_inds=order)


@MODELS.register_module()
class StreamMapNetHead(MapHead):
    """Map head with StreamMapNet's parts.

    Args:
        decoder: Settings that replace or extend the defaults of `StreamMapNetDecoder`.
        reference: Settings of `LineReference`.
        coder: Settings of `BestClassCoder`; by default it keeps all queries.
        num_points: Points per instance P.
        embed_dims: Channels of the BEV features. The queries have twice this number.
        kwargs: Further arguments of `MapHead`.
    """

    def __init__(
        self,
        decoder: PartConfig,
        reference: PartConfig | None = None,
        coder: PartConfig | None = None,
        num_points: int = 20,
        embed_dims: int = 256,
        **kwargs: Any,
    ) -> None:
        reference_settings: PartConfig = {"type": LineReference, "num_points": num_points}
        reference_settings |= reference or {}
        super().__init__(
            decoder={"type": StreamMapNetDecoder, "bev_dims": embed_dims, **decoder},
            reference=reference_settings,
            num_points=num_points,
            embed_dims=2 * embed_dims,
            **kwargs,
        )
        self.bev_dims = embed_dims
        num_queries = sum(group.num for group in self.query_groups)
        self.instance_embedding = nn.Embedding(num_queries, self.embed_dims)
        branch = nn.Linear(self.embed_dims, len(self.classes))
        mark_classes(branch)
        # `MapHead` has created a branch per decoder layer. Here all entries are one module, and
        # `LineReference` shares its regression branch in the same way.
        self.cls_branches = nn.ModuleList([branch] * len(self.cls_branches))
        # By default all queries of the first group, the only one in prediction, are kept: also
        # queries with points far beyond the map (no margin).
        coder_settings: PartConfig = {"max_num": self.query_groups[0].num, "margin_m": None}
        coder_settings |= coder or {}
        self.coder = BestClassCoder(grid=self.grid, **coder_settings)

    def queries(self) -> tuple[Tensor, Tensor]:
        """Return the query embeddings twice: for the initial lines, and as the decoder's input.

        `MapHead` calls this method, and splits each embedding into two halves if it is not
        overridden.
        """
        query = self.instance_embedding.weight
        if not self.training:  # later groups are used only in training
            query = query[: self.query_groups[0].num]
        return query, query
