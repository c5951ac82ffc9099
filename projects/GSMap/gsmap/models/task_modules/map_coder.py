"""From class scores and points of all queries to the best detections."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from mmdet3d.registry import TASK_UTILS
from torch import Tensor


class Detections(NamedTuple):
    """The best detections of one sample, highest score first.

    Attributes:
        scores: Confidence in [0, 1]. (M,)
        labels: Class index. (M,)
        query_inds: The query of each; one query may appear with several classes. (M,)
    """

    scores: Tensor
    labels: Tensor
    query_inds: Tensor


@TASK_UTILS.register_module()
class MapCoder:
    """Keep the best pairs of query and class whose box lies inside a range.

    Args:
        max_num: Largest number of detections per sample.
        post_center_range: x, y minima, then maxima, in metres, that the points must keep to; None
            keeps all.
        score_threshold: Smallest score to keep; None keeps all.

    Raises:
        ValueError: If ``max_num`` is not positive or the range does not have four values.
    """

    def __init__(
        self,
        max_num: int = 50,
        post_center_range: Sequence[float] | None = None,
        score_threshold: float | None = None,
    ) -> None:
        if max_num < 1:
            raise ValueError(f"max_num must be >= 1, got {max_num}.")
        if post_center_range is not None and len(post_center_range) != 4:
            raise ValueError(f"post_center_range must hold 4 values, got {len(post_center_range)}.")
        self.max_num = max_num
        self.post_center_range = post_center_range
        self.score_threshold = score_threshold

    def decode(self, scores: Tensor, pts: Tensor) -> Detections:
        """Select the detections of one sample.

        Args:
            scores: Class logits. (N, classes)
            pts: Points in metres. (N, P, 2)

        Returns:
            At most ``max_num`` detections; index ``pts`` with their ``query_inds``.
        """
        num_classes = scores.shape[-1]
        flat = scores.float().sigmoid().flatten()
        best, index = flat.topk(min(self.max_num, len(flat)))
        query = torch.div(index, num_classes, rounding_mode="floor")
        keep = torch.ones_like(best, dtype=torch.bool)
        if self.post_center_range is not None:
            limits = pts.new_tensor(self.post_center_range)
            low, high = pts[query].amin(1), pts[query].amax(1)
            keep = (low >= limits[:2]).all(-1) & (high <= limits[2:]).all(-1)
        if self.score_threshold is not None:
            keep &= best > self.score_threshold
        return Detections(best[keep], (index % num_classes)[keep], query[keep])
