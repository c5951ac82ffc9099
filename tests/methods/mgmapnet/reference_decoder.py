"""MGMapNet: the decoder with its branches and masks, values and gradients."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from methods.maptrv2.reference import all_queries
from methods.mgmapnet.reference import CONFIG, STATE, B, MGMapNetParts, N, P
from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.registry import init_default_scope
from predictions import stacked
from reference.golden import Golden
from reference.maptr import decoded_rows
from reference.parts import GRAD_L2
from reference.registry import check
from reference.report import (
    Row,
    fraction_beyond,
    largest_difference,
    largest_relative,
    relative_norm,
)
from torch import Tensor

from gsmap.models.base.head import MapHead
from gsmap.models.mgmapnet.keys import MGMAPNET
from gsmap.structures.grid import BEVGrid

FURTHER = 24  # one-to-many queries of the training set


def build_head(golden: Golden, **settings: Any) -> MapHead:
    """Return the head of the released config, with other settings."""
    init_default_scope("mmdet3d")
    cfg = Config.fromfile(golden.configs / CONFIG, import_custom_modules=False)
    shared = {"grid": BEVGrid(**cfg.grid), "classes": cfg.classes}
    return MODELS.build({**cfg.model.map_head, **shared, **settings})


def small_head(golden: Golden) -> MapHead:
    """Return the released head with few queries and without masks in the cameras."""
    groups = [{"num": N}, {"name": "one2many", "num": FURTHER}]
    seg = {"type": "BEVMaskHead", "num_masks": 3}
    return build_head(golden, query_groups=groups, aux_heads=[seg])


def run(head: MapHead, bev_feats: Tensor) -> dict[str, Tensor]:
    """Return all predictions by the golden names."""
    outputs = head({"bev_feats": bev_feats})
    states = stacked(outputs).instance_states
    position, _ = head.queries()
    samples = zip(states[-1], bev_feats, strict=True)
    return {
        "init_reference": head.reference.start(position)[:, None].expand(B, -1, P, -1),
        "instance_states": states.transpose(1, 2),
        "point_states": stacked(outputs).point_states,
        "references": stacked(outputs).references,
        "mean_loc": stacked(outputs).mean_locations,
        "all_cls_scores": stacked(outputs).scores,
        "seg": head.aux_heads["seg"](bev_feats),
        "ins_seg": torch.stack([head.losses["ins_seg"].logits(*sample) for sample in samples]),
    }


DECODER_ROWS = {  # what the file holds of each output, and the tolerance
    "init_reference": (np.s_[:], 1e-5),
    "instance_states": (np.s_[..., ::2], 5e-4),
    "point_states": (np.s_[..., ::16], 5e-4),
    "references": (np.s_[:], 3e-5),
    "mean_loc": (np.s_[:], 3e-5),
    "all_cls_scores": (np.s_[:], 3e-4),
    "seg": (np.s_[:], 1e-4),
    "ins_seg": (np.s_[:, ::2], 3e-3),
}
LOSS_OF = {  # the outputs that the scalar weighs, by upstream's name, and their factor
    "all_cls_scores": ("all_cls_scores", 1.0),
    "all_pts_preds": ("references", 1.0),
    "all_MGA_Ref_preds": ("mean_loc", 1.0),
    "seg": ("seg", 1.0),
    "ins_seg": ("ins_seg", 0.01),
}


@check("mgmapnet_decoder_{variant}.npz")
def check_decoder(golden: Golden, name: str) -> Iterator[Row]:
    """Compare six layers with their branches and masks: values and gradients."""
    data, parts = golden.read_arrays(name), MGMapNetParts(golden)
    head = parts.load(small_head(golden), "map_head.")
    with torch.no_grad():
        outputs = run(head, parts.bev)
    for key, (part, tolerance) in DECODER_ROWS.items():
        yield Row(name, key, largest_difference(outputs[key][part], data[key]), tolerance)
    yield from group_rows(name, data, parts, head)
    yield from decoder_gradient_rows(name, data, parts, head.double())


def decoder_gradient_rows(
    name: str, data: Mapping[str, np.ndarray], parts: MGMapNetParts, head: MapHead
) -> Iterator[Row]:
    """Compare gradients, ours in float64: in float32 a single ReLU that flips moves them by 1 %."""
    bev = parts.bev.double().requires_grad_()
    outputs = run(head, bev)
    scalar = sum(
        factor * (outputs[key] * parts.normal(f"mgm_gd_{theirs}", tuple(outputs[key].shape))).sum()
        for theirs, (key, factor) in LOSS_OF.items()
    )
    scalar.backward()
    yield Row(name, "scalar (relative)", largest_relative(scalar.item(), data["scalar"]), 1e-4)
    off = relative_norm(bev.grad.flatten(2).transpose(1, 2)[..., ::16], data["grad_bev_sub"])
    yield Row(name, "gradient of BEV (relative)", off, GRAD_L2)
    embedding = head.instance_embedding.weight.grad[:N]
    off = relative_norm(embedding, data["grad_instance_embedding"])
    yield Row(name, "gradient of the queries (relative)", off, GRAD_L2)
    yield from parts.gradient_rows(name, "", data, parts.gradients_of(head, "map_head."))
    idle = [name for name, p in head.named_parameters() if p.grad is None]
    idle += [key for key in data["no_grad_keys"] if key not in MGMAPNET.unused]
    yield Row(name, "parameters that only one of us trains", len(idle), 0)


@torch.no_grad()
def group_rows(
    name: str, data: Mapping[str, np.ndarray], parts: MGMapNetParts, head: MapHead
) -> Iterator[Row]:
    """Compare the training queries: a mask keeps the groups apart in the self-attention only."""
    with all_queries(head):
        outputs = run(head, parts.bev)
    ours = {
        "one2one_cls": (outputs["all_cls_scores"][:, :, :N], 3e-4),
        "one2one_pts": (outputs["references"][:, :, :N], 3e-5),
        "one2many_cls": (outputs["all_cls_scores"][:, :, N:], 3e-4),
        "one2many_pts": (outputs["references"][:, :, N:], 3e-5),
        "one2many_mean_loc": (outputs["mean_loc"][-1, :, N:], 3e-5),
    }
    for key, (value, tolerance) in ours.items():
        yield Row(name, f"train_{key}", largest_difference(value, data[f"train_{key}"]), tolerance)


@check("mgmapnet_forward_reduced_{variant}.npz")
@torch.no_grad()
def check_forward(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the way from the images to the detections."""
    data, meta = golden.read_arrays(name), golden.meta("reduced")
    model = golden.model(CONFIG, STATE)
    bev_outputs = model.bev_encoder(model.extract_img_feats(golden.images("reduced")), [meta])
    bev, head = bev_outputs["bev_feats"], model.map_head
    cells = bev[0][:, data["bev_rows"]][:, :, data["bev_cols"]].flatten(1).T  # (cells, C)
    off = fraction_beyond(cells, data["bev_embed_sub"], 1e-4)
    yield Row(name, "share of BEV that is off by > 1e-4", off, 0.01)
    outputs = head(bev_outputs)
    scores = stacked(outputs).scores
    ours = {
        "all_cls_scores": (scores, 1e-3),
        "all_pts_preds": (stacked(outputs).pts, 1e-4),
        "mean_loc_last": (stacked(outputs).mean_locations[-1], 1e-4),
    }
    for key, (value, tolerance) in ours.items():
        yield Row(name, key, largest_difference(value, data[key]), tolerance)
    yield from decoded_rows(name, data, head.predict_by_feat(outputs, [meta])[0])
    masks = head.aux_heads
    instances = head.losses["ins_seg"].logits(stacked(outputs).instance_states[-1, 0], bev[0])
    for key, value in {
        "seg": masks["seg"](bev)[..., ::2, ::2],
        "ins_seg": instances[None, ::10, ::4, ::4],
        "pv_seg": masks["pv_seg"](bev_outputs["img_feats"].flatten(0, 1))[None],
    }.items():
        off = fraction_beyond(value, data[key], 1e-3)
        yield Row(name, f"cells with {key} off by > 1e-3", off, 0.01)
    with all_queries(head):
        (_, first), (_, further) = head.split_groups(head(bev_outputs))
    change = (stacked(first).scores - scores).abs().amax((1, 2, 3))
    ours = {
        "one2one_cls": (stacked(first).scores, 1e-3),
        "one2one_pts_last": (stacked(first).pts[-1], 1e-4),
        "one2many_cls_sub": (stacked(further).scores[:, :, ::20], 1e-3),
        "one2many_pts_last_sub": (stacked(further).pts[-1, :, ::20], 1e-4),
        "minus_eval_cls_maxabs": (change, 1e-4),
    }
    for key, (value, tolerance) in ours.items():
        off = largest_difference(value, data[f"train_{key}"])
        yield Row(name, f"train_{key}", off, tolerance)
