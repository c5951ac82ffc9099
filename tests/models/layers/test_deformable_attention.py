import pytest
import torch
from mmcv.ops.multi_scale_deform_attn import multi_scale_deformable_attn_pytorch

from gsmap.models.layers.deformable_attention import (
    DeformableAttention,
    bilinear_cells,
    deformable_sample,
    directional_offsets,
    sum_rows,
)

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


def test_directional_offsets_lie_on_squares():
    offsets = directional_offsets(4, 2)
    expected = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    torch.testing.assert_close(offsets[:, 0], expected)
    torch.testing.assert_close(offsets[:, 1], 2 * expected)


@pytest.mark.parametrize("late", [False, True])
def test_attention_equals_its_formula_whether_it_projects_before_or_after_sampling(late):
    torch.manual_seed(0)
    attention = DeformableAttention(embed_dims=8, num_heads=2, num_points=3).eval()
    for parameter in attention.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    feats = torch.randn(2, 8, *((20, 30) if late else SHAPE))
    query, reference = torch.randn(2, 9, 8), torch.rand(2, 9, 5) * 1.2 - 0.1
    shape = tuple(feats.shape[-2:])
    assert late == (2 * shape[0] * shape[1] * 2 > 2 * 9 * 2 * 3 * 4)  # the module's own rule

    value = attention.value_proj(feats.flatten(2).transpose(1, 2)).unflatten(-1, (2, 4))
    offsets = attention.sampling_offsets(query).view(2, 9, 2, 3, 2)
    locations = reference[:, :, None, None, :2] + offsets / torch.tensor([shape[1], shape[0]])
    weights = attention.attention_weights(query).view(2, 9, 2, 3).softmax(-1)
    sampled = multi_scale_deformable_attn_pytorch(
        value, torch.tensor([shape]), locations[:, :, :, None], weights[:, :, :, None]
    )
    expected = attention.output_proj(sampled)
    torch.testing.assert_close(attention(query, reference, feats), expected, atol=1e-5, rtol=1e-5)


def test_a_new_attention_looks_in_every_direction_with_equal_weights():
    attention = DeformableAttention(embed_dims=8, num_heads=4, num_points=2)
    reference = torch.full((1, 1, 2), 0.5)
    locations = attention.sampling_locations(torch.randn(1, 1, 8), reference, (10, 20))
    # head 0 looks along +x: one and two cells of 1 / 20
    torch.testing.assert_close(locations[0, 0, 0], torch.tensor([[0.55, 0.5], [0.6, 0.5]]))
    assert torch.equal(attention.weights(torch.randn(1, 1, 8)), torch.full((1, 1, 4, 2), 0.5))


def test_channels_must_divide_among_the_heads():
    with pytest.raises(ValueError, match="divisible by num_heads, got 9 and 4"):
        DeformableAttention(embed_dims=9, num_heads=4)
