"""Scores of matched Gaussians: worked by hand, and on errors that are drawn from their sigmas."""

import numpy as np
import pytest
from scipy import stats

from gsmap.evaluation.analysis.calibration import (
    Vertices,
    fit_factors,
    format_uncertainty,
    matched_vertices,
    sparsification,
    uncertainty_figures,
    uncertainty_report,
)
from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.structures.elements import MapElements

CLASSES = ("divider", "ped_crossing", "boundary")
CONFIG = ChamferConfig(CLASSES)


def drawn(count: int = 20000, label: int = 0, **factors: float) -> Vertices:
    """Vertices whose errors have the sigmas that are said, times a factor."""
    rng = np.random.default_rng(0)
    sigmas = np.exp(rng.normal(size=(count, 2)))
    true = sigmas * [factors.get("along", 1.0), factors.get("across", 1.0)]
    errors = np.abs(rng.normal(size=(count, 2))) * true
    return Vertices(np.full(count, label), errors, sigmas, rng.uniform(0, 30, count))


def test_a_line_beside_the_true_one_by_hand():
    """Vertices 0.3 m to the side of a line along y, with sigmas of 0.5 m and 0.2 m.

    A second prediction, farther away than 1.5 m, matches nothing and is left out.
    """
    y = np.linspace(-10, 10, 5)
    line = np.column_stack([np.full(5, 4.0), y])
    found = MapElements.from_polylines(
        [np.add(line, [0.3, 0.0]), np.add(line, [5.0, 0.0])],
        [0, 0],
        [0.9, 0.8],
        [np.tile([0.5, 0.2], (5, 1))] * 2,
        [np.full(5, np.pi / 2)] * 2,
    )
    truth = MapElements.from_polylines([line[::-1][::4]], [0])  # runs the other way
    vertices = matched_vertices([("a", found, truth)], CONFIG)
    np.testing.assert_allclose(vertices.errors, np.tile([0.0, 0.3], (5, 1)), atol=1e-12)
    np.testing.assert_allclose(vertices.sigmas, np.tile([0.5, 0.2], (5, 1)))
    np.testing.assert_allclose(vertices.distances, np.hypot(4.3, y))
    figures = uncertainty_figures(vertices)
    across = 0.5 * np.log(2 * np.pi * 0.04) + 0.5 * 1.5**2
    assert figures["across/nll"] == pytest.approx(across)
    assert (figures["across/coverage@1"], figures["across/coverage@2"]) == (0, 1)
    assert (figures["along/coverage@1"], figures["across/sigma_m"]) == (1, pytest.approx(0.2))
    assert figures["across/rank_correlation"] == 0  # all alike: no order
    assert figures["num_vertices"] == 5


def test_true_sigmas_cover_and_order_and_half_as_large_ones_do_not():
    figures = uncertainty_figures(drawn(across=2.0))
    assert figures["along/coverage@1"] == pytest.approx(0.683, abs=0.01)
    assert figures["along/coverage@2"] == pytest.approx(0.954, abs=0.01)
    assert figures["along/reliability_error"] < 0.01
    half = 2 * stats.norm.cdf(0.5) - 1
    assert figures["across/coverage@1"] == pytest.approx(half, abs=0.01)
    assert figures["across/nll"] > figures["along/nll"] + 0.5
    assert figures["across/rank_correlation"] == pytest.approx(
        figures["along/rank_correlation"], abs=0.02
    )
    assert figures["along/rank_correlation"] > 0.5
    assert abs(figures["along/distance_rank_correlation"]) < 0.05


def test_sparsification_by_hand():
    """Errors 1, 2, 3: the best order leaves 1, then 1.5, then 2 m; the worst one 3, 2.5, 2."""
    errors = np.array([2.0, 1.0, 3.0])
    np.testing.assert_allclose(sparsification(errors, errors), [1, 1.5, 2])
    np.testing.assert_allclose(sparsification(errors, -errors), [3, 2.5, 2])
    sigmas = np.column_stack([errors, 4 - errors])
    figures = uncertainty_figures(
        Vertices(np.zeros(3, int), np.tile(errors[:, None], 2), sigmas, errors)
    )
    assert figures["along/sparsification_error"] == 0
    assert figures["across/sparsification_error"] == pytest.approx((2 + 1 + 0) / 3 / 2)
    assert figures["across/rank_correlation"] == -1
    assert figures["across/distance_rank_correlation"] == 1


def test_a_report_has_classes_lines_and_distances():
    parts = [drawn(200, label) for label in (0, 1, 2)]
    joined = Vertices(*map(np.concatenate, zip(*parts, strict=True)))
    metrics = uncertainty_report(joined, CLASSES, ["ped_crossing"]).metrics
    assert metrics["uncertainty/divider/num_vertices"] == 200
    assert metrics["uncertainty/line/num_vertices"] == 400
    distances = ("0-10m", "10-20m", "20m+")
    by_distance = [metrics[f"uncertainty/line/{part}/num_vertices"] for part in distances]
    assert sum(by_distance) == 400
    text = format_uncertainty(metrics)
    assert len(text.splitlines()) == 1 + 2 * 4 * 4
    with pytest.raises(ValueError, match=r"^a class cannot be called 'line', since"):
        uncertainty_report(joined, ("line", "divider", "boundary"), [])
    assert f"{metrics['uncertainty/line/across/nll']:.3f}" in text


def test_fitted_factors_bring_the_errors_within_their_sigmas():
    parts = [drawn(20000, label, along=2.0, across=0.5) for label in (0, 1, 2)]
    joined = Vertices(*map(np.concatenate, zip(*parts, strict=True)))
    for num_sigmas in (1, 2):
        found = fit_factors(joined, CLASSES, num_sigmas)
        np.testing.assert_allclose(found, [[2.0, 0.5]] * 3, rtol=0.03)
    with pytest.raises(ValueError, match="class 'boundary' has 0 matched vertices, 100 are needed"):
        fit_factors(parts[0]._replace(labels=np.arange(20000) % 2), CLASSES)


def test_long_tails_get_the_coverage_of_the_interval_that_is_fitted():
    """Errors of a Laplace distribution of scale 1: 95.4 % lie within 3.09, 68.3 % within 1.15."""
    rng = np.random.default_rng(0)
    errors = rng.exponential(size=(50000, 2))
    tailed = Vertices(np.zeros(50000, int), errors, np.ones_like(errors), np.ones(50000))
    one, two = (fit_factors(tailed, CLASSES[:1], k)[0, 1] for k in (1, 2))
    assert one == pytest.approx(1.148, rel=0.02)
    assert two == pytest.approx(3.090 / 2, rel=0.02)
    with pytest.raises(ValueError, match=r"num_sigmas must be in \(0, 3\], got 0"):
        fit_factors(tailed, CLASSES[:1], 0)


def test_the_law_of_the_errors_decides_intervals_and_likelihood():
    """Errors of a Laplace distribution: within its intervals as often as they say, by their sigma.

    Its sigma is sqrt(2) times its scale, and its intervals of 68.3 and 95.4 % are 0.812 and 2.185
    sigma wide.
    """
    rng = np.random.default_rng(0)
    sigmas = np.exp(rng.normal(size=(50000, 2)))
    errors = rng.exponential(size=(50000, 2)) * sigmas / np.sqrt(2)
    tailed = Vertices(np.zeros(50000, int), errors, sigmas, np.ones(50000))
    normal, laplace = (uncertainty_figures(tailed, law) for law in ("normal", "laplace"))
    assert laplace["across/coverage@1"] == pytest.approx(0.683, abs=0.005)
    assert laplace["across/coverage@2"] == pytest.approx(0.954, abs=0.005)
    assert laplace["across/reliability_error"] < 0.005
    assert normal["across/coverage@1"] == pytest.approx(1 - np.exp(-np.sqrt(2)), abs=0.005)
    expected = -stats.laplace.logpdf(errors[:, 1], scale=sigmas[:, 1] / np.sqrt(2)).mean()
    assert laplace["across/nll"] == pytest.approx(expected)
    assert laplace["across/nll"] < normal["across/nll"]
    for key in ("sigma_m", "rank_correlation", "sparsification_error"):
        assert laplace[f"across/{key}"] == normal[f"across/{key}"]
    for num_sigmas in (1, 2):  # both intervals fit one sigma
        found = fit_factors(tailed, CLASSES[:1], num_sigmas, "laplace")
        np.testing.assert_allclose(found, [[1.0, 1.0]], rtol=0.02)


def test_results_without_gaussians_are_refused():
    line = np.array([[0.0, -5.0], [0.0, 5.0]])
    found, truth = (MapElements.from_polylines([line], [0], s) for s in ([0.9], None))
    with pytest.raises(ValueError, match="sample 'a' has predictions without Gaussians"):
        matched_vertices([("a", found, truth)], CONFIG)
    with pytest.raises(ValueError, match="no prediction matches"):
        matched_vertices([("a", MapElements.from_polylines(), truth)], CONFIG)
