"""GSMap's head: elements as ordered Gaussians, supervised as polylines and as rendered masks."""

from collections.abc import Sequence
from typing import Any

from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.gsmap.statistics import gaussian_statistics
from gsmap.models.maptr.head import PARTS, MapHead
from gsmap.models.maptr.masks import ElementMasks
from gsmap.models.maptr.pairs import MatchedPairs
from gsmap.models.maptr.parts import switched, weighted
from gsmap.structures.grid import BEVGrid


@MODELS.register_module()
class GSMapHead(MapHead):
    """The map head with GSMap's parts as defaults, on whatever decoder and losses there are.

    A query's reference becomes a Gaussian (paper, Eq. 1), the decoder's layers are guided by it,
    matching adds the IoU cost of rendered masks (Eq. 9) and the losses the raster loss (Eqs. 10 and
    12). Nothing is rendered at inference. Besides `MapHead`'s arguments:

    Args:
        loss_raster: Settings of the loss of the rendered masks, or None to train without it; what
            they leave out is as by default.
        iou_cost: The same of the matching cost of the rendered masks.
        points_weight: Weight of the points in losses and in matching (the paper's lambda_v), or
            None to leave those of ``losses`` and ``match_costs``.
        reference: Settings of `GaussianReference`; its smallest sigma is half a pixel of the masks
            by default.
    """

    def __init__(
        self,
        grid: BEVGrid,
        decoder: PARTS,
        losses: Sequence[PARTS],
        match_costs: Sequence[PARTS],
        loss_raster: PARTS | None = {"loss_weight": 10.0},  # noqa: B006
        iou_cost: PARTS | None = {"weight": 2.0},  # noqa: B006
        points_weight: float | None = None,
        masks: PARTS | None = None,
        reference: PARTS | None = None,
        **kwargs: Any,
    ) -> None:
        guided = MODELS.get(decoder.get("type", "MapDecoder")).guided_layer
        # Half a pixel of the masks: smaller Gaussians get no gradient. On rasters so coarse that
        # the usual first Gaussian comes close to that, it grows with it.
        half_pixel_m = ElementMasks(grid, **(masks or {})).half_pixel_m
        smallest = (reference or {}).get("min_scale_m", half_pixel_m)
        gaussian = {
            "type": "GaussianReference",
            "min_scale_m": smallest,
            "init_scales_m": (max(1.0, 3 * smallest), max(0.4, 1.5 * smallest)),
        }
        losses = weighted(losses, "PointsLoss", "loss_weight", points_weight)
        match_costs = weighted(match_costs, "OrderedPointsCost", "weight", points_weight)
        super().__init__(
            grid=grid,
            decoder={**decoder, "layer": {**guided, **decoder.get("layer", {})}},
            losses=[*losses, *switched("RasterLoss", loss_raster, loss_weight=10.0)],
            match_costs=[*match_costs, *switched("IoUCost", iou_cost, weight=2.0)],
            masks=masks,
            reference={**gaussian, **(reference or {})},
            **kwargs,
        )

    def statistics(self, pairs: MatchedPairs) -> dict[str, Tensor]:
        """Return what says whether the Gaussians live (see `gaussian_statistics`)."""
        if "pred.masks" not in self._reads:
            return {}
        gaussians = self.reference.space.decode(pairs["pred.references"])
        masks, labels = (pairs["pred.masks"], pairs["gt.masks"]), pairs["gt.labels"]
        floor_m = self.reference.space.floor_m
        return gaussian_statistics(gaussians, *masks, labels, self.classes, floor_m)
