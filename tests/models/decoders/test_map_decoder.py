import pytest
import torch

from gsmap.models.decoders.map_decoder import MapDecoder, MapDecoderLayer, refine_reference


def test_refinement_moves_centres_before_the_sigmoid_and_adds_the_rest():
    reference = torch.tensor([[0.5, 0.2, 1.0, -2.0, 0.3]])
    offsets = torch.tensor([[0.0, 1.0, 0.5, 0.5, -0.3]])
    logit = torch.logit(torch.tensor(0.2))
    expected = torch.tensor([[0.5, torch.sigmoid(logit + 1.0), 1.5, -1.5, 0.0]])
    torch.testing.assert_close(refine_reference(reference, offsets), expected)


def test_refinement_at_the_border_stays_finite_and_has_a_gradient():
    reference = torch.tensor([[0.0, 1.0]])
    offsets = torch.zeros(1, 2, requires_grad=True)
    refined = refine_reference(reference, offsets)
    torch.testing.assert_close(refined, torch.tensor([[0.0, 1.0]]), atol=2e-5, rtol=0)
    refined.sum().backward()
    assert torch.isfinite(offsets.grad).all()
    assert (offsets.grad > 0).all()


def test_refinement_is_float32_under_mixed_precision():
    refined = refine_reference(torch.rand(1, 2), torch.rand(1, 2, dtype=torch.bfloat16))
    assert refined.dtype == torch.float32


def test_refinement_refuses_other_shapes():
    with pytest.raises(ValueError, match=r"offsets must have shape \(3, 2\) of reference"):
        refine_reference(torch.rand(3, 2), torch.rand(3, 5))


def small_decoder(num_layers=2):
    torch.manual_seed(0)
    layer = {"embed_dims": 8, "num_heads": 2, "num_sampling_points": 2, "ffn_dims": 16}
    return MapDecoder(layer, num_layers).eval()


def test_each_layer_refines_what_the_one_before_returned():
    decoder = small_decoder()
    reference = torch.rand(2, 6, 2)
    steps = [torch.randn(2, 6, 2), torch.randn(2, 6, 2)]
    states, references = decoder(
        torch.randn(2, 6, 8),
        torch.randn(2, 6, 8),
        reference,
        torch.randn(2, 8, 5, 4),
        lambda number, _: steps[number],
    )
    assert states.shape == (2, 2, 6, 8)
    first = refine_reference(reference, steps[0])
    torch.testing.assert_close(references[0], first)
    torch.testing.assert_close(references[1], refine_reference(first, steps[1]))


def test_the_gradient_is_cut_between_layers():
    decoder = small_decoder()
    steps = [torch.zeros(1, 6, 2, requires_grad=True) for _ in range(2)]
    _, references = decoder(
        torch.randn(1, 6, 8),
        torch.randn(1, 6, 8),
        torch.rand(1, 6, 2),
        torch.randn(1, 8, 5, 4),
        lambda number, _: steps[number],
    )
    references[1].sum().backward()
    assert not steps[0].grad.any()
    assert steps[1].grad.abs().min() > 0


def test_a_masked_query_does_not_change_the_others():
    decoder = small_decoder(num_layers=1)
    query, position = torch.randn(1, 6, 8), torch.randn(1, 6, 8)
    mask = torch.zeros(6, 6, dtype=torch.bool)
    mask[:5, 5] = True  # nobody looks at the last query
    arguments = (torch.rand(1, 6, 2), torch.randn(1, 8, 5, 4), lambda *_: torch.zeros(1, 6, 2))
    before, _ = decoder(query, position, *arguments, mask)
    changed = query.clone()
    changed[:, 5] += 3.0
    after, _ = decoder(changed, position, *arguments, mask)
    torch.testing.assert_close(before[:, :, :5], after[:, :, :5])
    assert not torch.allclose(before[:, :, 5], after[:, :, 5])


def test_a_layer_is_three_residual_blocks_with_norms_after():
    torch.manual_seed(0)
    layer = MapDecoderLayer(embed_dims=8, num_heads=2, num_sampling_points=2, ffn_dims=16).eval()
    query, position = torch.randn(1, 6, 8), torch.randn(1, 6, 8)
    reference, bev = torch.rand(1, 6, 2), torch.randn(1, 8, 5, 4)
    key = query + position
    x = layer.norms[0](query + layer.self_attn(key, key, query)[0])
    x = layer.norms[1](x + layer.cross_attn(x + position, reference, bev))
    x = layer.norms[2](x + layer.ffn.layers(x))
    torch.testing.assert_close(layer(query, position, reference, bev), x)
