"""Attention of the queries to the map, against a twin, and the queries that it leaves alone."""

import pytest
import torch
from head_cases import GSMAP, HEAD, N, P, bev, build_head

from gsmap.models.base.decoder import Queries
from gsmap.models.base.hooks import FlowStart
from gsmap.models.hrmapnet.query_start import MapKeys, PriorHook, PriorQueries

C, M, K = 16, 3, 7


def attention() -> PriorQueries:
    torch.manual_seed(0)
    queries = PriorQueries(C, num_channels=M, num_heads=4)
    queries.init_weights()
    return queries.eval()


def keys(*counts: int) -> MapKeys:
    generator = torch.Generator().manual_seed(1)
    return MapKeys(
        torch.rand(len(counts), K, M, generator=generator),
        torch.randn(len(counts), K, C, generator=generator),
        is_valid=torch.arange(K) < torch.tensor(counts)[:, None],
    )


def twin(queries: PriorQueries, query: torch.Tensor, cells: MapKeys, sample: int) -> torch.Tensor:
    """Attention of each head as a loop over the valid cells of a sample. (Q, C)"""
    count = int(cells.is_valid[sample].sum())
    values, positions = cells.values[sample, :count], cells.positions[sample, :count]
    tokens = positions + values @ queries.label_encoder.weight.T + queries.label_encoder.bias
    attn, width = queries.attention, C // 4
    parts = []
    for weight, bias, source in zip(
        attn.in_proj_weight.chunk(3),
        attn.in_proj_bias.chunk(3),
        (query, tokens, tokens),
        strict=True,
    ):
        parts.append(source @ weight.T + bias)
    heads = []
    for head in range(4):
        q, k, v = (part[:, head * width : (head + 1) * width] for part in parts)
        heads.append((q @ k.T / width**0.5).softmax(-1) @ v)
    return torch.cat(heads, -1) @ attn.out_proj.weight.T + attn.out_proj.bias


def test_queries_attend_to_the_valid_cells_only():
    queries, cells = attention(), keys(5, 0, 1, K)
    query = torch.randn(4, 6, C)
    with torch.no_grad():
        change = queries(query, cells)
        for sample in (0, 2, 3):
            expected = twin(queries, query[sample], cells, sample)
            torch.testing.assert_close(change[sample], expected, atol=1e-5, rtol=1e-5)
    assert (change[1] == 0).all()


def test_a_sample_without_cells_has_finite_gradients():
    queries, query = attention(), torch.randn(1, 6, C, requires_grad=True)
    queries(query, keys(0)).sum().backward()
    assert (query.grad == 0).all()
    for parameter in queries.parameters():
        assert (parameter.grad == 0).all()


@pytest.mark.parametrize("config", [HEAD, GSMAP], ids=["points", "Gaussians"])
def test_both_halves_of_the_queries_change_and_references_follow(config):
    head, queries = build_head(config).eval(), attention()
    position, content = (half[None] for half in head.queries())
    start = FlowStart(Queries(content, position, head.reference.start(position)), None)
    further = torch.ones(1, 2 * P, C)  # queries of another hook, which stay as they are
    references = head.reference.start(further)
    joined = Queries(
        torch.cat([content, further], 1),
        torch.cat([position, further], 1),
        torch.cat([start.queries.reference, references], 1),
    )
    cells = keys(4)
    with torch.no_grad():
        found = PriorHook(queries, cells).start(head, FlowStart(joined, None)).queries
        change = queries(position, cells)
    assert change.abs().sum() > 0
    own = N * P
    torch.testing.assert_close(found.state[:, :own], content + change)
    torch.testing.assert_close(found.position[:, :own], position + change)
    torch.testing.assert_close(found.reference[:, :own], head.reference.start(position + change))
    for part, expected in zip(found, (further, further, references), strict=True):
        torch.testing.assert_close(part[:, own:], expected)


def test_without_cells_a_head_predicts_as_before():
    head = build_head(HEAD).eval()
    hook = PriorHook(attention(), keys(0))
    with torch.no_grad():
        plain, started = head(bev()), head(bev(), hooks=(hook,))
    torch.testing.assert_close(started[-1].pts, plain[-1].pts)
    torch.testing.assert_close(hook.scores.read(), plain[-1].scores)
    torch.testing.assert_close(hook.points_m.read(), head.reference.metres(plain[-1].pts))
