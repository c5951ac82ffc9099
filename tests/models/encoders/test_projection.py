import torch

from gsmap.models.encoders.projection import pillar_points, project_pillars
from gsmap.structures.grid import BEVGrid


def test_pillar_points_are_cell_centres_at_the_middle_of_equal_slices():
    grid = BEVGrid((-1.0, 1.0), (-3.0, 3.0), 3, 2)
    points = pillar_points(grid, (-2.0, 2.0), 4, torch.device("cpu"))
    assert points.shape == (6, 4, 4)
    torch.testing.assert_close(points[0, :, 2], torch.tensor([-1.5, -0.5, 0.5, 1.5]))
    torch.testing.assert_close(points[1, 0], torch.tensor([0.5, -2.0, -1.5, 1.0]))  # next column
    torch.testing.assert_close(points[2, 0], torch.tensor([-0.5, 0.0, -1.5, 1.0]))  # next row
    torch.testing.assert_close(points[:, 0, :2].view(3, 2, 2), grid.pixel_centres())


def test_projection_by_hand():
    # x right, y forward, z up; a camera at the origin looks forward, 10 px focal length
    img_from_frame = torch.tensor(
        [[10.0, 8.0, 0.0, 0.0], [0.0, 4.0, -10.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    )
    points = torch.tensor(
        [
            [[1.0, 5.0, 0.0, 1.0]],  # (10 * 1 / 5 + 8, 4) = (10, 4)
            [[0.0, -5.0, 0.0, 1.0]],  # behind
            [[-4.0, 5.0, 0.0, 1.0]],  # u = 0: the border is outside
            [[0.0, 10.0, 3.0, 1.0]],  # (8, 4 - 3) = (8, 1)
        ]
    )
    projection = project_pillars(points, img_from_frame[None, None], (8, 16))
    assert projection.visible.tolist() == [[[True, False, False, True]]]
    torch.testing.assert_close(projection.uv[0, 0, 0, 0], torch.tensor([10 / 16, 4 / 8]))
    torch.testing.assert_close(projection.uv[0, 0, 3, 0], torch.tensor([8 / 16, 1 / 8]))


def test_a_cell_is_seen_if_any_height_is():
    points = torch.tensor([[[0.0, 1.0, 5.0, 1.0], [0.0, 1.0, 0.1, 1.0]]])
    img_from_frame = torch.tensor(
        [[1.0, 1.0, 0.0, 0.0], [0.0, 1.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    )
    assert project_pillars(points, img_from_frame[None, None], (2, 2)).visible.tolist() == [
        [[True]]
    ]
