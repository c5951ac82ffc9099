"""PivotNet's dynamic matching of the pivots of annotated lines with predicted points.

Pivots are the vertices that define the shape of a line, including its two ends. The points of a
predicted line have an order, too. Each pivot is matched with one predicted point, and the order of
the pivots is kept. Predicted points may remain without a pivot.
"""

import numpy as np
from numpy.typing import NDArray

from gsmap.utils.errors import InputError

Floats = NDArray[np.floating]


def path_costs(costs: Floats) -> Floats:
    """Compute the lowest total costs of matching the first pivots with the first points, in order.

    The first pivot is matched with the first point. Entry (i, j) is the lowest cost of matching the
    pivots 0 to i if pivot i is matched with point j. It is infinite if that is not possible.

    Args:
        costs: Cost of matching each of m pivots with each of p points. (..., m, p)

    Returns:
        Lowest total costs. (..., m, p)
    """
    table = np.full(costs.shape, fill_value=np.inf)
    table[..., 0, 0] = costs[..., 0, 0]
    for row in range(1, costs.shape[-2]):
        # The previous pivot is matched with the earlier point that has the lowest total cost.
        best_before = np.minimum.accumulate(table[..., row - 1, :-1], axis=-1)
        table[..., row, 1:] = best_before + costs[..., row, 1:]
    return table


def sequence_costs(costs: Floats, lengths: NDArray[np.integer], end_weight: float) -> Floats:
    """Compute the mean matching costs of predicted and annotated lines.

    Args:
        costs: Cost of matching each of m pivots of K annotated lines with each of p points of N
            predicted lines. The first pivot is matched with the first point, and the last pivot
            with the last point. (N, K, m, p)
        lengths: Number of pivots of each annotated line, at most m. Rows of ``costs`` beyond it are
            ignored. (K,)
        end_weight: Additional weight of the two ends of a line, >= 0.

    Returns:
        Mean cost of each pair of lines, infinite if a line has more pivots than points. (N, K)
    """
    line_indices = np.arange(len(lengths))
    last_pivots = lengths - 1
    totals = path_costs(costs)[:, line_indices, last_pivots, -1]
    ends = costs[..., 0, 0] + costs[:, line_indices, last_pivots, -1]
    # Each of the two ends has the weight 1 + end_weight, and the other pivots have the weight 1.
    return (totals + end_weight * ends) / (lengths + 2 * end_weight)


def match_pivots(costs: Floats) -> NDArray[np.int64]:
    """Return the point that is matched with each pivot, the first one of equally good points.

    Args:
        costs: Cost of matching each of m pivots of a line with each of p points. (m, p)

    Returns:
        Indices of the points, increasing. (m,)

    Raises:
        ValueError: If there are fewer points than pivots.
    """
    num_pivots, num_points = costs.shape
    if num_pivots > num_points:
        raise InputError(f"{num_pivots} pivots cannot be matched with {num_points} points.")
    table = path_costs(costs)
    path = np.full(num_pivots, fill_value=num_points - 1)
    # The last pivot is matched with the last point. From there backwards, each previous pivot is
    # matched with the best earlier point.
    for row in range(num_pivots - 1, 0, -1):
        earlier_points = slice(0, path[row])
        path[row - 1] = table[row - 1, earlier_points].argmin()
    return path
