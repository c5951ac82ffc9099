import importlib.util
import json

import numpy as np
import pytest
import torch

pytest.importorskip("mmdet3d")

from gsmap.models.gemap.attention import GeometryDecoupledAttention
from gsmap.models.gemap.keys import GEMAP

UPSTREAM = "pts_bbox_head.transformer.decoder.layers.0.attentions.0."
OURS = "map_head.decoder.layers.0.self_attn."


@pytest.fixture(scope="module")
def recipes(golden_dir):
    """The golden files' recipes of weights and of inputs."""
    modules = []
    for name in ("weights_recipe", "inputs_recipe"):
        spec = importlib.util.spec_from_file_location(name, golden_dir / f"models/{name}.py")
        modules.append(importlib.util.module_from_spec(spec))
        spec.loader.exec_module(modules[-1])
    return modules


@pytest.fixture(scope="module")
def state(golden_dir, recipes):
    """The golden weights under our names."""
    shapes = json.loads((golden_dir / "models/gemap_gda_state.json").read_text())
    state = {}
    for key, shape in shapes.items():
        ours = GEMAP.to_ours(UPSTREAM + key).removeprefix(OURS)
        state[ours] = torch.from_numpy(recipes[0].tensor("gda." + key, shape, "A"))
    return state


@pytest.mark.parametrize(("size", "instances", "points"), [("small", 6, 5), ("full", 50, 20)])
def test_equals_the_golden_output(golden_dir, recipes, state, size, instances, points):
    golden = np.load(golden_dir / "models/gemap_gda_A.npz")
    expected = torch.from_numpy(golden[f"{size}_out"])  # sequence first
    shape = (instances * points, expected.shape[1], 256)
    query = torch.from_numpy(recipes[1].normal(f"gda_query_{size}", shape)).transpose(0, 1)
    attention = GeometryDecoupledAttention(num_points=points).eval()
    attention.load_state_dict(state)
    with torch.no_grad():
        output = attention(query, torch.full_like(query, torch.nan))  # its position is not used
    output = output.transpose(0, 1)[:: len(query[0]) // len(expected)]
    torch.testing.assert_close(output, expected, atol=1e-5, rtol=0)


def small_attention(**kwargs):
    torch.manual_seed(0)
    return GeometryDecoupledAttention(8, 2, num_points=3, ffn_dims=16, **kwargs).eval()


def test_the_defaults_are_the_releases():
    attention = GeometryDecoupledAttention()
    assert attention.num_points == 20
    for block in (attention.inter, attention.intra):
        assert (block.attention.embed_dim, block.attention.num_heads) == (256, 8)
        assert (block.ffn[0].out_features, block.attention.dropout) == (1024, 0.1)


def test_the_first_step_sees_other_instances_and_the_second_ones_own():
    attention, query = small_attention(), torch.randn(1, 12, 8, requires_grad=True)
    output = attention(query)
    (gradient,) = torch.autograd.grad(output[0, 0, 0], query)
    assert gradient[0].abs().sum(-1).gt(0).all()
    blocked = torch.ones(4, 4, dtype=torch.bool)
    blocked[0, 1], blocked[1, 0], blocked[2, 3], blocked[3, 2] = False, False, False, False
    output = attention(query, attn_mask=blocked)  # pairs (0, 1) and (2, 3)
    (gradient,) = torch.autograd.grad(output[0, 0, 0], query)
    assert gradient[0, :6].abs().sum(-1).gt(0).all()
    assert not gradient[0, 6:].any()


def test_instances_and_samples_may_be_reordered():
    attention, query = small_attention(), torch.randn(2, 12, 8)
    order = torch.tensor([2, 0, 3, 1])
    with torch.no_grad():
        expected = attention(query).unflatten(1, (4, 3))[:, order].flatten(1, 2)
        shuffled = query.unflatten(1, (4, 3))[:, order].flatten(1, 2)
        torch.testing.assert_close(attention(shuffled), expected)
        torch.testing.assert_close(attention(query[1:]), attention(query)[1:])


def test_training_and_inference_agree_without_dropout():
    attention, query = small_attention(dropout=0.0), torch.randn(2, 12, 8)
    with torch.no_grad():
        expected = attention(query)
    torch.testing.assert_close(attention.train()(query), expected)


@pytest.mark.parametrize("count", [3, 10])
def test_other_numbers_of_queries_are_refused(count):
    with pytest.raises(ValueError, match=f"instances of num_points 3 queries each, got {count}"):
        small_attention()(torch.randn(1, count, 8))
