"""GSMap's head on MapTRv2, and on MapTR with an auxiliary mask."""

from mmdet3d.registry import MODELS

from .gsmap_head import GSMapHead
from .maptrv2_head import MapTRv2Head, SegmentationHead


@MODELS.register_module()
class GSMapV2Head(GSMapHead, MapTRv2Head):
    """MapTRv2's head with Gaussians; the parameters are those of its two bases.

    Both groups of queries are Gaussians; the further ones have the same costs and losses.
    """

    default_layer = "GaussianDecoupledLayer"


@MODELS.register_module()
class GSMapSegmentationHead(GSMapHead, SegmentationHead):
    """GSMap's head with masks that only help training; the parameters are those of its bases."""
