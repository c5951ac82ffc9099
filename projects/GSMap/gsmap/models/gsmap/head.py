"""Head of GSMap: elements as ordered Gaussians, with losses of polylines and rendered masks."""

from collections.abc import Mapping, Sequence
from typing import Any

from mmdet3d.registry import MODELS, TASK_UTILS
from torch import Tensor

from gsmap.models.base.coder import Detections
from gsmap.models.base.head import MapHead
from gsmap.models.base.pairs import MatchedPairs
from gsmap.models.base.parts import (
    DEFAULTS,
    PartConfig,
    WeightConfig,
    optional_part,
    set_points_weight,
    with_defaults,
)
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
    """Map head with the parts of GSMap as defaults, for any decoder and losses.

    References are Gaussians (GSMap Eq. 1), on which the decoder layers are conditioned. Matching
    includes the IoU cost of rendered masks (Eq. 9), and training includes the raster loss (Eqs. 10
    and 12). Prediction does not render masks.

    Args:
        grid: Extent of the map.
        decoder: Config of the decoder.
        losses: Configs of the losses other than ``loss_raster``.
        match_costs: Configs of the matching costs other than ``iou_cost``.
        loss_raster: Settings of the loss of rendered masks, by default `RasterLoss`. None trains
            without it.
        iou_cost: Settings of the matching cost of rendered masks, by default `IoUCost` with weight
            2. None matches without it.
        points_weight: Weight of the points in losses and matching (lambda_v of the paper), or a
            weight for each class. None keeps the weights of ``losses`` and ``match_costs``.
        masks: Settings of `GaussianMasks`.
        reference: Settings of `GaussianReference`. The default of the smallest sigma is half a
            pixel of the masks.
        temperatures: Two factors > 0 for each class, by which the sigmas of detections along and
            across the line are multiplied, or None. `tools/calibrate.py` fits them.
        kwargs: Further arguments of `MapHead`.

    Raises:
        ValueError: If there are not two temperatures for each class, or if ``points_weight`` is
            given and there is no loss or cost of points.
    """

    def __init__(
        self,
        grid: BEVGrid,
        decoder: PartConfig,
        losses: Sequence[PartConfig],
        match_costs: Sequence[PartConfig],
        loss_raster: Mapping[str, Any] | None = DEFAULTS,
        iou_cost: Mapping[str, Any] | None = DEFAULTS,
        points_weight: WeightConfig | None = None,
        masks: PartConfig | None = None,
        reference: PartConfig | None = None,
        temperatures: Sequence[Sequence[float]] | None = None,
        **kwargs: Any,
    ) -> None:
        element_masks = GaussianMasks(grid, **(masks or {}))
        # Gaussians smaller than half a pixel of the masks have no gradient. On coarse rasters, the
        # initial Gaussian is larger than usual, so that it stays above the smallest one.
        min_scale_m = (reference or {}).get("min_scale_m", element_masks.half_pixel_m)
        initial_along_m = max(1.0, 3 * min_scale_m)
        initial_across_m = max(0.4, 1.5 * min_scale_m)
        reference = with_defaults(
            reference,
            type=GaussianReference,
            min_scale_m=min_scale_m,
            init_scales_m=(initial_along_m, initial_across_m),
        )
        # The configs are copied, and the weight of the loss and of the cost of points is replaced.
        losses = set_points_weight(losses, PointsLoss, weight=points_weight, key="loss_weight")
        match_costs = set_points_weight(
            match_costs,
            OrderedPointsCost,
            weight=points_weight,
            key="weight",
            registry=TASK_UTILS,  # of the matching costs; losses are in MODELS
        )
        # `add_guidance` copies the config and conditions the layers on the Gaussians.
        # `optional_part` returns a list of one config, or an empty list for None.
        super().__init__(
            grid=grid,
            decoder=add_guidance(decoder),
            losses=[*losses, *optional_part(RasterLoss, loss_raster)],
            match_costs=[*match_costs, *optional_part(IoUCost, iou_cost, weight=2.0)],
            masks=element_masks,
            reference=reference,
            **kwargs,
        )
        self.check_temperatures(temperatures)
        self.temperatures = temperatures

    def check_temperatures(self, temperatures: Sequence[Sequence[float]] | None) -> None:
        """Raise ``ValueError`` if temperatures are neither None nor two numbers > 0 per class."""
        if temperatures is None:
            return
        is_valid = len(temperatures) == len(self.classes)
        for pair in temperatures:
            is_positive_pair = len(pair) == 2 and min(pair) > 0
            is_valid = is_valid and is_positive_pair
        if not is_valid:
            raise InputError(
                f"temperatures must be two numbers > 0 for each of the {len(self.classes)} "
                f"classes, got {temperatures}."
            )

    def select_detections(self, fields: dict[str, Tensor], best: Detections) -> dict[str, Tensor]:
        """Fields of the detections, with sigmas multiplied by the temperatures.

        Args:
            fields: Decoded references of the N queries: ``pts``, ``scales`` (sigmas in metres) and
                ``rotations``. (N, P, ...) each
            best: Selected pairs of query and class.

        Returns:
            The fields of the M selected pairs, by name. (M, P, ...) each
        """
        detections = super().select_detections(fields, best)
        if self.temperatures is None:
            return detections
        # A detection is stretched along and across the line, by the temperatures of its class.
        # `constant` uploads the numbers to the device once.
        factors = constant(detections["scales"], self.temperatures)[best.labels]  # (M, 2)
        gaussians = Gaussians(
            means=detections["pts"][..., :2],  # without heights
            scales=detections["scales"],
            rotations=detections["rotations"],
        )
        stretched = stretch_along_line(gaussians, factors[:, None])  # equal for all points
        return {**detections, "scales": stretched.scales, "rotations": stretched.rotations}

    def statistics(self, pairs: MatchedPairs) -> dict[str, Tensor]:
        """Statistics of the predicted Gaussians (`gaussian_statistics`), if masks are rendered.

        Args:
            pairs: Matched pairs of the last layer.

        Returns:
            Scalars by name; empty if the references are no Gaussians, or no loss renders masks.
        """
        space = self.reference.space  # decodes references to Gaussians
        renders_masks = any(isinstance(loss, MaskLoss) for loss in self.losses.values())
        if space is None or not renders_masks:
            return {}
        return gaussian_statistics(
            space.decode(pairs.pred_references),
            rendered=pairs.pred_masks,
            masks=pairs.gt_masks,
            labels=pairs.host_labels,  # classes of the ground truths, on the CPU
            class_names=self.classes,
            floor_m=space.floor_m,  # smallest sigma
        )
