"""Self-attentions of a decoder layer against attention computed group by group."""

import pytest
import torch

from gsmap.models.maptr.self_attention import PointSelfAttention
from gsmap.models.maptrv2.attention import DecoupledSelfAttention

N, P, C = 4, 3, 8
BOTH = pytest.mark.parametrize("kind", [PointSelfAttention, DecoupledSelfAttention])


def build(kind):
    torch.manual_seed(0)
    return kind(embed_dims=C, num_heads=2, num_points=P).eval()


def inputs(batch: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    query, pos = torch.randn(2, batch, N * P, C, generator=generator)
    return query, pos


def test_points_attend_to_all_points_with_a_residual():
    module, (query, pos) = build(PointSelfAttention), inputs()
    key = query + pos
    attention = torch.nn.MultiheadAttention(C, 2, batch_first=True).eval()
    attention.load_state_dict(module.state_dict())
    torch.testing.assert_close(module(query, pos), query + attention(key, key, query)[0])


def test_decoupled_equals_attention_group_by_group():
    module, (query, pos) = build(DecoupledSelfAttention), inputs()
    first = torch.empty_like(query)
    for p in range(P):  # the p-th points of all instances
        chosen = slice(p, None, P)
        key = (query + pos)[:, chosen]
        attended = module.instance_attn(key, key, query[:, chosen])[0]
        first[:, chosen] = module.norm(query[:, chosen] + attended)
    expected = torch.empty_like(query)
    for n in range(N):  # the points of one instance
        chosen = slice(n * P, (n + 1) * P)
        key = (first + pos)[:, chosen]
        expected[:, chosen] = first[:, chosen] + module.point_attn(key, key, first[:, chosen])[0]
    torch.testing.assert_close(module(query, pos), expected)


@BOTH
def test_masked_groups_do_not_see_each_other(kind):
    module, (query, pos) = build(kind), inputs()
    group = torch.tensor([0, 0, 1, 1])
    mask = group[:, None] != group
    both = module(query, pos, mask)
    alone = module(query[:, : 2 * P], pos[:, : 2 * P])
    torch.testing.assert_close(both[:, : 2 * P], alone)
    changed = query.clone()
    changed[:, 2 * P :] += 1
    torch.testing.assert_close(module(changed, pos, mask)[:, : 2 * P], alone)


@BOTH
def test_every_parameter_learns(kind):
    module, (query, pos) = build(kind).train(), inputs()
    module(query, pos).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in module.parameters())
