"""MapQR: key table, scatter-and-gather attention, decoder, losses."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from methods.maptrv2.reference import all_queries
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.config import Config
from mmengine.structures import InstanceData
from predictions import predicted, stacked
from reference.golden import NUM_CAMS, Golden
from reference.groups import GROUPS, REPEATS, match_rows
from reference.maptr import decoded_rows, state_rows
from reference.parts import GoldenParts
from reference.registry import check
from reference.report import (
    Row,
    largest_difference,
    largest_relative,
    relative_norm,
)
from torch import Tensor, nn

from gsmap.models.base.attention import place_samples, sample_map
from gsmap.models.base.head import MapHead
from gsmap.models.base.mask_heads import BEVMaskHead
from gsmap.models.mapqr.decoder import sine_code
from gsmap.models.mapqr.encoder import HeightQueryEncoder
from gsmap.models.mapqr.keys import MAPQR
from gsmap.structures.grid import BEVGrid

CONFIG = "mapqr/mapqr_r50_24e.py"
STATE = "mapqr_state.json"
B, N, P, C, LAYERS = 2, 12, 20, 256, 6
BEV = (50, 26)
HEAD, ENCODER = "map_head.", "bev_encoder."
FURTHER = 24  # one-to-many queries of the training set


@check(STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare MapQR's state with ours."""
    yield from state_rows(golden, name, CONFIG)
    listed = golden.read_json(name)
    model = golden.model(CONFIG, name)
    total = sum(parameter.numel() for parameter in model.parameters())
    off = abs(total + 4 - listed["total_params"])  # upstream's code weights are of no effect
    yield Row(name, "all parameters", off, 0)


class MapQRParts(GoldenParts):
    """MapQR's modules and inputs, with a BEV of few cells."""

    def __init__(self, golden: Golden) -> None:
        super().__init__(golden, "mapqr", MAPQR)
        self.cfg = Config.fromfile(golden.configs / CONFIG, import_custom_modules=False)
        self.grid = BEVGrid(**self.cfg.grid)

    def encoder(self) -> HeightQueryEncoder:
        """Return the encoder."""
        pixel_m = [self.grid.extent_m[0] / BEV[1], self.grid.extent_m[1] / BEV[0]]
        encoder = {**self.cfg.model.bev_encoder, "grid": self.grid, "bev_pixel_m": pixel_m}
        return self.load(MODELS.build(encoder), ENCODER)

    def head(self, groups: tuple[int, int] = (N, FURTHER), **settings: Any) -> MapHead:
        """Return the head."""
        queries = [{"num": groups[0]}, {"name": "o2m", "num": groups[1], "repeats": REPEATS}]
        shared = {"grid": self.grid, "classes": self.cfg.classes, "query_groups": queries}
        return self.load(MODELS.build({**self.cfg.model.map_head, **shared, **settings}), HEAD)

    @property
    def feats(self) -> Tensor:
        """Image features. (B, V, C, h, w)"""
        return self.normal("mapqr_feat", (B, NUM_CAMS, C, 6, 10))

    @property
    def bev(self) -> Tensor:
        """BEV features. (B, C, H, W)"""
        tokens = self.normal("mapqr_bev", (B, BEV[0] * BEV[1], C))
        return tokens.transpose(1, 2).unflatten(2, BEV)

    @property
    def query(self) -> Tensor:
        """Instance queries. (B, N, C)"""
        return self.normal("mapqr_query", (N, B, C)).transpose(0, 1)

    @property
    def reference(self) -> Tensor:
        """References. (B, N * P, 2)"""
        values = self.recipe.uniform("mapqr_ref", (B, N, 2 * P), 0.02, 0.98, self.golden.seed)
        return torch.from_numpy(values).unflatten(2, (P, 2)).flatten(1, 2)


def tokens(feats: Tensor) -> Tensor:
    """Return the cells of a map. (B, C, H, W) -> (B, cells, C)"""
    return feats.flatten(2).transpose(1, 2)


@check("mapqr_attention_{variant}.npz")
def check_attention(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the scatter-and-gather attention of the third layer: steps, output, gradients."""
    data, parts = golden.read_arrays(name), MapQRParts(golden)
    layer = parts.head().decoder.layers[2]
    attention, query = layer.cross_attn, parts.query.clone().requires_grad_()
    bev, reference = parts.bev.requires_grad_(), parts.reference.requires_grad_()
    code = sine_code(reference, C)
    position = layer.position_proj(code)
    scattered = query.repeat_interleave(P, 1) + position
    offsets = attention.offsets_in_cells(scattered)
    locations = place_samples(offsets, reference, BEV)
    weights = attention.weights(scattered)
    sampled = sample_map(attention.values(tokens(bev)), BEV, locations, weights)
    joined = sampled.unflatten(1, (N, P)).flatten(2)
    hidden = attention.output_proj[1](attention.output_proj[0](joined))
    gathered = attention(query, reference, bev, None, position)
    out = (gathered + query).transpose(0, 1)
    ours = {
        "sine": (code.unflatten(1, (N, P))[:, :, ::5], 1e-5),
        "point_pos": (position.unflatten(1, (N, P))[..., ::8], 1e-5),
        "point_query": (scattered.unflatten(1, (N, P))[..., ::16], 1e-5),
        "loc": (locations.unflatten(1, (N, P))[:, :, ::2], 1e-5),
        "weights": (weights.unflatten(1, (N, P))[:, :, ::2], 1e-5),
        "sampled": (sampled.unflatten(1, (N, P))[..., ::16], 1e-4),
        "gather_hidden": (hidden[..., ::20], 1e-4),
        "gather_out": (gathered, 1e-4),
        "out": (out, 1e-4),
    }
    for key, (value, tolerance) in ours.items():
        yield Row(name, key, largest_difference(value.detach(), data[key]), tolerance)
    scalar = (out * parts.normal("mapqr_ga", (N, B, C))).sum()
    scalar.backward()
    yield Row(name, "scalar (relative)", largest_relative(scalar.item(), data["scalar"]), 1e-4)
    ours = {
        "query": query.grad.transpose(0, 1),
        "bev_sub": tokens(bev.grad)[..., ::16],
        "ref": reference.grad.view(B, N, 2 * P),
    }
    for key, value in ours.items():
        off = relative_norm(value, data[f"grad_{key}"])
        yield Row(name, f"gradient of {key} (relative)", off, 1e-3)
    gradients = parts.gradients_of(layer, f"{HEAD}decoder.layers.2.")
    yield from parts.gradient_rows(name, "", data, gradients)


@check("mapqr_layer_{variant}.npz")
@torch.no_grad()
def check_layer(golden: Golden, name: str) -> Iterator[Row]:
    """Compare one decoder layer, without and with a mask between two groups of instances."""
    data, parts = golden.read_arrays(name), MapQRParts(golden)
    layers = parts.head().decoder.layers
    group = torch.arange(N) >= 8
    for tag, number in (("first", 0), ("later", 3), ("later_masked", 3)):
        layer, steps = layers[number], []
        mask = group[:, None] != group if tag.endswith("masked") else None
        hooks = [
            norm.register_forward_pre_hook(lambda _, inputs, own=steps: own.append(inputs[0]))
            for norm in layer.norms[:2]
        ]
        out = layer(parts.query, parts.query, parts.reference, parts.bev, mask)
        for hook in hooks:
            hook.remove()
        ours = {"self_attn": steps[0][..., ::2], "cross": steps[1][..., ::2], "out": out}
        for key, value in ours.items():
            off = largest_difference(value.transpose(0, 1), data[f"{tag}_{key}"])
            yield Row(name, f"{tag}_{key}", off, 1e-4)


def run(head: MapHead, bev: Tensor, feats: Tensor) -> dict[str, Tensor]:
    """Return all predictions by the golden names."""
    outputs = head({"bev_feats": bev})
    masks = head.aux_heads
    return {
        "init_reference": head.reference.start(head.queries()[0]).flatten().view(-1, 2 * P),
        "query": head.queries()[1],
        "states": stacked(outputs).instance_states.transpose(1, 2),
        "all_cls_scores": stacked(outputs).scores,
        "all_pts_preds": stacked(outputs).pts,
        "seg": masks["seg"](bev),
        "pv_seg": masks["pv_seg"](feats.flatten(0, 1)).unflatten(0, feats.shape[:2]),
    }


DECODER_ROWS = {  # what the file holds of each output, and the tolerance
    "init_reference": (np.s_[:], 1e-5),
    "query": (np.s_[:], 0),
    "states": (np.s_[..., ::2], 2e-3),
    "all_cls_scores": (np.s_[:], 1e-3),
    "all_pts_preds": (np.s_[:], 1e-4),
    "seg": (np.s_[:], 1e-4),
    "pv_seg": (np.s_[:], 1e-4),
}


@check("mapqr_decoder_{variant}.npz")
def check_decoder(golden: Golden, name: str) -> Iterator[Row]:
    """Compare six layers with their branches and masks: values and gradients."""
    data, parts = golden.read_arrays(name), MapQRParts(golden)
    head, bev, feats = parts.head(coder={"max_num": N}), parts.bev, parts.feats
    with torch.no_grad():
        outputs = run(head, bev, feats)
        decoded = head.predict_by_feat(head({"bev_feats": bev}), [{}] * B)
    for key, (part, tolerance) in DECODER_ROWS.items():
        off = largest_difference(outputs[key].detach()[part], data[key])
        yield Row(name, key, off, tolerance)
    last = largest_difference(outputs["states"][-1], data["states_full_last"])
    yield Row(name, "states_full_last", last, 2e-3)
    position = point_position(head.decoder.layers[-1], outputs["all_pts_preds"][-2])
    off = largest_difference(position[:, :, ::5, ::8], data["point_pos_last"])
    yield Row(name, "point_pos_last", off, 1e-3)
    for sample, result in enumerate(decoded):
        prefix = f"dec{sample}_"
        own = {f"dec_{k.removeprefix(prefix)}": v for k, v in data.items() if k.startswith(prefix)}
        yield from decoded_rows(name, own, result)
    yield from training_rows(name, data, head, {"bev_feats": bev}, 1)
    yield from decoder_gradient_rows(name, data, parts, head)


@torch.no_grad()
def point_position(layer: nn.Module, references: Tensor) -> Tensor:
    """Return the position that a layer adds for references. (B, N, P, 2) -> (B, N, P, C)"""
    return layer.position_proj(sine_code(references, C))


def decoder_gradient_rows(
    name: str, data: Mapping[str, np.ndarray], parts: MapQRParts, head: MapHead
) -> Iterator[Row]:
    """Compare gradients."""
    bev, feats = parts.bev.requires_grad_(), parts.feats.requires_grad_()
    outputs = run(head, bev, feats)
    scalar = sum(
        (outputs[key] * parts.normal(f"mapqr_gd_{key}", tuple(outputs[key].shape))).sum()
        for key in ("all_cls_scores", "all_pts_preds", "seg", "pv_seg")
    )
    scalar.backward()
    yield Row(name, "scalar (relative)", largest_relative(scalar.item(), data["scalar"]), 1e-4)
    ours = {
        "bev_sub": tokens(bev.grad)[..., ::16],
        "feat_sub": feats.grad[:, :, ::32],
        "instance_embedding": head.instance_embedding.weight.grad[:N],
    }
    for key, value in ours.items():
        off = relative_norm(value, data[f"grad_{key}"])
        yield Row(name, f"gradient of {key} (relative)", off, 2e-2)
    gradients = parts.gradients_of(head, HEAD)
    yield from parts.gradient_rows(name, "", data, gradients, norm=1e-2, dot=2e-2)


@torch.no_grad()
def training_rows(
    name: str,
    data: Mapping[str, np.ndarray],
    head: MapHead,
    bev_outputs: dict[str, Tensor],
    every: int,
    tolerances: tuple[float, float] = (1e-3, 1e-4),
) -> Iterator[Row]:
    """Compare the training queries, with and without the mask between their groups."""
    logits, points = tolerances
    suffix = "" if every == 1 else "_sub"
    scores = stacked(head(bev_outputs)).scores
    for tag, masked in (("train_masked", True), ("train", False)):
        for layer in head.decoder.layers:
            layer.mask_groups = masked
        with all_queries(head):
            first, further = (stacked(own) for _, own in head.split_groups(head(bev_outputs)))
        ours = {
            "one2one_cls": (first.scores, logits),
            "one2one_pts_last": (first.pts[-1], points),
            f"one2many_cls{suffix}": (further.scores[:, :, ::every], logits),
            f"one2many_pts_last{suffix}": (further.pts[-1, :, ::every], points),
            "minus_eval_cls_maxabs": ((first.scores - scores).abs().amax((1, 2, 3)), logits),
        }
        for key, (value, tolerance) in ours.items():
            off = largest_difference(value, data[f"{tag}_{key}"])
            yield Row(name, f"{tag}_{key}", off, tolerance)


@check("mapqr_losses_{variant}.npz")
def check_losses(golden: Golden, name: str) -> Iterator[Row]:
    """Compare matches, losses and gradients of fixed predictions."""
    data, parts = golden.read_arrays(name), MapQRParts(golden)
    head = parts.head(tuple(GROUPS.values()), aux_heads=[])
    shapes = {group: (LAYERS, B, num, 3) for group, num in GROUPS.items()}
    scores, pts = (
        torch.cat(values, 2).requires_grad_()
        for values in (
            [parts.normal(f"mapqr_loss_{group}_cls", shapes[group], shift=-1) for group in GROUPS],
            [torch.from_numpy(data[f"in_{group}_all_pts_preds"]) for group in GROUPS],
        )
    )
    gts = [
        InstanceData(
            labels_3d=torch.from_numpy(data[f"gt_labels_{sample}"]),
            pts=torch.from_numpy(data[f"gt_fixed_pts_{sample}"]),
            pts_shifts=torch.from_numpy(data[f"gt_shift_pts_{sample}"]),
        )
        for sample in range(B)
    ]
    outputs = predicted(head, scores, pts)
    yield from match_rows(name, data, head, outputs, gts)
    losses = head.loss_by_feat(outputs, gts, [{}] * B)
    for group in GROUPS:
        suffix = "" if group == "o2o" else f"_{group}"
        for key in ("cls", "pts", "dir"):
            layers = [*(f"d{layer}." for layer in range(LAYERS - 1)), ""]
            ours = [losses[f"{layer}loss_{key}{suffix}"].item() for layer in layers]
            off = largest_relative(ours, data[f"{group}_loss_{key}"])
            yield Row(name, f"{group}: {key} (relative)", off, 1e-4)
    masks = {}
    for number, (key, size) in enumerate({"seg": (1, *BEV), "pv": (NUM_CAMS, 1, 6, 10)}.items()):
        logits = parts.normal(f"mapqr_loss_{key}", (B, *size), shift=-1).requires_grad_()
        truth = parts.recipe.mask(f"mapqr_{key}", (B, *size), golden.seed)
        masks[("seg", "pv_seg")[number]] = logits
        part = MODELS.build(parts.cfg.model.map_head.aux_heads[number])
        losses[f"loss_{part.name}"] = mask_loss(part, logits, torch.from_numpy(truth))
        off = largest_relative(losses[f"loss_{part.name}"].item(), data[f"loss_{part.name}"])
        yield Row(name, f"loss_{part.name} (relative)", off, 1e-4)
    total = sum(losses.values())
    yield Row(name, "total (relative)", largest_relative(total.item(), data["total"]), 1e-4)
    total.backward()
    sizes = list(GROUPS.values())
    ours = {f"grad_{key}": logits.grad for key, logits in masks.items()}
    for key, value in (("all_cls_scores", scores), ("all_pts_preds", pts)):
        split = zip(GROUPS, value.grad.split(sizes, 2), strict=True)
        ours |= {f"grad_{group}_{key}": part for group, part in split}
    for key, value in ours.items():
        yield Row(name, f"{key} (relative)", relative_norm(value, data[key]), 1e-3)


def mask_loss(head: BEVMaskHead, logits: Tensor, truth: Tensor) -> Tensor:
    """Return the loss of a mask head whose features are the logits."""
    for number in range(len(head)):
        head[number] = nn.Identity()
    samples = [Det3DDataSample() for _ in range(B)]
    for sample, masks in zip(samples, truth, strict=True):
        setattr(sample, head.target, masks)
    return head.loss({head.feats: logits}, samples)
