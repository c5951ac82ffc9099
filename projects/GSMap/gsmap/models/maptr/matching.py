"""Assignment of predictions to annotated map elements, and MapTR's cost of points."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import TASK_UTILS
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gsmap.models.maptr.pairs import BuiltHead, MapMatch, SamplePredictions, SampleTruth
from gsmap.models.maptr.parts import WEIGHT, weights_of


class MapAssigner:
    """Hungarian assignment under summed costs, then each pair's point order (MapTR Eqs. 3-5).

    Args:
        match_costs: Configs of the costs. Each is called with predictions, ground truth and the
            meta dict and returns (N, K).

    Raises:
        ValueError: If there is no cost.
    """

    def __init__(self, match_costs: Sequence[dict[str, Any]]) -> None:
        if not match_costs:
            raise ValueError("match_costs must hold at least one cost.")
        self.match_costs = [TASK_UTILS.build(cost) for cost in match_costs]
        self.names = [type(cost).__name__ for cost in self.match_costs]
        of_points = (cost for cost in self.match_costs if isinstance(cost, OrderedPointsCost))
        self.between_points = next(of_points, OrderedPointsCost()).between_points

    @torch.no_grad()
    def assign(
        self,
        pred_instances: SamplePredictions,
        gt_instances: SampleTruth,
        img_meta: dict[str, Any] | None = None,
        repeats: int = 1,
    ) -> MapMatch:
        """Match each ground truth to ``repeats`` predictions: min(N, K * repeats) pairs.

        Args:
            pred_instances: The sample's predictions, N queries.
            gt_instances: Its ground truth, K elements.
            img_meta: Its ``token`` names the sample in errors.
            repeats: How often each ground truth may be matched.

        Raises:
            FloatingPointError: If a cost (or, without ground truth, a score) is not finite.
        """
        device, num_gts = pred_instances.scores.device, len(gt_instances.labels)
        if num_gts == 0:
            check_finite(pred_instances.scores[None], ["class scores"], img_meta)
            return MapMatch(*torch.empty(3, 0, dtype=torch.long, device=device))
        sample = pred_instances, gt_instances, img_meta
        total = torch.stack([cost(*sample).float() for cost in self.match_costs]).cpu()
        queries, gts = (part.to(device) for part in assigned(total, self.names, img_meta, repeats))
        orders = gt_instances.pts_shifts[gts]  # (M, S, P, 2)
        distances = self.between_points(pred_instances.pts[queries, None].expand_as(orders), orders)
        return MapMatch(queries, gts, distances.sum((-1, -2)).argmin(-1))


def assigned(
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
        raise FloatingPointError(
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
        self, pred_instances: SamplePredictions, gt_instances: SampleTruth, img_meta: Any = None
    ) -> Tensor:
        """Return the weighted cost of each prediction with each ground truth. (N, K)"""
        raise NotImplementedError


def order_distances(pts: Tensor, pts_shifts: Tensor) -> Tensor:
    """Return the summed L1 distance of every prediction to every order of every ground truth.

    ValueError if the numbers of points differ. (N, P, 2), (K, S, P, 2) -> (N, K, S)
    """
    if pts.shape[-2:] != pts_shifts.shape[-2:]:
        raise ValueError(
            f"predictions of {tuple(pts.shape[-2:])} points and ground truth of "
            f"{tuple(pts_shifts.shape[-2:])} do not fit: set the same number of points in the head "
            "and in the pipeline."
        )
    num_gts, num_orders = pts_shifts.shape[:2]
    distances = torch.cdist(pts.flatten(1), pts_shifts.flatten(0, 1).flatten(1), p=1)
    return distances.view(len(pts), num_gts, num_orders)


@TASK_UTILS.register_module()
class OrderedPointsCost(MapCost):
    """L1 distance to the closest equivalent point order (MapTR Eq. 5).

    Args:
        weight: Weight of the cost.
    """

    def __init__(self, weight: WEIGHT = 5.0) -> None:
        super().__init__(weight)

    def between_points(self, pts: Tensor, targets: Tensor) -> Tensor:
        """Return the distance of each coordinate, which also chooses the order of a pair."""
        return (pts - targets).abs()

    def __call__(
        self, pred_instances: SamplePredictions, gt_instances: SampleTruth, img_meta: Any = None
    ) -> Tensor:
        """Compare normalised ``pts`` (N, P, 2) with ``pts_shifts`` (K, S, P, 2). (N, K)"""
        distances = order_distances(pred_instances.pts, gt_instances.pts_shifts).amin(-1)
        return distances * weights_of(self.weight, gt_instances.labels)
