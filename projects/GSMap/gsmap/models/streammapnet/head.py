"""StreamMapNet's head: one query per element, one class branch and one line branch for all layers.

What it keeps of earlier frames is not its own: see `gsmap.models.streams`.
"""

from typing import Any

from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.coder import Detections, MapCoder
from gsmap.models.base.head import MapHead
from gsmap.models.base.parts import PARTS
from gsmap.models.streammapnet.decoder import StreamMapNetDecoder
from gsmap.models.streammapnet.reference import LineReference


class BestClassCoder(MapCoder):
    """Keep every query with its best class."""

    def best(self, scores: Tensor) -> Detections:
        """Return the best class of each query, best query first. (N, classes)"""
        best, labels = scores.float().sigmoid().max(-1)
        first, order = best.topk(min(self.max_num, len(best)))
        return Detections(first, labels[order], order)


@MODELS.register_module()
class StreamMapNetHead(MapHead):
    """The map head with StreamMapNet's parts. Besides `MapHead`'s arguments:

    Args:
        decoder: Settings of `StreamMapNetDecoder`.
        reference: Settings of `LineReference`.
        coder: Settings of `BestClassCoder`; by default all queries are handed on.
        num_points: Points per instance P.
        embed_dims: Channels of the BEV features; the queries have twice as many.
    """

    def __init__(
        self,
        decoder: PARTS,
        reference: PARTS | None = None,
        coder: PARTS | None = None,
        num_points: int = 20,
        embed_dims: int = 256,
        **kwargs: Any,
    ) -> None:
        lines = {"type": LineReference, "num_points": num_points}
        super().__init__(
            decoder={"type": StreamMapNetDecoder, "bev_dims": embed_dims, **decoder},
            reference={**lines, **(reference or {})},
            num_points=num_points,
            embed_dims=2 * embed_dims,
            **kwargs,
        )
        num_queries = sum(group.num for group in self.query_groups)
        self.instance_embedding = nn.Embedding(num_queries, self.embed_dims)
        branch = nn.Linear(self.embed_dims, len(self.classes))
        self.cls_branches = nn.ModuleList([branch] * len(self.cls_branches))
        settings = {"max_num": self.query_groups[0].num, "margin_m": None, **(coder or {})}
        self.coder = BestClassCoder(grid=self.grid, **settings)

    def queries(self) -> tuple[Tensor, Tensor]:
        """Return the queries, which say their first line, and which the decoder starts from."""
        query = self.instance_embedding.weight
        if not self.training:
            query = query[: self.query_groups[0].num]
        return query, query
