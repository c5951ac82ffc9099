"""Map elements to draw, read off a data sample."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor


def _array(values: Any) -> np.ndarray:
    """Return a tensor or array-like as a numpy array."""
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)


@dataclass(frozen=True)
class MapElements:
    """Polylines with their classes, in metres of the annotation frame.

    Args:
        polylines: One array per element. N x (n, 2 or 3)
        labels: Class index of each. (N,)
        scores: Confidence in [0, 1], or None for ground truth. (N,)
        scales: Standard deviations of each vertex's Gaussian in metres, if it has one. (N, P, 2)
        rotations: Angle of its first axis from +x in radians, anticlockwise. (N, P)

    Raises:
        ValueError: If the lengths disagree.
    """

    polylines: tuple[np.ndarray, ...]
    labels: np.ndarray
    scores: np.ndarray | None = None
    scales: np.ndarray | None = None
    rotations: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name in ("labels", "scores", "scales", "rotations"):
            values = getattr(self, name)
            if values is not None and len(values) != len(self.polylines):
                raise ValueError(
                    f"{name} must have one entry for each of the {len(self.polylines)} polylines, "
                    f"got {len(values)}."
                )

    def __len__(self) -> int:
        return len(self.polylines)

    @property
    def has_gaussians(self) -> bool:
        """Whether every vertex carries a Gaussian."""
        return self.scales is not None and self.rotations is not None


def ground_truth_elements(data_sample: Any) -> MapElements | None:
    """Read a sample's ground truth: full-resolution polylines, or else the training targets.

    Args:
        data_sample: A ``Det3DDataSample`` with ``eval_ann_info`` among its meta data, or
            ``gt_instances_3d``.

    Returns:
        The elements, or None if no ground truth is known.
    """
    info = data_sample.metainfo.get("eval_ann_info")
    if info is not None:
        polylines = tuple(_array(line) for line in info["polylines"])
        return MapElements(polylines, _array(info["labels"]).astype(int))
    instances = getattr(data_sample, "gt_instances_3d", None)
    if instances is None or "pts" not in instances:
        return None
    return MapElements(tuple(_array(instances.pts)), _array(instances.labels_3d).astype(int))


def predicted_elements(
    data_sample: Any, score_thr: float = 0.0, max_num: int | None = None
) -> MapElements | None:
    """Read the predictions of a sample, the most confident last so that they are drawn on top.

    Args:
        data_sample: A ``Det3DDataSample`` with ``pred_instances_3d``.
        score_thr: Smallest score that is kept.
        max_num: Largest number of elements kept, by score; None keeps all.

    Returns:
        The elements, or None if the sample has no predictions.
    """
    instances = getattr(data_sample, "pred_instances_3d", None)
    if instances is None or "pts" not in instances:
        return None
    scores = _array(instances.scores_3d).astype(float)
    order = np.argsort(scores, kind="stable")
    order = order[scores[order] >= score_thr]
    if max_num is not None:
        order = order[max(len(order) - max_num, 0) :]
    gaussians = {
        name: _array(instances[name])[order]
        for name in ("scales", "rotations")
        if name in instances
    }
    return MapElements(
        polylines=tuple(_array(instances.pts)[order]),
        labels=_array(instances.labels_3d)[order].astype(int),
        scores=scores[order],
        **gaussians,
    )
