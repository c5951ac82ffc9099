"""Masks of elements: their sizes and their pixels."""

import pytest
import torch
from head_cases import ALONG_Y, elements

import gsmap.registered  # noqa: F401
from gsmap.models.base.masks import ElementMasks
from gsmap.structures.grid import BEVGrid


def grid_of(x_m: float, y_m: float) -> BEVGrid:
    return BEVGrid((-x_m / 2, x_m / 2), (-y_m / 2, y_m / 2))


@pytest.mark.parametrize(
    ("extent", "pixel_m", "size", "cost_size"),
    [
        ((60, 30), None, (100, 200), (64, 128)),
        ((30, 60), 0.3, (200, 100), (128, 64)),
        ((100, 50), None, (100, 200), (64, 128)),
        ((100, 50), 0.25, (200, 400), (64, 128)),
        ((200, 100), 0.5, (200, 400), (64, 128)),
        ((30, 60), (0.3, 0.5), (120, 100), (128, 64)),
    ],
)
def test_sizes_follow_from_extent_and_pixel(extent, pixel_m, size, cost_size):
    masks = ElementMasks(grid_of(*extent), pixel_m=pixel_m)
    assert (masks.grid.height, masks.grid.width) == size
    assert (masks.cost_grid.height, masks.cost_grid.width) == cost_size
    assert masks.half_pixel_m == pytest.approx(max(masks.grid.pixel_size_m) / 2)


@pytest.mark.parametrize("name", ["pixel_m", "cost_pixel_m"])
def test_pixels_that_do_not_divide_the_extent_are_refused(name):
    with pytest.raises(ValueError, match=r"pixels of 0.7 x 0.7 m do not divide .* 30 x 60 m"):
        ElementMasks(ALONG_Y, **{name: 0.7})


def test_lines_are_bands_and_chosen_classes_are_filled():
    square = torch.tensor([[0.0, 0], [6, 0], [6, 6], [0, 6], [0, 0]]).repeat(2, 1, 1)
    labels = torch.tensor([0, 1])
    masks = ElementMasks(ALONG_Y, filled_classes=(1,))
    line, area = masks.draw(square, labels, masks.grid).sum((1, 2)) * 0.3**2
    assert line.item() == pytest.approx(24 * 0.75, rel=0.05)
    assert area.item() == pytest.approx(36, rel=0.05)
    both = ElementMasks(ALONG_Y).draw(square, labels, masks.grid)
    assert torch.equal(both[0], both[1])


def test_the_ground_truth_is_drawn_at_full_resolution_or_from_its_points():
    gt = elements(((-3, -20), (-3, 20)))
    gt.polylines = torch.tensor([[[-3.0, -20], [3, 0], [-3, 20]]])  # what five points do not show
    full, points = (ElementMasks(ALONG_Y, source=source) for source in ("full", "points"))
    labels = gt.labels_3d
    assert torch.equal(full.draw_batch([gt], full.grid), full.draw(gt.polylines, labels, full.grid))
    assert torch.equal(points.draw_batch([gt], full.grid), full.draw(gt.pts, labels, full.grid))


def test_targets_without_polylines_are_named():
    gt = elements(((-3, -20), (-3, 20)))
    del gt.polylines
    masks = ElementMasks(ALONG_Y)
    with pytest.raises(ValueError, match=r"'full' need gt_instances_3d.polylines: .*FormatMapT"):
        masks.draw_batch([gt], masks.grid)
