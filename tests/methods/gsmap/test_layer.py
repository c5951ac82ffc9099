"""The guided layer: gradients from Gaussians to Gaussians, and where it looks."""

import math

import pytest
import torch
from mmengine.registry import init_default_scope

from gsmap.models.base.attention import place_samples
from gsmap.models.base.decoder import MapDecoder, MapDecoderLayer
from gsmap.models.gsmap.guidance import GaussianGuidance
from gsmap.models.gsmap.layer import GaussianDecoderLayer, add_guidance
from gsmap.models.maptr.references import refine_reference
from gsmap.structures.gaussians import GaussianSpace
from gsmap.structures.grid import BEVGrid

SPACE = GaussianSpace(BEVGrid((-15, 15), (-30, 30)))
SELF = {"self_attn": {"type": "PointSelfAttention"}}
DECOUPLED = {"self_attn": {"type": "DecoupledSelfAttention"}}


def double_layer(**settings) -> GaussianDecoderLayer:
    """Return a small layer in float64 whose added parts are not neutral any more."""
    torch.manual_seed(0)
    sizes = {"embed_dims": 8, "num_heads": 2, "num_points": 3, "ffn_dims": 8, "dropout": 0.0}
    settings = {"cross_attn": {"num_points": 2}, "space": SPACE, **sizes, **settings}
    layer = GaussianDecoderLayer(**settings).double()
    for parameter in layer.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return layer


@pytest.mark.parametrize("attention", [SELF, DECOUPLED], ids=["joint", "decoupled"])
def test_the_path_from_gaussians_through_the_layer_to_gaussians_has_its_true_gradient(attention):
    layer = double_layer(**attention)
    query, position = torch.randn(2, 1, 3, 8, dtype=torch.float64)
    bev = torch.randn(1, 8, 6, 5, dtype=torch.float64)
    predict = torch.nn.Linear(8, 5).double()
    reference = torch.rand(1, 3, 5, dtype=torch.float64) * 0.6 + 0.2

    def gaussians(reference, query, bev):
        offsets = predict(layer(query, position, reference, bev))
        refined = SPACE.decode(refine_reference(reference, offsets))
        return torch.cat([refined.means, refined.scales, refined.rotations[..., None]], -1)

    inputs = [value.requires_grad_() for value in (reference, query, bev)]
    assert torch.autograd.gradcheck(gaussians, inputs)


def places(layer: GaussianDecoderLayer, reference: torch.Tensor) -> torch.Tensor:
    """Return where a layer samples a map of 6 x 5 cells for one and the same query."""
    query = torch.ones(1, reference.shape[1], 8, dtype=torch.float64)
    frames = layer.guidance.frames(reference, torch.empty(1, 1, 6, 5))
    offsets = layer.cross_attn.offsets_in_cells(query)
    return place_samples(offsets, reference, (6, 5), frames)


def test_each_of_the_five_parameters_changes_where_the_layer_looks():
    layer = double_layer()
    reference = torch.full((1, 3, 5), 0.4, dtype=torch.float64)
    before = places(layer, reference)
    for entry in range(5):
        changed = reference.clone()
        changed[..., entry] += 0.1
        assert (places(layer, changed) - before).abs().max() > 1e-3


@pytest.mark.parametrize("invariant", [False, True])
def test_half_a_turn_keeps_the_places_of_the_invariant_frame_only(invariant):
    layer = double_layer(invariant_frame=invariant)
    reference = torch.full((1, 3, 5), 0.4, dtype=torch.float64)
    turned = reference + torch.tensor([0, 0, 0, 0, math.pi])
    assert torch.allclose(places(layer, turned), places(layer, reference)) == invariant


def test_frames_act_on_metres_whatever_the_cells():
    """Cells of 6 x 10 m; a quarter turn brings one cell along y to 10 m along -x: 10 / 6 cells."""
    guidance = GaussianGuidance(SPACE, 8)
    reference = torch.tensor([[[0.5, 0.5, 0.0, 0.0, math.pi / 2]]])
    offsets = torch.tensor([0.0, 1.0]).view(1, 1, 1, 1, 2)
    turned = place_samples(
        offsets, reference, (6, 5), guidance.frames(reference, torch.empty(1, 1, 6, 5))
    )
    expected = torch.tensor([0.5 - 10 / 6 / 5, 0.5]).view_as(turned)  # five columns
    torch.testing.assert_close(turned, expected, atol=1e-6, rtol=0)
    left = place_samples(offsets, reference, (6, 5))
    torch.testing.assert_close(left, torch.tensor([0.5, 0.5 + 1 / 6]).view_as(left))


def test_a_new_guided_layer_computes_what_the_plain_one_does():
    torch.manual_seed(0)
    sizes = {"embed_dims": 8, "num_heads": 2, "num_points": 3, "ffn_dims": 8}
    plain = MapDecoderLayer(**sizes).eval()
    guided = GaussianDecoderLayer(space=SPACE, **sizes).eval()
    left = guided.load_state_dict(plain.state_dict(), strict=False)
    assert all(key.startswith("guidance.embedding.") for key in left.missing_keys)
    query, position = torch.randn(2, 1, 6, 8)
    reference = torch.rand(1, 6, 5) * torch.tensor([1.0, 1, 0, 0, 0])
    bev = torch.randn(1, 8, 6, 5)
    expected = plain(query, position, reference, bev)
    assert torch.equal(guided(query, position, reference, bev), expected)


def test_guidance_without_gaussians_is_refused():
    with pytest.raises(ValueError, match="needs a reference that holds Gaussians"):
        GaussianDecoderLayer()


def test_a_decoder_takes_the_layer_that_is_guided():
    """MapTR's take the layer that is guided."""
    for decoder in ({}, {"type": MapDecoder}):
        layer = {"type": GaussianDecoderLayer, "ffn_dims": 4}
        assert add_guidance({**decoder, "layer": {"ffn_dims": 4}}) == {**decoder, "layer": layer}


def test_the_guidance_of_a_layer_has_settings_or_is_switched_off():
    plain = add_guidance({"num_layers": 1, "layer": {"guidance": None}})
    plain["layer"].update(num_heads=2, ffn_dims=8)
    init_default_scope("mmdet3d")
    decoder = MapDecoder(**plain, embed_dims=8, num_points=3, space=SPACE)
    assert decoder.layers[0].guidance is None
    settings = {"guidance": {"sampling": False}}
    guided = add_guidance({"num_layers": 1, "layer": settings})
    assert guided["layer"]["guidance"] == {"type": GaussianGuidance, "sampling": False}
