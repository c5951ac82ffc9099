"""Depth bins and the depth loss, worked by hand."""

import math

import pytest
import torch

from gsmap.models.maptrv2.depth import depth_bins, depth_loss
from gsmap.structures.tensors import num_depth_bins

RANGE = (1.0, 3.0, 0.5)  # bins 1.0-1.5, 1.5-2.0, 2.0-2.5, 2.5-3.0 m


def test_number_of_bins():
    assert num_depth_bins(RANGE) == 4
    assert num_depth_bins((1.0, 35.0, 0.5)) == 68
    with pytest.raises(ValueError, match="one bin or more"):
        num_depth_bins((1.0, 1.2, 0.5))


def test_a_block_takes_its_nearest_return():
    depth = torch.zeros(2, 6)
    depth[0, 0], depth[1, 1] = 2.7, 1.6  # first block: the nearer one, bin 1
    depth[0, 2] = 3.01  # second block: beyond the last bin
    depth[1, 4], depth[0, 5] = 0.9, 2.2  # third block: the nearest is too near, and hides the other
    assert depth_bins(depth, 2, RANGE).tolist() == [[1, -1, -1]]


def test_bin_edges():
    depth = torch.tensor([[1.0, 1.49, 1.5, 2.99, 3.0, 0.0]])
    assert depth_bins(depth, 1, RANGE).tolist() == [[0, 0, 1, 3, -1, -1]]


def test_leading_axes_are_kept():
    assert depth_bins(torch.zeros(2, 6, 8, 12), 4, RANGE).shape == (2, 6, 2, 3)


def test_stride_must_divide_the_image():
    with pytest.raises(ValueError, match="divisible by stride 4"):
        depth_bins(torch.zeros(6, 8), 4, RANGE)


def test_depth_loss_is_the_mean_over_pixels_with_a_target():
    probs = torch.tensor([[0.5, 0.9], [0.25, 0.05], [0.25, 0.05]]).view(3, 1, 2)
    assert depth_loss(probs, torch.tensor([[1, -1]])).item() == pytest.approx(math.log(4))
    both = depth_loss(probs, torch.tensor([[1, 0]])).item()
    assert both == pytest.approx((math.log(4) - math.log(0.9)) / 2)


def test_depth_loss_without_target_is_zero_and_differentiable():
    logits = torch.randn(3, 2, 2, requires_grad=True)
    loss = depth_loss(logits.softmax(0), torch.full((2, 2), -1))
    loss.backward()
    assert loss.item() == 0
    assert logits.grad.eq(0).all()


def test_depth_loss_of_zero_probability_is_finite():
    probs = torch.tensor([1.0, 0.0]).view(2, 1, 1).requires_grad_()
    loss = depth_loss(probs, torch.tensor([[1]]))
    loss.backward()
    assert 80 < loss.item() < 90  # -log of the smallest normal float32
    assert probs.grad.isfinite().all()


def test_depth_loss_names_bad_shapes():
    with pytest.raises(ValueError, match="bins must have the shape"):
        depth_loss(torch.rand(3, 2, 2), torch.zeros(2, 3, dtype=torch.long))
