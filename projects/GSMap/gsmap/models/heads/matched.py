"""Matched predictions and ground truths of a batch, as the losses read them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from mmdet.utils import reduce_mean
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.heads.masks import ElementMasks
from gsmap.models.heads.references import PointReference
from gsmap.models.task_modules.map_assigner import MapMatch

GT_FIELDS = (
    "labels", "pts", "pts_m", "pts_shifts", "first_pts", "masks", "rasters", "samples", "counts",
    "inds",
)  # fmt: skip
# what only matched pairs have: a loss may read it, a matching cost may not
AFTER_MATCHING = frozenset(
    {"pred.pts_m", "pred.masks", "bev_feats"}
    | {f"gt.{name}" for name in ("pts", "pts_m", "masks", "samples", "counts", "inds")}
)


@dataclass
class MapTargets:
    """What the predictions of one decoder layer should be.

    Attributes:
        matches: Matched pairs of every sample.
        labels: Class of every query, the number of classes for background. (B * N,)
        pts: Normalised points of the matched ground truth, in the matched order, samples
            concatenated. (M, P, 2)
        avg_factor: Matched elements in the batch, averaged over ranks, at least 1. ()
    """

    matches: list[MapMatch]
    labels: Tensor
    pts: Tensor
    avg_factor: Tensor


def collect_targets(
    predictions: Sequence[InstanceData],
    gts: Sequence[InstanceData],
    matches: list[MapMatch],
    num_classes: int,
) -> MapTargets:
    """Turn the samples' matches into targets of the whole batch."""
    labels, pts = [], []
    for prediction, gt, match in zip(predictions, gts, matches, strict=True):
        sample_labels = gt.labels.new_full((len(prediction.scores),), num_classes)
        sample_labels[match.query_inds] = gt.labels[match.gt_inds]
        labels.append(sample_labels)
        pts.append(gt.pts_shifts[match.gt_inds, match.order_inds])
    matched = torch.cat(pts)
    count = reduce_mean(matched.new_tensor(float(len(matched))))
    return MapTargets(matches, torch.cat(labels), matched, count.clamp(min=1.0))


class MatchedPairs:
    """Fields of the M matched pairs of a batch, made when they are first read.

    ``pred.<name>`` is a field of the predictions, ``gt.<name>`` one of the ground truths, samples
    concatenated. Besides the samples' own fields: ``pred.pts_m``, ``gt.pts_m`` in metres (M, P, 2);
    ``gt.pts``, normalised, in the matched order (M, P, 2); ``pred.masks``, rendered from the
    Gaussians, and ``gt.masks`` (M, H, W); ``gt.samples``, the sample's number in the batch (M,);
    ``gt.inds``, the ground truth's number in its sample (M,); ``gt.counts``, each sample's number
    of pairs, Python integers; ``bev_feats`` of the batch (B, C, H, W).

    Args:
        predictions: Predictions of one layer, per sample.
        gts: Prepared ground truths, per sample.
        targets: Their matches.
        reference: What the predictions' references mean.
        masks: How masks are made.
        bev_feats: BEV features, for losses that read them. (B, C, H, W)
    """

    def __init__(
        self,
        predictions: Sequence[InstanceData],
        gts: Sequence[InstanceData],
        targets: MapTargets,
        reference: PointReference,
        masks: ElementMasks,
        bev_feats: Tensor | None = None,
    ) -> None:
        self._sides = {"pred": list(predictions), "gt": list(gts)}
        self._targets = targets
        self._reference = reference
        self._masks = masks
        counts = [len(match.gt_inds) for match in targets.matches]
        self._made: dict[str, Any] = {
            "gt.pts": targets.pts,
            "gt.counts": counts,
            "bev_feats": bev_feats,
        }

    def __getitem__(self, field: str) -> Any:
        if field not in self._made:
            self._made[field] = self._make(field)
        return self._made[field]

    def _make(self, field: str) -> Tensor:
        """Return a field of the matched pairs. (M, ...)"""
        if field in ("pred.pts_m", "gt.pts_m"):
            return self._reference.metres(self[field.removesuffix("_m")])
        if field == "pred.masks":
            gaussians = self._reference.gaussians(self["pred.references"])
            return self._masks.render(gaussians, self._masks.grid)
        if field == "gt.masks" and self._masks.source == "points":
            return self._masks.draw(self["gt.pts_m"], self["gt.labels"], self._masks.grid)
        if field == "gt.samples":
            counts = torch.tensor(self["gt.counts"])
            samples = torch.arange(len(counts)).repeat_interleave(counts)
            return samples.to(self._targets.labels.device)
        if field == "gt.inds":
            return torch.cat([match.gt_inds for match in self._targets.matches])
        side, name = field.split(".")
        index = "query_inds" if side == "pred" else "gt_inds"
        pairs = zip(self._sides[side], self._targets.matches, strict=True)
        return torch.cat([sample[name][getattr(match, index)] for sample, match in pairs])
