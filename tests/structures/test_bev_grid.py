import numpy as np
import pytest
import torch

from gsmap.structures.grid import BEVGrid

NUSCENES = BEVGrid((-15, 15), (-30, 30), 200, 100)


def test_row_zero_is_the_smallest_y_and_values_sit_at_pixel_centres():
    centres = NUSCENES.pixel_centres(dtype=torch.float64)  # (200, 100, 2)
    assert centres.shape == (200, 100, 2)
    torch.testing.assert_close(centres[0, 0], torch.tensor([-14.85, -29.85], dtype=torch.float64))
    torch.testing.assert_close(centres[199, 3], torch.tensor([-13.95, 29.85], dtype=torch.float64))
    assert NUSCENES.pixel_size_m == pytest.approx((0.3, 0.3))


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_conversions_by_hand_and_back(kind):
    points = kind(np.array([[-15.0, -30.0], [0.0, 15.0]]))
    norm = NUSCENES.norm_from_metres(points)
    pixels = NUSCENES.px_from_metres(points)
    np.testing.assert_allclose(norm, [[0, 0], [0.5, 0.75]], atol=1e-12)
    np.testing.assert_allclose(pixels, [[0, 0], [50, 150]], atol=1e-12)
    np.testing.assert_allclose(NUSCENES.metres_from_norm(norm), points, atol=1e-12)


@pytest.mark.parametrize(
    ("grid", "front_left", "rear_right", "ahead"),
    [
        (NUSCENES, (-15.0, 30.0), (15.0, -30.0), (0.0, 15.0)),  # x to the right, y ahead
        (BEVGrid((-30, 30), (-15, 15)), (30.0, 15.0), (-30.0, -15.0), (15.0, 0.0)),  # x ahead
    ],
)
def test_the_map_from_its_front_edge_and_from_its_left(grid, front_left, rear_right, ahead):
    points = np.array([front_left, rear_right, ahead])
    found = grid.front_from_metres(points)
    np.testing.assert_allclose(found, [[0, 0], [1, 1], [0.25, 0.5]], atol=1e-12)
    np.testing.assert_allclose(grid.metres_from_front(found), points, atol=1e-12)


def test_height_above_ground_is_kept():
    points = torch.tensor([[3.0, 6.0, 1.7]])
    torch.testing.assert_close(NUSCENES.norm_from_metres(points), torch.tensor([[0.6, 0.6, 1.7]]))


def test_another_raster_covers_the_same_extent():
    grid = BEVGrid((-30, 30), (-15, 15), 100, 200)
    assert grid.with_size(64, 128).pixel_size_m == pytest.approx((60 / 128, 30 / 64))


def test_pixels_of_a_size_in_metres_divide_the_extent():
    """60 m along x and 30 m along y."""
    grid = BEVGrid((-30, 30), (-15, 15), 100, 200)
    assert grid.rasterized(0.3) == BEVGrid((-30, 30), (-15, 15), 100, 200)
    assert grid.rasterized([0.5, 0.25]) == BEVGrid((-30, 30), (-15, 15), 120, 120)
    for sizes, named in ((0.7, "0.7 x 0.7"), ([0.5, 0.7], "0.5 x 0.7"), ([0.7, 0.5], "0.7 x 0.5")):
        with pytest.raises(ValueError, match=f"pixels of {named} m do not divide .* 60 x 30 m"):
            grid.rasterized(sizes)
    for sizes in (0, -0.3, float("nan"), [0.5, 0.0]):
        with pytest.raises(ValueError, match="pixel_m must be > 0 m, got "):
            grid.rasterized(sizes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((1, 1), (0, 2), 3, 3), "x_range must be"),
        (((0, 1), (2, 0), 3, 3), "y_range must be"),
        (((0, 1), (0, 2), 0, 3), "height and width"),
    ],
)
def test_impossible_grids_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        BEVGrid(*arguments)


def test_points_without_two_coordinates_are_refused():
    with pytest.raises(ValueError, match=r"end in \(x, y\)"):
        NUSCENES.norm_from_metres(torch.zeros(4, 1))


def test_whole_numbers_have_results_with_decimals():
    points = np.array([[3, 5], [14, 29]])
    np.testing.assert_array_equal(
        NUSCENES.norm_from_metres(points), NUSCENES.norm_from_metres(points.astype(float))
    )
    assert NUSCENES.norm_from_metres(points.astype(np.float32)).dtype == np.float32
