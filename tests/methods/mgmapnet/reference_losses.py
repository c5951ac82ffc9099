"""MGMapNet: matches, all losses of the head, and their gradients."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from methods.mgmapnet.reference import BEV, B, MGMapNetParts
from methods.mgmapnet.reference_decoder import build_head
from mmdet3d.structures import Det3DDataSample
from mmengine.structures import InstanceData
from predictions import predicted
from reference.golden import Golden
from reference.groups import GROUPS, REPEATS, match_rows
from reference.registry import check
from reference.report import Row, largest_relative, relative_norm
from torch import Tensor, nn

from gsmap.models.base.head import MapHead
from gsmap.models.base.mask_heads import BEVMaskHead
from gsmap.models.base.masks import ElementMasks
from gsmap.models.mgmapnet.decoder import MGMapNetDecoded
from gsmap.structures.grid import BEVGrid

LAYERS = 6
LOSS, LOSS_GRAD = 1e-4, 1e-3
OUTPUTS = {  # ours and the file's
    "scores": "all_cls_scores",
    "references": "all_pts_preds",
    "mean_locations": "all_MGA_Ref_preds",
}
WEIGHTS = {"_bce": (3.0, 0.0), "_dice": (0.0, 3.0), "": (3.0, 3.0)}  # of both terms of masks
LOSSES = {"cls": "cls", "pts": "pts", "dir": "dir", "mean_loc": "MGA_ref"}


class GivenMasks(ElementMasks):
    """Returns the masks that the recipe makes for the elements."""

    def draw_batch(self, gt_instances: Sequence[InstanceData], grid: BEVGrid) -> Tensor:
        return torch.cat([sample.given_masks for sample in gt_instances])


def loss_head(golden: Golden, pairing: str) -> MapHead:
    """Return a small head with the released losses, whose instance states are one-hot."""
    head = build_head(
        golden,
        embed_dims=16,
        decoder={"type": "MGMapNetDecoder", "num_layers": 1, "layer": {"num_heads": 2}},
        query_groups=[
            {"num": GROUPS["o2o"]},
            {"name": "o2m", "num": GROUPS["o2m"], "repeats": REPEATS},
        ],
        loss_ins_seg={"pairing": pairing},
        aux_heads=[],
    )
    head.losses["ins_seg"].embedding = nn.Identity()
    head.masks = GivenMasks(head.grid)
    return head


def saved_outputs(data: Mapping[str, np.ndarray], parts: MGMapNetParts) -> dict[str, Tensor]:
    """Return the file's predictions of both groups.

    A BEV feature is an instance's mask, and its state is one-hot: their product is the mask.
    """
    outputs = {}
    for ours, theirs in OUTPUTS.items():
        groups = []
        for group, num in GROUPS.items():
            if ours == "scores":
                groups.append(parts.normal(f"mgm_loss_{group}_cls", (LAYERS, B, num, 3), shift=-1))
            else:
                groups.append(torch.from_numpy(data[f"in_{group}_{theirs}"]))
        outputs[ours] = torch.cat(groups, 2).requires_grad_()
    states = torch.eye(sum(GROUPS.values()), GROUPS["o2o"]).expand(LAYERS, B, -1, -1)
    masks = torch.from_numpy(data["in_o2o_ins_seg"]).requires_grad_()
    return outputs | {"instance_states": states, "bev_feats": masks}


def ground_truths(data: Mapping[str, np.ndarray], parts: MGMapNetParts) -> list[InstanceData]:
    """Return the file's elements with the recipe's masks."""
    gts = []
    for sample in range(B):
        labels = torch.from_numpy(data[f"gt_labels_{sample}"])
        shape = (len(labels), 1, *BEV)
        masks = parts.recipe.mask(f"mgm_ins{sample}", shape, parts.golden.seed, p=0.08)
        pts, shifts = (torch.from_numpy(data[f"gt_{n}_pts_{sample}"]) for n in ("fixed", "shift"))
        given = torch.from_numpy(masks)[:, 0]
        gts.append(InstanceData(labels_3d=labels, pts=pts, pts_shifts=shifts, given_masks=given))
    return gts


@check("mgmapnet_losses_{variant}.npz")
def check_losses(golden: Golden, name: str) -> Iterator[Row]:
    """Compare matches, losses and gradients of fixed predictions."""
    data, parts = golden.read_arrays(name), MGMapNetParts(golden)
    saved, gts = saved_outputs(data, parts), ground_truths(data, parts)
    head = loss_head(golden, "released")
    outputs = predicted(head, kind=MGMapNetDecoded, **saved)
    yield from match_rows(name, data, head, outputs, gts)
    losses = head.loss_by_feat(outputs, gts, [{}] * B)
    for group in GROUPS:
        suffix = "" if group == "o2o" else f"_{group}"
        for key, theirs in LOSSES.items():
            names = [*(f"d{layer}.loss_{key}" for layer in range(LAYERS - 1)), f"loss_{key}"]
            ours = [losses[loss + suffix].item() for loss in names]
            off = largest_relative(ours, data[f"{group}_loss_{theirs}"])
            yield Row(name, f"{group}: {key} (relative)", off, LOSS)
    released = losses["loss_ins_seg"].item()
    off = largest_relative(released, data["loss_ins_seg_released"])
    yield Row(name, "instance masks, released (relative)", off, LOSS)
    yield from class_mask_rows(name, data, parts)
    total = sum(losses.values())
    off = largest_relative(total.item() + data["loss_seg"], data["total"])
    yield Row(name, "total (relative)", off, LOSS)
    total.backward()
    yield from gradient_rows(name, data, saved)
    yield from matched_rows(name, data, saved, loss_head(golden, "matched"), gts)


def class_mask_rows(
    name: str, data: Mapping[str, np.ndarray], parts: MGMapNetParts
) -> Iterator[Row]:
    """Compare the losses of the recipe's class masks, and their gradient."""
    head = BEVMaskHead(16, pos_weight=1.0, num_masks=3)
    for number in range(len(head)):
        head[number] = nn.Identity()  # the features are the masks
    logits = parts.normal("mgm_loss_seg", (B, 3, *BEV), shift=-1).requires_grad_()
    truth = torch.from_numpy(parts.recipe.mask("mgm_seg", (B, 3, *BEV), parts.golden.seed))
    samples = [Det3DDataSample() for _ in range(B)]
    for sample, masks in zip(samples, truth, strict=True):
        sample.gt_seg = masks
    for key, weights in WEIGHTS.items():
        head.loss_weight, head.dice_weight = weights
        loss = head.loss({"bev_feats": logits}, samples)
        off = largest_relative(loss.item(), data[f"loss_seg{key}"])
        yield Row(name, f"class masks{key} (relative)", off, LOSS)
    loss.backward()
    off = relative_norm(logits.grad, data["grad_seg"])
    yield Row(name, "gradient of class masks (relative)", off, LOSS_GRAD)


def gradient_rows(
    name: str, data: Mapping[str, np.ndarray], saved: dict[str, Tensor]
) -> Iterator[Row]:
    """Compare the gradients of all predictions."""
    for ours, theirs in OUTPUTS.items():
        parts = saved[ours].grad.split(list(GROUPS.values()), 2)
        for group, part in zip(GROUPS, parts, strict=True):
            off = relative_norm(part, data[f"grad_{group}_{theirs}"])
            yield Row(name, f"{group}: gradient of {ours} (relative)", off, LOSS_GRAD)
    off = relative_norm(saved["bev_feats"].grad, data["grad_ins_seg"])
    yield Row(name, "gradient of instance masks, released (relative)", off, LOSS_GRAD)


def matched_rows(
    name: str,
    data: Mapping[str, np.ndarray],
    saved: dict[str, Tensor],
    head: MapHead,
    gts: list[InstanceData],
) -> Iterator[Row]:
    """Compare the loss of instance masks whose pairs are those of the matching."""
    saved["bev_feats"].grad = None
    part = head.losses["ins_seg"]
    for key, weights in WEIGHTS.items():
        part.loss_weight, part.dice_weight = weights
        outputs = predicted(head, kind=MGMapNetDecoded, **saved)
        loss = head.loss_by_feat(outputs, gts, [{}] * B)["loss_ins_seg"]
        off = largest_relative(loss.item(), data[f"loss_ins_seg_matched{key}"])
        yield Row(name, f"instance masks, matched{key} (relative)", off, LOSS)
    loss.backward()
    off = relative_norm(saved["bev_feats"].grad, data["grad_ins_seg_matched"])
    yield Row(name, "gradient of instance masks, matched (relative)", off, LOSS_GRAD)
