"""The halving of BEV features; reference*.py compares it with the original."""

import pytest
import torch

from gsmap.models.mgmapnet.bev_pyramid import BEVPyramid, PatchMerging


def test_four_cells_become_one_in_the_order_of_the_original():
    """A 2 x 4 map of one channel: even column first, both rows of it, then the odd column.

    0 1 | 2 3
    4 5 | 6 7
    """
    merge = PatchMerging(embed_dims=1)
    merge.norm = torch.nn.Identity()
    merge.reduction.weight.data = torch.tensor([[1000.0, 100.0, 10.0, 1.0]])
    out = merge(torch.arange(8.0).view(1, 1, 2, 4))
    assert out.tolist() == [[[[415, 2637]]]]


def test_levels_halve_from_the_finest():
    bev = torch.randn(2, 4, 8, 12)
    levels = BEVPyramid(embed_dims=4, num_levels=3)(bev)
    assert levels[0] is bev
    assert [tuple(level.shape) for level in levels[1:]] == [(2, 4, 4, 6), (2, 4, 2, 3)]
    assert not list(BEVPyramid(4, 1).parameters())


def test_odd_sides_and_no_level_are_named():
    with pytest.raises(ValueError, match="even sides to be halved, got 50 x 25"):
        PatchMerging(4)(torch.zeros(1, 4, 50, 25))
    with pytest.raises(ValueError, match="num_levels must be >= 1, got 0"):
        BEVPyramid(4, 0)
