"""Training of a ResNet with fixed batch norms as fused convolutions."""

import pytest
import torch
from mmdet.models.backbones import ResNet
from torch import nn

from gsmap.models.encoders.fused_resnet import FrozenNorms, has_frozen_norms

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


def make_backbone(depth=18, requires_grad=False, **settings):
    """A small ResNet in training mode, whose norms have statistics of their own."""
    torch.manual_seed(0)
    backbone = ResNet(
        depth,
        base_channels=8,
        out_indices=(1, 3),
        norm_cfg={"type": "BN", "requires_grad": requires_grad},
        norm_eval=True,
        **settings,
    )
    for module in backbone.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, 0, 0.1)
    backbone.train()
    return backbone


def gradients_of(backbone, feats):
    """Gradients of all trained parameters by a fixed function of the feature maps."""
    backbone.zero_grad()
    sum(feat.float().sin().sum() for feat in feats).backward()
    return {
        name: parameter.grad.clone()
        for name, parameter in backbone.named_parameters()
        if parameter.grad is not None
    }


@pytest.mark.parametrize("depth", [18, 50])
@pytest.mark.parametrize("requires_grad", [False, True])
@pytest.mark.parametrize("frozen_stages", [-1, 1])
def test_maps_and_gradients_are_those_of_separate_norms(depth, requires_grad, frozen_stages):
    backbone = make_backbone(depth, requires_grad, frozen_stages=frozen_stages).double()
    assert has_frozen_norms(backbone)
    images = torch.randn(2, 3, 64, 96, dtype=torch.float64)
    expected = backbone(images)
    expected_gradients = gradients_of(backbone, expected)
    actual = FrozenNorms()(backbone, images, dtype=torch.float64)
    actual_gradients = gradients_of(backbone, actual)
    for ours, theirs in zip(actual, expected, strict=True):
        torch.testing.assert_close(ours, theirs)
    assert actual_gradients.keys() == expected_gradients.keys()
    assert len(actual_gradients) > 10
    for name, gradient in actual_gradients.items():
        torch.testing.assert_close(gradient, expected_gradients[name], msg=name)


def test_gradients_reach_the_images():
    backbone = make_backbone().double()
    images = torch.rand(1, 3, 32, 32, dtype=torch.float64, requires_grad=True)
    (expected,) = torch.autograd.grad(backbone(images)[1].sum(), images)
    feats = FrozenNorms()(backbone, images, dtype=torch.float64)
    (actual,) = torch.autograd.grad(feats[1].sum(), images)
    torch.testing.assert_close(actual, expected)


def test_new_statistics_are_used():
    backbone = make_backbone()
    frozen_norms = FrozenNorms()
    images = torch.randn(1, 3, 32, 32)
    before = frozen_norms(backbone, images, dtype=torch.float32)
    for buffer in backbone.buffers():
        if buffer.is_floating_point():
            buffer.mul_(2)
    after = frozen_norms(backbone, images, dtype=torch.float32)
    assert (after[0] - before[0]).norm() > 0.1 * before[0].norm()
    for ours, theirs in zip(after, backbone(images), strict=True):
        torch.testing.assert_close(ours, theirs)


def test_half_precision_keeps_three_digits():
    backbone = make_backbone(50)
    images = torch.randn(1, 3, 64, 64)
    for ours, theirs in zip(
        FrozenNorms()(backbone, images, dtype=torch.bfloat16), backbone(images), strict=True
    ):
        assert ours.dtype == torch.bfloat16
        assert 0 < (ours.float() - theirs).norm() < 0.02 * theirs.norm()


def test_other_backbones_are_left_as_they_are():
    assert not has_frozen_norms(None)
    assert not has_frozen_norms(nn.Conv2d(3, 8, kernel_size=3))
    assert not has_frozen_norms(make_backbone(with_cp=True))
    assert not has_frozen_norms(make_backbone(50, deep_stem=True))
    trained_norms = make_backbone()
    trained_norms.layer2[0].bn1.train()
    assert not has_frozen_norms(trained_norms)
    hooked = make_backbone()
    hooked.layer1.register_forward_hook(lambda *_: None)
    assert not has_frozen_norms(hooked)


@needs_gpu
def test_fused_operators_equal_separate_norms_on_a_gpu():
    backbone = make_backbone(50).cuda()
    images = torch.randn(2, 3, 64, 96, device="cuda").contiguous(memory_format=torch.channels_last)
    expected = backbone(images)
    expected_gradients = gradients_of(backbone, expected)
    actual = FrozenNorms()(backbone, images, dtype=torch.bfloat16)
    for ours, theirs in zip(actual, expected, strict=True):
        assert (ours.float() - theirs).norm() < 0.02 * theirs.norm()
    for name, gradient in gradients_of(backbone, actual).items():
        expected_gradient = expected_gradients[name]
        cosine = torch.cosine_similarity(gradient.flatten(), expected_gradient.flatten(), dim=0)
        assert cosine > 0.99, name
