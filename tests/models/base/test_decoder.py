import pytest
import torch

import gsmap.registered  # noqa: F401
from gsmap.models.base.decoder import MapDecoder, MapDecoderLayer
from gsmap.models.maptr.references import refine_reference

SIZES = {"embed_dims": 8, "num_heads": 2, "num_points": 1, "ffn_dims": 16}
LAYER = {**SIZES, "cross_attn": {"num_points": 2}}


def small_decoder(num_layers=2, **settings):
    torch.manual_seed(0)
    layer = {"type": "MapDecoderLayer", **LAYER}
    return MapDecoder(layer, num_layers, num_points=1, **settings).eval()


def stepping(steps):
    """Return a refinement that moves the reference by given offsets."""
    return lambda number, _, reference: refine_reference(reference, steps[number])


def test_each_layer_refines_what_the_one_before_returned():
    decoder = small_decoder()
    reference = torch.rand(2, 6, 2)
    steps = [torch.randn(2, 6, 2), torch.randn(2, 6, 2)]
    out = decoder(
        torch.randn(2, 6, 8),
        torch.randn(2, 6, 8),
        reference,
        torch.randn(2, 8, 5, 4),
        stepping(steps),
    )
    assert [layer.point_states.shape for layer in out] == [(2, 6, 1, 8)] * 2
    first = refine_reference(reference, steps[0])
    torch.testing.assert_close(out[0].references[:, :, 0], first)
    torch.testing.assert_close(out[1].references[:, :, 0], refine_reference(first, steps[1]))


@pytest.mark.parametrize("cut", [True, False])
def test_the_gradient_between_layers_is_cut_or_not(cut):
    decoder = small_decoder(**({} if cut else {"detach_reference": False}))
    steps = [torch.zeros(1, 6, 2, requires_grad=True) for _ in range(2)]
    out = decoder(
        torch.randn(1, 6, 8),
        torch.randn(1, 6, 8),
        torch.rand(1, 6, 2),
        torch.randn(1, 8, 5, 4),
        stepping(steps),
    )
    out[1].references.sum().backward()
    assert (steps[0].grad is None or not steps[0].grad.any()) == cut
    assert steps[1].grad.abs().min() > 0


def test_a_masked_query_does_not_change_the_others():
    decoder = small_decoder(num_layers=1)
    query, position = torch.randn(1, 6, 8), torch.randn(1, 6, 8)
    mask = torch.zeros(6, 6, dtype=torch.bool)
    mask[:5, 5] = True  # nobody looks at the last query
    arguments = (torch.rand(1, 6, 2), torch.randn(1, 8, 5, 4), stepping([torch.zeros(1, 6, 2)]))
    before = decoder(query, position, *arguments, mask)[0].point_states
    changed = query.clone()
    changed[:, 5] += 3.0
    after = decoder(changed, position, *arguments, mask)[0].point_states
    torch.testing.assert_close(before[:, :5], after[:, :5])
    assert not torch.allclose(before[:, 5], after[:, 5])


def test_a_layer_is_three_residual_blocks_with_norms_after():
    torch.manual_seed(0)
    layer = MapDecoderLayer(**LAYER).eval()
    query, position = torch.randn(1, 6, 8), torch.randn(1, 6, 8)
    reference, bev = torch.rand(1, 6, 2), torch.randn(1, 8, 5, 4)
    x = layer.norms[0](layer.self_attn(query, position))
    x = layer.norms[1](x + layer.cross_attn(x + position, reference, bev))
    x = layer.norms[2](x + layer.ffn.layers(x))
    torch.testing.assert_close(layer(query, position, reference, bev), x)


def test_a_layer_takes_its_attentions_as_parts():
    decoupled = {"type": "DecoupledSelfAttention"}
    layer = MapDecoderLayer(**{**LAYER, "num_points": 2}, self_attn=decoupled).train()
    inputs = torch.randn(2, 1, 6, 8)
    out = layer(*inputs, torch.rand(1, 6, 2), torch.randn(1, 8, 5, 4))
    out.square().sum().backward()
    assert type(layer.self_attn).__name__ == "DecoupledSelfAttention"
    norms = [*layer.norms, layer.self_attn.norm]  # four, of both attentions
    assert all(norm.weight.grad.abs().sum() > 0 for norm in norms)
    assert layer.cross_attn.num_points == 2
