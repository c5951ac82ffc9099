"""BeMapNet: fits of Bezier curves to annotated lines."""

import re
from collections.abc import Iterator

import numpy as np

from gsmap.structures.bezier import bernstein, curve_points, fit_piece, fit_pieces, mean_deviation
from reference.golden import Golden
from reference.registry import check
from reference.report import Row, largest_difference

ACCEPTED_M = 0.1


@check("bemapnet_bezier_{variant}.npz")
def check_fits(golden: Golden, name: str) -> Iterator[Row]:
    """Compare fits of one piece, how far they are off, and fits of several pieces."""
    data = golden.read_arrays(name)
    for label, degree in enumerate((2, 1, 3)):
        off = largest_difference(bernstein(degree), data[f"coefficient{label}"])
        yield Row(name, f"weights of control points, degree {degree}", off, 1e-6)
    lines = annotated_lines(golden, name)
    for key in sorted(key for key in data if key.endswith("_one_f64")):
        fit = key.removesuffix("_one_f64")
        degree, number = map(int, re.findall(r"\d+", fit))
        one = fit_piece(lines[number], degree)
        yield Row(name, f"{fit}_one", largest_difference(one, data[key]), 1e-6)
        loss = mean_deviation(lines[number], curve_points(one, degree))
        yield Row(name, f"{fit}_loss", largest_difference(loss, data[f"{fit}_loss"]), 1e-4)
        pieces = fit_pieces(lines[number], degree, ACCEPTED_M, mean_deviation)
        off = largest_difference(pieces, data[f"{fit}_piecewise_f64"])
        yield Row(name, f"{fit}_piecewise", off, 1e-6)


def annotated_lines(golden: Golden, name: str) -> list[np.ndarray]:
    """Return the lines that are fitted: vertices every metre, in the frame of the vehicle."""
    data = golden.read_arrays(name.replace("bemapnet_bezier", "hdmapnet_targets"))
    ends = np.cumsum(data["many_vec_count"])[:-1]
    return np.split(data["many_vec_pts_f64"], ends)
