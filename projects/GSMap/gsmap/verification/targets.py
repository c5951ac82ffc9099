"""Training targets of the reference's annotated elements."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from mmengine.structures import InstanceData

from gsmap.geometry.polylines import PADDING, bounding_boxes, clamp, equivalent_orders, resample

NUM_POINTS = 20
X_RANGE_M, Y_RANGE_M = (-15.0, 15.0), (-30.0, 30.0)


def gt_instances(elements: Sequence[dict[str, Any]]) -> InstanceData:
    """Make the training targets of annotated elements.

    Args:
        elements: ``label`` and ``pts`` (n, 2) in metres.

    Returns:
        ``labels_3d``, ``pts``, ``pts_shifts``, ``boxes``, as the data pipeline makes them.
    """
    lines = [np.asarray(element["pts"], np.float64) for element in elements]
    pts = np.zeros((0, NUM_POINTS, 2))
    shifts = np.zeros((0, NUM_POINTS - 1, NUM_POINTS, 2))
    boxes = np.zeros((0, 4))
    if lines:
        boxes = np.stack([bounding_boxes(clamp(line, X_RANGE_M, Y_RANGE_M)) for line in lines])
        pts = np.stack([resample(line, NUM_POINTS) for line in lines])
        shifts = np.stack([equivalent_orders(line, NUM_POINTS) for line in lines])
    used = shifts != PADDING
    pts = clamp(pts, X_RANGE_M, Y_RANGE_M)
    shifts = np.where(used, clamp(shifts, X_RANGE_M, Y_RANGE_M), PADDING)
    return InstanceData(
        labels_3d=torch.tensor([element["label"] for element in elements], dtype=torch.long),
        pts=torch.from_numpy(pts).float(),
        pts_shifts=torch.from_numpy(shifts).float(),
        boxes=torch.from_numpy(boxes).float(),
    )
