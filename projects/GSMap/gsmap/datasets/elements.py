"""Conversion of map annotations and predictions to ``MapElements``.

A sample has K ground truths or N predictions. Points are in metres in the annotation frame, and
labels are indices of classes. For targets and predictions, ``instances`` is mmengine's
``InstanceData``, or a mapping with equal keys.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from gsmap.datasets.annotations.record import MapInstance
from gsmap.structures.elements import MapElements


def _array(values: Any) -> npt.NDArray[Any]:
    """Convert a tensor on any device, or an array-like, to an array."""
    # Only tensors have this method. The test needs no import of torch.
    if hasattr(values, "detach"):
        values = values.detach().cpu()
    return np.asarray(values)


def _polylines(instances: Any) -> Any:
    """Return ``pts`` (N, P, 2), or a list of lines without padding if ``num_pts`` exists."""
    points = _array(instances["pts"])
    if "num_pts" not in instances:
        return points
    polylines = []
    for line, num_points in zip(points, _array(instances["num_pts"]), strict=True):
        polylines.append(line[:num_points])
    return polylines


def elements_of_instances(instances: Sequence[MapInstance]) -> MapElements:
    """Convert the ``instances`` of a sample in an annotation file to map elements."""
    polylines = []
    labels = []
    for instance in instances:
        polylines.append(instance.points)
        labels.append(instance.label)
    return MapElements.from_polylines(polylines, labels=labels)


def elements_of_truth(info: Mapping[str, Any]) -> MapElements:
    """Convert the ground truth of a sample, ``eval_ann_info``, to map elements.

    Args:
        info: ``polylines`` in metres in the annotation frame, K x (n, 2 or 3), and ``labels`` (K,).

    Raises:
        ValueError: If a point is not finite (raised by `MapElements`).
    """
    polylines = [_array(polyline) for polyline in info["polylines"]]
    return MapElements.from_polylines(polylines, labels=info["labels"])


def elements_of_targets(instances: Any) -> MapElements:
    """Convert the training targets of a sample, ``gt_instances_3d``, to map elements.

    Args:
        instances: ``pts`` in metres in the annotation frame (K, P, 2) and ``labels_3d`` (K,). If
            the elements have different numbers of points, also ``num_pts`` (K,).
    """
    labels = _array(instances["labels_3d"])
    return MapElements.from_polylines(_polylines(instances), labels=labels)


def elements_of_predictions(instances: Any) -> MapElements:
    """Convert the predictions of a sample, ``pred_instances_3d``, to map elements.

    Args:
        instances: ``pts`` in metres in the annotation frame (N, P, 2), ``labels_3d`` (N,) and
            ``scores_3d`` in [0, 1] (N,). If the elements have different numbers of points, also
            ``num_pts`` (N,), after which ``pts`` are padding. If the model predicts Gaussians, also
            their standard deviations ``scales`` in metres (N, P, 2) and the angles ``rotations`` of
            their first axes from +x in radians (N, P).

    Raises:
        ValueError: If a point or a rotation is not finite, a score is not in [0, 1], or a scale is
            not positive and finite (raised by `MapElements`).
    """
    gaussians = {}  # arguments of `from_polylines`; empty without Gaussians
    for key in ("scales", "rotations"):
        if key in instances:
            gaussians[key] = _array(instances[key])
    return MapElements.from_polylines(
        _polylines(instances),
        labels=_array(instances["labels_3d"]),
        scores=_array(instances["scores_3d"]),
        **gaussians,
    )
