"""MapTRv2's decoder layer against attention computed group by group."""

import torch
from gsmap.models.decoders.decoupled_layer import DecoupledDecoderLayer

N, P, C = 4, 3, 8


def layer() -> DecoupledDecoderLayer:
    torch.manual_seed(0)
    return DecoupledDecoderLayer(num_points=P, embed_dims=C, num_heads=2, ffn_dims=16).eval()


def inputs(batch: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    query, pos = torch.randn(2, batch, N * P, C, generator=generator)
    return query, pos


def test_equals_attention_group_by_group():
    module = layer()
    query, pos = inputs()
    first = torch.empty_like(query)
    for p in range(P):  # the p-th points of all instances
        chosen = slice(p, None, P)
        key = (query + pos)[:, chosen]
        attended = module.self_attn(key, key, query[:, chosen])[0]
        first[:, chosen] = module.norms[0](query[:, chosen] + attended)
    expected = torch.empty_like(query)
    for n in range(N):  # the points of one instance
        chosen = slice(n * P, (n + 1) * P)
        key = (first + pos)[:, chosen]
        attended = module.point_attn(key, key, first[:, chosen])[0]
        expected[:, chosen] = module.norms[1](first[:, chosen] + attended)
    torch.testing.assert_close(module.interact(query, pos, None), expected)


def test_masked_groups_do_not_see_each_other():
    module = layer()
    query, pos = inputs()
    group = torch.tensor([0, 0, 1, 1])
    mask = group[:, None] != group
    both = module.interact(query, pos, mask)
    alone = module.interact(query[:, : 2 * P], pos[:, : 2 * P], None)
    torch.testing.assert_close(both[:, : 2 * P], alone)
    changed = query.clone()
    changed[:, 2 * P :] += 1
    torch.testing.assert_close(module.interact(changed, pos, mask)[:, : 2 * P], alone)


def test_whole_layer_uses_four_norms():
    module = layer()
    query, pos = inputs()
    reference = torch.rand(2, N * P, 2)
    out = module(query, pos, reference, torch.randn(2, C, 6, 5))
    out.square().sum().backward()
    assert out.shape == query.shape
    assert len(module.norms) == 4
    assert all(norm.weight.grad.abs().sum() > 0 for norm in module.norms)
