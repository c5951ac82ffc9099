"""BEV pooling against hand-worked sums, a scalar loop, and torch's own convolution."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.ops.bev_pool import bev_pool, bev_pool_conv3x3, cell_indices
from gsmap.structures.grid import BEVGrid

GRID = BEVGrid((-2.0, 2.0), (-3.0, 3.0), height=6, width=4)


def random_case(
    batch: int = 2, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    shape = (batch, 3, 5, 2, 3)
    probs = torch.rand(shape, generator=generator, dtype=dtype)
    context = torch.randn((batch, 3, 7, 2, 3), generator=generator, dtype=dtype)
    cells = torch.randint(-4, GRID.height * GRID.width, shape, generator=generator).clamp(min=-1)
    return probs, context, cells


def looped_pool(probs: Tensor, context: Tensor, cells: Tensor) -> Tensor:
    pooled = context.new_zeros(len(probs), context.shape[2], GRID.height * GRID.width)
    for b, v, d, y, x in cells.ge(0).nonzero().tolist():
        pooled[b, :, cells[b, v, d, y, x]] += probs[b, v, d, y, x] * context[b, v, :, y, x]
    return pooled.view(len(probs), -1, GRID.height, GRID.width)


def test_cells_count_from_the_smallest_x_and_y():
    points = torch.tensor([[-1.9, -2.9, 0.0], [1.9, -2.9, 0.0], [-0.5, 2.5, 0.0]])
    assert cell_indices(points, GRID, (-1, 1)).tolist() == [0, 3, 5 * 4 + 1]


def test_truncation_lets_one_cell_below_the_edge_count_as_the_first():
    # a cell is 1 m wide and 2 m high: -2.9 m lies 0.9 cells below the edge, -3.1 m lies 1.1 below
    points = torch.tensor([[-2.9, 0.5, 0.0], [-3.1, 0.5, 0.0], [0.5, 0.5, -2.9], [0.5, 0.5, -3.1]])
    assert cell_indices(points, GRID, (-1, 1)).tolist() == [12, -1, 14, -1]


def test_upper_edges_are_outside():
    points = torch.tensor([[2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 1.0]])
    assert cell_indices(points, GRID, (-1, 1)).tolist() == [-1, -1, -1]


def test_two_points_of_one_cell_add_up():
    probs = torch.tensor([0.25, 0.5]).view(1, 1, 2, 1, 1)
    context = torch.tensor([4.0, 8.0]).view(1, 1, 2, 1, 1)
    cells = torch.full((1, 1, 2, 1, 1), 9)  # row 2, column 1
    pooled = bev_pool(probs, context, cells, GRID)
    assert pooled.shape == (1, 2, 6, 4)
    assert pooled[0, :, 2, 1].tolist() == [3.0, 6.0]  # (0.25 + 0.5) * context
    assert pooled.sum() == 9


def test_pool_equals_a_loop():
    case = random_case()
    torch.testing.assert_close(bev_pool(*case, GRID), looped_pool(*case))


def test_pooled_convolution_equals_convolving_the_pooled_map():
    case = random_case()
    weight = torch.randn(4, 7, 3, 3, dtype=torch.float64)
    expected = F.conv2d(looped_pool(*case), weight, padding=1)
    torch.testing.assert_close(bev_pool_conv3x3(*case, GRID, weight), expected)


def test_no_point_gives_zeros():
    probs, context, cells = random_case()
    nowhere = torch.full_like(cells, -1)
    weight = torch.randn(4, 7, 3, 3, dtype=torch.float64)
    assert bev_pool(probs, context, nowhere, GRID).eq(0).all()
    assert bev_pool_conv3x3(probs, context, nowhere, GRID, weight).eq(0).all()


def test_same_bits_every_time():
    probs, context, cells = random_case(dtype=torch.float32)
    weight = torch.randn(4, 7, 3, 3)
    first = bev_pool_conv3x3(probs, context, cells, GRID, weight)
    assert torch.equal(first, bev_pool_conv3x3(probs, context, cells, GRID, weight))


def test_gradients():
    probs, context, cells = random_case(batch=1)
    probs, context = probs[:, :2, :3], context[:, :2, :3]
    cells = cells[:, :2, :3]
    weight = torch.randn(2, 3, 3, 3, dtype=torch.float64, requires_grad=True)
    inputs = (probs.clone().requires_grad_(), context.clone().requires_grad_())
    assert torch.autograd.gradcheck(lambda p, c: bev_pool(p, c, cells, GRID), inputs)
    assert torch.autograd.gradcheck(
        lambda p, c, w: bev_pool_conv3x3(p, c, cells, GRID, w), (*inputs, weight)
    )


def test_bad_shapes_are_named():
    probs, context, cells = random_case()
    with pytest.raises(ValueError, match="probs and cells"):
        bev_pool(probs, context, cells[:1], GRID)
    with pytest.raises(ValueError, match="context must have shape"):
        bev_pool(probs, context[..., :2], cells, GRID)
    with pytest.raises(ValueError, match="weight must have shape"):
        bev_pool_conv3x3(probs, context, cells, GRID, torch.zeros(4, 6, 3, 3).double())
    with pytest.raises(ValueError, match="points_m must end"):
        cell_indices(torch.zeros(3, 2), GRID, (-1, 1))
    with pytest.raises(ValueError, match="z_range"):
        cell_indices(torch.zeros(3, 3), GRID, (1, -1))
