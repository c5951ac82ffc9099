"""From class scores and points of all queries to the best detections."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from mmdet3d.structures import Det3DDataSample
from mmengine.model import BaseModule
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.base.references import Reference
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import shortest_orders
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError
from gsmap.utils.targets import NeedsTargets

Tensors = dict[str, Tensor]
Samples = Sequence[Det3DDataSample]
Metas = Sequence[dict[str, Any]]


class Detections(NamedTuple):
    """The best detections of one sample, highest score first. (M,) each"""

    scores: Tensor  # confidence in [0, 1]
    labels: Tensor  # class index
    query_inds: Tensor  # the query of each; one may appear with several classes


class MapCoder:
    """Keep the best pairs of query and class whose points lie on the map or close to it.

    Args:
        grid: The map's extent.
        max_num: Largest number of detections per sample; ValueError if it is not positive.
        margin_m: How far beyond the map a point may lie, in metres, > 0; None keeps all.
        score_threshold: Smallest score to keep; None keeps all.
        unfold_classes: Class indices of lines whose points are put in the order of a short way
            through them (`shortest_orders`), for masks do not see when a line runs back and forth.
    """

    def __init__(
        self,
        grid: BEVGrid,
        max_num: int = 50,
        margin_m: float | None = 5.0,
        score_threshold: float | None = None,
        unfold_classes: Sequence[int] = (),
    ) -> None:
        if max_num < 1:
            raise InputError(f"max_num must be >= 1, got {max_num}.")
        if margin_m is not None and margin_m <= 0:
            raise InputError(f"margin_m must be > 0, got {margin_m}.")
        self.grid, self.max_num = grid, max_num
        self.margin_m, self.score_threshold = margin_m, score_threshold
        self.unfold_classes = tuple(unfold_classes)

    def decode(self, scores: Tensor, pts: Tensor) -> Detections:
        """Select at most ``max_num`` detections; index ``pts`` with their ``query_inds``.

        Class logits (N, classes), points in metres (N, P, 2 or 3).
        """
        found = self.best(scores)
        places = pts if self.margin_m is None else pts[found.query_inds]
        chosen = self.keep_mask(found.scores, places)
        kept = chosen.nonzero()[:, 0]  # the one wait for the device
        return Detections(*(values[kept] for values in found))

    def keep_mask(self, scores: Tensor, pts: Tensor) -> Tensor:
        """Return which detections lie on the map or close to it, and are sure enough.

        Args:
            scores: Their confidence. (M,)
            pts: Their points in metres. (M, P, 2 or 3)

        Returns:
            True for those that count. (M,)
        """
        keep = torch.ones_like(scores, dtype=torch.bool)
        if self.margin_m is not None:
            low, high = constant(pts, [self.grid.x_range, self.grid.y_range]).T
            keep = (pts[..., :2].amin(1) >= low - self.margin_m).all(-1)
            keep &= (pts[..., :2].amax(1) <= high + self.margin_m).all(-1)
        if self.score_threshold is not None:
            keep &= scores > self.score_threshold
        return keep

    def weigh_scores(self, scores: Tensor, fields: Tensors) -> Tensor:
        """Return class logits by which detections are chosen. (N, classes) -> (N, classes)

        Args:
            scores: Class logits. (N, classes)
            fields: What the reference decodes. (N, ...) each
        """
        return scores

    def best(self, scores: Tensor) -> Detections:
        """Return the best pairs of query and class, wherever they lie. (N, classes)"""
        flat = scores.float().sigmoid().flatten()
        best, index = flat.topk(min(self.max_num, len(flat)))
        query = torch.div(index, scores.shape[-1], rounding_mode="floor")
        return Detections(best, index % scores.shape[-1], query)

    def unfold_lines(self, fields: Tensors, labels: Tensor) -> Tensors:
        """Put what belongs to points in the order of a short way through them.

        Args:
            fields: ``pts`` in metres (M, P, 2 or 3), and what else points have. (M, P, ...)
            labels: Class indices; of those not in ``unfold_classes``, points stay. (M,)
        """
        if not self.unfold_classes:
            return fields
        points = fields["pts"]
        lines = torch.isin(labels, constant(labels, self.unfold_classes))
        orders = torch.arange(points.shape[1], device=points.device).repeat(len(points), 1)
        orders[lines] = torch.from_numpy(shortest_orders(points[lines].cpu().numpy())).to(orders)
        rows = torch.arange(len(points), device=points.device)[:, None]
        return {name: values[rows, orders] for name, values in fields.items()}


class DetectionHead(BaseModule, NeedsTargets):
    """What every head shares: detections of its last layer.

    Attributes:
        reference: How references of predictions stand for points.
        coder: The choice of detections.
        not_exported: Why there is no ONNX file of the head; empty if there is one.
    """

    not_exported: str = ""

    reference: Reference
    coder: MapCoder

    def fit_state(self, state: dict[str, Tensor], prefix: str) -> None:
        """Fit a checkpoint's state to the model's, in place."""

    def predict(self, bev_outputs: Tensors, batch_data_samples: Samples) -> list[InstanceData]:
        """Run the head and return its detections."""
        metas = [sample.metainfo for sample in batch_data_samples]
        return self.predict_by_feat(self(bev_outputs), metas)

    def predict_by_feat(self, outputs: Sequence[Any], batch_img_metas: Metas) -> list[InstanceData]:
        """Decode the last layer's predictions, best first.

        They are, per sample, ``scores_3d`` (M,), ``labels_3d`` (M,), ``pts`` (M, P, 2) in metres
        and what else the reference decodes.
        """
        results = []
        for scores, references in zip(outputs[-1].scores, outputs[-1].references, strict=True):
            fields = self.reference.decode(references)
            best = self.coder.decode(self.coder.weigh_scores(scores, fields), fields["pts"])
            chosen = self.coder.unfold_lines(self.select_detections(fields, best), best.labels)
            chosen.update(scores_3d=best.scores, labels_3d=best.labels)
            results.append(InstanceData(metainfo=dict(self.reference.metainfo), **chosen))
        return results

    def select_detections(self, fields: Tensors, best: Detections) -> Tensors:
        """Return what the reference decoded, (N, ...), of the detections. (M, ...)"""
        return {name: value[best.query_inds] for name, value in fields.items()}
