"""MapVR's head: points supervised through their soft rasters."""

from collections.abc import Mapping, Sequence
from typing import Any

from mmdet3d.registry import MODELS, TASK_UTILS

from gsmap.models.base.head import MapHead
from gsmap.models.base.masks import ElementMasks
from gsmap.models.base.parts import DEFAULTS, PARTS, brought, class_of, with_points_weight
from gsmap.models.maptr.cost import OrderedPointsCost
from gsmap.models.maptr.losses import DirectionLoss, PointsLoss
from gsmap.models.mapvr.cost import RenderedDiceCost
from gsmap.models.mapvr.losses import RenderedDiceLoss, SelfDirectionLoss
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.grid import BEVGrid


@MODELS.register_module()
class MapVRHead(MapHead):
    """The map head with MapVR's parts as defaults, on whatever decoder and references there are.

    Matched points are rendered softly, as lines or as polygons by their class, and compared by the
    dice loss, in matching on coarser rasters. Points weigh less than in MapTR, and predictions
    shall be straight in place of the ground truth's directions. Besides `MapHead`'s arguments:

    Args:
        losses: As in `MapHead`; `PointsLoss` gets another weight, `DirectionLoss` is replaced.
        match_costs: As in `MapHead`; `OrderedPointsCost` gets another weight.
        loss_dice: Settings of the dice loss, or None to train without it.
        dice_cost: Settings of its matching cost, or None to match without it.
        loss_direction: Settings of `SelfDirectionLoss`, or None to train without it.
        points_weight: Weight of the points in losses and in matching, None to leave theirs;
            ValueError if a weight is given and there are no points.
        polygons: Names of the classes that are rendered as filled polygons, ValueError for what is
            no class; None: those that are areas (`AREA_CLASSES`).
        rendering: Further settings of `ElementRenderer`, for loss and cost.
        masks: Sizes of pixels as in `ElementMasks`: 256 x 128 and, for matching, 128 x 64 on a map
            of 60 x 30 m.
        dropout: Dropout in the decoder's layers.
    """

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        decoder: PARTS,
        losses: Sequence[PARTS],
        match_costs: Sequence[PARTS],
        loss_dice: Mapping[str, Any] | None = DEFAULTS,
        dice_cost: Mapping[str, Any] | None = DEFAULTS,
        loss_direction: Mapping[str, Any] | None = DEFAULTS,
        points_weight: float | None = 1.0,
        polygons: Sequence[str] | None = None,
        rendering: PARTS | None = None,
        masks: PARTS | None = None,
        dropout: float = 0.0,
        **kwargs: Any,
    ) -> None:
        unknown = sorted(set(polygons or ()) - set(classes))
        if unknown:
            raise ValueError(f"polygons must be classes of {list(classes)}, got {unknown}.")
        areas = AREA_CLASSES if polygons is None else polygons
        indices = tuple(index for index, name in enumerate(classes) if name in areas)
        sizes = {"pixel_m": 60 / 256, "cost_pixel_m": 60 / 128}
        drawing = ElementMasks(grid, **{**sizes, **(masks or {})})
        shared = {"polygon_classes": indices, **(rendering or {})}
        size, cost_size = ((g.height, g.width) for g in (drawing.grid, drawing.cost_grid))
        kept = [loss for loss in losses if class_of(loss) is not DirectionLoss]
        losses = [
            *with_points_weight(kept, PointsLoss, points_weight, "loss_weight"),
            *brought(SelfDirectionLoss, loss_direction),
            *brought(RenderedDiceLoss, loss_dice, size=size, **shared),
        ]
        match_costs = [
            *with_points_weight(
                match_costs, OrderedPointsCost, points_weight, "weight", TASK_UTILS
            ),
            *brought(RenderedDiceCost, dice_cost, size=cost_size, **shared),
        ]
        super().__init__(
            grid=grid,
            classes=classes,
            decoder={**decoder, "layer": {**decoder.get("layer", {}), "dropout": dropout}},
            losses=losses,
            match_costs=match_costs,
            masks=drawing,
            **kwargs,
        )
