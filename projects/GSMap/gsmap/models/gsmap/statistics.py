"""Figures of matched Gaussians that are logged beside the losses."""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsmap.ops.soft_iou import soft_iou
from gsmap.structures.gaussians import AT_FLOOR, Gaussians, extents_along_line
from gsmap.structures.tensors import upload


@torch.no_grad()
def gaussian_statistics(
    gaussians: Gaussians,
    rendered: Tensor,
    masks: Tensor,
    labels: Tensor,
    class_names: Sequence[str],
    floor_m: float,
) -> dict[str, Tensor]:
    """Summarise matched elements by class; a class without one is left out.

    Args:
        gaussians: Gaussians of the predictions. (M, P)
        rendered: Their masks in [0, 1]. (M, H, W)
        masks: Masks of their ground truths in [0, 1]. (M, H, W)
        labels: Class indices, on the host. (M,)
        class_names: Names of the classes.
        floor_m: Smallest sigma in metres.

    Returns:
        Scalars: per class ``soft_iou/<name>`` (mean), ``sigma_along/<name>`` and
        ``sigma_across/<name>`` (medians in metres); of all ``at_floor``, the share of Gaussians
        whose sigmas both lie within 10 % of the smallest.
    """
    if not len(labels):
        return {}
    counts = labels.bincount(minlength=len(class_names)).tolist()
    (order,) = upload([labels.argsort(stable=True)], rendered.device)
    iou = soft_iou(rendered, masks)[order].split(counts)
    extents = extents_along_line(gaussians)[order].split(counts)  # (n, P, 2) of each class
    figures = {}
    for name, count, own_iou, own_extents in zip(class_names, counts, iou, extents, strict=True):
        if count:
            along, across = own_extents.flatten(0, 1).median(0).values
            figures[f"soft_iou/{name}"] = own_iou.mean()
            figures[f"sigma_along/{name}"], figures[f"sigma_across/{name}"] = along, across
    at_floor = (gaussians.scales < AT_FLOOR * floor_m).all(-1)
    return {**figures, "at_floor": at_floor.float().mean()}
