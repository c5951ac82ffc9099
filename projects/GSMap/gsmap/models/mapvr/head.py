"""Head of MapVR: points supervised by their soft rasters."""

from collections.abc import Mapping, Sequence
from typing import Any

from mmdet3d.registry import MODELS, TASK_UTILS

from gsmap.models.base.head import MapHead
from gsmap.models.base.masks import ElementMasks
from gsmap.models.base.parts import (
    DEFAULTS,
    PartConfig,
    class_of,
    optional_part,
    set_points_weight,
    with_defaults,
)
from gsmap.models.maptr.cost import OrderedPointsCost
from gsmap.models.maptr.losses import DirectionLoss, PointsLoss
from gsmap.models.mapvr.cost import RenderedDiceCost
from gsmap.models.mapvr.losses import RenderedDiceLoss, SelfDirectionLoss
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError


@MODELS.register_module()
class MapVRHead(MapHead):
    """Map head with the losses and matching costs of MapVR as defaults.

    Matched points are rendered softly, as lines or as filled polygons depending on their class, and
    compared by the dice loss. Matching uses coarser rasters. Points have a lower weight than in
    MapTR, and `SelfDirectionLoss` replaces the direction loss.

    Args:
        grid: Extent of the map.
        classes: Names of the classes.
        decoder: Config of the decoder; the dropout of its layers is set to ``dropout``.
        losses: Configs of the losses. The weight of `PointsLoss` is set to ``points_weight``, and
            `DirectionLoss` is removed.
        match_costs: Configs of the matching costs. The weight of `OrderedPointsCost` is set to
            ``points_weight``.
        loss_dice: Settings of the dice loss, or None to train without it.
        dice_cost: Settings of the matching cost of rendered masks, or None to match without it.
        loss_direction: Settings of `SelfDirectionLoss`, or None to train without it. For these
            three arguments, ``DEFAULTS`` keeps the default values of the classes.
        points_weight: Weight of the points in losses and matching. None keeps the weights of the
            configs.
        polygons: Names of the classes that are rendered as filled polygons. None means
            `AREA_CLASSES`.
        rendering: Further settings of `ElementRenderer`, for loss and cost.
        masks: Pixel sizes as in `ElementMasks`. Defaults: 256 x 128 pixels, and 128 x 64 for
            matching, on a map of 60 x 30 m.
        dropout: Dropout in the layers of the decoder.
        kwargs: Further arguments of `MapHead`.

    Raises:
        ValueError: If ``polygons`` has an unknown class, or ``points_weight`` is given without a
            loss and a cost of points.
    """

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        decoder: PartConfig,
        losses: Sequence[PartConfig],
        match_costs: Sequence[PartConfig],
        loss_dice: Mapping[str, Any] | None = DEFAULTS,
        dice_cost: Mapping[str, Any] | None = DEFAULTS,
        loss_direction: Mapping[str, Any] | None = DEFAULTS,
        points_weight: float | None = 1.0,
        polygons: Sequence[str] | None = None,
        rendering: PartConfig | None = None,
        masks: PartConfig | None = None,
        dropout: float = 0.0,
        **kwargs: Any,
    ) -> None:
        unknown = sorted(set(polygons or ()) - set(classes))
        if unknown:
            raise InputError(f"polygons must be classes of {list(classes)}, got {unknown}.")
        areas = AREA_CLASSES if polygons is None else polygons
        area_inds = tuple(index for index, name in enumerate(classes) if name in areas)
        # Settings that were passed take precedence over these defaults.
        mask_settings = with_defaults(masks, pixel_m=60 / 256, cost_pixel_m=60 / 128)
        element_masks = ElementMasks(grid, **mask_settings)
        rendering = with_defaults(rendering, polygon_classes=area_inds)
        # Grids of the masks of losses and of matching. By default, the latter is coarser.
        loss_grid = element_masks.grid
        cost_grid = element_masks.cost_grid
        points_losses = [loss for loss in losses if class_of(loss) is not DirectionLoss]
        points_losses = set_points_weight(
            points_losses, PointsLoss, weight=points_weight, key="loss_weight"
        )
        points_costs = set_points_weight(
            match_costs,
            OrderedPointsCost,
            weight=points_weight,
            key="weight",
            registry=TASK_UTILS,
        )
        # `optional_part` returns a list of one config, or an empty list for the settings None.
        dice_losses = optional_part(
            RenderedDiceLoss, loss_dice, size=(loss_grid.height, loss_grid.width), **rendering
        )
        dice_costs = optional_part(
            RenderedDiceCost, dice_cost, size=(cost_grid.height, cost_grid.width), **rendering
        )
        # Changes are made in copies, since the config of the caller must stay as it is.
        layer = {**decoder.get("layer", {}), "dropout": dropout}
        super().__init__(
            grid=grid,
            classes=classes,
            decoder={**decoder, "layer": layer},
            losses=[
                *points_losses,
                *optional_part(SelfDirectionLoss, loss_direction),
                *dice_losses,
            ],
            match_costs=[*points_costs, *dice_costs],
            masks=element_masks,
            **kwargs,
        )
