"""Statistics of matched Gaussians, for the log."""

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
    """Statistics of the Gaussians of matched predictions, by class.

    Each of the M rows is a pair of a prediction and its ground truth.

    Args:
        gaussians: Gaussians of the predictions. (M, P)
        rendered: Masks of the predictions in [0, 1]. (M, H, W)
        masks: Masks of the ground truths in [0, 1]. (M, H, W)
        labels: Class indices of the pairs, on the CPU. (M,)
        class_names: Names of the classes.
        floor_m: Smallest sigma that the model can predict, in metres.

    Returns:
        Scalars by name, on the device of the Gaussians; empty without pairs. For each class with
        pairs: ``soft_iou/<name>`` (mean), ``sigma_along/<name>`` and ``sigma_across/<name>``
        (medians in metres). For all pairs: ``at_floor``, the share of Gaussians with both sigmas
        less than 10 % above ``floor_m``.
    """
    if not len(labels):
        return {}
    # Sort the pairs by class, so that a split by the counts has one part for each class.
    counts = labels.bincount(minlength=len(class_names)).tolist()
    # The counts are read from the labels on the CPU, so the host does not wait for the device.
    (order,) = upload([labels.argsort(stable=True)], rendered.device)
    iou = soft_iou(rendered, masks)[order].split(counts)
    extents = extents_along_line(gaussians)[order].split(counts)  # (n, P, 2) of each class
    figures = {}
    for index, name in enumerate(class_names):
        if counts[index]:
            # Medians of the n * P Gaussians of the class.
            along, across = extents[index].flatten(0, 1).median(0).values
            figures[f"soft_iou/{name}"] = iou[index].mean()
            figures[f"sigma_along/{name}"] = along
            figures[f"sigma_across/{name}"] = across
    # AT_FLOOR is 1.1: up to 10 % above the floor counts as the floor.
    at_floor = (gaussians.scales < AT_FLOOR * floor_m).all(-1)
    return {**figures, "at_floor": at_floor.float().mean()}
