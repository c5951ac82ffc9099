"""Whether predicted Gaussians live: overlap of their masks with the map, their sizes."""

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


@METRICS.register_module()
class GaussianMetric(BaseMetric):
    """Soft IoU of the masks of predictions and ground truths, and the sizes of the Gaussians.

    Predictions of a class are assigned to its ground truths by the soft IoU of their masks. Figures
    are of confident predictions only; models without Gaussians have none.

    Args:
        score_threshold: Smallest score of a confident prediction.
        pixel_m: Side of a pixel of the masks in metres.
        line_width_m: Width of a line in the ground-truth mask, in metres.
        collect_device: As in mmengine.
        prefix: Prefix of the figures' names.
    """

    def __init__(
        self,
        score_threshold: float = 0.3,
        pixel_m: float = 0.3,
        line_width_m: float = 0.75,
        collect_device: str = "cpu",
        prefix: str = "gaussians",
    ) -> None:
        super().__init__(collect_device, prefix)
        self.score_threshold = score_threshold
        self.pixel_m = pixel_m
        self.line_width_m = line_width_m

    def process(self, data_batch: Any, data_samples: Sequence[dict[str, Any]]) -> None:
        """Measure the samples of a batch."""
        for sample in data_samples:
            predicted, truth = sample["pred_instances_3d"], sample.get("eval_ann_info")
            figures = {}
            if "scales" in predicted and truth is not None:
                figures = self.measure(predicted, truth, sample["x_range"], sample["y_range"])
            self.results.append((sample["token"], figures))

    def measure(
        self,
        predicted: dict[str, Any],
        truth: dict[str, Any],
        x_range: tuple[float, float],
        y_range: tuple[float, float],
    ) -> dict[str, Any]:
        """Measure one sample.

        Args:
            predicted: ``scores_3d`` (N,), ``labels_3d`` (N,), ``pts`` (N, P, 2), ``scales`` (N, P,
                2), ``rotations`` (N, P) and ``min_scale_m``.
            truth: ``polylines``, list of (n, 2), and ``labels`` (K,).
            x_range: Smallest and largest x of the map in metres.
            y_range: Smallest and largest y of the map in metres.

        Returns:
            ``iou``: per class the soft IoU of each matched pair; ``extents``: per class sigma along
            and across (n, 2) in metres; ``at_floor``: whether each Gaussian is at its smallest.
        """
        grid = BEVGrid(x_range, y_range).rasterized(self.pixel_m)
        chosen = predicted["scores_3d"] >= self.score_threshold
        labels = predicted["labels_3d"][chosen]
        gaussians = Gaussians(
            *(predicted[name][chosen].float().cpu() for name in ("pts", "scales", "rotations"))
        )
        gaussians = Gaussians(gaussians.means[..., :2], gaussians.scales, gaussians.rotations)
        masks = render_gaussians(gaussians.means, gaussians.scales, gaussians.rotations, grid)
        extents = extents_along_line(gaussians)
        floor = AT_FLOOR * predicted["min_scale_m"]
        figures: dict[str, Any] = {
            "iou": {},
            "extents": {},
            "at_floor": (gaussians.scales < floor).all(-1).flatten().numpy(),
        }
        for label in set(truth["labels"].tolist()) | set(labels.tolist()):
            own = (labels == label).cpu()
            lines = [
                line
                for line, other in zip(truth["polylines"], truth["labels"], strict=True)
                if other == label
            ]
            figures["iou"][label] = self._matched_iou(masks[own], lines, grid)
            figures["extents"][label] = extents[own].flatten(0, 1).numpy()
        return figures

    def _matched_iou(self, masks: Tensor, lines: Sequence[Array], grid: BEVGrid) -> Array:
        """Return the soft IoU of every matched pair of one class. (n,)"""
        if not len(masks) or not lines:
            return np.empty(0)
        longest = max(len(line) for line in lines)
        padded = [np.pad(line[:, :2], ((0, longest - len(line)), (0, 0)), "edge") for line in lines]
        vertices = torch.from_numpy(np.stack(padded).astype(np.float32))
        iou = pairwise_soft_iou(masks, draw_polylines(vertices, grid, self.line_width_m)).numpy()
        return iou[linear_sum_assignment(-iou)]

    def compute_metrics(self, results: list[tuple[str, dict[str, Any]]]) -> dict[str, float]:
        """Average over all samples and print a table.

        Returns:
            Per class ``soft_iou/<name>``, ``sigma_along/<name>`` and ``sigma_across/<name>``
            (medians in metres), and ``at_floor``, a share; empty without Gaussians.
        """
        samples = [figures for _, figures in sorted(dict(results).items()) if figures]
        if not samples:
            return {}
        floor = np.concatenate([figures["at_floor"] for figures in samples])
        metrics = {"at_floor": float(floor.mean()) if len(floor) else 0.0}
        rows = []
        for label, name in enumerate(self.dataset_meta["classes"]):
            ious = [figures["iou"][label] for figures in samples if label in figures["iou"]]
            sizes = [figures["extents"][label] for figures in samples if label in figures["iou"]]
            iou, size = (
                np.concatenate([np.empty(0), *ious]),
                np.concatenate([np.empty((0, 2)), *sizes]),
            )
            if len(iou):
                metrics[f"soft_iou/{name}"] = float(iou.mean())
            if len(size):
                along, across = np.median(size, 0)
                metrics[f"sigma_along/{name}"] = float(along)
                metrics[f"sigma_across/{name}"] = float(across)
            rows.append(self._row(name, iou, size))
        table = "\n".join(rows)
        print_log(
            f"Gaussians of predictions with a score of {self.score_threshold} or more, "
            f"{100 * metrics['at_floor']:.1f} % of them at their smallest size:\n{table}",
            "current",
        )
        return metrics

    @staticmethod
    def _row(name: str, iou: Array, size: Array) -> str:
        """Return a class's line of the table."""
        if not len(size):
            return f"  {name}: no confident prediction"
        along, across = np.median(size, 0)
        overlap = (
            f"soft IoU {iou.mean():.3f} of {len(iou)} matched masks" if len(iou) else "none matched"
        )
        return f"  {name}: {overlap}, sigma {along:.2f} m along, {across:.2f} m across (medians)"
