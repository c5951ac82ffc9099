"""Assignment of predictions to annotated map elements."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from mmdet3d.registry import TASK_UTILS
from mmengine.structures import InstanceData
from scipy.optimize import linear_sum_assignment
from torch import Tensor


class MapMatch(NamedTuple):
    """Matched pairs of one sample, sorted by query. (M,) each"""

    query_inds: Tensor
    gt_inds: Tensor  # the ground truth of each
    order_inds: Tensor  # the closest equivalent point order of that ground truth


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

    @torch.no_grad()
    def assign(
        self,
        pred_instances: InstanceData,
        gt_instances: InstanceData,
        img_meta: dict[str, Any] | None = None,
        repeats: int = 1,
    ) -> MapMatch:
        """Match each ground truth to ``repeats`` predictions: min(N, K * repeats) pairs.

        Predictions have ``scores``, logits (N, classes), ``pts`` normalised (N, P, 2), ground
        truths ``labels`` (K,), ``pts_shifts`` normalised (K, S, P, 2), and both what further costs
        read. The meta dict's ``token`` names the sample in errors.

        Raises:
            FloatingPointError: If a cost (or, without ground truth, a score) is not finite.
        """
        device = pred_instances.scores.device
        if len(gt_instances) == 0:
            self._check_finite(pred_instances.scores, "class scores", img_meta)
            return MapMatch(*(torch.empty(0, dtype=torch.long, device=device) for _ in range(3)))
        costs = [cost(pred_instances, gt_instances, img_meta) for cost in self.match_costs]
        total = torch.stack([cost.float() for cost in costs]).cpu()  # (costs, N, K)
        for cost, values in zip(self.match_costs, total, strict=True):
            self._check_finite(values, type(cost).__name__, img_meta)
        rows, cols = linear_sum_assignment(np.tile(total.sum(0).numpy(), repeats))
        queries = torch.from_numpy(rows).to(device)
        gts = torch.from_numpy(cols % len(gt_instances)).to(device)
        offsets = pred_instances.pts[queries, None] - gt_instances.pts_shifts[gts]  # (M, S, P, 2)
        return MapMatch(queries, gts, offsets.abs().sum((-1, -2)).argmin(-1))

    @staticmethod
    def _check_finite(values: Tensor, what: str, img_meta: dict[str, Any] | None) -> None:
        """Refuse values that the assignment cannot order."""
        if not torch.isfinite(values).all():
            token = (img_meta or {}).get("token", "unknown")
            raise FloatingPointError(
                f"{what} of sample {token!r} is not finite before the assignment: look at the "
                "sample's images and ground truth, then at the learning rate and at the loss scale "
                "of mixed precision."
            )
