"""Training targets of the reference's annotated elements, as the data pipeline makes them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from mmengine.structures import InstanceData

from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.transforms.map_targets import map_targets

NUM_POINTS = 20
X_RANGE_M, Y_RANGE_M = (-15.0, 15.0), (-30.0, 30.0)


def gt_instances(elements: Sequence[dict[str, Any]]) -> InstanceData:
    """Make the training targets of annotated elements, ``label`` and ``pts`` (n, 2) in metres."""
    instances = [
        MapInstance(element["label"], np.asarray(element["pts"], np.float64))
        for element in elements
    ]
    return map_targets(instances, NUM_POINTS, X_RANGE_M, Y_RANGE_M)
