"""From class scores and points of all queries to the best detections."""

from typing import NamedTuple

import torch
from torch import Tensor

from gsmap.structures.grid import BEVGrid


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
    """

    def __init__(
        self,
        grid: BEVGrid,
        max_num: int = 50,
        margin_m: float | None = 5.0,
        score_threshold: float | None = None,
    ) -> None:
        if max_num < 1:
            raise ValueError(f"max_num must be >= 1, got {max_num}.")
        if margin_m is not None and margin_m <= 0:
            raise ValueError(f"margin_m must be > 0, got {margin_m}.")
        self.grid, self.max_num = grid, max_num
        self.margin_m, self.score_threshold = margin_m, score_threshold

    def decode(self, scores: Tensor, pts: Tensor) -> Detections:
        """Select at most ``max_num`` detections; index ``pts`` with their ``query_inds``.

        Class logits (N, classes), points in metres (N, P, 2 or 3).
        """
        best, labels, query = self.best(scores)
        keep = torch.ones_like(best, dtype=torch.bool)
        if self.margin_m is not None:
            low, high = pts.new_tensor([self.grid.x_range, self.grid.y_range]).T
            chosen = pts[query][..., :2]
            keep = (chosen.amin(1) >= low - self.margin_m).all(-1)
            keep &= (chosen.amax(1) <= high + self.margin_m).all(-1)
        if self.score_threshold is not None:
            keep &= best > self.score_threshold
        return Detections(best[keep], labels[keep], query[keep])

    def best(self, scores: Tensor) -> Detections:
        """Return the best pairs of query and class, wherever they lie. (N, classes)"""
        flat = scores.float().sigmoid().flatten()
        best, index = flat.topk(min(self.max_num, len(flat)))
        query = torch.div(index, scores.shape[-1], rounding_mode="floor")
        return Detections(best, index % scores.shape[-1], query)
