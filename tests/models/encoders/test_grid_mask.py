import pytest
import torch

from gsmap.models.encoders.grid_mask import GridMask


def test_the_mask_is_a_regular_grid_of_black_squares():
    torch.manual_seed(0)
    mask = GridMask(ratio=0.5).draw_mask(60, 80)
    assert mask.shape == (60, 80)
    black = mask == 0
    rows, cols = black.any(1), black.any(0)
    # a pixel is black exactly where its row and its column both are of the grid
    assert torch.equal(black, rows[:, None] & cols)
    assert 0 < black.float().mean() < 0.5


def test_all_images_of_a_batch_share_the_mask():
    torch.manual_seed(0)
    masked = GridMask(prob=1.0)(torch.ones(3, 3, 40, 50))
    assert torch.equal(masked[0], masked[2])
    assert set(masked.unique().tolist()) == {0.0, 1.0}


def test_probability_zero_leaves_the_images_alone():
    images = torch.rand(2, 3, 8, 8)
    assert GridMask(prob=0.0)(images) is images


def test_wrong_settings_are_refused():
    with pytest.raises(ValueError, match=r"prob must be in \[0, 1\]"):
        GridMask(prob=1.5)
