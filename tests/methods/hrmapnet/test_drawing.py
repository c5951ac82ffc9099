"""Drawn predictions, against values by hand."""

import math

import pytest
import torch
from prior_cases import CLASSES

from gsmap.models.hrmapnet.drawing import draw_elements
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.grid import BEVGrid

GRID = BEVGrid((0, 6), (0, 5), 5, 6)  # cells of 1 m, whose centres are at .5


def draw(points, labels, **settings):
    return draw_elements(
        torch.tensor(points),
        labels=torch.tensor(labels, dtype=torch.long),
        grid=GRID,
        classes=CLASSES,
        areas=AREA_CLASSES,
        **settings,
    )


def test_a_line_falls_off_by_its_squared_distance():
    """A divider along y = 2.5, through the centres of row 2."""
    raster = draw([[[-9.0, 2.5], [15.0, 2.5]]], [0])
    assert raster.shape == (3, 5, 6)
    expected = [math.exp(-(distance**2) / 2) for distance in (2, 1, 0, 1, 2)]
    # the way back of the line is 0.01 cells beside it
    torch.testing.assert_close(raster[0, :, 3], torch.tensor(expected), atol=0.011, rtol=0)
    assert (raster[1:] == 0).all()


def test_a_crossing_is_filled_and_the_largest_of_a_class_counts():
    square = [[1.5, 0.5], [4.5, 0.5], [4.5, 3.5], [1.5, 3.5]]
    far = [[50.0, 50.0], [51.0, 50.0], [51.0, 51.0], [50.0, 51.0]]
    raster = draw([far, square], [1, 1])
    assert raster[1, 2, 3] > 0.5 > raster[1, 4, 0]
    alone = draw([square], [1])
    torch.testing.assert_close(raster, alone)


def test_the_release_draws_half_a_cell_off():
    """The release samples cells at their corners: a line at y = 2 is in the middle of row 2."""
    ours, released = (
        draw([[[-9.0, y], [15.0, y]]], [2], released_pixels=flag)
        for y, flag in ((2.5, False), (2.0, True))
    )
    torch.testing.assert_close(ours[:, :, 2:4], released[:, :, 2:4])
    assert released[2, 2, 3] == pytest.approx(1.0, abs=0.001)


def test_nothing_is_drawn_of_no_elements():
    raster = draw_elements(
        torch.zeros(0, 4, 2),
        labels=torch.zeros(0, dtype=torch.long),
        grid=GRID,
        classes=CLASSES,
        areas=AREA_CLASSES,
    )
    assert not raster.any()
