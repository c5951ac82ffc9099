"""GSMap's head on MapTRv2, and on MapTR with an auxiliary mask."""

from typing import Any

from mmdet3d.registry import MODELS
from mmengine.structures import InstanceData

from gsmap.models.heads.gsmap_head import GSMapHead
from gsmap.models.heads.maptrv2_head import MapTRv2Head, SegmentationHead


@MODELS.register_module()
class GSMapV2Head(GSMapHead, MapTRv2Head):
    """MapTRv2's head with Gaussians.

    Both groups of queries are Gaussians, matched under the same costs.

    Args:
        raster_one2many: Whether the further queries have the raster loss, too. The paper does not
            say; they have all other losses of the first group.
        kwargs: Arguments of the two bases.
    """

    default_layer = "GaussianDecoupledLayer"

    def __init__(self, raster_one2many: bool = True, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.raster_one2many = raster_one2many

    def further_gt(self, gt: InstanceData) -> InstanceData:
        """Return a sample's ground truth for the further queries; no raster loss without masks."""
        gt = super().further_gt(gt)
        if self.raster_one2many:
            return gt
        return InstanceData(**{name: value for name, value in gt.items() if name != "masks"})


@MODELS.register_module()
class GSMapSegmentationHead(GSMapHead, SegmentationHead):
    """GSMap's head with masks that only help training; the parameters are those of its bases."""
