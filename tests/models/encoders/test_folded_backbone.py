"""The backbone of inference: the same maps as the backbone's own, from fewer passes."""

import copy

import pytest
import torch
from mmdet3d.registry import MODELS
from model_cases import build_small
from torch import nn

from gsmap.models.encoders.folded_backbone import FoldedBackbone, can_be_folded


@pytest.fixture
def backbone() -> nn.Module:
    """A ResNet whose batch norms do something."""
    config = dict(
        type="mmdet.ResNet", depth=18, base_channels=8, stem_channels=8, out_indices=(1, 3)
    )
    model = MODELS.build(config)
    generator = torch.Generator().manual_seed(0)
    for norm in model.modules():
        if isinstance(norm, nn.BatchNorm2d):
            norm.weight.data.uniform_(0.5, 1.5, generator=generator)
            norm.bias.data.uniform_(-1, 1, generator=generator)
            norm.running_mean.uniform_(-1, 1, generator=generator)
            norm.running_var.uniform_(0.5, 2, generator=generator)
    model.eval()
    return model


IMAGES = torch.randn(2, 3, 32, 64, generator=torch.Generator().manual_seed(1))


def assert_same(ours: tuple[torch.Tensor, ...], theirs: tuple[torch.Tensor, ...]) -> None:
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_gives_the_backbones_maps_without_touching_it(backbone: nn.Module) -> None:
    before = copy.deepcopy(backbone.state_dict())
    folded = FoldedBackbone()
    assert_same(folded(backbone, IMAGES), backbone(IMAGES))
    assert folded.folded is not None
    assert not any(isinstance(m, nn.BatchNorm2d) for m in folded.folded.modules())
    after = backbone.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[key], after[key]) for key in before)


@torch.no_grad()
@pytest.mark.parametrize("change", ["in place", "loaded", "statistics", "moved", "replaced"])
def test_follows_every_change_of_a_weight(backbone: nn.Module, change: str) -> None:
    folded = FoldedBackbone()
    before = folded(backbone, IMAGES)
    if change == "in place":
        backbone.conv1.weight.mul_(1.5)
    elif change == "loaded":
        backbone.load_state_dict({k: 1.5 * v for k, v in backbone.state_dict().items()})
    elif change == "statistics":
        backbone.bn1.running_mean.add_(1)
    elif change == "moved":
        backbone.double()
    else:
        backbone.conv1.weight = nn.Parameter(backbone.conv1.weight * 1.5)
    images = IMAGES.to(backbone.conv1.weight.dtype)
    after = folded(backbone, images)
    assert_same(after, backbone(images))
    assert change == "moved" or not torch.allclose(before[0], after[0])


def test_works_on_a_model_made_in_inference_mode(backbone: nn.Module) -> None:
    with torch.inference_mode():
        made = copy.deepcopy(backbone)
        assert_same(FoldedBackbone()(made, IMAGES), backbone(IMAGES))


def test_is_the_backbone_itself_when_it_trains_or_is_watched(backbone: nn.Module) -> None:
    assert not can_be_folded(backbone)  # a gradient may be asked for
    with torch.no_grad():
        assert can_be_folded(backbone)
        backbone.bn1.train()
        assert not can_be_folded(backbone)
        backbone.eval()
        seen = []
        handle = backbone.layer1.register_forward_hook(lambda *args: seen.append(args))
        FoldedBackbone()(backbone, IMAGES)
        assert len(seen) == 1
        handle.remove()
        assert can_be_folded(backbone)
        assert not can_be_folded(nn.Sequential(nn.BatchNorm2d(3), nn.Conv2d(3, 3, 1)).eval())
    folded = FoldedBackbone()
    folded(backbone, IMAGES)[0].sum().backward()
    assert backbone.conv1.weight.grad is not None


def test_a_config_can_leave_the_backbone_as_it_is():
    model = build_small(fold_batch_norms=False)
    assert model.folded_backbone is None


def test_a_training_by_a_fused_optimizer_is_followed() -> None:
    """It changes weights, but not their versions; a replayed graph does not call the backbone."""
    model = build_small(img_neck=None).eval()
    with torch.no_grad():
        model.extract_img_feats(IMAGES[None])
    model.train()
    weights = list(model.img_backbone.parameters())
    for weight in weights:
        weight.grad = torch.ones_like(weight)
    torch.optim.AdamW(weights, lr=0.1, fused=True).step()
    model.eval()
    with torch.no_grad():
        feats = model.extract_img_feats(IMAGES[None])
        assert_same([level[0] for level in feats], model.img_backbone(IMAGES))


@torch.no_grad()
def test_a_backbone_with_deformable_convolutions_is_not_folded_nor_fed_channels_last():
    """mmcv folds their norm into another convolution, and reads channels last as first."""
    config = dict(
        type="mmdet.ResNet",
        depth=50,
        base_channels=8,
        stem_channels=8,
        out_indices=(2,),
        dcn=dict(type="DCNv2", deform_groups=1, fallback_on_stride=False),
        stage_with_dcn=(False, False, True, True),
    )
    backbone = MODELS.build(config)
    backbone.eval()
    for name, parameter in backbone.named_parameters():
        if "conv_offset" in name:
            nn.init.normal_(parameter, std=0.3)
    assert not can_be_folded(backbone)
    model = build_small(img_backbone=config, img_neck=None).eval()
    assert build_small().channels_last
    assert not model.channels_last
    model.img_backbone.load_state_dict(backbone.state_dict())
    (feats,) = model.extract_img_feats(IMAGES[None])
    assert_same((feats[0],), backbone(IMAGES))
