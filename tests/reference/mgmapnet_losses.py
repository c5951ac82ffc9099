"""MGMapNet: what it adds to MapTRv2's losses, with the matches of the reference."""

from collections.abc import Iterator, Mapping

import numpy as np
import torch

from gsmap.models.losses.point import SamplingLocationLoss
from gsmap.models.losses.segmentation import class_mask_losses, instance_mask_losses, pair_masks
from reference.golden import Golden
from reference.mgmapnet import BEV, B, GoldenParts
from reference.registry import check
from reference.report import Row, largest_relative, relative_norm

LOW_M, SIZE_M = torch.tensor([-15.0, -30.0]), torch.tensor([30.0, 60.0])
MASK_WEIGHT = 3.0
LOSS, LOSS_GRAD = 1e-4, 1e-3


@check("mgmapnet_losses_{variant}.npz")
def check_losses(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the losses that MGMapNet adds, with the matches of the file, and their gradients."""
    data, parts = golden.read_arrays(name), GoldenParts(golden)
    for group in ("o2o", "o2m"):
        yield from mean_location_rows(name, data, group)
    yield from class_mask_rows(name, data, parts)
    for pairing, suffix in (("matched", "_matched"), ("released", "")):
        yield from instance_mask_rows(name, data, parts, pairing, suffix)


def mean_location_rows(name: str, data: Mapping[str, np.ndarray], group: str) -> Iterator[Row]:
    """Compare the L1 of the mean sampling locations with the points that the queries matched."""
    locations = torch.from_numpy(data[f"in_{group}_all_MGA_Ref_preds"]).requires_grad_()
    losses = []
    for layer, by_layer in enumerate(locations):
        pred, target = [], []
        for sample in range(B):
            query, gt, order = data[f"match_{group}_l{layer}_b{sample}"].T
            shifts = torch.from_numpy(data[f"gt_shift_pts_{sample}"])
            pred.append(by_layer[sample, query])
            target.append((shifts[gt, order] - LOW_M) / SIZE_M)
        matched = torch.cat(pred)
        losses.append(SamplingLocationLoss()(matched, torch.cat(target), len(matched)))
    torch.stack(losses).sum().backward()
    off = largest_relative([loss.item() for loss in losses], data[f"{group}_loss_MGA_ref"])
    yield Row(name, f"{group}: mean locations (relative)", off, LOSS)
    off = relative_norm(locations.grad, data[f"grad_{group}_all_MGA_Ref_preds"])
    yield Row(name, f"{group}: gradient of mean locations (relative)", off, LOSS_GRAD)


def class_mask_rows(name: str, data: Mapping[str, np.ndarray], parts: GoldenParts) -> Iterator[Row]:
    """Compare the losses of the class masks."""
    logits = parts.normal("mgm_loss_seg", (B, 3, *BEV), shift=-1).requires_grad_()
    truth = torch.from_numpy(parts.recipe.mask("mgm_seg", (B, 3, *BEV), parts.golden.seed))
    losses = class_mask_losses(logits, truth)
    for key, loss in zip(("bce", "dice"), losses, strict=True):
        off = largest_relative(MASK_WEIGHT * loss.item(), data[f"loss_seg_{key}"])
        yield Row(name, f"seg {key} (relative)", off, LOSS)
    (MASK_WEIGHT * sum(losses)).backward()
    off = relative_norm(logits.grad, data["grad_seg"])
    yield Row(name, "gradient of seg (relative)", off, LOSS_GRAD)


def instance_mask_rows(
    name: str, data: Mapping[str, np.ndarray], parts: GoldenParts, pairing: str, suffix: str
) -> Iterator[Row]:
    """Compare the losses of the instance masks."""
    logits = torch.from_numpy(data["in_o2o_ins_seg"]).requires_grad_()
    chosen, truth = [], []
    for sample in range(B):
        shape = (len(data[f"gt_labels_{sample}"]), 1, *BEV)
        masks = parts.recipe.mask(f"mgm_ins{sample}", shape, parts.golden.seed, p=0.08)
        query, gt, _ = torch.from_numpy(data[f"match_o2o_l5_b{sample}"]).T
        query, gt = pair_masks(query, gt, pairing)
        chosen.append(logits[sample, query])
        truth.append(torch.from_numpy(masks)[gt, 0])
    pred = torch.cat(chosen)
    losses = instance_mask_losses(pred, torch.cat(truth), len(pred))
    total = MASK_WEIGHT * sum(losses)
    total.backward()
    off = largest_relative(total.item(), data[f"loss_ins_seg_{pairing}"])
    yield Row(name, f"instance masks, {pairing} (relative)", off, LOSS)
    for key, loss in zip(("bce", "dice"), losses, strict=True):
        if f"loss_ins_seg_{pairing}_{key}" in data:
            off = largest_relative(MASK_WEIGHT * loss.item(), data[f"loss_ins_seg_{pairing}_{key}"])
            yield Row(name, f"instance masks, {pairing}: {key} (relative)", off, LOSS)
    off = relative_norm(logits.grad, data[f"grad_ins_seg{suffix}"])
    yield Row(name, f"gradient of instance masks, {pairing} (relative)", off, LOSS_GRAD)
