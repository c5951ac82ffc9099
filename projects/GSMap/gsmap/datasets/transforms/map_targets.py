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

ORDERS = ("vertices", "points")  # values of `orders_of`, explained in `map_targets`


def map_targets(
    instances: Sequence[MapInstance],
    num_points: int,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    dim: int = 2,
    rng: np.random.Generator | None = None,
    orders_of: str = "vertices",
) -> InstanceData:
    """Create the training targets of a sample, by default as MapTR does (its point orders "v2").

    Args:
        instances: K map elements at full resolution, in metres in the annotation frame.
        num_points: Number P of points per element.
        x_range: Smallest and largest x in metres. Points outside are moved to the edge.
        y_range: Smallest and largest y in metres. Points outside are moved to the edge.
        dim: Coordinates per point, 2 or 3. Heights are interpolated but not clamped.
        rng: Generator that selects P - 1 orders at random if a ring has more than P - 1 vertices;
            None for an even selection.
        orders_of: Points at which the equivalent orders of a ring start. ``vertices``: one order
            starts at each vertex, in the direction of the ring (MapTR). ``points``: two orders,
            forward and reversed, start at each of the P - 1 different resampled points. A line
            whose ends almost meet then counts as a ring.

    Returns:
        Targets of the elements, with coordinates in metres as float32. ``labels_3d`` (K,) are the
        class indices, int64. ``pts`` (K, P, dim) are the resampled points. ``pts_shifts``
        (K, S, P, dim) are the points in S equivalent orders, with S = max(P - 1, 2) for
        ``vertices`` and S = 2 (P - 1) for ``points``; unused orders are filled with -10000.
        ``boxes`` (K, 4) are (x_min, y_min, x_max, y_max). ``polylines`` (K, M, 2) are the elements
        at full resolution; shorter ones repeat their last vertex up to the M vertices of the
        longest element. ``closed`` (K,), bool, is True for rings.

    Raises:
        ValueError: If elements have fewer coordinates than ``dim``, or ``orders_of`` is unknown.
    """
    if orders_of not in ORDERS:
        raise InputError(f"orders_of must be one of {ORDERS}, got {orders_of!r}.")
    num_orders = 2 * (num_points - 1)
    if orders_of == "vertices":
        num_orders = max(num_points - 1, 2)  # an open line has two orders
    points = np.empty((len(instances), num_points, dim))
    orders = np.empty((len(instances), num_orders, num_points, dim))
    # Number M of vertices of the longest element; any number serves if there is no element.
    longest = max((len(instance.points) for instance in instances), default=2)
    polylines = np.empty((len(instances), longest, 2))
    closed = np.empty(len(instances), dtype=bool)
    for i, instance in enumerate(instances):
        if instance.points.shape[1] < dim:
            raise InputError(
                f"targets of dim {dim} need points with {dim} coordinates, got points of shape "
                f"{instance.points.shape}."
            )
        line = instance.points[:, :dim].astype(np.float64)
        points[i] = resample(line, num_points)
        if orders_of == "vertices":
            # These orders are resampled from the line at full resolution.
            orders[i] = equivalent_orders(line, num_points, rng=rng)
        else:
            is_ring = ends_meet(points[i], x_range=x_range, y_range=y_range)
            orders[i] = sampled_orders(points[i], closed=is_ring)
        polylines[i, : len(line)] = line[:, :2]
        polylines[i, len(line) :] = line[-1, :2]  # repeat the last vertex
        closed[i] = is_closed(instance.points[:, :dim])
    is_unused = orders == PADDING  # both functions fill unused orders with this value, -10000
    points = clamp(points, x_range=x_range, y_range=y_range)
    orders = clamp(orders, x_range=x_range, y_range=y_range)
    orders[is_unused] = PADDING  # `clamp` has moved the padding to the edge
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
    """Test whether the ends of a line almost meet.

    They do if their distance along each axis, x and y, is at most about a thousandth of the map's
    extent along this axis.

    Args:
        points: Points of the line in metres. (P, D)
        x_range: Smallest and largest x of the map in metres.
        y_range: Smallest and largest y of the map in metres.
    """
    # In multiples of the extent, so that one tolerance serves for both axes.
    origin = np.array([x_range[0], y_range[0]])
    extent = np.array([x_range[1] - x_range[0], y_range[1] - y_range[0]])
    first_norm = (points[0, :2] - origin) / extent
    last_norm = (points[-1, :2] - origin) / extent
    return bool(np.allclose(first_norm, last_norm, atol=1e-3))


@TRANSFORMS.register_module()
@dataclass(eq=False)
class FormatMapTargets(BaseTransform):
    """Add the training targets of `map_targets` as ``gt_instances_3d``.

    The data set determines the number of coordinates per point (``dim``). The orders of rings with
    more than P - 1 vertices are drawn at random each time, as in MapTR.

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
        # List of `MapInstance`. Without ground truth, an error names this transform.
        elements = ground_truth_elements(results, transform=self)
        # The seed comes from the global generator, which mmengine seeds in each worker.
        seed = np.random.randint(2**31)  # noqa: NPY002
        rng = np.random.default_rng(seed)
        results["gt_instances_3d"] = map_targets(
            elements,
            num_points=self.num_points,
            x_range=results["x_range"],
            y_range=results["y_range"],
            dim=results.get("dim", 2),  # set by the data set
            rng=rng,
            orders_of=self.orders_of,
        )
        return results
