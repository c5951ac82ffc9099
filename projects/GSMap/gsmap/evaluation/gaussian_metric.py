"""Health of predicted Gaussians: overlap of their masks with the map, and their sizes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from mmdet3d.registry import METRICS
from mmengine.logging import print_log
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gsmap.evaluation.gathered_metric import GatheredMetric
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.ops.polyline_raster import draw_polylines
from gsmap.ops.soft_iou import pairwise_soft_iou
from gsmap.structures.gaussians import AT_FLOOR, Gaussians, extents_along_line
from gsmap.structures.grid import BEVGrid

Array = npt.NDArray[Any]

SCORE_THRESHOLD = 0.3  # smallest score of a prediction that counts
PIXEL_M = 0.3  # size of a pixel of the masks
LINE_WIDTH_M = 0.75  # width of a ground-truth line in its mask


@METRICS.register_module()
class GaussianMetric(GatheredMetric):
    """Metric of the soft IoU of predicted and true masks, and of the sizes of the Gaussians.

    Predictions of a class are assigned to its ground truths by the soft IoU of their masks. Only
    predictions with a score of 0.3 or more count. A model without Gaussians has no figures. The
    sizes of a Gaussian are its standard deviations along and across the line.
    """

    default_prefix = "gaussians"

    def process(self, data_batch: Any, data_samples: Sequence[dict[str, Any]]) -> None:
        """Measure the samples of a batch.

        Args:
            data_batch: Not used.
            data_samples: Samples with ``token``, ``x_range`` and ``y_range`` in metres,
                ``eval_ann_info`` and ``pred_instances_3d`` (docs/architecture.md).
                ``pred_instances_3d`` contains ``scores_3d``, ``labels_3d``, ``pts`` and, for a
                model with Gaussians, ``scales``, ``rotations`` and ``min_scale_m``, the lower bound
                of sizes in metres.
        """
        for sample in data_samples:
            has_gaussians = "scales" in sample["pred_instances_3d"]
            measurement = None  # for a sample without annotations, or a model without Gaussians
            if sample.get("eval_ann_info") and has_gaussians:
                measurement = self._measure(sample)
            self.results.append((sample["token"], measurement))

    def _measure(self, sample: dict[str, Any]) -> tuple[Array, dict[int, tuple[Array, Array]]]:
        """Measure the Gaussians of one sample.

        Returns:
            Whether each Gaussian of the sample is at the lower bound of sizes (n,), and a dict by
            label. Its values are two arrays: the soft IoU of each matched pair of the class
            (m,), and the sizes in metres of each Gaussian of the class, along and across the line
            (k, 2). Predictions below `SCORE_THRESHOLD` are left out.
        """
        predictions = sample["pred_instances_3d"]
        truth = sample["eval_ann_info"]
        extent = BEVGrid(x_range=sample["x_range"], y_range=sample["y_range"])
        # Pixels of about PIXEL_M, which need not divide the map.
        x_m, y_m = extent.extent_m
        grid = extent.with_size(round(y_m / PIXEL_M), round(x_m / PIXEL_M))
        is_confident = predictions["scores_3d"] >= SCORE_THRESHOLD
        labels = predictions["labels_3d"][is_confident].cpu()
        means = predictions["pts"][is_confident].float().cpu()[..., :2]
        scales = predictions["scales"][is_confident].float().cpu()
        rotations = predictions["rotations"][is_confident].float().cpu()
        masks = render_gaussians(means, scales=scales, rotations=rotations, grid=grid)
        extents = extents_along_line(Gaussians(means, scales, rotations))
        figures = {}
        for label in set(truth["labels"].tolist()) | set(labels.tolist()):
            is_class = labels == label
            gt_index = np.flatnonzero(truth["labels"] == label)
            lines = [truth["polylines"][k] for k in gt_index]
            iou = self._matched_iou(masks[is_class], lines=lines, grid=grid)
            sizes = extents[is_class].flatten(start_dim=0, end_dim=1).numpy()
            figures[label] = (iou, sizes)
        # AT_FLOOR is a factor slightly above 1, as sizes approach their lower bound but stay above.
        at_floor = (scales < AT_FLOOR * predictions["min_scale_m"]).all(dim=-1)
        return at_floor.flatten().numpy(), figures

    def _matched_iou(self, masks: Tensor, lines: Sequence[Array], grid: BEVGrid) -> Array:
        """Compute the soft IoU of every matched pair of one class. (n,)

        Args:
            masks: Masks of the predictions. (N, H, W)
            lines: Vertices of each ground truth in metres. K x (P, D)
            grid: Extent and raster of the masks.
        """
        if not len(masks) or not lines:
            return np.empty(0)
        gt_masks = []
        for line in lines:
            vertices = torch.from_numpy(line[None, :, :2].astype(np.float32))
            gt_masks.append(draw_polylines(vertices, grid, width_m=LINE_WIDTH_M))
        iou = pairwise_soft_iou(masks, torch.cat(gt_masks)).numpy()
        pred_index, gt_index = linear_sum_assignment(-iou)  # negative, as it minimises the sum
        return iou[pred_index, gt_index]

    def compute_metrics(self, results: list[tuple[str, Any]]) -> dict[str, float]:
        """Compute the figures of all samples and log them as a table.

        Args:
            results: Token of each sample, and the value of `_measure` or None.

        Returns:
            ``soft_iou/<name>`` (mean), ``sigma_along/<name>`` and ``sigma_across/<name>`` (medians
            in metres) of each class for which they are defined, and ``at_floor``, the share of
            Gaussians at the lower bound of sizes; empty without Gaussians.
        """
        floors = []
        class_figures = []
        # The dict keeps one of several results of a sample. Sorting makes the order of the samples
        # independent of the processes that measured them.
        for _, measurement in sorted(dict(results).items()):
            if measurement:
                floor, figures = measurement
                floors.append(floor)
                class_figures.append(figures)
        if not floors:
            return {}
        at_floor = np.concatenate(floors)
        metrics = {"at_floor": float(at_floor.mean()) if len(at_floor) else 0.0}
        rows = [
            f"Gaussians of predictions with a score of {SCORE_THRESHOLD} or more, "
            f"{100 * metrics['at_floor']:.1f} % of them at their smallest size:"
        ]
        for label, name in enumerate(self.dataset_meta["classes"]):
            ious = [np.empty(0)]  # an empty array, as `concatenate` needs at least one
            sizes = [np.empty((0, 2))]
            for figures in class_figures:
                if label in figures:
                    sample_iou, sample_sizes = figures[label]
                    ious.append(sample_iou)
                    sizes.append(sample_sizes)
            iou = np.concatenate(ious)
            size = np.concatenate(sizes)
            overlap = "none matched"
            if len(iou):
                metrics[f"soft_iou/{name}"] = float(iou.mean())
                overlap = f"soft IoU {iou.mean():.3f} of {len(iou)} matched masks"
            if not len(size):
                rows.append(f"  {name}: no confident prediction")
                continue
            along, across = np.median(size, axis=0).tolist()
            metrics[f"sigma_along/{name}"] = along
            metrics[f"sigma_across/{name}"] = across
            rows.append(
                f"  {name}: {overlap}, sigma {along:.2f} m along, {across:.2f} m across (medians)"
            )
        print_log("\n".join(rows), logger="current")
        return metrics
