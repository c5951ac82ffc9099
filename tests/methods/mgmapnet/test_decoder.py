"""MGMapNet's decoder: who sees whom, references, switches of the ablation tables."""

import pytest
import torch
from mmdet3d.registry import MODELS
from mmengine.registry import init_default_scope

import gsmap.registered  # noqa: F401
from gsmap.models.maptr.references import refine_reference
from gsmap.structures.gaussians import GaussianSpace
from gsmap.structures.grid import BEVGrid

B, N, P, C = 2, 4, 3, 8
BASELINE = {"type": "MultiPointAttention"}


def build(num_levels=2, cross_attn=None, space=None, **layer):
    init_default_scope("mmdet3d")
    torch.manual_seed(0)
    config = {
        "type": "MGMapNetDecoder",
        "num_layers": 3,
        "embed_dims": C,
        "num_points": P,
        "space": space,
        "num_levels": num_levels,
        "layer": {
            "num_heads": 2,
            "ffn_dims": 16,
            "cross_attn": {"num_samples": 2, **(cross_attn or {})},
            **layer,
        },
    }
    decoder = MODELS.build(config).eval().double()
    for name, parameter in decoder.named_parameters():
        if parameter.dim() > 1:  # so that nothing starts neutral
            torch.nn.init.normal_(parameter, std=5.0 if "offsets" in name else 0.3)
    return decoder


def inputs(dims=2):
    generator = torch.Generator().manual_seed(1)
    shapes = [(B, N, C), (B, N, C), (B, C, 8, 6)]
    normal = [torch.randn(*s, generator=generator, dtype=torch.float64) for s in shapes]
    return *normal, torch.rand(B, N, dims, generator=generator, dtype=torch.float64)


def run(decoder, mask=None, num=N, dims=2, step=0.3):
    position, content, bev, reference = inputs(dims)
    position, content, reference = (x[:, :num] for x in (position, content, reference))

    def refine(_, states, reference):
        return refine_reference(reference, step * states[..., :dims])

    mask = decoder.layer_mask(mask, group_mask=mask)
    layers = decoder(content, position, reference, bev, refine, mask)
    names = vars(layers[0])
    return {name: torch.stack([vars(layer)[name] for layer in layers]) for name in names}


@pytest.mark.parametrize("dims", [2, 3, 5])
def test_shapes_and_references_of_several_entries(dims):
    out = run(build(reference_dims=min(dims, 3)), dims=dims)
    assert out["instance_states"].shape == (3, B, N, C)
    assert out["point_states"].shape == (3, B, N, P, C)
    assert out["references"].shape == (3, B, N, P, dims)
    assert out["mean_locations"].shape == (3, B, N, P, 2)


def test_the_gradient_is_cut_between_layers():
    decoder = build()
    moves = torch.zeros(3, requires_grad=True)
    position, query, bev, reference = inputs()
    out = decoder(
        query, position, reference, bev, lambda n, _, r: refine_reference(r, moves[n].expand_as(r))
    )
    (gradient,) = torch.autograd.grad(out[2].references.sum(), moves, retain_graph=True)
    assert gradient.ne(0).tolist() == [False, False, True]
    locations = sum(layer.mean_locations.sum() for layer in out)
    (gradient,) = torch.autograd.grad(locations, moves, allow_unused=True)
    assert gradient is None or not gradient.any()


def test_later_layers_look_around_the_refined_reference():
    decoder = build()
    moved, still = run(decoder, step=2.0), run(decoder, step=0.0)
    assert torch.equal(moved["mean_locations"][0], still["mean_locations"][0])
    assert not torch.allclose(moved["mean_locations"][1], still["mean_locations"][1])


def test_a_mask_parts_the_groups_in_the_self_attention_but_not_in_p2i():
    group = torch.tensor([False, False, True, True])
    mask = group[:, None] != group
    without = build(cross_attn={"p2i": False})
    both, alone = run(without, mask), run(without, num=2)
    torch.testing.assert_close(both["point_states"][:, :, :2], alone["point_states"])
    torch.testing.assert_close(both["instance_states"][:, :, :2], alone["instance_states"])
    full = build()
    both, alone = run(full, mask), run(full, num=2)
    assert not torch.allclose(both["point_states"][:, :, :2], alone["point_states"])


ROWS = {  # the poster's tables
    "multi-point": {"num_levels": 1, "cross_attn": BASELINE, "reference_dims": None},
    "(a)": {"num_levels": 1, "cross_attn": {"position_codes": False}, "reference_dims": None},
    "(c)": {"cross_attn": {"position_codes": False}, "reference_dims": None},
    "(d)": {},
    "interaction: multi-point": {"cross_attn": BASELINE},
    "interaction: none": {"cross_attn": {"p2p": False, "p2i": False}},
    "interaction: P2P": {"cross_attn": {"p2i": False}},
    "interaction: P2I": {"cross_attn": {"p2p": False}},
}


@pytest.mark.parametrize("row", ROWS)
def test_every_row_of_the_tables_trains_with_all_of_its_parameters(row):
    decoder = build(**ROWS[row]).train()
    out = run(decoder)
    loss = (
        out["instance_states"].square().sum()
        + out["references"].sum()
        + out["mean_locations"].sum()
    )
    loss.backward()
    assert [name for name, p in decoder.named_parameters() if p.grad is None] == []


def test_gaussians_guide_positions_and_samples_once_they_are_not_neutral():
    grid = BEVGrid((-15, 15), (-30, 30), 8, 6)
    settings = {"space": GaussianSpace(grid), "reference_dims": 2}
    guided, plain = (
        build(**settings, guidance={"type": "GaussianGuidance"}),
        build(reference_dims=2),
    )
    plain.load_state_dict({k: guided.state_dict()[k] for k in plain.state_dict()})
    assert not torch.allclose(
        run(guided, dims=5)["mean_locations"][0], run(plain, dims=5)["mean_locations"][0]
    )
    for layer in guided.layers:
        layer.guidance.init_weights()
    layer = guided.layers[0]
    neutral = torch.rand(B, N * P, 5, dtype=torch.float64)
    neutral[..., 2:] = 0
    frames = layer.guidance.frames(neutral, torch.empty(1, 1, 8, 6))
    torch.testing.assert_close(frames, torch.eye(2, dtype=frames.dtype).expand_as(frames))
    position = torch.randn(B, N, C, dtype=torch.float64)
    torch.testing.assert_close(layer.guide_position(position, neutral), position)


def test_without_a_position_code_every_layer_adds_the_learned_position():
    assert [layer.reference_code is None for layer in build().layers] == [True, False, False]
    assert all(layer.reference_code is None for layer in build(reference_dims=None).layers)
