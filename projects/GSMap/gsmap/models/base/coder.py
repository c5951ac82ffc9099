"""Selection of detections from the class scores and points of all queries.

N is the number of queries, and M is the number of detections.
"""

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
    """Detections of one sample, highest score first.

    Attributes:
        scores: Confidences in [0, 1]. (M,)
        labels: Class indices. (M,)
        query_inds: Indices of the queries; a query may occur with several classes. (M,)
    """

    scores: Tensor
    labels: Tensor
    query_inds: Tensor


class MapCoder:
    """Selects detections: the pairs of query and class with the highest scores.

    Detections with points far outside of the map are dropped.

    Args:
        grid: Extent of the map.
        max_num: Largest number of detections per sample, >= 1.
        margin_m: Largest distance of a point outside of the map, in metres, > 0. With None, no
            detection is dropped because of its points.
        score_threshold: Detections with this score or a lower one are dropped. With None, no
            detection is dropped because of its score.
        unfold_classes: Class indices of lines whose points are reordered to a short path
            (`shortest_orders`). This is for models that are trained with losses of masks, which do
            not penalise lines that run back and forth.

    Raises:
        ValueError: If ``max_num`` or ``margin_m`` is out of range.
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
        self.grid = grid
        self.max_num = max_num
        self.margin_m = margin_m
        self.score_threshold = score_threshold
        self.unfold_classes = tuple(unfold_classes)

    def decode(self, scores: Tensor, pts: Tensor) -> Detections:
        """Select at most ``max_num`` detections.

        Args:
            scores: Class logits. (N, classes)
            pts: Points in metres. (N, P, 2 or 3)
        """
        best = self.best(scores)
        # Without a margin, `keep_mask` does not read the points, so they need not be selected.
        best_pts = pts if self.margin_m is None else pts[best.query_inds]
        is_valid = self.keep_mask(best.scores, best_pts)
        # The number of valid detections must be known here, so the host waits for the device. It is
        # the only such wait in this method.
        rows = is_valid.nonzero()[:, 0]
        return Detections(
            scores=best.scores[rows], labels=best.labels[rows], query_inds=best.query_inds[rows]
        )

    def keep_mask(self, scores: Tensor, pts: Tensor) -> Tensor:
        """Mask of the detections near the map with a score above the threshold.

        Args:
            scores: Confidences in [0, 1]. (M,)
            pts: Points in metres. (M, P, 2 or 3)

        Returns:
            True for the detections to keep. (M,)
        """
        keep = torch.ones_like(scores, dtype=torch.bool)
        if self.margin_m is not None:
            # Corners (x, y) of the map. `constant` uploads and caches them.
            low, high = constant(pts, [self.grid.x_range, self.grid.y_range]).T
            keep = (pts[..., :2].amin(1) >= low - self.margin_m).all(-1)
            keep &= (pts[..., :2].amax(1) <= high + self.margin_m).all(-1)
        if self.score_threshold is not None:
            keep &= scores > self.score_threshold
        return keep

    @property
    def weighs_scores(self) -> bool:
        """Whether `weigh_scores` changes scores."""
        return False

    def weigh_scores(self, scores: Tensor, fields: Tensors) -> Tensor:
        """Class logits for the selection of detections; a subclass may change them here.

        Args:
            scores: Class logits. (N, classes)
            fields: Decoded references, by name. (N, ...) each

        Returns:
            Class logits. (N, classes)
        """
        return scores

    def best(self, scores: Tensor) -> Detections:
        """Pairs of query and class with the highest scores, without a check of their positions.

        Args:
            scores: Class logits. (N, classes)
        """
        confidences = scores.float().sigmoid().flatten()
        num = min(self.max_num, len(confidences))
        best_confidences, inds = confidences.topk(num)
        num_classes = scores.shape[-1]  # index i is query i // num_classes, class i % num_classes
        return Detections(
            scores=best_confidences,
            labels=inds % num_classes,
            query_inds=torch.div(inds, num_classes, rounding_mode="floor"),
        )

    def unfold_lines(self, fields: Tensors, labels: Tensor) -> Tensors:
        """Reorder the points of lines to a short path.

        Args:
            fields: ``pts`` in metres (M, P, 2 or 3), and other fields of the points, by name.
                (M, P, ...)
            labels: Class indices. Points of classes not in ``unfold_classes`` keep their order.
                (M,)

        Returns:
            The reordered fields, by name.
        """
        if not self.unfold_classes:
            return fields
        points = fields["pts"]
        is_line = torch.isin(labels, constant(labels, self.unfold_classes))
        orders = torch.arange(points.shape[1], device=points.device).repeat(len(points), 1)
        # New order of the points of each line, computed in numpy on the host. (lines, P)
        line_orders = shortest_orders(points[is_line].cpu().numpy())
        orders[is_line] = torch.from_numpy(line_orders).to(orders)
        # The new point j of detection i is its previous point ``orders[i, j]``.
        rows = torch.arange(len(points), device=points.device)[:, None]  # (M, 1)
        return {name: values[rows, orders] for name, values in fields.items()}


class DetectionHead(BaseModule, NeedsTargets):
    """Base class of map heads, which predict the detections of the last decoder layer.

    A call of a head returns the predictions of each decoder layer, objects with the class logits
    ``scores`` (B, N, classes) and the ``references`` (B, N, ...). References are the geometry that
    the queries predict.

    Attributes:
        reference: Decoding of references to points in metres.
        coder: Selection of detections.
        not_exported: Reason why the head has no ONNX export; empty if it has one.
    """

    not_exported: str = ""

    reference: Reference
    coder: MapCoder

    def fit_state(self, state: dict[str, Tensor], prefix: str) -> None:
        """Adapt the state of a checkpoint to the head, in place.

        The base class changes nothing. A subclass may rename or reshape tensors here.

        Args:
            state: Tensors of the checkpoint, by name.
            prefix: Prefix of the names of the head.
        """

    def predict(self, bev_outputs: Tensors, batch_data_samples: Samples) -> list[InstanceData]:
        """Run the head and decode its detections.

        Args:
            bev_outputs: Outputs of the encoder, with ``bev_feats`` (B, C, H, W).
            batch_data_samples: Samples of the batch.

        Returns:
            Detections of each sample, as in `predict_by_feat`.
        """
        metas = [sample.metainfo for sample in batch_data_samples]
        return self.predict_by_feat(self(bev_outputs), metas)

    def predict_by_feat(self, outputs: Sequence[Any], batch_img_metas: Metas) -> list[InstanceData]:
        """Decode the predictions of the last layer.

        Args:
            outputs: Predictions of each layer, with ``scores`` and ``references``.
            batch_img_metas: Meta dict of each sample, for subclasses; not used in this class.

        Returns:
            Detections of each sample, highest score first: ``scores_3d`` (M,), ``labels_3d`` (M,),
            ``pts`` (M, P, 2 or 3) in metres, and the other fields of the reference.
        """
        last = outputs[-1]
        results = []
        for logits, references in zip(last.scores, last.references, strict=True):  # each sample
            scores, fields = self.decode(logits, references)
            best = self.coder.decode(scores, fields["pts"])
            best_fields = self.select_detections(fields, best)
            detections = self.coder.unfold_lines(best_fields, best.labels)
            detections["scores_3d"] = best.scores
            detections["labels_3d"] = best.labels
            metainfo = dict(self.reference.metainfo)  # `InstanceData` accepts no other mapping
            results.append(InstanceData(metainfo=metainfo, **detections))
        return results

    def decode(self, scores: Tensor, references: Any) -> tuple[Tensor, Tensors]:
        """Decode the elements of a sample, and weigh their scores by their geometry.

        Args:
            scores: Class logits. (N, classes)
            references: Encoded geometry of the elements.

        Returns:
            Class logits for the selection of detections (N, classes), and the decoded fields by
            name. (N, ...) each
        """
        fields = self.reference.decode(references)
        return self.coder.weigh_scores(scores, fields), fields

    def select_detections(self, fields: Tensors, best: Detections) -> Tensors:
        """Select the fields of the detections from the fields of all queries.

        Args:
            fields: Decoded references, by name. (N, ...) each
            best: Selected pairs of query and class.

        Returns:
            The fields by name. (M, ...) each
        """
        return {name: values[best.query_inds] for name, values in fields.items()}
