"""How predicted Gaussians live: overlap of their masks with the map, their sizes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from mmdet3d.registry import METRICS
from mmengine.evaluator import BaseMetric
from mmengine.logging import print_log
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.ops.polyline_raster import draw_polylines
from gsmap.ops.soft_iou import pairwise_soft_iou
from gsmap.structures.gaussians import AT_FLOOR, Gaussians, extents_along_line
from gsmap.structures.grid import BEVGrid

Array = npt.NDArray[Any]

SCORE_THRESHOLD = 0.3
PIXEL_M = 0.3
LINE_WIDTH_M = 0.75  # in the mask of a ground truth


@METRICS.register_module()
class GaussianMetric(BaseMetric):
    """Soft IoU of the masks of predictions and ground truths, and the sizes of the Gaussians.

    Predictions of a class are assigned to its ground truths by the soft IoU of their masks. Figures
    are of predictions with a score of 0.3 or more; models without Gaussians have none.
    """

    default_prefix = "gaussians"

    def process(self, data_batch: Any, data_samples: Sequence[dict[str, Any]]) -> None:
        """Measure the samples of a batch.

        They have ``token``, ``x_range`` and ``y_range`` in metres, ``eval_ann_info`` and
        ``pred_instances_3d`` (docs/architecture.md), the latter with ``min_scale_m``.
        """
        for sample in data_samples:
            measured = sample.get("eval_ann_info") and "scales" in sample["pred_instances_3d"]
            self.results.append((sample["token"], self._measure(sample) if measured else None))

    def _measure(self, sample: dict[str, Any]) -> tuple[Array, dict[int, tuple[Array, Array]]]:
        """Return which Gaussians are at their floor; per class soft IoUs, sizes (n, 2)."""
        predicted, truth = sample["pred_instances_3d"], sample["eval_ann_info"]
        grid = BEVGrid(sample["x_range"], sample["y_range"]).rasterized(PIXEL_M)
        chosen = predicted["scores_3d"] >= SCORE_THRESHOLD
        labels = predicted["labels_3d"][chosen].cpu()
        means, scales, rotations = (
            predicted[name][chosen].float().cpu() for name in ("pts", "scales", "rotations")
        )
        means = means[..., :2]
        masks = render_gaussians(means, scales, rotations, grid)
        extents = extents_along_line(Gaussians(means, scales, rotations))
        figures = {}
        for label in set(truth["labels"].tolist()) | set(labels.tolist()):
            own = labels == label
            lines = [truth["polylines"][i] for i in np.flatnonzero(truth["labels"] == label)]
            iou = self._matched_iou(masks[own], lines, grid)
            figures[label] = iou, extents[own].flatten(0, 1).numpy()
        at_floor = (scales < AT_FLOOR * predicted["min_scale_m"]).all(-1)
        return at_floor.flatten().numpy(), figures

    def _matched_iou(self, masks: Tensor, lines: Sequence[Array], grid: BEVGrid) -> Array:
        """Return the soft IoU of every matched pair of one class. (n,)"""
        if not len(masks) or not lines:
            return np.empty(0)
        vertices = (torch.from_numpy(line[None, :, :2].astype(np.float32)) for line in lines)
        truth = torch.cat([draw_polylines(line, grid, LINE_WIDTH_M) for line in vertices])
        iou = pairwise_soft_iou(masks, truth).numpy()
        return iou[linear_sum_assignment(-iou)]

    def compute_metrics(self, results: list[tuple[str, Any]]) -> dict[str, float]:
        """Average over all samples and print a table.

        Returns per class ``soft_iou/<name>``, ``sigma_along/<name>`` and ``sigma_across/<name>``
        (medians in metres), and ``at_floor``, a share; nothing without Gaussians.
        """
        samples = [measured for _, measured in sorted(dict(results).items()) if measured]
        if not samples:
            return {}
        floor = np.concatenate([at_floor for at_floor, _ in samples])
        metrics = {"at_floor": float(floor.mean()) if len(floor) else 0.0}
        rows = [
            f"Gaussians of predictions with a score of {SCORE_THRESHOLD} or more, "
            f"{100 * metrics['at_floor']:.1f} % of them at their smallest size:"
        ]
        for label, name in enumerate(self.dataset_meta["classes"]):
            of_class = [figures[label] for _, figures in samples if label in figures]
            iou = np.concatenate([np.empty(0), *(iou for iou, _ in of_class)])
            size = np.concatenate([np.empty((0, 2)), *(size for _, size in of_class)])
            overlap = "none matched"
            if len(iou):
                metrics[f"soft_iou/{name}"] = float(iou.mean())
                overlap = f"soft IoU {iou.mean():.3f} of {len(iou)} matched masks"
            if not len(size):
                rows.append(f"  {name}: no confident prediction")
                continue
            along, across = np.median(size, 0).tolist()
            metrics[f"sigma_along/{name}"], metrics[f"sigma_across/{name}"] = along, across
            rows.append(
                f"  {name}: {overlap}, sigma {along:.2f} m along, {across:.2f} m across (medians)"
            )
        print_log("\n".join(rows), "current")
        return metrics
