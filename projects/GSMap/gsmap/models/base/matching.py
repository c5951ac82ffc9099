"""Assignment of predictions to ground-truth map elements."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch
from mmdet.models.task_modules.assigners.match_cost import FocalLossCost
from mmdet3d.registry import TASK_UTILS
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gsmap.models.base.pairs import BuiltHead, GroundTruth, MapMatches, Predictions, SampleView
from gsmap.models.base.parts import WeightConfig
from gsmap.structures.tensors import upload
from gsmap.utils.errors import InputError, NotFiniteError


class HostCosts(NamedTuple):
    """Inputs of the assignment on the CPU, for L decoder layers with N queries each.

    Attributes:
        samples: Values of the n costs for each sample. Rows are the predictions of all layers,
            columns the ground truths of the sample. (n, L * N, K) each
        labels: Class indices of the T ground truths of the batch. (T,)
    """

    samples: list[Tensor]
    labels: Tensor


class MapAssigner:
    """Hungarian assignment by the sum of costs, and choice of point orders (MapTR Eqs. 3-5).

    Args:
        match_costs: Configs of the costs. A cost is called for each sample with the predictions of
            all L layers, the ground truth and the meta dict. It returns a matrix. (L * N, K)

    Raises:
        ValueError: If there is no cost.
    """

    def __init__(self, match_costs: Sequence[dict[str, Any]]) -> None:
        if not match_costs:
            raise InputError("match_costs must hold at least one cost.")
        self.match_costs = [TASK_UTILS.build(cost) for cost in match_costs]
        self.names = [type(cost).__name__ for cost in self.match_costs]
        points_cost = PointsCost()  # replaced by the first `PointsCost` of the configs
        for cost in self.match_costs:
            if isinstance(cost, PointsCost):
                points_cost = cost
                break
        self.between_points = points_cost.between_points  # distance that selects the point order

    @torch.no_grad()
    def assign(
        self,
        predictions: Predictions,
        truths: GroundTruth,
        metas: Sequence[dict[str, Any]],
        repeats: int = 1,
    ) -> MapMatches:
        """Match each ground truth with ``repeats`` predictions of its sample, in every layer.

        The costs of the whole batch are copied from the device at once, and the matches are copied
        to the device at once.

        Args:
            predictions: Predictions of L layers, N queries each.
            truths: Ground truth, with K elements in a sample.
            metas: Meta dict of each sample, with the ``token`` of the sample for errors.
            repeats: Number of predictions that each ground truth is matched with.

        Returns:
            The matches, min(N, K * repeats) for each sample and layer.

        Raises:
            FloatingPointError: If a cost is not finite, or if a score of a sample without ground
                truth is not finite.
            ValueError: If the matrix of a cost has another shape.
        """
        num_layers = len(predictions.layers)
        num_queries = predictions.scores.shape[1] // num_layers
        host_costs = self.costs(predictions, truths, metas)
        pairs = []
        for sample_costs, meta in zip(host_costs.samples, metas, strict=True):
            queries = []
            gts = []
            layer_costs = sample_costs.unflatten(1, (num_layers, num_queries)).unbind(1)
            for costs in layer_costs:  # (n, N, K) each
                rows, cols = solve_assignment(costs, self.names, img_meta=meta, repeats=repeats)
                queries.append(rows)
                gts.append(cols)
            pairs.append((torch.stack(queries), torch.stack(gts)))  # (L, m) each
        return self.choose_orders(predictions, truths, pairs=pairs, labels=host_costs.labels)

    @torch.no_grad()
    def assign_known(
        self,
        predictions: Predictions,
        truths: GroundTruth,
        pairs: Sequence[tuple[Tensor, Tensor]],
    ) -> MapMatches:
        """Create the matches of pairs that are known before the decoder runs.

        Args:
            predictions: Predictions of L layers, N queries each.
            truths: Ground truth.
            pairs: Matched pairs of each sample, as increasing indices of the queries and indices of
                the ground truths, on the CPU. (m,) each
        """
        num_layers = len(predictions.layers)
        layer_pairs = []
        for queries, gts in pairs:
            layer_pairs.append((queries.expand(num_layers, -1), gts.expand(num_layers, -1)))
        labels = truths.labels.cpu()
        return self.choose_orders(predictions, truths, pairs=layer_pairs, labels=labels)

    def choose_orders(
        self,
        predictions: Predictions,
        truths: GroundTruth,
        pairs: Sequence[tuple[Tensor, Tensor]],
        labels: Tensor,
    ) -> MapMatches:
        """Choose the closest point order of each matched pair.

        Args:
            predictions: Predictions of L layers, N queries each.
            truths: Ground truth.
            pairs: Matched pairs of each sample: indices of the queries and of the ground truths, on
                the CPU. (L, m) each
            labels: Class indices of the T ground truths of the batch, on the CPU. (T,)

        Returns:
            The matches.
        """
        num_layers = len(predictions.layers)
        num_queries = predictions.scores.shape[1] // num_layers
        # Among the queries of all layers, query i of layer l has the index first_query[l] + i.
        first_query = num_queries * torch.arange(num_layers)[:, None]
        indices = []
        counts = []
        for index, (query, gt) in enumerate(pairs):
            sample = torch.full_like(query, index)
            row = gt + truths.first[index]  # index among the ground truths of all samples
            indices.append(torch.stack([sample, query, query + first_query, gt, row]))
            counts.append(query.shape[1])
        host_indices = torch.cat(indices, dim=2)  # (5, L, M), M pairs in each layer
        # `upload` copies to the device without waiting for its pending work.
        (device_indices,) = upload([host_indices], predictions.scores.device)
        samples, query_inds, joined_inds, gt_inds, rows = device_indices.unbind(0)
        orders = truths.pts_shifts[rows]  # (L, M, S, P, 2 or 3)
        pts = predictions.pts[samples, joined_inds]
        repeated_pts = pts[:, :, None].expand_as(orders)  # once for each of S equivalent orders
        distances = self.between_points(repeated_pts, orders)
        return MapMatches(
            samples=samples,
            query_inds=query_inds,
            joined_inds=joined_inds,
            gt_inds=gt_inds,
            rows=rows,
            order_inds=distances.sum((-1, -2)).argmin(-1),  # (L, M), sum over points and axes
            host_labels=labels[host_indices[-1]],  # the last entry of `indices` is `row`
            counts=counts,
        )

    def costs(
        self, predictions: Predictions, truths: GroundTruth, metas: Sequence[dict[str, Any]]
    ) -> HostCosts:
        """Compute all costs and copy them to the CPU, with one synchronisation.

        Args:
            predictions: Predictions of L layers, N queries each.
            truths: Ground truth.
            metas: Meta dict of each sample.

        Raises:
            FloatingPointError: If a score of a sample without ground truth is not finite.
            ValueError: If the matrix of a cost has another shape.
        """
        class_costs = self._class_costs(predictions)
        num_rows = predictions.scores.shape[1]
        # All tensors are copied as one vector, which is then split again. First are the matrices of
        # each sample, one per cost. A sample without ground truth has a check of its scores instead
        # of matrices. Last are the labels, which are exact in float32.
        blocks: list[Tensor] = []
        for index, count in enumerate(truths.counts):
            pred = predictions.sample(index)
            truth = truths.sample(index)
            if not count:
                blocks.append((pred.scores * 0).sum(0))  # 0, or NaN if a score is not finite
                continue
            for cost, by_class in zip(self.match_costs, class_costs, strict=True):
                if by_class is None:
                    matrix = cost(pred, truth, metas[index])
                    check_shape(cost, matrix, expected=(num_rows, count))
                else:
                    matrix = by_class[index][:, truth.labels]
                blocks.append(matrix.float())
        blocks.append(truths.labels.float())
        values = torch.cat([block.flatten() for block in blocks]).cpu()
        host_blocks = iter(values.split([block.numel() for block in blocks]))
        samples = []
        for count, meta in zip(truths.counts, metas, strict=True):
            if not count:
                check_finite(next(host_blocks)[None], ["class scores"], img_meta=meta)
                samples.append(values.new_zeros(1, num_rows, 0))  # costs without ground truths
                continue
            matrices = [next(host_blocks).view(num_rows, count) for _ in self.match_costs]
            samples.append(torch.stack(matrices))
        return HostCosts(samples, labels=next(host_blocks).long())

    def _class_costs(self, predictions: Predictions) -> list[Tensor | None]:
        """Compute costs by class; None for a cost with other inputs. (B, L * N, classes) each"""
        # The costs of mmdet read the scores of predictions and the labels of ground truths. Here,
        # they receive the predictions of all samples, and each class in place of a ground truth.
        scores = predictions.scores
        all_scores = SimpleNamespace(scores=scores.flatten(0, 1))
        all_classes = SimpleNamespace(labels=torch.arange(scores.shape[2], device=scores.device))
        costs: list[Tensor | None] = []
        for cost in self.match_costs:
            if depends_on_class_only(cost):
                class_costs = cost(all_scores, all_classes)  # (B * L * N, classes)
                costs.append(class_costs.view(scores.shape))
            else:
                costs.append(None)
        return costs


def check_shape(cost: Any, matrix: Tensor, expected: tuple[int, int]) -> None:
    """Require one value of a cost for each pair of a prediction and a ground truth.

    Without this check, a transposed matrix would be read as values of other pairs.

    Args:
        cost: Built cost, for the message.
        matrix: Matrix that it has returned.
        expected: Number of predictions of all layers, and number of ground truths.

    Raises:
        ValueError: If the matrix has another shape.
    """
    if tuple(matrix.shape) != expected:
        raise InputError(
            f"{type(cost).__name__} must return the shape {expected}, predictions of all layers x "
            f"ground truths, got {tuple(matrix.shape)}."
        )


def depends_on_class_only(cost: Any) -> bool:
    """Whether a cost depends on scores and labels only, so that it can be computed by class.

    Args:
        cost: Built cost.
    """
    # A subclass may read other inputs. With `binary_input`, the cost compares masks.
    return type(cost) is FocalLossCost and not cost.binary_input


def solve_assignment(
    costs: Tensor, names: Sequence[str], img_meta: dict[str, Any] | None, repeats: int = 1
) -> tuple[Tensor, Tensor]:
    """Find the pairs of predictions and ground truths with the least sum of costs.

    Args:
        costs: Costs of N predictions with K ground truths, on the CPU. (n, N, K)
        names: Names of the costs, for the message. (n,)
        img_meta: Meta dict with the token of the sample, for the message.
        repeats: Number of predictions that each ground truth is matched with.

    Returns:
        Increasing indices of the predictions, and indices of the ground truths, with
        m = min(N, K * repeats). (m,) each

    Raises:
        FloatingPointError: If a cost is not finite.
    """
    check_finite(costs, names, img_meta=img_meta)
    repeated_costs = np.tile(costs.sum(0).numpy(), repeats)  # (N, repeats * K)
    rows, cols = linear_sum_assignment(repeated_costs)
    # The columns k, K + k, 2 K + k, .. belong to ground truth k. With K = 0, there are no columns.
    num_truths = max(costs.shape[2], 1)
    return torch.from_numpy(rows), torch.from_numpy(cols % num_truths)


def check_finite(values: Tensor, names: Sequence[str], img_meta: dict[str, Any] | None) -> None:
    """Raise an error if values are not finite.

    Args:
        values: Costs or predictions. (n, ...)
        names: Name of each entry of the first axis. (n,)
        img_meta: Meta dict with the token of the sample, for the message.

    Raises:
        FloatingPointError: If a value is not finite.
    """
    is_finite = values.isfinite().flatten(1).all(1)
    if not is_finite.all():
        token = (img_meta or {}).get("token", "unknown")
        name = names[int(is_finite.int().argmin())]  # the first one that is not finite
        raise NotFiniteError(
            f"{name} of sample {token!r} is not finite before the assignment: look at the "
            "sample's images and ground truth, then at the learning rate and at the loss scale "
            "of mixed precision."
        )


class MapCost:
    """Base class of matching costs that need certain outputs of the head, which `check` requires.

    Other costs need not derive from it.

    Args:
        weight: Weight of the cost, or a weight for each class, applied to the ground truths of the
            class.
    """

    def __init__(self, weight: WeightConfig = 1.0) -> None:
        self.weight = weight

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if a head lacks an input of the cost. Called when the head is built."""

    def __call__(
        self, pred_instances: SampleView, gt_instances: SampleView, img_meta: Any = None
    ) -> Tensor:
        """Weighted cost of each prediction with each ground truth.

        Args:
            pred_instances: Predictions of a sample.
            gt_instances: Ground truth of the sample.
            img_meta: Meta dict of the sample.

        Returns:
            The costs. (N, K)
        """
        raise NotImplementedError


class PointsCost(MapCost):
    """Base class of matching costs of points. Its distance also selects the closest point order."""

    def between_points(self, pts: Tensor, targets: Tensor) -> Tensor:
        """Distance along each axis. (..., P, 2 or 3) and (..., P, 2 or 3) -> (..., P, 2 or 3)"""
        return (pts - targets).abs()
