"""GSMap's guided layer on MapTRv2's decoupled self-attention."""

from mmdet3d.registry import MODELS

from gsmap.models.decoders.decoupled_layer import DecoupledDecoderLayer
from gsmap.models.decoders.gaussian_layer import GaussianDecoderLayer


@MODELS.register_module()
class GaussianDecoupledLayer(GaussianDecoderLayer, DecoupledDecoderLayer):
    """MapTRv2's layer guided by Gaussians; the parameters are those of its two bases."""
