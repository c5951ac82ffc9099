"""Training targets of map elements: resampled points and their equivalent orders."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from mmcv.transforms import BaseTransform
from mmdet3d.registry import TRANSFORMS
from mmengine.structures import InstanceData

from gsmap.datasets.annotations.record import MapInstance
from gsmap.structures.elements import ground_truth_elements
from gsmap.structures.polylines import (
    PADDING,
    bounding_boxes,
    clamp,
    equivalent_orders,
    is_closed,
    resample,
    sampled_orders,
)
from gsmap.utils.errors import InputError

ORDERS = ("vertices", "points")


def map_targets(
    instances: Sequence[MapInstance],
    num_points: int,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    dim: int = 2,
    rng: np.random.Generator | None = None,
    orders_of: str = "vertices",
) -> InstanceData:
    """Make a sample's training targets, as MapTR does ("v2" orders).

    Args:
        instances: Map elements at full resolution.
        num_points: Points P per element.
        x_range: Smallest and largest x in metres; points beyond are moved onto the edge.
        y_range: Smallest and largest y in metres.
        dim: Coordinates per point, 2 or 3; heights are interpolated and kept as they are.
        rng: Draws the orders of rings with more than P - 1 vertices; None spreads them evenly.
        orders_of: ``vertices``: a ring starts at each vertex, in its own direction (MapTR);
            ``points``: at each of its P points, in both directions, and a line whose ends almost
            meet is a ring too.

    Returns:
        ``labels_3d`` (K,) int64, ``pts`` (K, P, dim), ``pts_shifts`` (K, S, P, dim), ``boxes`` (K,
        4), ``polylines`` (K, M, 2) float32 in metres, ``closed`` (K,) bool. Unused orders hold
        -10000; polylines are at full resolution, the last vertex repeated up to the longest.

    Raises:
        ValueError: If elements have fewer coordinates than ``dim``, or ``orders_of`` is unknown.
    """
    if orders_of not in ORDERS:
        raise InputError(f"orders_of must be one of {ORDERS}, got {orders_of!r}.")
    slots = max(num_points - 1, 2) if orders_of == "vertices" else 2 * (num_points - 1)
    points = np.empty((len(instances), num_points, dim))
    orders = np.empty((len(instances), slots, num_points, dim))
    longest = max((len(instance.points) for instance in instances), default=2)
    polylines = np.empty((len(instances), longest, 2))
    closed = np.empty(len(instances), bool)
    for i, instance in enumerate(instances):
        if instance.points.shape[1] < dim:
            raise InputError(
                f"targets of dim {dim} need points of as many coordinates, got "
                f"{instance.points.shape}."
            )
        line = instance.points[:, :dim].astype(np.float64)
        points[i] = resample(line, num_points)
        if orders_of == "vertices":
            orders[i] = equivalent_orders(line, num_points, rng)
        else:
            orders[i] = sampled_orders(points[i], ends_meet(points[i], x_range, y_range))
        polylines[i, : len(line)] = line[:, :2]
        polylines[i, len(line) :] = line[-1, :2]
        closed[i] = is_closed(instance.points[:, :dim])
    unused = orders == PADDING
    metres = {"pts": points, "pts_shifts": orders, "polylines": polylines}
    targets = {name: clamp(array, x_range, y_range) for name, array in metres.items()}
    targets["pts_shifts"][unused] = PADDING
    targets["boxes"] = bounding_boxes(targets["polylines"])
    return InstanceData(
        labels_3d=torch.tensor([instance.label for instance in instances], dtype=torch.int64),
        closed=torch.from_numpy(closed),
        **{name: torch.from_numpy(a.astype(np.float32)) for name, a in targets.items()},
    )


def ends_meet(
    points: np.ndarray, x_range: tuple[float, float], y_range: tuple[float, float]
) -> bool:
    """Say whether the ends of a line are within a thousandth of the map of each other. (P, D)"""
    extent = np.array([x_range[1] - x_range[0], y_range[1] - y_range[0]])
    first, last = (points[[0, -1], :2] - (x_range[0], y_range[0])) / extent
    return bool(np.allclose(first, last, atol=1e-3))  # and the relative 1e-5 of numpy


@TRANSFORMS.register_module()
@dataclass(eq=False)
class FormatMapTargets(BaseTransform):
    """Add ``gt_instances_3d``, the training targets, from ``map_instances``.

    Points have as many coordinates as the data set hands on (its ``dim``). The orders of rings with
    more than P - 1 vertices are drawn anew each time, as in MapTR.

    Args:
        num_points: Points P per element.
        orders_of: Which orders a ring has, see `map_targets`.
    """

    num_points: int = 20
    orders_of: str = "vertices"

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Add the targets; ValueError if the sample has no ground truth."""
        elements = ground_truth_elements(results, self)
        # seeded from the generator that mmengine seeds in each worker
        rng = np.random.default_rng(np.random.randint(2**31))  # noqa: NPY002
        results["gt_instances_3d"] = map_targets(
            elements,
            self.num_points,
            results["x_range"],
            results["y_range"],
            results.get("dim", 2),
            rng,
            self.orders_of,
        )
        return results
