"""MGMapNet's attention from its definition; reference*.py compares it with the original."""

import pytest
import torch
import torch.nn.functional as F

from gsmap.models.mgmapnet.attention import (
    Granularities,
    MultiGranularityAttention,
    MultiPointAttention,
)

B, N, P, K, C, HEADS = 2, 3, 4, 5, 8, 2
SMALL = {"embed_dims": C, "num_heads": HEADS, "num_points": P, "num_samples": K, "dropout": 0.0}


def build(kind=MultiGranularityAttention, **settings):
    torch.manual_seed(0)
    attention = kind(**SMALL, **settings).double()
    for parameter in attention.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    return attention


def inputs(num_levels=2):
    generator = torch.Generator().manual_seed(1)
    sizes = [(6, 10), (3, 5)][:num_levels]
    feats = [
        torch.randn(B, C, *s, generator=generator, dtype=torch.float64).requires_grad_()
        for s in sizes
    ]
    query, position = torch.randn(2, B, N, C, generator=generator, dtype=torch.float64)
    # beyond the map on every side, so that the zero padding counts
    reference = torch.rand(B, N, P, 3, generator=generator, dtype=torch.float64) * 1.4 - 0.2
    return query, position, reference, feats


def by_definition(attention, query, reference, feats):
    """Sample one by one: MGMapNet's equations with heads and levels. -> (B, N, C), (B, N, P, C)"""
    offsets = attention.sampling_offsets(query).view(B, N, HEADS, len(feats), P, K, 2)
    logits = attention.attention_weights(query).view(B, N, HEADS, len(feats), P, K)
    joint = logits.flatten(3).softmax(-1).view_as(logits)
    own = logits.softmax(-1)
    instances = torch.zeros(B, N, HEADS, C // HEADS, dtype=torch.float64)
    points = torch.zeros(B, N, P, HEADS, C // HEADS, dtype=torch.float64)
    for level, feat in enumerate(feats):
        value = attention.value_proj(feat.movedim(1, -1)).movedim(-1, 1)
        size = torch.tensor([feat.shape[3], feat.shape[2]])
        for head in range(HEADS):
            where = reference[:, :, :, None, :2] + offsets[:, :, head, level] / size
            part = value[:, head * C // HEADS : (head + 1) * C // HEADS]
            seen = F.grid_sample(part, where.flatten(2, 3) * 2 - 1, align_corners=False)
            seen = seen.view(B, -1, N, P, K).movedim(1, -1)  # (B, N, P, K, C')
            instances[:, :, head] += (seen * joint[:, :, head, level, ..., None]).sum((2, 3))
            points[:, :, :, head] += (seen * own[:, :, head, level, ..., None]).sum(3) / len(feats)
    return instances.flatten(2), points.flatten(3)


@pytest.mark.parametrize("num_levels", [1, 2])
def test_one_sampling_gives_both_granularities_and_their_gradients(num_levels):
    attention = build(num_levels=num_levels)
    query, position, reference, feats = inputs(num_levels)
    samples = attention.compute_samples(query + position, reference, feats)
    ours = attention.aggregate(feats, samples)
    theirs = by_definition(attention, query + position, reference, feats)
    gradients = []
    for outputs in (ours, theirs):
        attention.zero_grad()
        scalar = sum(out.square().sum() for out in outputs)
        by_level = torch.autograd.grad(scalar, feats, retain_graph=True)
        scalar.backward()
        parameters = [p.grad for p in attention.parameters() if p.grad is not None]
        gradients.append([*by_level, *parameters])
    for mine, other in zip([*ours, *gradients[0]], [*theirs, *gradients[1]], strict=True):
        torch.testing.assert_close(mine, other)


def test_multi_point_attention_is_the_instance_half():
    attention = build(MultiPointAttention)
    query, position, reference, feats = inputs()
    out = attention(Granularities(query), position, reference, feats)
    seen, _ = by_definition(attention, query + position, reference, feats)
    torch.testing.assert_close(out.instances, query + attention.output_proj(seen))
    points = attention.point_proj(out.instances).view(B, N, P, C)
    torch.testing.assert_close(out.points, points)


def test_a_new_attention_looks_around_its_reference():
    attention = MultiGranularityAttention(**SMALL, num_levels=2)
    query, position, reference, feats = (x for x in inputs())
    feats = [feat.float() for feat in feats]
    out = attention(Granularities(query.float()), position.float(), reference.float(), feats)
    # opposite heads cancel: the mean of all samples is the reference itself
    torch.testing.assert_close(out.mean_locations, reference[..., :2].float())
    samples = attention.compute_samples(query.float(), reference.float(), feats)
    torch.testing.assert_close(samples.point_weights, torch.full_like(samples.weights, 1 / K))
    torch.testing.assert_close(samples.weights, torch.full_like(samples.weights, 1 / (2 * P * K)))


def influence(attention, before=False):
    """Return how instance 1's points move when instance 0's query, or previous points, change."""
    query, position, reference, feats = inputs()
    generator = torch.Generator().manual_seed(2)
    points, code = torch.randn(2, B, N, P, C, generator=generator, dtype=torch.float64)
    outputs = []
    for change in (0.0, 1.0):
        moved, moved_points = query.clone(), points.clone()
        (moved_points if before else moved)[:, 0] += change
        state = Granularities(moved, moved_points, code)
        outputs.append(attention(state, position, reference, feats))
    difference = (outputs[0].points - outputs[1].points).detach().abs().amax((0, 2, 3))
    return difference[0] > 0, difference[1] > 0


def test_only_p2i_crosses_from_one_instance_to_another():
    assert influence(build()) == (True, True)
    assert influence(build(p2i=False)) == (True, False)


def test_p2p_sees_the_points_of_the_layer_before_within_an_instance():
    attention = build(p2i=False)
    assert influence(attention, before=True) == (True, False)
    points, before = torch.randn(2, B, N, P, C, dtype=torch.float64)
    state = Granularities(inputs()[0])
    first = attention.attend_to_points(points, 0.0, state)
    later = attention.attend_to_points(points, 0.0, state._replace(points=before))
    assert not torch.allclose(first, later)
    assert build(p2p=False).attend_to_points(points, 0.0, state) is points


SWITCHES = [
    {},
    {"p2p": False},
    {"p2i": False},
    {"p2p": False, "p2i": False},
    {"position_codes": False},
    {"add_instance": False},
    {"num_levels": 1},
]


@pytest.mark.parametrize("settings", SWITCHES, ids=str)
def test_every_parameter_of_every_ablation_takes_part(settings):
    attention = build(**settings)
    query, position, reference, feats = inputs(settings.get("num_levels", 2))
    state = Granularities(query, *torch.randn(2, B, N, P, C, dtype=torch.float64))
    out = attention(state, position, reference, feats)
    (out.instances.square().sum() + out.points.square().sum()).backward()
    assert [name for name, p in attention.named_parameters() if p.grad is None] == []


def test_codes_and_joined_instance_change_the_points():
    query, position, reference, feats = inputs()
    variants = [build(), build(add_instance=False), build()]
    for branch in (variants[2].point_code, variants[2].instance_code):
        torch.nn.init.zeros_(branch[-1].weight)
        torch.nn.init.zeros_(branch[-1].bias)
    without = build(position_codes=False)
    without.load_state_dict(variants[2].state_dict(), strict=False)
    points = [a(Granularities(query), position, reference, feats).points for a in variants]
    assert not torch.allclose(points[0], points[1])
    assert not torch.allclose(points[0], points[2])
    plain = without(Granularities(query), position, reference, feats)
    torch.testing.assert_close(plain.points, points[2])  # a code of zero is no code
    assert plain.point_code == 0


def test_wrong_numbers_of_levels_or_points_are_named():
    query, position, reference, feats = inputs()
    attention = build()
    with pytest.raises(ValueError, match=r"2 levels of BEV features and 4 points .* got 1 and 4"):
        attention(Granularities(query), position, reference, feats[:1])
    with pytest.raises(ValueError, match="4 points per instance, got 2 and 3"):
        attention(Granularities(query), position, reference[:, :, :3], feats)
    with pytest.raises(ValueError, match="divisible by num_heads, got 9 and 4"):
        MultiPointAttention(embed_dims=9, num_heads=4)
