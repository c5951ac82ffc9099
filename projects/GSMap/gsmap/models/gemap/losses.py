"""Euclidean loss of GeMap (arXiv 2312.03341): shapes of map elements and relations between them.

Angles are compared by their cosine and sine, which do not jump where the angle wraps around. Two
details follow the released code: coordinates are normalised to [0, 1], so x and y weigh
differently; and every element, including open lines, has an edge from its last point to its first.
"""

from collections.abc import Sequence

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import MatchedPairs
from gsmap.structures.tensors import check_same_shape, upload
from gsmap.utils.errors import InputError

NORM_EPS = 1e-6  # added to the product of two lengths: an edge may be a single point


def shape_features(points: Tensor) -> Tensor:
    """Length of each edge, and cosine and sine of the angle from the previous edge to the edge.

    Args:
        points: Normalised points. (..., P, 2)

    Returns:
        Length, cosine, sine. (3, ..., P)
    """
    # With x and y along the first axis, sums over the coordinates are fast.
    edges = _edges(points.movedim(-1, 0))
    lengths = edges.norm(dim=0)
    previous_edges = edges.roll(1, -1)
    products = lengths.roll(1, -1) * lengths
    cosines, sines = _turns(previous_edges, edges, products=products)
    return torch.stack([lengths, cosines, sines])


def relation_features(points: Tensor, pairs: Tensor) -> Tensor:
    """Distances between the points, and angles between the edges, of pairs of elements.

    Args:
        points: Normalised points of M elements. (..., M, P, 2)
        pairs: Indices (into M) of the first and the second element of R pairs. (2, R)

    Returns:
        Along the first axis: distance of two points, and cosine and sine of the angle between two
        edges. The last two axes are the points (or edges) of the first and of the second element.
        (3, ..., R, P, P)
    """
    points = points.movedim(-1, 0)  # as in `shape_features`
    edges = _edges(points)
    lengths = edges.norm(dim=0)
    first = (..., pairs[0], slice(None), None)  # selects (2, ..., R, P, 1)
    second = (..., pairs[1], None, slice(None))  # selects (2, ..., R, 1, P)
    distances = (points[first] - points[second]).norm(dim=0)
    turns = _turns(edges[first], edges[second], products=lengths[first] * lengths[second])
    return torch.stack([distances, *turns])


def euclidean_shape_loss(pred: Tensor, target: Tensor) -> Tensor:
    """Mean L1 distance between the shape features of matched elements.

    Args:
        pred: Normalised points of M predictions. (..., M, P, 2)
        target: Normalised points of their ground truths, in matching order. (..., M, P, 2)

    Returns:
        The sum of the distances of lengths, cosines and sines; zero without matches. (...)

    Raises:
        ValueError: If the shapes disagree.
    """
    check_same_shape(pred=pred, target=target)
    distances = (shape_features(pred) - shape_features(target)).abs().sum(0)  # (..., M, P)
    num_points = pred.shape[-3] * pred.shape[-2]
    return distances.sum((-2, -1)) / max(num_points, 1)


def euclidean_relation_loss(pred: Tensor, target: Tensor, counts: Sequence[int]) -> Tensor:
    """L1 distance between the relation features of the elements of each sample.

    The distances of a sample are summed over all pairs of different elements, and over the P * P
    pairs of points of two elements. Each pair of elements is taken once. With n matches, the sum is
    divided by (n * P)^2, the number of all pairs of points. The results of all samples are added.

    Args:
        pred: Normalised points of M predictions, sample after sample. (..., M, P, 2)
        target: Normalised points of their ground truths, in matching order. (..., M, P, 2)
        counts: Number of matches of each sample, M in total.

    Returns:
        The distance; zero if no sample has two matches. (...)

    Raises:
        ValueError: If the shapes disagree, or the counts do not add up to M.
    """
    check_same_shape(pred=pred, target=target)
    if sum(counts) != pred.shape[-3]:
        raise InputError(f"counts must add up to {pred.shape[-3]} matches, got {list(counts)}.")
    pairs = [torch.zeros(2, 0, dtype=torch.long)]  # for a batch without samples
    weights: list[float] = []
    first = 0
    for count in counts:
        # Pairs i < j of the elements of the sample, as indices into all M elements.
        sample_pairs = torch.triu_indices(count, count, 1) + first
        pairs.append(sample_pairs)
        weight = 1 / max(count, 1) ** 2
        weights += [weight] * sample_pairs.shape[1]
        first += count
    host_tensors = [torch.cat(pairs, dim=1), torch.tensor(weights, dtype=pred.dtype)]
    # Copies to the device of `pred`, without waiting for its work.
    pair_indices, pair_weights = upload(host_tensors, pred.device)
    pred_relations = relation_features(pred, pair_indices)
    target_relations = relation_features(target, pair_indices)
    distances = (pred_relations - target_relations).abs()  # (3, ..., R, P, P)
    # The mean over pairs of points divides by P^2, and the weight of a pair of elements by n^2.
    return distances.sum(0).mean((-2, -1)) @ pair_weights


@MODELS.register_module()
class EuclideanLoss(MapLoss):
    """Euclidean loss of GeMap between matched elements.

    Args:
        loss_weight: Weight of the loss (lambda in Table A1 of the supplement).
        shape_weight: Weight of the shapes within the loss.
        relation_weight: Weight of the relations within the loss.
        flags: Flags ``last_layer_only`` and ``first_group_only`` of `MapLoss`.
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
        self.shape_weight = shape_weight
        self.relation_weight = relation_weight

    def by_layer(self, pairs: MatchedPairs) -> Tensor:
        """Weighted loss of each decoder layer. Heights are ignored. (L,)"""
        # The M pairs are ordered by decoder layer, and each of the L layers has equally many pairs.
        pred = pairs.by_layer(pairs.pred_pts[..., :2])  # (L, M / L, P, 2)
        target = pairs.by_layer(pairs.gt_pts[..., :2])
        shape = euclidean_shape_loss(pred, target)
        # `pairs.counts` repeats the number of pairs of each sample for every layer. The counts of
        # one layer are enough.
        num_samples = len(pairs.counts) // pairs.num_layers
        counts = pairs.counts[:num_samples]
        relation = euclidean_relation_loss(pred, target, counts)
        return self.loss_weight * (self.shape_weight * shape + self.relation_weight * relation)


def _edges(points: Tensor) -> Tensor:
    """Edges that end in each point; the first one comes from the last point. (2, ..., P)"""
    return points - points.roll(1, -1)


def _turns(first: Tensor, second: Tensor, products: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine of the angle from the first to the second edges.

    Args:
        first: First edges. (2, ...)
        second: Second edges. (2, ...)
        products: Products of the lengths of both edges. (...)
    """
    dot = first[0] * second[0] + first[1] * second[1]
    cross = first[0] * second[1] - first[1] * second[0]
    scale = 1 / (products + NORM_EPS)
    return dot * scale, cross * scale
