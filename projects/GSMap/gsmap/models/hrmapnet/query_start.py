"""Initialisation of queries by the map of earlier frames.

The map is a raster of cells. `raster_prior.py` selects the cells in which it is known.
"""

from typing import Any, NamedTuple

import torch
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule, constant_init, xavier_init
from torch import Tensor, nn

from gsmap.models.base.decoder import Queries
from gsmap.models.base.hooks import FlowHead, FlowHook, FlowStart
from gsmap.models.base.pairs import Predictions
from gsmap.structures.tensors import LateValues


class MapKeys(NamedTuple):
    """Cells of the map to which queries attend.

    Attributes:
        values: Values of the M channels of the map in each of K cells, [0, 1]. (B, K, M)
        positions: Positional encoding of each cell. (B, K, C)
        is_valid: False for padding. (B, K)
    """

    values: Tensor
    positions: Tensor
    is_valid: Tensor


@MODELS.register_module()
class PriorQueries(BaseModule):
    """Attention of queries to the cells in which the map is known (HRMapNet).

    Args:
        embed_dims: Channels C of the queries and of the positional encoding.
        num_channels: Channels M of the map in each cell.
        num_heads: Heads of the attention.
        stride: Every ``stride``-th row and column of the cells is used, from the first on.
            `raster_prior.py`, which selects the cells, reads ``stride`` and ``threshold``.
        threshold: Value that a channel of a cell must exceed for the cell to be used.
        dropout: Probability to drop an attention weight in training.
        zero_init: Whether to initialise the output projection with 0, so that a model that was
            trained without a map keeps its queries. By default, its weights are random, as
            published.
        init_cfg: Initialisation config of mmengine.
    """

    def __init__(
        self,
        embed_dims: int = 256,
        num_channels: int = 3,
        num_heads: int = 8,
        stride: int = 2,
        threshold: float = 0.8,
        dropout: float = 0.0,
        zero_init: bool = False,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.zero_init = zero_init
        self.stride = stride
        self.threshold = threshold
        self.label_encoder = nn.Linear(num_channels, embed_dims)
        self.attention = nn.MultiheadAttention(
            embed_dims, num_heads, dropout=dropout, batch_first=True
        )

    def init_weights(self) -> None:
        """Initialise the encoder of map values from Xavier's uniform distribution."""
        super().init_weights()
        xavier_init(self.label_encoder, distribution="uniform", bias=0.0)
        if self.zero_init:
            constant_init(self.attention.out_proj, 0.0)

    def forward(self, query: Tensor, keys: MapKeys) -> Tensor:
        """Compute changes of the queries by attention to the map.

        Args:
            query: Queries. (B, Q, C)
            keys: Cells of the map, of which at least one is given, even if it is padding.

        Returns:
            Changes, to be added to the queries; 0 in samples without a valid cell. (B, Q, C)
        """
        tokens = keys.positions + self.label_encoder(keys.values)
        has_cells = keys.is_valid.any(1, keepdim=True)  # (B, 1)
        # A softmax over no cell is undefined. A sample without a valid cell therefore attends to
        # its padding, and its change is replaced by 0 below.
        is_blocked = has_cells & ~keys.is_valid
        change, _ = self.attention(
            query=query, key=tokens, value=tokens, key_padding_mask=is_blocked, need_weights=False
        )
        return torch.where(has_cells[..., None], change, 0.0)


class PriorHook(FlowHook):
    """Hook that starts the queries of a batch from the map, and keeps the batch's predictions.

    The head calls `start` before its first decoder layer, and `outputs` after its last one. The
    predictions are later written to the map.

    Args:
        queries: Attention to the map, or None to leave the queries as they are.
        keys: Cells of the map; None without ``queries``.

    Attributes:
        scores: Class logits of the last layer, once the head has run. (B, N, classes)
        points_m: Points of the last layer in metres. (B, N, P, 2)
    """

    def __init__(self, queries: PriorQueries | None, keys: MapKeys | None) -> None:
        self.queries = queries
        self.keys = keys
        self.scores: LateValues | None = None
        self.points_m: LateValues | None = None

    def start(self, head: FlowHead, start: FlowStart) -> FlowStart:
        """Change the queries of the head by the map, and compute their references from the result.

        Differs from HRMapNet: where a head's queries have a state and a positional encoding, the
        positional encoding attends to the map, and the result is added to both.

        Args:
            head: The head.
            start: Queries of the head and of the previous hooks.

        Returns:
            ``start`` with new queries. Queries that other hooks have appended are not changed.
        """
        if self.queries is None:
            return start
        states, positions, references = start.queries
        num_rows = _num_rows(head)  # queries of other hooks follow
        head_positions = positions[:, :num_rows]
        change = self.queries(head_positions, self.keys)
        new_positions = head_positions + change
        new_states = states[:, :num_rows] + change
        # `head.reference` is the module that computes reference points from positional encodings.
        new_references = head.reference.start(new_positions)
        # References are always of points, so their number may differ from the number of rows.
        num_references = new_references.shape[1]
        queries = Queries(
            state=torch.cat([new_states, states[:, num_rows:]], dim=1),
            position=torch.cat([new_positions, positions[:, num_rows:]], dim=1),
            reference=torch.cat([new_references, references[:, num_references:]], dim=1),
        )
        return start._replace(queries=queries)

    def outputs(self, head: Any, layers: list[Predictions]) -> list[Predictions]:
        """Start copying the predictions of the last layer to the host, and store the copies.

        Args:
            head: The head.
            layers: Predictions of each layer.

        Returns:
            ``layers``, unchanged.
        """
        last = layers[-1]
        num_instances = head.query_groups[0].num  # the first group predicts
        points_m = head.reference.metres(last.pts[:, :num_instances].detach().float())
        scores = last.scores[:, :num_instances].detach()
        if head.coder.weighs_scores:
            weighted_scores = []
            for references, logits in zip(last.references.detach(), scores, strict=True):
                sample_scores, _ = head.decode(logits, references[:num_instances])
                weighted_scores.append(sample_scores)
            scores = torch.stack(weighted_scores)
        # A `LateValues` copies in the background: the host waits only when the values are read.
        self.scores = LateValues(scores.float())
        self.points_m = LateValues(points_m[..., :2])  # without heights
        return layers


def _num_rows(head: Any) -> int:
    """Number of rows of the states of the head's queries.

    A row is a point, or an instance for a decoder of instance queries. In training, all query
    groups are decoded. In prediction, only the first one is.
    """
    groups = head.query_groups if head.training else head.query_groups[:1]
    num_instances = sum(group.num for group in groups)
    rows_per_instance = head.num_points if head.decoder.point_queries else 1
    return num_instances * rows_per_instance
