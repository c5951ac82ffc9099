"""Half precision where the arithmetic is, and compiled parts: switches of a training."""

import pytest
import torch
from model_cases import (
    build_small,
    disable_dropout,
    make_images,
    make_samples,
    small_config,
    straight_elements,
)

from gsmap.models.detector import MapDetector

TWO = straight_elements(((-5.0, -20.0), (-5.0, 20.0)), ((4.0, -10.0), (9.0, 15.0)), labels=[0, 2])


def build(**settings) -> MapDetector:
    """Build a small GSMap without chance in training."""
    head = {**small_config()["map_head"], "type": "GSMapHead", "masks": {"pixel_m": 1.5}}
    model = build_small(map_head=head, img_augment=None, **settings)
    return disable_dropout(model).train()


def first_linear(part: torch.nn.Module) -> torch.nn.Linear:
    return next(module for module in part.modules() if isinstance(module, torch.nn.Linear))


def losses_and_gradients(model: MapDetector) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Return the losses of one batch, and all gradients as one vector."""
    torch.manual_seed(1)
    losses = model.loss(make_images(2), make_samples(TWO, TWO))
    model.zero_grad()
    model.parse_losses(losses)[0].backward()
    gradients = [p.grad.flatten() for p in model.parameters() if p.grad is not None]
    return losses, torch.cat(gradients)


def test_backbone_neck_and_encoder_alone_are_in_half_precision():
    model, seen = build(autocast="bfloat16"), {}
    parts = {
        "backbone": model.img_backbone.conv1,
        "neck": model.img_neck.deblocks[0][0],
        "encoder": first_linear(model.bev_encoder.layers[0].ffn),
        "decoder": first_linear(model.map_head.decoder.layers[0].ffn),
        "classes": model.map_head.cls_branches[0][-1],
    }
    for name, part in parts.items():
        part.register_forward_hook(lambda *given, name=name: seen.update({name: given[-1].dtype}))
    losses, gradients = losses_and_gradients(model)
    half = {name for name, dtype in seen.items() if dtype == torch.bfloat16}
    assert seen.keys() == parts.keys()
    assert half == {"backbone", "neck", "encoder"}
    expected, wanted = losses_and_gradients(build())
    for name, loss in losses.items():
        assert loss.dtype == torch.float32
        # bfloat16 has three digits
        torch.testing.assert_close(loss, expected[name], rtol=0.05, atol=0.02)
    assert torch.cosine_similarity(gradients, wanted, dim=0) > 0.98


def test_predictions_stay_in_full_precision():
    torch.manual_seed(0)
    images = make_images(1)
    found = []
    for settings in ({}, {"autocast": "bfloat16"}):
        with torch.no_grad():
            samples = build(**settings).eval().predict(images, make_samples(TWO))
        found.append(samples[0].pred_instances_3d.pts)
    assert torch.equal(*found)


def test_another_type_is_refused():
    with pytest.raises(ValueError, match="autocast must be None or 'bfloat16', got 'float16'"):
        build(autocast="float16")


def test_compiled_parts_have_the_same_gradients_and_state(monkeypatch):
    monkeypatch.setattr(MapDetector, "compiler", "aot_eager")
    plain, compiled = build(), build(compiled=True)
    assert compiled.map_head._compiled_call_impl is not None
    assert list(compiled.state_dict()) == list(plain.state_dict())
    (losses, gradients), (expected, wanted) = map(losses_and_gradients, (compiled, plain))
    for name, loss in losses.items():
        torch.testing.assert_close(loss, expected[name], rtol=1e-4, atol=1e-6)
    # the order of sums differs
    assert (gradients - wanted).norm() < 1e-4 * wanted.norm()
