import pytest
import torch
from mmcv.ops.multi_scale_deform_attn import multi_scale_deformable_attn_pytorch

from gsmap.models.base.attention import BEVDeformableAttention, directional_offsets, place_samples

SHAPE = (5, 7)  # rows, columns


def test_directional_offsets_lie_on_squares():
    offsets = directional_offsets(4, 2)
    expected = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    torch.testing.assert_close(offsets[:, 0], expected)
    torch.testing.assert_close(offsets[:, 1], 2 * expected)


@pytest.mark.parametrize("late", [False, True])
def test_attention_equals_its_formula_whether_it_projects_before_or_after_sampling(late):
    torch.manual_seed(0)
    attention = BEVDeformableAttention(embed_dims=8, num_heads=2, num_points=3).eval()
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
    attention = BEVDeformableAttention(embed_dims=8, num_heads=4, num_points=2)
    reference = torch.full((1, 1, 2), 0.5)
    offsets = attention.offsets_in_cells(torch.randn(1, 1, 8))
    locations = place_samples(offsets, reference, (10, 20))
    # head 0 looks along +x: one and two cells of 1 / 20
    torch.testing.assert_close(locations[0, 0, 0], torch.tensor([[0.55, 0.5], [0.6, 0.5]]))
    assert torch.equal(attention.weights(torch.randn(1, 1, 8)), torch.full((1, 1, 4, 2), 0.5))


def test_channels_must_divide_among_the_heads():
    with pytest.raises(ValueError, match="divisible by num_heads, got 9 and 4"):
        BEVDeformableAttention(embed_dims=9, num_heads=4)
