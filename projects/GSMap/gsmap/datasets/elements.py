"""``MapElements`` out of the records and fields that hold a sample's map."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from gsmap.datasets.annotations.record import MapInstance
from gsmap.structures.elements import MapElements


def _array(values: Any) -> npt.NDArray[Any]:
    """Return a tensor on any device, or an array-like, as an array."""
    return np.asarray(values.detach().cpu() if hasattr(values, "detach") else values)


def _polylines(instances: Any) -> Any:
    """Return ``pts`` (N, P, 2), of each the first ``num_pts`` (N,) if they differ in number."""
    points = _array(instances["pts"])
    if "num_pts" not in instances:
        return points
    return [
        line[:number] for line, number in zip(points, _array(instances["num_pts"]), strict=True)
    ]


def elements_of_instances(instances: Sequence[MapInstance]) -> MapElements:
    """Convert the ``instances`` of an annotation record."""
    return MapElements.from_polylines([i.points for i in instances], [i.label for i in instances])


def elements_of_truth(info: Mapping[str, Any]) -> MapElements:
    """Convert ``eval_ann_info``: ``polylines``, K x (n, 2 or 3) in metres, and ``labels`` (K,)."""
    return MapElements.from_polylines([_array(p) for p in info["polylines"]], info["labels"])


def elements_of_targets(instances: Any) -> MapElements:
    """Convert ``gt_instances_3d``: ``pts`` in metres (K, P, 2) and ``labels_3d`` (K,)."""
    return MapElements.from_polylines(_polylines(instances), _array(instances["labels_3d"]))


def elements_of_predictions(instances: Any) -> MapElements:
    """Convert ``pred_instances_3d``; ValueError if a point or a score is not finite.

    It has ``pts`` (N, P, 2) in metres, ``labels_3d`` (N,), ``scores_3d`` (N,), where elements have
    points of any number ``num_pts`` (N,), and, where there are
    Gaussians, ``scales`` (N, P, 2) in metres and ``rotations`` (N, P).
    """
    labels, scores = (_array(instances[k]) for k in ("labels_3d", "scores_3d"))
    gaussians = {k: _array(instances[k]) for k in ("scales", "rotations") if k in instances}
    return MapElements.from_polylines(_polylines(instances), labels, scores, **gaussians)
