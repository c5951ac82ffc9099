"""AP near and far: pieces against shapely, figures of what is missing far away."""

import json

import numpy as np
import pytest
import shapely
from golden_data import EVALUATOR
from test_files import annotated, command, results_of

from gsmap.evaluation.analysis.distances import (
    SHORTEST_M,
    cut_area,
    cut_by_distance,
    cut_line,
    distance_groups,
)
from gsmap.evaluation.analysis.groups import ap_by_group
from gsmap.evaluation.core.results_json import write_results
from gsmap.structures.elements import MapElements

DISCS = [shapely.Point(0, 0).buffer(radius, quad_segs=20_000) for radius in (10, 20)]
BANDS = [DISCS[0], DISCS[1] - DISCS[0], shapely.box(-99, -99, 99, 99) - DISCS[1]]


def walk(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.cumsum([rng.uniform(-15, 15, 2), *rng.normal(0, 6, (9, 2))], axis=0)


@pytest.mark.parametrize("seed", range(20))
def test_pieces_of_a_line_have_the_length_that_shapely_finds_in_each_band(seed):
    points = walk(seed)
    line = shapely.LineString(points)
    found_m = [0.0, 0.0, 0.0]  # total length of the pieces in each band
    for number, piece in cut_line(points):
        piece_line = shapely.LineString(piece)
        assert piece_line.length >= SHORTEST_M
        assert BANDS[number].buffer(1e-3).covers(piece_line)
        found_m[number] += piece_line.length
    for number, band in enumerate(BANDS):
        within = shapely.intersection(line, band)
        parts = shapely.get_parts(shapely.line_merge(within))
        short_m = sum(part.length for part in parts if part.length < SHORTEST_M)
        least_m = within.length - short_m - 4 * SHORTEST_M
        assert least_m <= found_m[number] <= within.length + 1e-3


def test_a_line_is_cut_exactly_on_the_circles():
    found = list(cut_line(np.array([[0.0, -30.0], [0.0, 30.0]])))
    assert [band for band, _ in found] == [2, 1, 0, 1, 2]
    ends = [-30, -20, -10, 10, 20, 30]
    for (_, piece), low, high in zip(found, ends, ends[1:], strict=False):
        np.testing.assert_allclose(piece, [[0, low], [0, high]], atol=1e-12)


def test_a_ring_is_not_cut_at_its_start():
    ring = np.array([[5.0, 0], [15, 0], [15, 3], [5, 3], [5, 0]])
    (near_band, near), (far_band, far) = cut_line(ring)
    assert (near_band, len(near)) == (0, 4)
    assert (far_band, len(far)) == (1, 4)


def test_what_has_no_extent_gives_no_piece():
    assert not list(cut_line(np.array([[1.0, 1.0]])))
    assert not list(cut_line(np.array([[1.0, 1.0], [1.0, 1.0]])))
    assert not list(cut_line(np.array([[1.0, 1.0], [1.0, 1.5]])))
    assert not list(cut_area(np.array([[1.0, 1.0], [2.0, 2.0], [1.0, 1.0]])))
    assert not list(cut_area(np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])))


@pytest.mark.parametrize("seed", range(5))
def test_pieces_of_an_area_cover_it_also_if_its_outline_crosses_itself(seed):
    outline = walk(seed)[:5]
    area = shapely.make_valid(shapely.Polygon(outline))
    pieces = [shapely.Polygon(piece) for _, piece in cut_area(outline)]
    assert sum(piece.area for piece in pieces) == pytest.approx(area.area, abs=3)
    assert all(area.buffer(1e-6).covers(piece) for piece in pieces)


def test_what_is_missing_far_away_costs_the_far_bands_only():
    whole = [[0.0, -28.0], [0.0, 28.0]]
    near = [[0.0, -9.9], [0.0, 9.9]]
    crossing = [[2.0, 2.0], [6.0, 2.0], [6.0, 8.0], [2.0, 8.0], [2.0, 2.0]]
    truth = MapElements.from_polylines([whole, crossing], [0, 1])
    predictions = MapElements.from_polylines([near, crossing], [0, 1], [0.9, 0.8])
    pieces = list(cut_by_distance([("t", predictions, truth)], areas=[1]))
    reports = EVALUATOR.reports(EVALUATOR.match(*sample) for sample in pieces)
    found = ap_by_group(reports, distance_groups(reports[0].tokens))
    aps = {band: figures["chamfer/divider/AP"] for band, figures in found.items()}
    assert aps == pytest.approx({"0-10 m": 1, "10-20 m": 0, "beyond 20 m": 0})
    assert found["0-10 m"]["chamfer/ped_crossing/AP"] == pytest.approx(1)


def test_command_writes_the_ap_of_each_band(tmp_path, capsys):
    truth = annotated(tmp_path / "val.arrow", 4)
    results = tmp_path / "results.json"
    write_results(results, results_of(4), {"use_camera": True})
    out = tmp_path / "metrics.json"
    command()([str(results), str(truth), "--by", "distance", "--out", str(out)])
    figures = json.loads(out.read_text())
    assert {"by/0-10 m/chamfer/mAP", "by/10-20 m/raster/mAP"} <= set(figures)
    assert "| 0-10 m" in capsys.readouterr().out


@pytest.mark.parametrize("option", [["--dim", "3"], ["--prior", "other.arrow"]])
def test_command_refuses_bands_of_what_it_cannot_cut(option, capsys):
    files = ["val.arrow"] if "--prior" in option else ["results.json", "val.arrow"]
    with pytest.raises(SystemExit):
        command()([*files, *option, "--by", "distance"])
    assert "--by distance" in capsys.readouterr().err
