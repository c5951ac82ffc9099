"""MGMap: key table, neck, activated queries, decoder, refinement, masks, losses."""

from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.structures import InstanceData
from reference.golden import Golden
from reference.maptr import decoded_rows, match_rows, state_rows
from reference.parts import GoldenParts
from reference.registry import check
from reference.report import (
    Row,
    fraction_beyond,
    largest_difference,
    largest_relative,
    relative_norm,
)
from reference.targets import X_RANGE_M, Y_RANGE_M, gt_instances
from torch import Tensor, nn

from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.transforms.masks import MakeInstanceMasks
from gsmap.models.base.decoder import Decoded
from gsmap.models.base.head import MapHead
from gsmap.models.base.pairs import Predictions
from gsmap.models.mgmap.decoder import MaskedDecoded, RefinedDecoded
from gsmap.models.mgmap.keys import MGMAP
from gsmap.models.mgmap.refinement import BINS, crop_patches
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import clip_to_box

CONFIG = "mgmap/mgmap_r50_30e.py"
STATE = "mgmap_state.json"
B, N, P, C, LAYERS = 2, 50, 20, 256, 6
BEV = (40, 24)
HEAD = "map_head."
UPSTREAM_NECK = "pts_bbox_head.transformer.bevencode."


@check(STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare MGMap's state with ours."""
    yield from state_rows(golden, name, CONFIG)
    entries = sum(int(np.prod(shape)) for shape in golden.state_shapes(name).values())
    weights = golden.read_json(name)["buffer_elements_in_state"]
    shared = golden.read_json(name)["shared_storage"]
    twice = sum(int(np.prod(golden.state_shapes(name)[key])) for key, _ in shared)
    total = golden.read_json(name)["total_params"]
    yield Row(name, "entries of a checkpoint", abs(entries - total - twice - weights), 0)


class MGMapParts(GoldenParts):
    """MGMap's modules and inputs, with a BEV of few cells."""

    def __init__(self, golden: Golden) -> None:
        super().__init__(golden, "mgmap", MGMAP)
        self.cfg = Config.fromfile(golden.configs / CONFIG, import_custom_modules=False)

    def head(self, **decoder: Any) -> MapHead:
        """Return the head."""
        settings = self.cfg.model.map_head.to_dict()
        settings["decoder"].update(decoder)
        shared = {"grid": BEVGrid(**self.cfg.grid), "classes": self.cfg.classes}
        return self.load(MODELS.build({**settings, **shared}), HEAD)

    @property
    def bev(self) -> Tensor:
        """BEV features. (B, C, H, W)"""
        tokens = self.normal("mgmap_bev", (B, BEV[0] * BEV[1], C))
        return tokens.transpose(1, 2).unflatten(2, BEV)


@check("mgmap_neck_{variant}.npz")
def check_neck(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the neck: stages, gates, levels, the fused map and gradients."""
    data, parts = golden.read_arrays(name), MGMapParts(golden)
    neck, bev = parts.head().decoder.neck, parts.bev.requires_grad_()
    seen: dict[str, Tensor] = {}

    def keep(key: str, module: nn.Module) -> None:
        module.register_forward_hook(lambda _, __, out: seen.__setitem__(key, out.detach()))

    keep("stem", neck.stem[0])
    for number, stage in enumerate(neck.stages, 1):
        keep(f"layer{number}", stage)
    keep("block_out_layer2_0", neck.stages[1][0])
    for tag, block in (("layer1_0", neck.stages[0][0]), ("layer3_1", neck.stages[2][1])):
        gates, own = block.gates, []
        gates.channel.register_forward_hook(lambda _, __, out, own=own: own.append(out))
        gates.space.register_forward_hook(
            lambda _, __, out, tag=tag, own=own: seen.update(
                {
                    f"gate_channel_{tag}": sum(own).sigmoid().detach()[..., 0, 0],
                    f"gate_space_{tag}": out.sigmoid().detach()[:, 0],
                }
            )
        )
    fused, levels = neck(bev)
    seen |= {"fused": fused.detach()} | {f"neck{k}": x.detach() for k, x in enumerate(levels)}
    strides = {"fused": 16, "neck0": 8, "neck1": 4, "neck2": 2, "neck3": 8}
    for key, value in seen.items():
        if key.startswith("gate"):
            off = largest_difference(value, data[key])
        else:
            off = largest_difference(value[:, :: strides.get(key, 8)], data[f"{key}_sub"])
        yield Row(name, key, off, 1e-4)
    scalar = (fused * parts.normal("mgmap_g_fin", tuple(fused.shape))).sum() / 10
    for k, level in enumerate(levels):
        scalar = scalar + (level * parts.normal(f"mgmap_g_neck{k}", tuple(level.shape))).sum()
    scalar.backward()
    yield Row(name, "scalar (relative)", largest_relative(scalar.item(), data["scalar"]), 1e-4)
    off = relative_norm(bev.grad[:, ::16], data["grad_input_sub"])
    yield Row(name, "gradient of the BEV (relative)", off, 1e-2)
    full = {**data, "grad_keys": [f"{UPSTREAM_NECK}{key}" for key in data["grad_keys"]]}
    gradients = parts.gradients_of(neck, f"{HEAD}decoder.neck.")
    yield from parts.gradient_rows(name, "", full, gradients, short=UPSTREAM_NECK)


def by_golden_name(outputs: list[Predictions]) -> dict[str, Tensor]:
    """Return all class logits and points."""
    return {
        "all_cls_scores": torch.stack([layer.scores for layer in outputs]),
        "all_pts_preds": torch.stack([layer.pts for layer in outputs]),
    }


@check("mgmap_decoder_{variant}.npz")
def check_decoder(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the activated queries, six layers and gradients."""
    data, parts = golden.read_arrays(name), MGMapParts(golden)
    head, bev = parts.head(), parts.bev.requires_grad_()
    decoder = head.decoder
    inputs: list[Tensor] = []
    decoder.layers[0].register_forward_pre_hook(lambda _, args: inputs.append(args[0]))
    outputs = head({"bev_feats": bev})
    layers = by_golden_name(outputs[:LAYERS])
    fused = decoder.neck(bev)[0]
    masks = outputs[0].decoded.mask_logits
    features = decoder.instance_features(fused, masks)
    states = torch.stack([o.decoded.point_states.flatten(1, 2) for o in outputs[:LAYERS]])
    references = torch.stack([o.decoded.references.flatten(1, 2) for o in outputs[:LAYERS]])
    instances = head.instance_embedding.weight
    points = head.pts_embedding(instances) - instances[:, None]  # without the instance itself
    ours = {
        "init_reference": (head.reference.start(head.queries()[0]), 1e-5),
        "pts_embed_sub": (points[::10, ::5], 1e-5),
        "iam_logits_sub": (masks[:, ::10], 3e-4),
        "iam_logits_mean": (masks.mean((2, 3)), 3e-4),
        "instance_features": (features, 1e-4),
        "activated": (decoder.activation(features), 1e-4),
        "query_in_sub": (inputs[0][:, ::25].transpose(0, 1), 1e-4),
        "states_sub": (states[:, :, ::25, ::8].transpose(1, 2), 3e-4),
        "states_last": (states[-1][:, ::10, ::2].transpose(0, 1), 3e-4),
        "references": (references, 3e-5),
        "all_cls_scores": (layers["all_cls_scores"], 3e-4),
        "all_pts_preds": (layers["all_pts_preds"], 3e-5),
    }
    for key, (value, tolerance) in ours.items():
        yield Row(name, key, largest_difference(value.detach(), data[key]), tolerance)
    weights = masks.sigmoid().sum((2, 3)).detach()
    off = largest_relative(weights, data["iam_normalizer"])
    yield Row(name, "iam_normalizer (relative)", off, 1e-4)
    scalar = sum(
        (value * parts.normal(f"mgmap_gd_{key}", tuple(value.shape))).sum()
        for key, value in layers.items()
    )
    for key, value in (("ins", masks), ("seg", outputs[-1].decoded.segmentation)):
        scalar = scalar + 0.01 * (value * parts.normal(f"mgmap_gd_{key}", value.shape)).sum()
    scalar.backward()
    yield Row(name, "scalar (relative)", largest_relative(scalar.item(), data["scalar"]), 1e-4)
    off = relative_norm(bev.grad.flatten(2).transpose(1, 2)[..., ::32], data["grad_bev_sub"])
    yield Row(name, "gradient of the BEV (relative)", off, 1e-2)
    off = relative_norm(head.instance_embedding.weight.grad[::5], data["grad_instance_embedding"])
    yield Row(name, "gradient of the queries (relative)", off, 1e-2)
    yield from parts.gradient_rows(name, "", data, parts.gradients_of(head, HEAD))


@check("mgmap_refine_{variant}.npz")
def check_refinement(golden: Golden, name: str) -> Iterator[Row]:
    """Compare segmentation, mask feature and both stages, without and with patches."""
    data, parts = golden.read_arrays(name), MGMapParts(golden)
    for tag, patches in (("released", False), ("patch", True)):
        head, bev = parts.head(patches=patches), parts.bev.requires_grad_()
        decoder, seen = head.decoder, {}
        for g, stage in enumerate(decoder.refinements):
            named = {"patch_vector": stage.patch_net, "memory": stage.memory,
                     "glimpse": stage.norm, "fused": stage.fuser,
                     "norm1": stage.layer.norm1, "norm2": stage.layer.norm2}  # fmt: skip
            for key, module in named.items():
                at = f"glimpse{g}_{key}" if key.startswith("norm") else f"{key}{g}"
                module.register_forward_hook(
                    lambda _, __, out, at=at, own=seen: own.__setitem__(at, out.detach())
                )
        outputs = head({"bev_feats": bev})
        for key, value in seen.items():
            full = value if value.dim() == 3 else value.view(-1, 1 if len(value) < B else N * P, C)
            full = full.expand(B, N * P, -1)
            ours = full[:, ::50, :: 8 if "norm" in key else 4]
            off = largest_difference(ours, data[f"{tag}_{key}_sub"])
            yield Row(name, f"{tag}_{key}", off, 3e-4)
        refined = by_golden_name(outputs[LAYERS:])
        for key, tolerance in (("all_cls_scores", 3e-4), ("all_pts_preds", 3e-5)):
            off = largest_difference(refined[key].detach(), data[f"{tag}_{key}"])
            yield Row(name, f"{tag}_{key}", off, tolerance)
        for sample, result in enumerate(head.predict_by_feat(outputs, [{}] * B)):
            scores = result.scores_3d.detach().numpy()
            off = largest_difference(np.sort(scores), np.sort(data[f"{tag}_dec{sample}_scores"]))
            yield Row(name, f"{tag}_dec{sample}_scores", off, 5e-4)
        scalar = sum(
            (value * parts.normal(f"mgmap_gr_{key}", tuple(value.shape))).sum()
            for key, value in refined.items()
        )
        scalar.backward()
        off = largest_relative(scalar.item(), data[f"{tag}_scalar"])
        yield Row(name, f"{tag}_scalar (relative)", off, 1e-4)
        own = {k.removeprefix(f"{tag}_"): v for k, v in data.items() if k.startswith(f"{tag}_")}
        gradients = parts.gradients_of(head, HEAD)
        first = "pts_bbox_head.glimpse_transformer"  # the release has it under two names
        gradients = {key.replace(f"{first}_0.", f"{first}."): g for key, g in gradients.items()}
        yield from parts.gradient_rows(name, f"{tag}: ", own, gradients)
    yield from feature_rows(name, data, head, parts.bev)


@torch.no_grad()
def feature_rows(
    name: str, data: Mapping[str, np.ndarray], head: MapHead, bev: Tensor
) -> Iterator[Row]:
    """Compare segmentation, mask feature and patches."""
    decoder = head.decoder
    fused, _ = decoder.neck(bev)
    segmentation = decoder.segmentation(fused)
    feature = decoder.mask_feature(fused, segmentation)
    block = decoder.mask_feature.block(decoder.mask_feature.expand(segmentation.softmax(1)))
    hidden = decoder.segmentation[:3](fused)
    ours = {
        "seg": (segmentation, 1e-4),
        "mask_feature_sub": (feature[:, ::16], 1e-4),
        "seg_feature_sub": (block[:, ::4], 1e-4),
        "conv2_sub": (hidden[:, ::8], 1e-4),
    }
    outputs = head({"bev_feats": bev})
    for g in (0, 1):
        centres = outputs[LAYERS - 1 + g].pts.flatten(1, 2)
        ours[f"patch_roi{g}_sub"] = (crop_patches(feature, centres)[:, ::100, ::16], 3e-4)
    for key, (value, tolerance) in ours.items():
        yield Row(name, key, largest_difference(value, data[key]), tolerance)
    yield Row(name, "bins", abs(BINS - data["patch_roi0_sub"].shape[-1]), 0)


def cut_elements(golden: Golden, case: str, order: np.ndarray) -> list[MapInstance]:
    """Return the parts within the map of a set's elements, in an order of elements."""
    elements = [golden.gt_sets[case][number] for number in order]
    return [
        MapInstance(element["label"], part)
        for element in elements
        for part in clip_to_box(np.asarray(element["pts"], np.float64), X_RANGE_M, Y_RANGE_M)
    ]


def drawn(instances: list[MapInstance]) -> Tensor:
    """Return the released masks of elements. (K, 200, 100)"""
    results = {"map_instances": instances, "x_range": X_RANGE_M, "y_range": Y_RANGE_M}
    results["gt_instances_3d"] = InstanceData(labels=torch.zeros(len(instances)))
    return MakeInstanceMasks().transform(results)["gt_instances_3d"].masks


@check("mgmap_masks_{variant}.npz")
def check_masks(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the masks; the reference numbers the parts of an element that leaves the map."""
    data = golden.read_arrays(name)
    for case in ("closed", "many"):
        masks = drawn(cut_elements(golden, case, data[f"{case}_order"]))
        shape = tuple(data[f"{case}_instance_shape"])
        wanted = np.unpackbits(data[f"{case}_instance"])[: np.prod(shape)].reshape(shape)
        # the reference also cuts a line where it crosses itself: its parts make our mask
        joined = np.zeros(masks.shape, bool)
        for part in wanted[wanted.any((1, 2))].astype(bool):
            joined[(masks.numpy() & part).sum((1, 2)).argmax()] |= part
        wrong = (joined != masks.numpy()).sum()
        yield Row(name, f"{case}: cells of instances that differ", float(wrong), 0)
        shape = tuple(data[f"{case}_semantic_shape"])
        wanted = np.unpackbits(data[f"{case}_semantic"])[: np.prod(shape)].reshape(shape)
        drawn_any = masks.any(0).numpy()
        wrong = np.abs(np.stack([drawn_any, ~drawn_any]) - wanted).sum()
        yield Row(name, f"{case}: cells of the segmentation that differ", wrong, 0)


@check("mgmap_losses_{variant}.npz")
def check_losses(golden: Golden, name: str) -> Iterator[Row]:
    """Compare matches, losses and gradients of fixed predictions."""
    data, parts = golden.read_arrays(name), MGMapParts(golden)
    order = golden.read_arrays(f"mgmap_masks_{golden.variant}.npz")
    gts, parts_drawn = [], []
    for case in ("closed", "many"):
        numbers = order[f"{case}_order"]
        gt = gt_instances([golden.gt_sets[case][number] for number in numbers])
        parts_drawn.append(drawn(cut_elements(golden, case, numbers)))
        gt.masks = parts_drawn[-1][: len(gt)]  # as released, whose numbers differ
        gts.append(gt)
    head = parts.head()
    saved = saved_outputs(parts, gts)
    outputs = [
        head.predictions(scores, decoded, None)
        for scores, decoded in zip(saved["cls"], decoded_layers(saved), strict=True)
    ]
    yield from match_rows(name, data, head, outputs, gts, [{}] * B)
    segmentation_loss = head.losses.pop("seg")
    losses = head.loss_by_feat(outputs, gts, [{}] * B)
    pairs = SimpleNamespace(
        predictions=outputs[-1],
        truths=SimpleNamespace(
            pipeline_masks=torch.cat(parts_drawn), counts=[len(own) for own in parts_drawn]
        ),
    )
    losses["loss_seg"] = segmentation_loss(pairs)
    for key in ("cls", "pts", "dir", "ins"):
        names = [f"d{layer}.loss_{key}" for layer in range(len(outputs) - 1)] + [f"loss_{key}"]
        ours = [losses[loss].item() for loss in names if loss in losses]
        off = largest_relative(ours, data[f"loss_{key}"])
        yield Row(name, f"{key} (relative)", off, 1e-4)
    off = largest_relative(losses["loss_seg"].item(), data["loss_seg"])
    yield Row(name, "seg (relative)", off, 1e-4)
    total = sum(losses.values())
    yield Row(name, "total (relative)", largest_relative(total.item(), data["loss_total"]), 1e-4)
    total.backward()
    ours = {
        "grad_cls": saved["cls"].grad,
        "grad_pts": saved["pts"].grad[[0, 5, 6, 7]],
        "grad_seg_sub": saved["seg"].grad[..., ::4, ::4],
        "grad_ins_sub": saved["ins"].grad[:, ::7, ::5, ::5],
        "grad_ins_l2_per_query": saved["ins"].grad.flatten(2).norm(dim=2),
    }
    for key, value in ours.items():
        yield Row(name, f"{key} (relative)", relative_norm(value, data[key]), 1e-3)


def saved_outputs(parts: MGMapParts, gts: list[InstanceData]) -> dict[str, Tensor]:
    """Return the recipe's predictions, whose masks are near those of elements."""
    outputs, size = LAYERS + 2, (200, 100)
    values = parts.recipe.uniform(
        "mgmap_loss_pts", (outputs, B, N, P, 2), 0.02, 0.98, parts.golden.seed
    )
    masks = parts.normal("mgmap_loss_ins", (B, N, *size), shift=-1)
    near = torch.stack([gt.masks[torch.arange(N) % len(gt)] for gt in gts])
    return {
        "cls": parts.normal("mgmap_loss_cls", (outputs, B, N, 3), shift=-1).requires_grad_(),
        "pts": torch.from_numpy(values).requires_grad_(),
        "seg": parts.normal("mgmap_loss_seg", (B, 2, *size), shift=-1).requires_grad_(),
        "ins": (masks + 3 * near).requires_grad_(),
    }


def decoded_layers(saved: dict[str, Tensor]) -> Iterator[Decoded]:
    """Return what the layers and the refinement return."""
    states = torch.zeros(B, N, 1)
    for number, pts in enumerate(saved["pts"]):
        if number < LAYERS:
            yield MaskedDecoded(states, pts, states, saved["ins"])
        else:
            yield RefinedDecoded(states, pts, states, saved["seg"])


@check("mgmap_forward_reduced_{variant}.npz")
@torch.no_grad()
def check_forward(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the way from the images to the detections."""
    data, meta = golden.read_arrays(name), golden.meta("reduced")
    model = golden.model(CONFIG, STATE)
    bev_outputs = model.bev_encoder(model.extract_img_feats(golden.images("reduced")), [meta])
    cells = np.ix_(data["bev_rows"], data["bev_cols"])
    bev = bev_outputs["bev_feats"]
    fused, levels = model.map_head.decoder.neck(bev)
    for key, value, tolerance in (("bev_embed_sub", bev, 1e-4), ("fused_sub", fused, 1e-3)):
        own = value[0].permute(1, 2, 0)[cells].flatten(0, 1)
        off = fraction_beyond(own, data[key], tolerance)
        yield Row(name, f"share of {key} off by > {tolerance}", off, 0.01)
    for k, (channels, step) in enumerate(((16, 4), (16, 2), (8, 1), (16, 4))):
        own = levels[k][0, ::channels, ::step, ::step]
        off = fraction_beyond(own, data[f"neck{k}_sub"], 1e-3)
        yield Row(name, f"share of neck{k} off by > 1e-3", off, 0.01)
    outputs = model.map_head(bev_outputs)
    ours = by_golden_name(outputs)
    off = largest_difference(ours["all_cls_scores"], data["all_cls_scores"])
    yield Row(name, "all_cls_scores", off, 1e-3)
    off = largest_difference(ours["all_pts_preds"][[0, 5, 6, 7]], data["all_pts_preds"])
    yield Row(name, "all_pts_preds", off, 1e-4)
    segmentation = outputs[-1].decoded.segmentation[0, :, ::2, ::2]
    off = fraction_beyond(segmentation, data["seg_sub"], 1e-3)
    yield Row(name, "share of seg off by > 1e-3", off, 0.01)
    masks = outputs[0].decoded.mask_logits[0, ::10, ::4, ::4]
    yield Row(name, "share of masks off", fraction_beyond(masks, data["ins_sub"], 1e-2), 0.01)
    result = model.map_head.predict_by_feat(outputs, [meta])[0]
    yield from decoded_rows(name, data, result, 1e-3)
