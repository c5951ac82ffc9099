"""MapVR's dice loss between softly rendered elements, and the same as a matching cost."""

import torch
from torch import Tensor, nn

from ..ops.polyline_raster import soft_rasters


def render_elements(
    points: Tensor,
    is_polygon: Tensor,
    size: tuple[int, int],
    line_softness: float = 2.0,
    polygon_softness: float = 4.0,
) -> Tensor:
    """Render map elements as MapVR does: lines or filled polygons, by their class.

    Args:
        points: Vertices (x, y), normalised to [0, 1] over the raster. (n, P, 2)
        is_polygon: Which elements are polygons. (n,)
        size: Rows H and columns W.
        line_softness: Softness of lines in square pixels.
        polygon_softness: Softness of polygons in square pixels.

    Returns:
        Masks in [0, 1]. (n, H, W)
    """
    height, width = size
    pixels = torch.stack([points[..., 0] * width, points[..., 1] * height], -1)
    return soft_rasters(pixels, height, width, is_polygon, line_softness, polygon_softness)


def dice_loss(preds: Tensor, targets: Tensor) -> Tensor:
    """Dice loss of each pair of masks, 1 - (2 sum(p t) + 1) / (sum p + sum t + 1).

    Args:
        preds: Masks in [0, 1]. (n, H, W)
        targets: Masks in [0, 1]. (n, H, W)

    Returns:
        Losses in [0, 1). (n,)
    """
    overlap = (preds * targets).sum((1, 2))
    return 1 - (2 * overlap + 1) / (preds.sum((1, 2)) + targets.sum((1, 2)) + 1)


def pairwise_dice_loss(preds: Tensor, targets: Tensor) -> Tensor:
    """Dice loss of every prediction with every target. (N, H, W), (K, H, W) -> (N, K)"""
    preds, targets = preds.flatten(1), targets.flatten(1)
    overlap = preds @ targets.T
    return 1 - (2 * overlap + 1) / (preds.sum(-1)[:, None] + targets.sum(-1) + 1)


def rendered_dice_cost(
    pred_points: Tensor,
    gt_points: Tensor,
    gt_is_polygon: Tensor,
    size: tuple[int, int] = (128, 64),
    line_softness: float = 2.0,
    polygon_softness: float = 4.0,
) -> Tensor:
    """Dice loss of every prediction with every ground truth, each rendered as the latter's class.

    Args:
        pred_points: Normalised points. (N, P, 2)
        gt_points: Normalised points. (K, P, 2)
        gt_is_polygon: Which ground truths are polygons. (K,)
        size: Rows and columns of the rasters.
        line_softness: Softness of lines in square pixels.
        polygon_softness: Softness of polygons in square pixels.

    Returns:
        Costs, without gradient. (N, K)
    """
    softness = (line_softness, polygon_softness)
    with torch.no_grad(), torch.autocast(pred_points.device.type, enabled=False):
        preds, gts = pred_points.float(), gt_points.float()
        targets = render_elements(gts, gt_is_polygon, size, *softness)
        lines = torch.zeros(len(preds), dtype=torch.bool, device=preds.device)
        as_lines = pairwise_dice_loss(render_elements(preds, lines, size, *softness), targets)
        as_polygons = pairwise_dice_loss(render_elements(preds, ~lines, size, *softness), targets)
        return torch.where(gt_is_polygon, as_polygons, as_lines)


class RenderedDiceLoss(nn.Module):
    """Dice loss between softly rendered predictions and ground truths (MapVR, section 4.3).

    Args:
        loss_weight: Weight of the loss.
        size: Rows and columns of the rasters.
        line_softness: Softness of lines in square pixels.
        polygon_softness: Softness of polygons in square pixels.
        polygon_classes: Classes that are rendered as filled polygons.
    """

    def __init__(
        self,
        loss_weight: float = 15.0,
        size: tuple[int, int] = (256, 128),
        line_softness: float = 2.0,
        polygon_softness: float = 4.0,
        polygon_classes: tuple[int, ...] = (1,),
    ) -> None:
        super().__init__()
        if min(line_softness, polygon_softness) <= 0:
            raise ValueError(f"softness must be > 0, got {line_softness} and {polygon_softness}.")
        self.loss_weight, self.size = loss_weight, (int(size[0]), int(size[1]))
        self.softness = (line_softness, polygon_softness)
        self.polygon_classes = tuple(polygon_classes)

    def forward(
        self,
        pred_points: Tensor,
        gt_points: Tensor,
        gt_labels: Tensor,
        avg_factor: float | Tensor | None = None,
    ) -> Tensor:
        """Return the weighted loss of matched pairs.

        Args:
            pred_points: Normalised points. (n, P, 2)
            gt_points: Normalised points, in their first order. (n, P, 2)
            gt_labels: Class of each ground truth, which decides how both are rendered. (n,)
            avg_factor: What the sum over pairs is divided by; n without it.

        Returns:
            The loss; 0 with a gradient of 0 if nothing is matched. ()
        """
        if not len(pred_points):
            return pred_points.float().sum() * 0
        with torch.autocast(pred_points.device.type, enabled=False):
            dtype = torch.promote_types(pred_points.dtype, torch.float32)
            classes = gt_labels.new_tensor(self.polygon_classes)
            is_polygon = torch.isin(gt_labels, classes)
            preds = render_elements(pred_points.to(dtype), is_polygon, self.size, *self.softness)
            with torch.no_grad():
                targets = render_elements(
                    gt_points.to(dtype), is_polygon, self.size, *self.softness
                )
            losses = dice_loss(preds, targets)
        count = len(pred_points) if avg_factor is None else avg_factor
        return self.loss_weight * losses.sum() / count
