"""ResNet whose convolutions include the batch norm, residual and ReLU after them, for a GPU."""

from typing import Any, Protocol

import torch
import torch.nn.functional as F
from mmdet.models.backbones import ResNet
from mmdet.models.backbones.resnet import BasicBlock, Bottleneck
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from gsmap.structures.tensors import is_recording, tensor_versions

Geometry = dict[str, Any]  # stride, padding, dilation and groups of a convolution


class Convolve(Protocol):
    """Convolution, batch norm, optional residual and optional ReLU as one operation."""

    def __call__(
        self,
        conv: nn.Conv2d,
        norm: nn.Module,
        x: Tensor,
        identity: Tensor | None = None,
        relu: bool = True,
    ) -> Tensor:
        """Compute ``relu(norm(conv(x)) + identity)``.

        Args:
            conv: The convolution.
            norm: The batch norm after the convolution. A function whose convolutions already
                contain their batch norms does not use it.
            x: Input. (n, C, h, w)
            identity: Residual in the shape of the output, or None.
            relu: Whether the ReLU is applied.

        Returns:
            Output. (n, D, h', w')
        """
        ...


def fused_resnet(backbone: ResNet, images: Tensor, convolve: Convolve) -> tuple[Tensor, ...]:
    """Compute the feature maps of a ResNet of plain blocks (`is_plain`).

    Args:
        backbone: The ResNet.
        images: Input of the ResNet. (n, 3, H, W)
        convolve: Function that computes each convolution with its norm, residual and ReLU.

    Returns:
        The maps of ``backbone.out_indices``. (n, C, h, w) each
    """
    x = backbone.maxpool(convolve(backbone.conv1, backbone.norm1, images))
    feats = []
    # `res_layers` has the attribute names of the stages.
    for index, name in enumerate(backbone.res_layers):
        for block in getattr(backbone, name):
            identity = x
            if block.downsample is not None:
                # The shortcut is a convolution with its norm. Variants of ResNet pool first.
                *pooling, conv, norm = block.downsample
                for layer in pooling:
                    identity = layer(identity)
                identity = convolve(conv, norm, identity, relu=False)
            x = convolve(block.conv1, block.norm1, x)
            if isinstance(block, Bottleneck):
                x = convolve(block.conv2, block.norm2, x)
                x = convolve(block.conv3, block.norm3, x, identity)
            else:
                x = convolve(block.conv2, block.norm2, x, identity)
        if index in backbone.out_indices:
            feats.append(x)
    return tuple(feats)


def is_plain(backbone: nn.Module) -> bool:
    """Whether a backbone is a ResNet of plain blocks, which `fused_resnet` requires.

    A plain block has no plugins, deformable convolutions (``dcn``) or gradient checkpointing. The
    stem must be a single convolution.
    """
    if not isinstance(backbone, ResNet):
        return False
    has_extras = backbone.deep_stem or backbone.plugins is not None or backbone.dcn is not None
    if has_extras:
        return False
    for name in backbone.res_layers:
        for block in getattr(backbone, name):
            # Subclasses of the blocks may compute something else, so they do not count.
            # ``with_cp`` is mmdet's name of gradient checkpointing.
            if type(block) not in (BasicBlock, Bottleneck) or block.with_cp:
                return False
    return True


def convolve_folded(
    conv: nn.Conv2d,
    norm: nn.Module,
    x: Tensor,
    identity: Tensor | None = None,
    relu: bool = True,
) -> Tensor:
    """Convolution on a GPU whose weights include the batch norm (`Convolve`).

    Args:
        conv: The convolution, with the batch norm folded into its weights.
        norm: Not used, since the weights include it.
        x: Input. (n, C, h, w)
        identity: Residual in the shape of the output, or None.
        relu: Whether the ReLU is applied.
    """
    if not relu:
        return conv(x)
    return _convolve_relu(x, conv.weight, conv.bias, identity=identity, geometry=_geometry(conv))


class FrozenNorms:
    """Forward pass, with gradients, of a ResNet whose batch norms have fixed statistics.

    A norm with fixed statistics is a scale and a shift per channel. The scale multiplies the
    weights of the convolution, with gradients, and the shift is the bias of the convolution.
    Compared with separate norms and ReLUs, this avoids most of the memory traffic of the backbone.
    The weights of the backbone, and therefore its checkpoints, do not change.
    """

    def __init__(self) -> None:
        # For each norm without gradients: versions of its tensors (`tensor_versions`), scale and
        # shift. The versions show whether the tensors have changed since.
        self._constants: dict[nn.Module, tuple[list[tuple[int, int]], Tensor, Tensor]] = {}

    def __call__(self, backbone: ResNet, images: Tensor, dtype: torch.dtype) -> tuple[Tensor, ...]:
        """Compute the feature maps of normalised images.

        Args:
            backbone: ResNet for which `has_frozen_norms` is True.
            images: Normalised images. (n, 3, H, W)
            dtype: Type in which the convolutions are computed.

        Returns:
            One map per output level, of type ``dtype``. (n, C, h, w) each
        """
        # Autocast would choose other types than ``dtype``.
        with torch.autocast(images.device.type, enabled=False):
            return fused_resnet(backbone, images.to(dtype), convolve=self._convolve)

    def _convolve(
        self,
        conv: nn.Conv2d,
        norm: nn.Module,
        x: Tensor,
        identity: Tensor | None = None,
        relu: bool = True,
    ) -> Tensor:
        """Convolution with its norm, with gradients (`Convolve`)."""
        scale, shift = self._scale_and_shift(norm)
        scaled = conv.weight * scale[:, None, None, None]
        weight = scaled.to(x.dtype, memory_format=torch.channels_last)
        bias = shift.to(x.dtype)
        if not relu:
            return F.conv2d(x, weight, bias, **_geometry(conv))
        output: Tensor = _ConvolveReLU.apply(x, weight, bias, identity, _geometry(conv))
        return output

    def _scale_and_shift(self, norm: Any) -> tuple[Tensor, Tensor]:
        """Scale and shift of a norm with fixed statistics. (C,) each"""
        # The recording of a step, a CUDA graph, must include the computation of scale and shift:
        # a checkpoint may be loaded into the norm after the recording, and each replay must read
        # its new tensors.
        if norm.weight.requires_grad or is_recording(norm.weight.device.type):
            return _scale_and_shift(norm)
        versions = tensor_versions(norm)
        constants = self._constants.get(norm)
        if constants is not None:
            known_versions, scale, shift = constants
            if known_versions == versions:
                return scale, shift
        scale, shift = _scale_and_shift(norm)
        self._constants[norm] = (versions, scale, shift)
        return scale, shift


def has_frozen_norms(backbone: nn.Module | None) -> bool:
    """Whether `FrozenNorms` can replace the forward pass of a backbone in its present state.

    It cannot if a batch norm is in training mode, or if a module has hooks, which `FrozenNorms`
    would not call. It is not used under ``torch.compile``.
    """
    if backbone is None or not is_plain(backbone) or torch.compiler.is_compiling():
        return False
    for module in backbone.modules():
        if module._forward_hooks or module._forward_pre_hooks:
            return False
        if isinstance(module, nn.modules.batchnorm._BatchNorm) and module.training:
            return False
    return True


def _scale_and_shift(norm: Any) -> tuple[Tensor, Tensor]:
    """Scale and shift of a norm with fixed statistics, from its tensors. (C,) each"""
    scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    return scale, norm.bias - norm.running_mean * scale


class _ConvolveReLU(torch.autograd.Function):
    """Convolution, bias, optional residual and ReLU as one operation.

    The values before the ReLU are not kept for the gradient.
    """

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        weight: Tensor,
        bias: Tensor,
        identity: Tensor | None,
        geometry: Geometry,
    ) -> Tensor:
        """Compute the output.

        Args:
            ctx: Context that keeps tensors for the gradient.
            x: Input. (n, C, h, w)
            weight: Weights of the convolution. (D, C, kh, kw)
            bias: Bias of the convolution. (D,)
            identity: Residual in the shape of the output, or None.
            geometry: Stride, padding, dilation and groups of the convolution.

        Returns:
            Output after the ReLU. (n, D, h', w')
        """
        output = _convolve_relu(x, weight, bias, identity=identity, geometry=geometry)
        ctx.save_for_backward(x, weight, output)
        ctx.geometry = geometry
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, output = ctx.saved_tensors
        needed = ctx.needs_input_grad
        # Gradient of the ReLU: 0 where its output is 0.
        grad = torch.ops.aten.threshold_backward(grad, output, 0)
        x_grad, weight_grad, bias_grad = torch.ops.aten.convolution_backward(
            grad,
            x,
            weight,
            [len(weight)],  # shape of the bias: one value per output channel
            transposed=False,
            output_padding=[0, 0],
            output_mask=list(needed[:3]),  # whether x, weight and bias need a gradient
            **ctx.geometry,
        )
        identity_grad = grad if needed[3] else None  # the residual is added, so the factor is 1
        return x_grad, weight_grad, bias_grad, identity_grad, None  # none for `geometry`


def _convolve_relu(
    x: Tensor, weight: Tensor, bias: Tensor | None, identity: Tensor | None, geometry: Geometry
) -> Tensor:
    """Convolution, bias, optional residual and ReLU; on a GPU one operator of cuDNN."""
    if not x.is_cuda:
        output = F.conv2d(x, weight, bias, **geometry)
        if identity is not None:
            output = output + identity
        return output.relu_()
    if identity is None:
        return torch.cudnn_convolution_relu(x, weight=weight, bias=bias, **geometry)
    return torch.cudnn_convolution_add_relu(
        x, weight=weight, z=identity, alpha=1.0, bias=bias, **geometry
    )


def _geometry(conv: nn.Conv2d) -> Geometry:
    """Stride, padding, dilation and groups of a convolution."""
    return {
        "stride": conv.stride,
        "padding": conv.padding,
        "dilation": conv.dilation,
        "groups": conv.groups,
    }
