import pytest
import torch
from mmcv.ops.multi_scale_deform_attn import multi_scale_deformable_attn_pytorch

from gsmap.ops.deformable_sampling import bilinear_cells, deformable_sample, sum_rows

SHAPE = (5, 7)  # rows, columns


def random_problem(dtype=torch.float64):
    torch.manual_seed(0)
    value = torch.randn(2, 35, 4, 6, dtype=dtype, requires_grad=True)
    # beyond the map on every side, so that the zero padding counts
    locations = (torch.rand(2, 9, 4, 3, 2, dtype=dtype) * 1.6 - 0.3).requires_grad_()
    weights = torch.rand(2, 9, 4, 3, dtype=dtype, requires_grad=True)
    return value, locations, weights


def test_values_and_gradients_equal_mmcv():
    ours, theirs = random_problem(), random_problem()
    out = deformable_sample(ours[0], SHAPE, ours[1], ours[2])
    shapes = torch.tensor([SHAPE])
    reference = multi_scale_deformable_attn_pytorch(
        theirs[0], shapes, theirs[1][:, :, :, None], theirs[2][:, :, :, None]
    )
    torch.testing.assert_close(out, reference)
    seed = torch.randn_like(out)
    (out * seed).sum().backward()
    (reference * seed).sum().backward()
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine.grad, other.grad)


def test_bilinear_weights_by_hand():
    # a 2 x 2 map; (0.5, 0.25) is halfway between the centres of the upper two cells
    cells, weights = bilinear_cells(torch.tensor([[0.5, 0.25]]), torch.tensor([2.0]), (2, 2))
    total = torch.zeros(4).index_add(0, cells.flatten(), weights.flatten())
    torch.testing.assert_close(total, torch.tensor([1.0, 1.0, 0.0, 0.0]))
    # the corner of the map has a quarter of its weight inside
    cells, weights = bilinear_cells(torch.zeros(1, 2), torch.ones(1), (2, 2))
    total = torch.zeros(4).index_add(0, cells.flatten(), weights.flatten())
    torch.testing.assert_close(total, torch.tensor([0.25, 0.0, 0.0, 0.0]))


def test_a_location_that_is_not_a_number_poisons_its_own_sample_only():
    value, locations, weights = random_problem(torch.float32)
    with torch.no_grad():
        clean = deformable_sample(value, SHAPE, locations, weights)
        locations[0, 3, 1, 2, 0] = float("nan")
        locations[1, 2, 0, 0] = float("inf")
        out = deformable_sample(value, SHAPE, locations, weights)
    poisoned = torch.zeros(2, 9, 4, 6, dtype=torch.bool)
    poisoned[0, 3, 1] = poisoned[1, 2, 0] = True
    assert out.unflatten(-1, (4, 6))[poisoned].isnan().all()
    torch.testing.assert_close(
        out.unflatten(-1, (4, 6))[~poisoned], clean.unflatten(-1, (4, 6))[~poisoned]
    )


def test_sum_rows_equals_the_plain_sum():
    torch.manual_seed(0)
    table, rows, weights = torch.randn(8, 3), torch.randint(8, (2, 4, 5)), torch.rand(2, 4, 5)
    expected = (table[rows] * weights[..., None]).sum(-2)
    torch.testing.assert_close(sum_rows(table, rows, weights), expected)


@pytest.mark.usefixtures("poisoned_empty")
@pytest.mark.parametrize("shape", [(50, 3, 7), (1, 1, 1), (0, 4, 3)])
def test_the_fused_gradient_equals_torchs(shape):
    bags, samples, channels = shape
    torch.manual_seed(0)
    rows = torch.randint(0, 20, (bags, 2, samples))
    results = []
    for backend, dtype in (("cpu", torch.float32), ("reference", torch.float64)):
        torch.manual_seed(1)
        table = torch.randn(20, channels, dtype=torch.float64).to(dtype).requires_grad_()
        weights = torch.randn(bags, 2, samples, dtype=torch.float64).to(dtype).requires_grad_()
        out = sum_rows(table, rows, weights, backend)
        (
            out
            * torch.linspace(-1, 1, max(out.numel(), 1), dtype=dtype)[: out.numel()].view(out.shape)
        ).sum().backward()
        results.append((out, table.grad, weights.grad))
    for fused, exact in zip(*results, strict=True):
        # sums of up to 100 float32 products of size 1
        torch.testing.assert_close(fused, exact.float(), atol=1e-5, rtol=1e-5)


def test_the_fused_gradient_works_under_compile_and_twice():
    table = torch.randn(20, 4, requires_grad=True)
    rows, weights = torch.randint(0, 20, (6, 3)), torch.rand(6, 3, requires_grad=True)
    out = sum_rows(table, rows, weights).square().sum()
    first = torch.autograd.grad(out, (table, weights), retain_graph=True)
    again = torch.autograd.grad(out, (table, weights))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    compiled = torch.compile(lambda t, w: sum_rows(t, rows, w).square().sum(), backend="aot_eager")
    for a, b in zip(
        first, torch.autograd.grad(compiled(table, weights), (table, weights)), strict=True
    ):
        torch.testing.assert_close(a, b)
