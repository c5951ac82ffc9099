"""Matched predictions and ground truths of a batch, as the losses read them."""

from collections.abc import Sequence
from typing import Any

import torch
from mmdet.utils import reduce_mean
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.maptr.masks import ElementMasks
from gsmap.models.maptr.matching import MapMatch
from gsmap.models.maptr.references import PointReference
from gsmap.ops.gaussian_raster import render_gaussians

GT_FIELDS = {"gt.labels", "gt.pts_shifts", "gt.first_pts", "gt.rasters"}
# what only matched pairs have: a loss may read it, a matching cost may not
MATCHED_GT_FIELDS = {f"gt.{x}" for x in ("pts", "pts_m", "masks", "samples", "counts", "inds")}
AFTER_MATCHING = {"pred.pts_m", "pred.masks", "bev_feats", *MATCHED_GT_FIELDS}


class MatchedPairs:
    """Fields of the M matched pairs of a batch, made when they are first read.

    ``pred.<name>`` is a field of the predictions of one layer, ``gt.<name>`` one of the ground
    truths, samples concatenated. Besides the samples' own fields: ``pred.pts_m``, ``gt.pts_m`` in
    metres (M, P, 2); ``gt.pts``, normalised, in the matched order (M, P, 2); ``pred.masks``,
    rendered from the Gaussians, and ``gt.masks`` (M, H, W); ``gt.samples``, the sample's number in
    the batch (M,); ``gt.inds``, the ground truth's number in its sample (M,); ``gt.counts``, each
    sample's number of pairs, Python integers; ``bev_feats`` of the batch (B, C, H, W).
    ``avg_factor`` is the number of pairs, averaged over ranks, at least 1. ()
    """

    def __init__(
        self,
        predictions: Sequence[InstanceData],
        gts: Sequence[InstanceData],
        matches: Sequence[MapMatch],
        reference: PointReference,
        masks: ElementMasks,
        bev_feats: Tensor | None = None,
    ) -> None:
        self.matches = list(matches)
        self._sides = {"pred": list(predictions), "gt": list(gts)}
        self._reference: Any = reference  # one of Gaussians where masks are read
        self._masks = masks
        counts = [len(match.gt_inds) for match in matches]
        self._made: dict[str, Any] = {"gt.counts": counts, "bev_feats": bev_feats}
        count = predictions[0].scores.new_tensor(float(sum(counts)))
        self.avg_factor: Tensor = reduce_mean(count).clamp(min=1.0)

    def __getitem__(self, field: str) -> Any:
        if field not in self._made:
            self._made[field] = self._make(field)
        return self._made[field]

    def query_scores(self) -> Tensor:
        """Return the class logits of every query, matched or not. (B * N, classes)"""
        return torch.cat([prediction.scores for prediction in self._sides["pred"]])

    def query_labels(self) -> Tensor:
        """Return the class that every query should say, -1 for none. (B * N,)"""
        labels = []
        for prediction, gt, match in zip(*self._sides.values(), self.matches, strict=True):
            sample_labels = gt.labels.new_full((len(prediction.scores),), -1)
            sample_labels[match.query_inds] = gt.labels[match.gt_inds]
            labels.append(sample_labels)
        return torch.cat(labels)

    def _make(self, field: str) -> Tensor:
        """Return a field of the matched pairs. (M, ...)"""
        if field in ("pred.pts_m", "gt.pts_m"):
            return self._reference.metres(self[field.removesuffix("_m")])
        if field == "pred.masks":
            means, scales, rotations = self._reference.space.decode(self["pred.references"])
            return render_gaussians(means, scales, rotations, self._masks.grid)
        if field == "gt.masks" and self._masks.source == "points":
            return self._masks.draw(self["gt.pts_m"], self["gt.labels"], self._masks.grid)
        if field == "gt.inds":
            return torch.cat([match.gt_inds for match in self.matches])
        if field == "gt.samples":
            return torch.cat(
                [m.gt_inds.new_full(m.gt_inds.shape, i) for i, m in enumerate(self.matches)]
            )
        side, name = field.split(".")
        pairs = list(zip(self._sides[side], self.matches, strict=True))
        if field == "gt.pts":
            return torch.cat([gt.pts_shifts[m.gt_inds, m.order_inds] for gt, m in pairs])
        index = "query_inds" if side == "pred" else "gt_inds"
        return torch.cat([sample[name][getattr(match, index)] for sample, match in pairs])
