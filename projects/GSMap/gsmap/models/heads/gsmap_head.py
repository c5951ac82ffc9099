"""GSMap's head: elements as ordered Gaussians, supervised as polylines and as rendered masks."""

from collections.abc import Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.model import constant_init
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.decoders.gaussian_layer import GaussianDecoderLayer
from gsmap.models.heads.map_head import MapHead, MapTargets, gather_matched
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.ops.polyline_raster import draw_polylines
from gsmap.structures.gaussians import GaussianSpace
from gsmap.structures.grid import BEVGrid


@MODELS.register_module()
class GSMapHead(MapHead):
    """MapTR's head with Gaussians; to put it on another head, inherit from both, this one first.

    A query's reference becomes a Gaussian (paper, Eq. 1), the decoder is guided by it, matching
    adds the IoU cost of rendered masks (Eq. 9) and the losses the raster loss (Eqs. 10 and 12).
    Nothing is rendered at inference. Each of these can be switched off by itself.

    Args:
        pc_range: x, y, z minima, then maxima, in metres.
        decoder: Config of the decoder; its layer may leave out its type (``default_layer``).
        assigner: Config of the assigner, without the IoU cost.
        gaussians: Settings of `GaussianSpace`: ``min_scale_m``, ``max_scale_m``, ``init_scales_m``.
        loss_raster: Config of the raster loss, or None to train without it.
        raster_size: Rows and columns of the masks in the loss.
        raster_layers: ``"all"`` decoder layers have the raster loss, or only the ``"last"``.
        iou_cost: Config of the matching cost, or None to match without it.
        cost_raster_size: Rows and columns of the masks in matching.
        line_width_m: Width of a line in the ground-truth mask, in metres.
        filled_classes: Classes whose ground-truth mask is filled; the others are bands.
        kwargs: Settings of the head.

    Raises:
        ValueError: If ``raster_layers`` is unknown.
    """

    default_layer = "GaussianDecoderLayer"
    neutral_keys = ("gaussian_init.", "gaussian_branches.")

    def __init__(
        self,
        pc_range: Sequence[float],
        decoder: dict[str, Any],
        assigner: dict[str, Any],
        gaussians: dict[str, Any] | None = None,
        loss_raster: dict[str, Any] | None = None,
        raster_size: tuple[int, int] = (200, 100),
        raster_layers: str = "all",
        iou_cost: dict[str, Any] | None = None,
        cost_raster_size: tuple[int, int] = (128, 64),
        line_width_m: float = 0.75,
        filled_classes: Sequence[int] = (),
        **kwargs: Any,
    ) -> None:
        if raster_layers not in ("all", "last"):
            raise ValueError(f"raster_layers must be 'all' or 'last', got {raster_layers!r}.")
        extent = BEVGrid.from_pc_range(pc_range, 1, 1)
        space = GaussianSpace(extent, **(gaussians or {}))
        if iou_cost is not None:
            assigner = {**assigner, "match_costs": [*assigner["match_costs"], iou_cost]}
        decoder = {**decoder, "layer": self._guided_layer(decoder.get("layer"), space)}
        super().__init__(pc_range=pc_range, decoder=decoder, assigner=assigner, **kwargs)
        self.space = space
        self.loss_raster = None if loss_raster is None else MODELS.build(loss_raster)
        self.raster_grid = extent.resized(*raster_size)
        self.cost_grid = None if iou_cost is None else extent.resized(*cost_raster_size)
        self.raster_layers = raster_layers
        self.line_width_m = line_width_m
        self.filled_classes = tuple(filled_classes)
        self.gaussian_init = nn.Linear(self.embed_dims, 3)
        self.gaussian_branches = nn.ModuleList(
            nn.Linear(self.embed_dims, 3) for _ in range(len(self.decoder.layers))
        )
        self.reset_gaussian_parts()

    @classmethod
    def _guided_layer(cls, layer: dict[str, Any] | None, space: GaussianSpace) -> dict[str, Any]:
        """Return the layer's config, with the Gaussians' space if it is guided by them."""
        layer = {"type": cls.default_layer, **(layer or {})}
        if issubclass(MODELS.get(layer["type"]), GaussianDecoderLayer):
            layer["space"] = space
        return layer

    def init_weights(self) -> None:
        """Initialise as the head does; what GSMap adds starts neutral."""
        super().init_weights()
        self.reset_gaussian_parts()

    def reset_gaussian_parts(self) -> None:
        """Let every query start with the same Gaussian, and every layer leave it as it is."""
        for linear in (self.gaussian_init, *self.gaussian_branches):
            constant_init(linear, 0.0)
        for layer in self.decoder.layers:
            if isinstance(layer, GaussianDecoderLayer):
                layer.reset_gaussian_parts()

    def initial_reference(self, query_pos: Tensor) -> Tensor:
        """Return the Gaussians that the first layer starts from. (..., C) -> (..., 5)"""
        centres = super().initial_reference(query_pos)
        return torch.cat([centres, self.gaussian_init(query_pos).float()], -1)

    def predict_offsets(self, layer: int, states: Tensor) -> Tensor:
        """Return a layer's change of the Gaussians (Eq. 8). (B, N * P, C) -> (B, N * P, 5)"""
        centres = super().predict_offsets(layer, states)
        return torch.cat([centres, self.gaussian_branches[layer](states).float()], -1)

    def prepare_gt(self, gt_instances: InstanceData) -> InstanceData:
        """Add a sample's ground-truth masks: ``masks`` (K, H, W), ``rasters`` (K, h, w)."""
        gt = super().prepare_gt(gt_instances)
        if self.loss_raster is not None:
            gt.masks = self.draw_gt(gt_instances, self.raster_grid)
        if self.cost_grid is not None:
            gt.rasters = self.draw_gt(gt_instances, self.cost_grid)
        return gt

    def draw_gt(self, gt_instances: InstanceData, grid: BEVGrid) -> Tensor:
        """Draw the annotated polylines of one sample as bands (or areas). (K, H, W)"""
        filled = None
        if self.filled_classes:
            labels = gt_instances.labels_3d
            filled = torch.isin(labels, labels.new_tensor(self.filled_classes))
        return draw_polylines(gt_instances.pts.float(), grid, self.line_width_m, filled)

    def layer_predictions(self, outputs: dict[str, Tensor], layer: int) -> list[InstanceData]:
        """Add the Gaussians of one layer, and their masks for matching, to its predictions.

        Returns:
            Per sample also ``references`` (N, P, 5) where the layer has the raster loss, and
            ``rasters`` (N, h, w), without gradient, where there is an IoU cost.
        """
        predictions = super().layer_predictions(outputs, layer)
        references = outputs["all_references"][layer]  # (B, N, P, 5)
        rasters = (
            None if self.cost_grid is None else self.render(references.detach(), self.cost_grid)
        )
        for sample, prediction in enumerate(predictions):
            if self.has_raster_loss(layer):
                prediction.references = references[sample]
            if rasters is not None:
                prediction.rasters = rasters[sample]
        return predictions

    def render(self, references: Tensor, grid: BEVGrid) -> Tensor:
        """Render each instance's Gaussians to its mask (Eq. 6). (..., P, 5) -> (..., H, W)"""
        gaussians = self.space.decode(references)
        return render_gaussians(gaussians.means, gaussians.scales, gaussians.rotations, grid)

    def has_raster_loss(self, layer: int) -> bool:
        """Return whether a decoder layer has the raster loss."""
        last = len(self.decoder.layers) - 1
        return self.loss_raster is not None and (self.raster_layers == "all" or layer == last)

    def matched_losses(
        self, predictions: Sequence[InstanceData], gts: Sequence[InstanceData], targets: MapTargets
    ) -> dict[str, Tensor]:
        """Add the raster loss of the matched predictions of one layer (Eqs. 10 and 12)."""
        losses = super().matched_losses(predictions, gts, targets)
        has_fields = "references" in predictions[0] and "masks" in gts[0]
        if self.loss_raster is not None and has_fields:
            references = gather_matched(predictions, targets.matches, "references")
            pairs = zip(gts, targets.matches, strict=True)
            masks = torch.cat([gt.masks[match.gt_inds] for gt, match in pairs])
            rendered = self.render(references, self.raster_grid)
            losses["loss_raster"] = self.loss_raster(rendered, masks, targets.avg_factor)
        return losses

    def decode_reference(self, references: Tensor) -> dict[str, Tensor]:
        """Add the Gaussians' ``scales`` (N, P, 2) in metres and ``rotations`` (N, P) in radians."""
        gaussians = self.space.decode(references)
        fields = super().decode_reference(references)
        return {**fields, "scales": gaussians.scales, "rotations": gaussians.rotations}
