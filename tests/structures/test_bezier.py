"""Piecewise Bezier curves: scipy's values, exact lines, the error that was asked for."""

from itertools import pairwise

import numpy as np
import pytest
import shapely
from scipy.interpolate import BPoly

from gsmap.structures.bezier import (
    bernstein,
    controls_between,
    curve_points,
    fit_joints,
    fit_piece,
    fit_pieces,
    largest_deviation,
    mean_deviation,
)
from gsmap.structures.polylines import resample

T = np.linspace(0, 1, 100)


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
def test_points_of_a_curve_are_scipys(degree):
    controls = np.random.default_rng(degree).normal(size=(2 * degree + 1, 3))
    found = curve_points(controls, degree)
    for start, part in ((0, found[:100]), (degree, found[99:])):
        curve = BPoly(controls[start : start + degree + 1, None], [0, 1])
        np.testing.assert_allclose(part, curve(T), atol=1e-12)


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_a_fit_gives_a_curve_of_equal_speed_back(degree):
    controls = np.linspace([0.0, 0.0], [6.0, 3.0], degree + 1)  # a straight line
    np.testing.assert_allclose(
        fit_piece(curve_points(controls, degree), degree), controls, atol=1e-9
    )


def arc(vertices: int = 60) -> np.ndarray:
    angle = np.linspace(0, 1.9 * np.pi, vertices)
    return 20 * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.parametrize("max_error_m", [0.5, 0.1, 0.02])
@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_a_fit_keeps_the_error_and_its_ends(max_error_m, degree, seed):
    steps = np.random.default_rng(seed).normal([1.5, 0], 0.3, (40, 2))
    for line in (np.cumsum(steps, axis=0), arc()):
        controls = fit_pieces(line, degree, max_error_m)
        assert (len(controls) - 1) % degree == 0
        np.testing.assert_array_equal(controls[[0, -1]], line[[0, -1]])
        sides = resample(line, 1000), curve_points(controls, degree, 150)
        for points, other in (sides, sides[::-1]):  # more points than the fit looked at
            apart = shapely.distance(shapely.points(points), shapely.linestrings(other))
            assert apart.max() < max_error_m + 0.02
        assert len(fit_pieces(line, degree, 10 * max_error_m)) <= len(controls)


def test_an_arc_takes_few_cubic_pieces():
    assert len(fit_pieces(arc(), 3, 0.1)) < 20 < len(fit_pieces(arc(), 1, 0.1))


def test_deviations_are_distances():
    line = np.array([[0.0, 0.0], [5.0, 0.0]])
    assert largest_deviation(line, line + np.array([0, 0.5])) == pytest.approx(0.5)
    assert largest_deviation(line, np.array([[0.0, 0], [2.5, 2], [5, 0]])) == pytest.approx(2)
    dense = resample(line, 1000)
    assert mean_deviation(line, dense + np.array([0, 0.5])) == pytest.approx(0.5, abs=1e-3)
    assert mean_deviation(line, dense + np.array([0, 0.04])) == 0


@pytest.mark.parametrize("seed", range(5))
def test_largest_deviations_are_shapelys(seed):
    line, curve = np.random.default_rng(seed).normal(size=(2, 30, 3))
    line[3], line[7] = line[2], line[6]  # steps of no length
    sides = np.concatenate([line, resample(line, 100)]), curve
    apart = [
        shapely.distance(shapely.points(points[:, :2]), shapely.linestrings(other[:, :2])).max()
        for points, other in zip(sides, (curve, line), strict=True)
    ]
    assert largest_deviation(line, curve) == pytest.approx(max(apart), abs=1e-12)


@pytest.mark.parametrize("deviation", [largest_deviation, mean_deviation])
def test_joints_are_the_farthest_ends_that_fit(deviation):
    line = np.cumsum(np.random.default_rng(0).normal([1.0, 0], 0.2, (20, 2)), axis=0)
    joints = fit_joints(line, 3, 0.1, deviation)
    for start, end in pairwise(joints):
        fits = [
            deviation(part, curve_points(fit_piece(part, 3), 3)) < 0.1
            for part in (line[start : other + 1] for other in range(end, 20))
        ]
        assert fits[0] or end == start + 1
        assert not any(fits[1:])


def zigzag(count: int) -> np.ndarray:
    return np.stack([np.tile([-15.0, 15.0], count // 2), np.linspace(-30, 30, count)], axis=1)


@pytest.mark.parametrize("count", [100, 400, 1600])
def test_the_search_for_joints_is_bounded_by_the_number_of_vertices(count):
    """Without the bound it looks at a third of the cube of their number."""
    looked_at = []

    def deviation(part, curve):
        looked_at.append(len(part) + 100)
        return 0.0 if len(part) == 2 else 9.0

    assert fit_joints(zigzag(count), 3, 0.1, deviation) == list(range(count))
    assert sum(looked_at) <= (2000 + 2 * 103) * count


def test_a_zigzag_keeps_its_error_within_the_bound():
    line = zigzag(3000)
    joints = fit_joints(line, 3, 0.1)
    controls = controls_between(line, joints, 3)
    for number, (start, end) in enumerate(pairwise(joints)):
        piece = curve_points(controls[3 * number : 3 * number + 4], 3)
        assert largest_deviation(line[start : end + 1], piece) < 0.1


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: bernstein(0), "must be 1 to 5, got 0"),
        (lambda: bernstein(6), "must be 1 to 5, got 6"),
        (lambda: curve_points(np.zeros((5, 2)), 3), "3 control points each and one at the end"),
        (lambda: curve_points(np.zeros((1, 2)), 1), "control points each"),
        (lambda: curve_points(np.zeros(4), 3), "points of shape .4,."),
        (lambda: fit_pieces(np.zeros((1, 2))), "two points or more, got 1"),
        (lambda: fit_pieces(arc(), 3, 0), "must be more than 0, got 0"),
        (lambda: fit_pieces(arc(), 9), "must be 1 to 5"),
    ],
)
def test_what_is_no_curve_is_refused(act, message):
    with pytest.raises(ValueError, match=message):
        act()
