"""GSMap's head: elements as ordered Gaussians, supervised as polylines and as rendered masks."""

from collections.abc import Sequence
from typing import Any, ClassVar

from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.heads.gaussian_statistics import gaussian_statistics
from gsmap.models.heads.map_head import PARTS, MapHead
from gsmap.models.heads.masks import ElementMasks
from gsmap.models.heads.matched import MatchedPairs
from gsmap.structures.grid import BEVGrid

_RASTER_LOSS: PARTS = {"type": "RasterLoss", "loss_weight": 10.0}
_IOU_COST: PARTS = {"type": "IoUCost", "weight": 2.0}


def _over(default: PARTS, settings: PARTS | None) -> list[PARTS]:
    """Return a part's default with other settings, or nothing if it is switched off."""
    return [] if settings is None else [{**default, **settings}]


@MODELS.register_module()
class GSMapHead(MapHead):
    """The map head with GSMap's parts as defaults, on whatever decoder and losses there are.

    A query's reference becomes a Gaussian (paper, Eq. 1), the decoder's layers are guided by it,
    matching adds the IoU cost of rendered masks (Eq. 9) and the losses the raster loss (Eqs. 10 and
    12). Nothing is rendered at inference. Each of these can be switched off by itself.

    Args:
        grid: The map's extent.
        losses: Configs of the losses of the head that this one extends.
        match_costs: Configs of its matching costs.
        loss_raster: Settings of the loss of the rendered masks, or None to train without it; what
            they leave out is as by default.
        iou_cost: The same of the matching cost of the rendered masks.
        masks: Settings of `ElementMasks`.
        kwargs: Further arguments of `MapHead`; ``reference`` also takes the settings of
            `GaussianSpace`, whose smallest sigma is half a pixel of the masks by default.
    """

    default_reference = "GaussianReference"
    default_layer: ClassVar[PARTS] = {"type": "GaussianDecoderLayer"}
    own_layer: ClassVar[PARTS] = {"guidance": {}}

    def __init__(
        self,
        grid: BEVGrid,
        losses: Sequence[PARTS],
        match_costs: Sequence[PARTS],
        loss_raster: PARTS | None = _RASTER_LOSS,
        iou_cost: PARTS | None = _IOU_COST,
        masks: PARTS | None = None,
        **kwargs: Any,
    ) -> None:
        self._min_scale_m = ElementMasks(grid, **(masks or {})).half_pixel_m
        super().__init__(
            grid=grid,
            losses=[*losses, *_over(_RASTER_LOSS, loss_raster)],
            match_costs=[*match_costs, *_over(_IOU_COST, iou_cost)],
            masks=masks,
            **kwargs,
        )

    def reference_settings(self, reference: PARTS) -> PARTS:
        """Let the smallest Gaussian be half a pixel of the masks: smaller ones get no gradient.

        On rasters so coarse that the usual first Gaussian comes close to that, it grows with it.
        """
        smallest = reference.get("min_scale_m", self._min_scale_m)
        first = (max(1.0, 3 * smallest), max(0.4, 1.5 * smallest))
        return {"min_scale_m": smallest, "init_scales_m": first, **reference}

    def statistics(self, pairs: MatchedPairs) -> dict[str, Tensor]:
        """Return what says whether the Gaussians live (see `gaussian_statistics`)."""
        if "pred.masks" not in self._reads:
            return {}
        return gaussian_statistics(
            self.reference.gaussians(pairs["pred.references"]),
            pairs["pred.masks"],
            pairs["gt.masks"],
            pairs["gt.labels"],
            self.classes,
            self.reference.space.floor_m,
        )
