"""Training targets of map elements: resampled points in all equivalent orders."""

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
    """Create the training targets of a sample, like MapTR with the "v2" orders.

    Args:
        instances: K map elements at full resolution, in metres in the annotation frame.
        num_points: Number P of points per element.
        x_range: Smallest and largest x in metres. Points outside are moved to the edge.
        y_range: Smallest and largest y in metres. Points outside are moved to the edge.
        dim: Coordinates per point, 2 or 3. Heights are interpolated but not clamped.
        rng: Generator for the selection of P - 1 orders of rings with more vertices; None for an
            even selection.
        orders_of: With ``vertices``, a ring has an order for each vertex, in the direction of the
            ring (MapTR). With ``points``, a ring has an order for each of its P points in both
            directions, and a line whose ends almost meet is treated as a ring.

    Returns:
        Targets of the elements: ``labels_3d`` (K,), int64; ``pts`` (K, P, dim), the resampled
        points; ``pts_shifts`` (K, S, P, dim), the points in S equivalent orders, where unused
        orders are -10000; ``boxes`` (K, 4), as (x_min, y_min, x_max, y_max); ``polylines``
        (K, M, 2), the elements at full resolution, where the last vertex is repeated up to the
        length of the longest element; ``closed`` (K,), bool, whether an element is a ring.
        Coordinates are float32 in metres.

    Raises:
        ValueError: If elements have fewer coordinates than ``dim``, or ``orders_of`` is unknown.
    """
    if orders_of not in ORDERS:
        raise InputError(f"orders_of must be one of {ORDERS}, got {orders_of!r}.")
    num_orders = max(num_points - 1, 2) if orders_of == "vertices" else 2 * (num_points - 1)
    points = np.empty((len(instances), num_points, dim))
    orders = np.empty((len(instances), num_orders, num_points, dim))
    longest = max((len(instance.points) for instance in instances), default=2)
    polylines = np.empty((len(instances), longest, 2))
    closed = np.empty(len(instances), dtype=bool)
    for i, instance in enumerate(instances):
        if instance.points.shape[1] < dim:
            raise InputError(
                f"targets of dim {dim} need points of as many coordinates, got "
                f"{instance.points.shape}."
            )
        line = instance.points[:, :dim].astype(np.float64)
        points[i] = resample(line, num_points)
        if orders_of == "vertices":
            orders[i] = equivalent_orders(line, num_points, rng=rng)
        else:
            is_ring = ends_meet(points[i], x_range=x_range, y_range=y_range)
            orders[i] = sampled_orders(points[i], closed=is_ring)
        polylines[i, : len(line)] = line[:, :2]
        polylines[i, len(line) :] = line[-1, :2]
        closed[i] = is_closed(instance.points[:, :dim])
    is_unused = orders == PADDING
    points = clamp(points, x_range=x_range, y_range=y_range)
    orders = clamp(orders, x_range=x_range, y_range=y_range)
    orders[is_unused] = PADDING
    polylines = clamp(polylines, x_range=x_range, y_range=y_range)
    labels = [instance.label for instance in instances]
    return InstanceData(
        labels_3d=torch.tensor(labels, dtype=torch.int64),
        closed=torch.from_numpy(closed),
        pts=_float_tensor(points),
        pts_shifts=_float_tensor(orders),
        polylines=_float_tensor(polylines),
        boxes=_float_tensor(bounding_boxes(polylines)),
    )


def _float_tensor(array: np.ndarray) -> torch.Tensor:
    """Convert an array to a float32 tensor."""
    return torch.from_numpy(array.astype(np.float32))


def ends_meet(
    points: np.ndarray, x_range: tuple[float, float], y_range: tuple[float, float]
) -> bool:
    """Test whether the ends of a line are closer than a thousandth of the map along each axis.

    Args:
        points: Points of the line in metres. (P, D)
        x_range: Smallest and largest x of the map in metres.
        y_range: Smallest and largest y of the map in metres.
    """
    extent = np.array([x_range[1] - x_range[0], y_range[1] - y_range[0]])
    first, last = (points[[0, -1], :2] - (x_range[0], y_range[0])) / extent
    return bool(np.allclose(first, last, atol=1e-3))  # with the default rtol=1e-5


@TRANSFORMS.register_module()
@dataclass(eq=False)
class FormatMapTargets(BaseTransform):
    """Add ``gt_instances_3d``, the training targets of the map elements, see `map_targets`.

    Points have ``dim`` coordinates, as set in the data set. The orders of rings with more than
    P - 1 vertices are drawn at random in each epoch, as in MapTR.

    Args:
        num_points: Number P of points per element.
        orders_of: Equivalent orders of a ring, ``vertices`` or ``points``, see `map_targets`.
    """

    num_points: int = 20
    orders_of: str = "vertices"

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Add the targets.

        Raises:
            ValueError: If the sample has no ground truth, or has no heights and ``dim`` is 3.
        """
        elements = ground_truth_elements(results, self)
        # The seed comes from the global generator, which mmengine seeds in each worker.
        rng = np.random.default_rng(np.random.randint(2**31))  # noqa: NPY002
        results["gt_instances_3d"] = map_targets(
            elements,
            num_points=self.num_points,
            x_range=results["x_range"],
            y_range=results["y_range"],
            dim=results.get("dim", 2),
            rng=rng,
            orders_of=self.orders_of,
        )
        return results
