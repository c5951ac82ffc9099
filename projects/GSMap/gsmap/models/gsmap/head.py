"""GSMap's head: elements as ordered Gaussians, supervised as polylines and as rendered masks."""

from collections.abc import Mapping, Sequence
from typing import Any

from mmdet3d.registry import MODELS, TASK_UTILS
from torch import Tensor

from gsmap.models.base.coder import Detections
from gsmap.models.base.head import MapHead
from gsmap.models.base.pairs import MatchedPairs
from gsmap.models.base.parts import DEFAULTS, PARTS, WEIGHT, optional_part, set_points_weight
from gsmap.models.gsmap.cost import IoUCost
from gsmap.models.gsmap.layer import add_guidance
from gsmap.models.gsmap.losses import MaskLoss, RasterLoss
from gsmap.models.gsmap.masks import GaussianMasks
from gsmap.models.gsmap.reference import GaussianReference
from gsmap.models.gsmap.statistics import gaussian_statistics
from gsmap.models.maptr.cost import OrderedPointsCost
from gsmap.models.maptr.losses import PointsLoss
from gsmap.structures.gaussians import Gaussians, stretch_along_line
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError


@MODELS.register_module()
class GSMapHead(MapHead):
    """The map head with GSMap's parts as defaults, on whatever decoder and losses there are.

    A query's reference becomes a Gaussian (paper, Eq. 1), the decoder's layers are guided by it,
    matching adds the IoU cost of rendered masks (Eq. 9) and the losses the raster loss (Eqs. 10 and
    12). Nothing is rendered at inference. Besides `MapHead`'s arguments:

    Args:
        loss_raster: Settings of the loss of the rendered masks, `RasterLoss` if they name no other,
            or None to train without it.
        iou_cost: Settings of the matching cost of the rendered masks, `IoUCost` of weight 2 if they
            say nothing else, or None to match without it.
        points_weight: Weight of the points in losses and in matching (the paper's lambda_v), or
            one for each class, or None to leave those of ``losses`` and ``match_costs``; ValueError
            if a weight is given and they have no points.
        masks: Settings of `GaussianMasks`.
        reference: Settings of `GaussianReference`; its smallest sigma is half a pixel of the masks
            by default.
        temperatures: Factors, > 0, of the sigmas of detections, along and across the line, of each
            class (`tools/calibrate.py` fits them), or None. C x (2,)

    Raises:
        ValueError: If there are not two temperatures for each class.
    """

    def __init__(
        self,
        grid: BEVGrid,
        decoder: PARTS,
        losses: Sequence[PARTS],
        match_costs: Sequence[PARTS],
        loss_raster: Mapping[str, Any] | None = DEFAULTS,
        iou_cost: Mapping[str, Any] | None = DEFAULTS,
        points_weight: WEIGHT | None = None,
        masks: PARTS | None = None,
        reference: PARTS | None = None,
        temperatures: Sequence[Sequence[float]] | None = None,
        **kwargs: Any,
    ) -> None:
        drawing = GaussianMasks(grid, **(masks or {}))
        # Half a pixel of the masks: smaller Gaussians get no gradient. On rasters so coarse that
        # the usual first Gaussian comes close to that, it grows with it.
        smallest = (reference or {}).get("min_scale_m", drawing.half_pixel_m)
        gaussian = {
            "type": GaussianReference,
            "min_scale_m": smallest,
            "init_scales_m": (max(1.0, 3 * smallest), max(0.4, 1.5 * smallest)),
        }
        losses = set_points_weight(losses, PointsLoss, points_weight, "loss_weight")
        match_costs = set_points_weight(
            match_costs, OrderedPointsCost, points_weight, "weight", TASK_UTILS
        )
        super().__init__(
            grid=grid,
            decoder=add_guidance(decoder),
            losses=[*losses, *optional_part(RasterLoss, loss_raster)],
            match_costs=[*match_costs, *optional_part(IoUCost, iou_cost, weight=2.0)],
            masks=drawing,
            reference={**gaussian, **(reference or {})},
            **kwargs,
        )
        if temperatures is not None:
            fits = [len(pair) == 2 and min(pair) > 0 for pair in temperatures]
            if fits != [True] * len(self.classes):
                raise InputError(
                    f"temperatures must be two numbers > 0 for each of the {len(self.classes)} "
                    f"classes, got {temperatures}."
                )
        self.temperatures = temperatures

    def select_detections(self, fields: dict[str, Tensor], best: Detections) -> dict[str, Tensor]:
        """Return what the reference decoded of the detections, sigmas at their temperatures."""
        found = super().select_detections(fields, best)
        if self.temperatures is None:
            return found
        factors = constant(found["scales"], self.temperatures)[best.labels][:, None]  # (M, 1, 2)
        means, scales, rotations = found["pts"][..., :2], found["scales"], found["rotations"]
        _, scales, rotations = stretch_along_line(Gaussians(means, scales, rotations), factors)
        return {**found, "scales": scales, "rotations": rotations}

    def statistics(self, pairs: MatchedPairs) -> dict[str, Tensor]:
        """Return what says whether the Gaussians live (see `gaussian_statistics`)."""
        space = self.reference.space
        if space is None or not any(isinstance(loss, MaskLoss) for loss in self.losses.values()):
            return {}
        return gaussian_statistics(
            space.decode(pairs.pred_references),
            rendered=pairs.pred_masks,
            masks=pairs.gt_masks,
            labels=pairs.host_labels,
            class_names=self.classes,
            floor_m=space.floor_m,
        )
