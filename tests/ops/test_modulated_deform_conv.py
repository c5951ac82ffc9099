"""The deformable convolution of torch: mmcv's, where it has no compiled operator."""

import pytest
import torch
import torch.nn.functional as F
from mmcv import _ext
from mmcv.ops import modulated_deform_conv2d

import gsmap.mmcv_ext

COMPILED = _ext.__file__ != gsmap.mmcv_ext.__file__
MODULE = "mmcv.ops.modulated_deform_conv.ext_module"


def inputs(bias: bool, spread: float = 3.0) -> list[torch.Tensor | None]:
    """Images, offset, mask, weight, bias of 2 groups and 2 deformable groups; stride (2, 1)."""
    draw = torch.Generator().manual_seed(0)
    shapes = (2, 8, 9, 7), (2, 24, 5, 6), (2, 12, 5, 6), (6, 4, 3, 2), (6,)
    tensors = [torch.randn(s, generator=draw, dtype=torch.float64) for s in shapes]
    tensors[1] *= spread
    return [t.requires_grad_() for t in tensors[: 4 + bias]] + [None] * (not bias)


def run(values: list[torch.Tensor | None]) -> list[torch.Tensor]:
    """Return the output and the gradients of a sum of its squares."""
    out = modulated_deform_conv2d(*values, (2, 1), (1, 0), (1, 1), 2, 2)
    return [out, *torch.autograd.grad((out**2).sum(), [v for v in values if v is not None])]


@pytest.mark.skipif(not COMPILED, reason="mmcv is installed without its compiled operators")
@pytest.mark.parametrize("bias", [True, False])
def test_it_equals_the_compiled_operator(monkeypatch, bias):
    theirs = run(inputs(bias))
    monkeypatch.setattr(MODULE, gsmap.mmcv_ext)
    for ours, other in zip(run(inputs(bias)), theirs, strict=True):
        torch.testing.assert_close(ours, other)


@pytest.mark.parametrize("bias", [True, False])
def test_without_shifts_it_is_a_convolution(monkeypatch, bias):
    monkeypatch.setattr(MODULE, gsmap.mmcv_ext)
    images, offset, mask, weight, own = inputs(bias, spread=0.0)
    mask = torch.ones_like(mask, requires_grad=True)
    out, grad_images, *_ = run([images, offset, mask, weight, own])
    plain = F.conv2d(images, weight, own, (2, 1), (1, 0), 1, 2)
    torch.testing.assert_close(out, plain)
    torch.testing.assert_close(grad_images, torch.autograd.grad((plain**2).sum(), images)[0])
