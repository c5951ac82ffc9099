"""GeMap's Euclidean loss (arXiv 2312.03341): shapes of map elements and the relations between them.

Angles count by their cosine and sine, so that no angle wraps around. The released code is the
specification: it compares coordinates normalised to [0, 1], so x and y weigh differently; every
element has an edge from its last point to its first, open lines too.
"""

from collections.abc import Sequence

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import MatchedPairs
from gsmap.structures.tensors import check_same_shape, uploaded

NORM_EPS = 1e-6  # added to the product of two lengths: an edge may be a single point


def shape_features(points: Tensor) -> Tensor:
    """Return each edge's length, cosine and sine to the edge before. (..., P, 2) -> (3, ..., P)"""
    edges = _edges(points.movedim(-1, 0))
    lengths = edges.norm(dim=0)
    before = edges.roll(1, -1)
    return torch.stack([lengths, *_turns(before, edges, lengths.roll(1, -1) * lengths)])


def relation_features(points: Tensor, pairs: Tensor) -> Tensor:
    """Return distances between all points of pairs (2, R), and cosine and sine between all edges.

    One per point (or edge) of the first and of the second. (..., M, P, 2) -> (3, ..., R, P, P)
    """
    points = points.movedim(-1, 0)  # sums over a last axis of two would be slow
    edges = _edges(points)
    lengths = edges.norm(dim=0)
    one, other = (..., pairs[0], slice(None), None), (..., pairs[1], None, slice(None))
    distances = (points[one] - points[other]).norm(dim=0)
    turns = _turns(edges[one], edges[other], lengths[one] * lengths[other])
    return torch.stack([distances, *turns])


def euclidean_shape_loss(pred: Tensor, target: Tensor) -> Tensor:
    """Return the mean L1 distance of shapes: of lengths, of cosines and of sines, added up.

    Normalised points in the same order, of M matches, 2 x (..., M, P, 2) -> (...); zero without
    matches. ValueError if the shapes disagree.
    """
    check_same_shape(pred=pred, target=target)
    off = (shape_features(pred) - shape_features(target)).abs().sum(0)  # (..., M, P)
    return off.sum((-2, -1)) / max(pred.shape[-3] * pred.shape[-2], 1)


def euclidean_relation_loss(pred: Tensor, target: Tensor, counts: Sequence[int]) -> Tensor:
    """Return the L1 distance of the relations between the elements of each sample.

    A sample with n matches adds the sum over its pairs of elements, each taken once, divided by
    (n * P)^2: by all pairs of points, also those of an element with itself. Normalised points,
    sample after sample and in the same order, 2 x (..., M, P, 2) -> (...), and the matches of each
    sample; zero where none has two. ValueError if shapes disagree or counts do not add up.
    """
    check_same_shape(pred=pred, target=target)
    if sum(counts) != pred.shape[-3]:
        raise ValueError(f"counts must add up to {pred.shape[-3]} matches, got {list(counts)}.")
    pairs = [torch.zeros(2, 0, dtype=torch.long)]
    shares: list[float] = []
    first = 0
    for count in counts:
        pairs.append(torch.triu_indices(count, count, 1) + first)
        shares += [1 / max(count, 1) ** 2] * pairs[-1].shape[1]
        first += count
    on_host = [torch.cat(pairs, 1), torch.tensor(shares, dtype=pred.dtype)]
    both, share = uploaded(on_host, pred.device)
    off = (relation_features(pred, both) - relation_features(target, both)).abs()
    return off.sum(0).mean((-2, -1)) @ share


@MODELS.register_module()
class EuclideanLoss(MapLoss):
    """GeMap's Euclidean loss of matched elements, of their shapes and of their relations.

    Args:
        loss_weight: Weight of the whole (lambda of the supplement's Table A1).
        shape_weight: Weight of the shapes within it.
        relation_weight: Weight of the relations within it.
        flags: As in `MapLoss`.
    """

    name = "euclidean"

    def __init__(
        self,
        loss_weight: float = 0.005,
        shape_weight: float = 1.0,
        relation_weight: float = 1.0,
        **flags: bool,
    ) -> None:
        super().__init__(loss_weight, **flags)
        self.shape_weight, self.relation_weight = shape_weight, relation_weight

    def by_layer(self, pairs: MatchedPairs) -> Tensor:
        """Return the weighted loss of parts that are means, in the plane: heights are left out."""
        pred, target = (
            pairs.by_layer(pairs.pred_pts[..., :2]),
            pairs.by_layer(pairs.gt_pts[..., :2]),
        )
        shape = euclidean_shape_loss(pred, target)
        counts = pairs.counts[: len(pairs.counts) // pairs.num_layers]
        relation = euclidean_relation_loss(pred, target, counts)
        return self.loss_weight * (self.shape_weight * shape + self.relation_weight * relation)


def _edges(points: Tensor) -> Tensor:
    """Return the edge that ends in each point; the first one closes the ring. (2, ..., P)"""
    return points - points.roll(1, -1)


def _turns(first: Tensor, second: Tensor, products: Tensor) -> tuple[Tensor, Tensor]:
    """Return cosine and sine from edges (2, ...) to others, given their lengths' products."""
    dot = first[0] * second[0] + first[1] * second[1]
    cross = first[0] * second[1] - first[1] * second[0]
    scale = 1 / (products + NORM_EPS)
    return dot * scale, cross * scale
