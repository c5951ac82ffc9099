"""Assignment of predictions to annotated map elements."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from mmdet.models.task_modules.assigners.match_cost import FocalLossCost
from mmdet3d.registry import TASK_UTILS
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gsmap.models.base.pairs import BuiltHead, GroundTruth, MapMatches, Predictions, SampleView
from gsmap.models.base.parts import WEIGHT
from gsmap.structures.tensors import upload
from gsmap.utils.errors import InputError, NotFiniteError


class MapAssigner:
    """Hungarian assignment under summed costs, then each pair's point order (MapTR Eqs. 3-5).

    Args:
        match_costs: Configs of the costs. Each is called for every sample, with the predictions of
            all layers, the ground truth and the meta dict, and returns (N, K).

    Raises:
        ValueError: If there is no cost.
    """

    def __init__(self, match_costs: Sequence[dict[str, Any]]) -> None:
        if not match_costs:
            raise InputError("match_costs must hold at least one cost.")
        self.match_costs = [TASK_UTILS.build(cost) for cost in match_costs]
        self.names = [type(cost).__name__ for cost in self.match_costs]
        of_points = (cost for cost in self.match_costs if isinstance(cost, PointsCost))
        self.between_points = next(of_points, PointsCost()).between_points

    @torch.no_grad()
    def assign(
        self,
        predictions: Predictions,
        truths: GroundTruth,
        metas: Sequence[dict[str, Any]],
        repeats: int = 1,
    ) -> tuple[MapMatches, list[int]]:
        """Match each ground truth to ``repeats`` predictions of its sample, in every layer.

        All costs are read from the device in one copy, and all matches return in one.

        Args:
            predictions: Predictions of L layers, N queries each.
            truths: Ground truth, K elements of a sample.
            metas: Meta dict of each sample; its ``token`` names the sample in errors.
            repeats: How often each ground truth may be matched.

        Returns:
            The matches, and how many each sample has in a layer: min(N, K * repeats).

        Raises:
            FloatingPointError: If a cost (or, without ground truth, a score) is not finite.
        """
        layers = len(predictions.layers)
        num_queries = predictions.scores.shape[1] // layers
        pairs = []
        of_samples, labels = self.costs(predictions, truths, metas)
        for index, costs in enumerate(of_samples):
            by_layer = costs.unflatten(1, (layers, num_queries)).unbind(1)
            found = [solve_assignment(own, self.names, metas[index], repeats) for own in by_layer]
            query, gt = (torch.stack(part) for part in zip(*found, strict=True))  # (L, m)
            pairs.append((query, gt))
        return self.choose_orders(predictions, truths, pairs, labels)

    @torch.no_grad()
    def assign_known(
        self,
        predictions: Predictions,
        truths: GroundTruth,
        pairs: Sequence[tuple[Tensor, Tensor]],
    ) -> tuple[MapMatches, list[int]]:
        """Return matches that are known before the decoder runs, in the closest point order.

        Args:
            predictions: Predictions of L layers, N queries each.
            truths: Ground truth.
            pairs: Of each sample the numbers of its matched queries, increasing, and the number of
                the ground truth of each, on the CPU. 2 x (m,)

        Returns:
            As `assign`.
        """
        layers = len(predictions.layers)
        by_layer = [tuple(part.expand(layers, -1) for part in sample) for sample in pairs]
        return self.choose_orders(predictions, truths, by_layer, truths.labels.cpu())

    def choose_orders(
        self,
        predictions: Predictions,
        truths: GroundTruth,
        pairs: Sequence[tuple[Tensor, ...]],
        labels: Tensor,
    ) -> tuple[MapMatches, list[int]]:
        """Return pairs as matches, each in the point order that is closest.

        Args:
            predictions: Predictions of L layers, N queries each.
            truths: Ground truth.
            pairs: Of each sample the numbers of queries and of ground truths, on the CPU. 2 x
                (L, m)
            labels: Classes of all ground truth, on the CPU. (T,)

        Returns:
            As `assign`.
        """
        layers = len(predictions.layers)
        first_query = predictions.scores.shape[1] // layers * torch.arange(layers)[:, None]
        matches = []
        for index, (query, gt) in enumerate(pairs):
            sample = torch.full_like(query, index)
            row = gt + truths.first[index]
            matches.append(torch.stack([sample, query, query + first_query, gt, row]))
        counts = [query.shape[1] for query, _ in pairs]
        on_host = torch.cat(matches, 2)  # (5, L, M)
        (packed,) = upload([on_host], predictions.scores.device)
        samples, queries, joined, gts, rows = packed.unbind(0)
        orders = truths.pts_shifts[rows]  # (L, M, S, P, 2 or 3)
        pts = predictions.pts[samples, joined]
        distances = self.between_points(pts[:, :, None].expand_as(orders), orders)
        order = distances.sum((-1, -2)).argmin(-1)
        host_labels = labels[on_host[-1]]
        return MapMatches(samples, queries, joined, gts, rows, order, host_labels), counts

    def costs(
        self, predictions: Predictions, truths: GroundTruth, metas: Sequence[dict[str, Any]]
    ) -> tuple[list[Tensor], Tensor]:
        """Return what the assignment reads, on the host: the one wait for the device.

        Returns:
            The costs of each sample, (n, L * N, K), and the classes of all ground truth. (T,)

        Raises:
            FloatingPointError: If a score of a sample without ground truth is not finite.
        """
        shape = predictions.scores.shape
        flat = SimpleNamespace(scores=predictions.scores.flatten(0, 1))
        classes = SimpleNamespace(labels=torch.arange(shape[2], device=predictions.scores.device))
        by_class = [
            cost(flat, classes).view(shape) if depends_on_class_only(cost) else None
            for cost in self.match_costs
        ]
        parts: list[Tensor] = []
        for index, count in enumerate(truths.counts):
            pred, truth = predictions.sample(index), truths.sample(index)
            if not count:
                parts.append((pred.scores * 0).sum(0))  # not a number if a score is not finite
                continue
            for cost, of_classes in zip(self.match_costs, by_class, strict=True):
                if of_classes is None:
                    parts.append(cost(pred, truth, metas[index]).float())
                else:
                    parts.append(of_classes[index][:, truth.labels].float())
        parts.append(truths.labels.float())
        host = torch.cat([part.flatten() for part in parts]).cpu()
        read = iter(host.split([part.numel() for part in parts]))
        found = []
        for count, meta in zip(truths.counts, metas, strict=True):
            if not count:
                check_finite(next(read)[None], ["class scores"], meta)
            own = [next(read).view(shape[1], count) for _ in self.match_costs if count]
            found.append(torch.stack(own) if own else host.new_zeros(1, shape[1], 0))
        return found, next(read).long()


def depends_on_class_only(cost: Any) -> bool:
    """Return whether a cost of mmdet depends on scores and label alone, so one a class will do."""
    return type(cost) is FocalLossCost and not cost.binary_input


def solve_assignment(
    costs: Tensor, names: Sequence[str], img_meta: dict[str, Any] | None, repeats: int = 1
) -> tuple[Tensor, Tensor]:
    """Return the pairs of least summed cost: predictions in order, and the ground truth of each.

    Args:
        costs: Costs of N predictions with K ground truths, on the CPU. (n, N, K)
        names: What each cost is, for the message. (n,)
        img_meta: Has the token of the sample, likewise.
        repeats: How often each ground truth may be matched.

    Raises:
        FloatingPointError: If a cost is not finite.
    """
    check_finite(costs, names, img_meta)
    rows, cols = linear_sum_assignment(np.tile(costs.sum(0).numpy(), repeats))
    return torch.from_numpy(rows), torch.from_numpy(cols % max(costs.shape[2], 1))


def check_finite(values: Tensor, names: Sequence[str], img_meta: dict[str, Any] | None) -> None:
    """Refuse values that the assignment cannot order.

    Args:
        values: Costs or predictions. (n, ...)
        names: What each entry of the first axis is. (n,)
        img_meta: Has the token of the sample, for the message.

    Raises:
        FloatingPointError: If a value is not finite.
    """
    finite = values.isfinite().flatten(1).all(1)
    if not finite.all():
        token = (img_meta or {}).get("token", "unknown")
        what = names[int(finite.int().argmin())]
        raise NotFiniteError(
            f"{what} of sample {token!r} is not finite before the assignment: look at the "
            "sample's images and ground truth, then at the learning rate and at the loss scale "
            "of mixed precision."
        )


class MapCost:
    """A matching cost that says what it needs when the head is built; others may be costs as well.

    Args:
        weight: Weight of the cost, or one for each class; a pair has that of its ground truth.
    """

    def __init__(self, weight: WEIGHT = 1.0) -> None:
        self.weight = weight

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if a head lacks what the cost reads; called when the head is built."""

    def __call__(
        self, pred_instances: SampleView, gt_instances: SampleView, img_meta: Any = None
    ) -> Tensor:
        """Return the weighted cost of each prediction with each ground truth. (N, K)"""
        raise NotImplementedError


class PointsCost(MapCost):
    """A matching cost of points, whose distance also chooses the point order of a matched pair."""

    def between_points(self, pts: Tensor, targets: Tensor) -> Tensor:
        """Return the distance of each coordinate. 2 x (..., P, 2 or 3) -> (..., P, 2 or 3)"""
        return (pts - targets).abs()
