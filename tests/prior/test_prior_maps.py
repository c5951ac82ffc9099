"""Vector maps written to a prior."""

import numpy as np
import pytest
import shapely
import torch
from shapely import LineString, Polygon

from gsmap.prior import KeepMaximum, LastSeen, MapPrior, PriorSettings
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid

SETTINGS = PriorSettings(("divider", "ped_crossing"), "town")
GRID = BEVGrid((-45, 45), (-45, 45), 300, 300)  # the cells of the prior at a pose of 0.3 m


def pose_at(x, y):
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3], pose[1, 3] = x, y
    return pose


@pytest.mark.parametrize("shift", [(0.0, 0.0), (-3000.0, 600.0), (39_512_400.0, -999_900.0)])
def test_cells_near_a_line_and_within_an_area_are_hits(shift):
    """A line over four tiles, and a crossing over the border of two."""
    line = np.array([[-70.0, -20.0], [10.0, 7.0], [33.0, 50.0]])
    ring = np.array([[-10.0, 20.0], [5.0, 20.0], [5.0, 31.0], [-10.0, 31.0], [-10.0, 20.0]])
    elements = MapElements.from_polylines([line + shift, ring + shift], [0, 1])
    prior = MapPrior(SETTINGS, LastSeen())
    prior.write_map(elements, width_m=0.9)
    found = prior.read(pose_at(*shift), GRID).numpy()
    centres = GRID.pixel_centres(dtype=torch.float64).reshape(-1, 2).numpy()
    points = shapely.points(centres).reshape(300, 300)
    to_line = shapely.distance(LineString(line), points)
    inside = shapely.contains(Polygon(ring), points)
    to_edge = shapely.distance(LineString(ring), points)
    for value, hit, distance in (
        (found[0], to_line < 0.45, abs(to_line - 0.45)),
        (found[1], inside, to_edge),
    ):
        clear = distance > 0.02  # float32 and the corner of the tiles
        assert hit.any()
        np.testing.assert_array_equal(value[clear], hit[clear])


def test_other_cells_and_classes_do_not_change():
    prior = MapPrior(SETTINGS, LastSeen())
    half = torch.full((2, 300, 300), 0.5)
    prior.write(pose_at(0, 0), GRID, half)
    prior.write_map(MapElements.from_polylines([[[-10.0, 0.1], [10.0, 0.1]]], [0]))
    found = prior.read(pose_at(0, 0), GRID)
    assert set(found[0].unique().tolist()) == {0.5, 1.0}
    assert found[1].unique().tolist() == [0.5]


def test_an_empty_map_makes_no_tiles():
    prior = MapPrior(SETTINGS, KeepMaximum())
    prior.write_map(MapElements.from_polylines())
    prior.write_map(MapElements.from_polylines([[[1.0, 1.0]], []], [0, 0]))
    assert prior.num_tiles == 0


@pytest.mark.parametrize(
    ("line", "label", "width_m", "message"),
    [
        ([[0, 0], [1, 1]], 2, 0.6, r"labels of elements must be in \[0, 2\)"),
        ([[0, 0], [1, 1]], -1, 0.6, "labels of elements must be in"),
        ([[0, 0], [1e9, 1]], 0, 0.6, "within 1e"),
        ([[-9e6, -9e6], [9e6, 9e6]], 0, 0.6, "more than 1000000 tiles"),
        ([[-9e6, 0], [9e6, 0], [0, 9e6], [-9e6, 0]], 1, 0.6, "more than 1000000 tiles"),
        ([[0, 0], [1, 1]], 0, 0.0, "width_m must be in"),
        ([[0, 0], [1, 1]], 0, float("nan"), "width_m must be in"),
    ],
)
def test_wrong_maps_are_refused(line, label, width_m, message):
    prior = MapPrior(SETTINGS)
    with pytest.raises(ValueError, match=message):
        prior.write_map(MapElements.from_polylines([line], [label]), width_m)
    assert prior.num_tiles == 0
