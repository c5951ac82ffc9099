"""Map elements to draw, read off a data sample."""

from typing import Any

import numpy as np

from gsmap.datasets.elements import (
    elements_of_predictions,
    elements_of_targets,
    elements_of_truth,
)
from gsmap.structures.elements import MapElements


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
        return elements_of_truth(info)
    instances = getattr(data_sample, "gt_instances_3d", None)
    if instances is None or "pts" not in instances:
        return None
    return elements_of_targets(instances)


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
    found = elements_of_predictions(instances)
    order = np.argsort(found.confidence, kind="stable")
    order = order[found.confidence[order] >= score_thr]
    if max_num is not None:
        order = order[max(len(order) - max_num, 0) :]
    return found.select(order)
