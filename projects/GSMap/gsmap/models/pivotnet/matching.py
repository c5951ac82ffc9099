"""PivotNet's dynamic matching of pivots with predicted points."""

import numpy as np
from numpy.typing import NDArray

from gsmap.utils.errors import InputError

Floats = NDArray[np.floating]


def path_costs(costs: Floats) -> Floats:
    """Return the cheapest way to match the first pivots with points, up to each of both.

    The first pivot has the first point; the order is kept. Infinite where there is no way.
    Differences of pivots (rows) and points (columns). (..., m, p) -> (..., m, p)
    """
    table = np.full(costs.shape, np.inf)
    table[..., 0, 0] = costs[..., 0, 0]
    for row in range(1, costs.shape[-2]):
        before = np.minimum.accumulate(table[..., row - 1, :-1], -1)
        table[..., row, 1:] = before + costs[..., row, 1:]
    return table


def sequence_costs(costs: Floats, lengths: NDArray[np.integer], end_weight: float) -> Floats:
    """Return the mean cost of lines. (N, K)

    Args:
        costs: Differences of points and pivots; the last pivot has the last point. (N, K, m, p)
        lengths: Numbers of pivots. (K,)
        end_weight: What the ends of a line count more.
    """
    last, number = lengths - 1, np.arange(len(lengths))
    total = path_costs(costs)[:, number, last, -1]
    ends = costs[..., 0, 0] + costs[:, number, last, -1]
    return (total + end_weight * ends) / (lengths + 2 * end_weight)


def match_pivots(costs: Floats) -> NDArray[np.int64]:
    """Return the point of every pivot, the earlier one of two as good. (m, p) -> (m,)

    ValueError if there are fewer points than pivots.
    """
    num_pivots, num_points = costs.shape
    if num_pivots > num_points:
        raise InputError(f"{num_pivots} pivots cannot be matched with {num_points} points.")
    table, path = path_costs(costs), np.full(num_pivots, num_points - 1)
    for row in range(num_pivots - 1, 0, -1):
        path[row - 1] = table[row - 1, : path[row]].argmin()
    return path
