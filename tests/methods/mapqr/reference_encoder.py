"""MapQR: the encoder with moving pillars, and the whole model."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from methods.mapqr.reference import (
    CONFIG,
    ENCODER,
    STATE,
    B,
    C,
    MapQRParts,
    run,
    tokens,
    training_rows,
)
from reference.golden import Golden
from reference.maptr import decoded_rows
from reference.registry import check
from reference.report import (
    Row,
    fraction_beyond,
    largest_difference,
    largest_relative,
    relative_norm,
)
from torch import Tensor, nn

from gsmap.models.encoders.gkt import kernel_offsets
from gsmap.models.mapqr.encoder import HeightQueryEncoder, MovingPillars

VISIBLE = 1e-4  # share of cells whose visibility a rounding may turn


class LayerLog:
    """What happens in each layer of an encoder, by the golden names."""

    def __init__(self, encoder: HeightQueryEncoder) -> None:
        self.values: list[dict[str, Tensor]] = []
        self._hooks: list[Any] = []
        for layer in encoder.layers:
            attention = layer.cross_attn
            self._hooks += [
                layer.norms[0].register_forward_pre_hook(self._start),
                attention.output_proj.register_forward_pre_hook(self._keep("slots")),
                attention.register_forward_hook(self._pillars),
                layer.norms[1].register_forward_pre_hook(self._keep("cross")),
                layer.norms[2].register_forward_hook(
                    lambda _, __, out: self.values[-1].update(out=out)
                ),
            ]

    def _start(self, _: nn.Module, inputs: tuple[Tensor]) -> None:
        self.values.append({"tsa": inputs[0]})

    def _keep(self, name: str) -> Any:
        return lambda _, inputs: self.values[-1].update({name: inputs[0]})

    def _pillars(self, _: nn.Module, inputs: tuple[Any, ...], __: Tensor) -> None:
        pillars: MovingPillars = inputs[2]
        still = torch.zeros_like(pillars.heights)
        uv, visible = pillars.move(still, True)
        depth_m = pillars.feet[..., 2, None] + (
            (pillars.low_m + pillars.heights[:, None] * pillars.extent_m) * pillars.upwards[..., 2]
        )
        inside = (depth_m > 1e-5) & ((uv > 0) & (uv < 1)).all(-1)
        self.values[-1].update(heights=pillars.heights, uv=uv, inside=inside, visible=visible)

    def close(self) -> None:
        """Take the hooks away."""
        for hook in self._hooks:
            hook.remove()


def metas(data: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Return the meta dicts of both samples."""
    return [
        {
            "token": f"rig {number}",
            "batch_input_shape": (192, 320),
            "lidar2img": data["lidar2img"][number],
            "can_bus": data["can_bus"][number],
        }
        for number in range(B)
    ]


LAYER_ROWS = {"tsa": (np.s_[:, ::10, ::8], 1e-4), "slots": (np.s_[:, ::13, ::4], 3e-4),
              "cross": (np.s_[:, ::10, ::8], 1e-4), "out": (np.s_[:, ::5, ::8], 1e-4)}  # fmt: skip


@check("mapqr_encoder_{variant}.npz")
def check_encoder(golden: Golden, name: str) -> Iterator[Row]:
    """Compare each step of each layer, for each sample alone and for both in one batch."""
    data, parts = golden.read_arrays(name), MapQRParts(golden)
    encoder, feats, rigs = parts.encoder(), parts.feats, metas(data)
    offsets = encoder.layers[0].cross_attn.offsets
    wanted = data["kernel_offsets_xy_in_weight_order"]
    yield Row(name, "kernel offsets", largest_difference(offsets, wanted), 0)
    yield Row(name, "kernel", largest_difference(kernel_offsets((2, 4)), wanted), 0)
    for sample in range(B):
        own = {k.removeprefix(f"s{sample}_"): v for k, v in data.items()}
        value = feats[sample : sample + 1].clone().requires_grad_()
        log = LayerLog(encoder)
        bev = tokens(encoder([value], rigs[sample : sample + 1])["bev_feats"])
        log.close()
        for layer, values in enumerate(log.values):
            yield from layer_rows(name, f"s{sample}_l{layer}_", data, values)
        off = largest_difference(bev.detach()[:, ::13], own["bev_full_channels"])
        yield Row(name, f"s{sample}: BEV", off, 1e-4)
        scalar = (bev * parts.normal(f"mapqr_enc_g_s{sample}", tuple(bev.shape))).sum()
        encoder.zero_grad()
        scalar.backward()
        off = largest_relative(scalar.item(), own["scalar"])
        yield Row(name, f"s{sample}: scalar (relative)", off, 1e-4)
        off = relative_norm(value.grad[0, :, ::16], own["grad_feat_sub"])
        yield Row(name, f"s{sample}: gradient of the features (relative)", off, 1e-2)
        off = relative_norm(
            encoder.bev_embedding.weight.grad[::13, ::8], own["grad_bev_embedding_sub"]
        )
        yield Row(name, f"s{sample}: gradient of the queries (relative)", off, 1e-2)
        gradients = parts.gradients_of(encoder, ENCODER)
        yield from parts.gradient_rows(name, f"s{sample}: ", own, gradients, norm=1e-2, dot=1e-2)
    with torch.no_grad():
        both = tokens(encoder([feats], rigs)["bev_feats"])[:, ::13]
    wanted = np.concatenate([data[f"s{sample}_bev_full_channels"] for sample in range(B)])
    yield Row(name, "BEV of both in one batch", largest_difference(both, wanted), 1e-4)
    for layer in encoder.layers:
        layer.released_pairs = layer.cross_attn.released_cells = True
    with torch.no_grad():
        second = tokens(encoder([feats], rigs)["bev_feats"])[1, ::5, ::8]
    off = largest_difference(second, data["b2_released_s1_out"])
    yield Row(name, "BEV of the second in one batch, as released", off, 1e-4)


def layer_rows(
    name: str, tag: str, data: Mapping[str, np.ndarray], values: dict[str, Tensor]
) -> Iterator[Row]:
    """Compare what happened in a layer of the encoder."""
    for key, (part, tolerance) in LAYER_ROWS.items():
        ours = values[key].detach()[part]
        yield Row(name, tag + key, largest_difference(ours, data[tag + key]), tolerance)
    heights = values["heights"].detach().transpose(1, 2)[:, :, ::5]
    yield Row(name, tag + "heights", largest_difference(heights, data[tag + "heights"]), 1e-5)
    uv = values["uv"].detach()[0, :, None, ::26]
    near = np.abs(data[tag + "uv"]) < 5
    off = largest_difference(uv.numpy()[near], data[tag + "uv"][near])
    yield Row(name, tag + "uv", off, 3e-5)
    seen = np.packbits(values["inside"][0, :, None].numpy())
    flips = np.unpackbits(seen ^ data[tag + "vis"].ravel()).mean()
    yield Row(name, tag + "visibility that differs", float(flips), VISIBLE)
    counts = values["visible"][0].sum(1)[:, None]
    off = largest_difference(counts, data[tag + "vis_counts"]) / counts.sum()
    yield Row(name, tag + "seen cells (share)", float(off), VISIBLE)


@check("mapqr_forward_reduced_{variant}.npz")
@torch.no_grad()
def check_forward(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the way from the images to the detections."""
    data, meta = golden.read_arrays(name), golden.meta("reduced")
    model = golden.model(CONFIG, STATE)
    log = LayerLog(model.bev_encoder)
    bev_outputs = model.bev_encoder(model.extract_img_feats(golden.images("reduced")), [meta])
    log.close()
    cells = np.ix_(data["bev_rows"], data["bev_cols"])
    for layer, values in enumerate(log.values):
        out = values["out"][0].view(200, 100, C)[cells].flatten(0, 1)[:, ::2]
        off = fraction_beyond(out, data[f"layer{layer}_out_sub"], 1e-3)
        yield Row(name, f"share of layer {layer} off by > 1e-3", off, 1e-3)
        heights = values["heights"][0].view(200, 100, 8)[cells].flatten(0, 1).T
        off = largest_difference(heights, data[f"heights_l{layer}_sub"])
        yield Row(name, f"heights of layer {layer}", off, 1e-5)
    seen = np.packbits(log.values[-1]["visible"][0].numpy(), axis=-1)
    flips = np.unpackbits(seen ^ data["seen_last"]).mean()
    yield Row(name, "seen cells that differ", float(flips), VISIBLE)
    bev, head = bev_outputs["bev_feats"], model.map_head
    off = fraction_beyond(bev[0].mean(0), data["bev_embed_channel_mean"], 1e-4)
    yield Row(name, "share of BEV means off by > 1e-4", off, 1e-3)
    outputs = run(head, bev, bev_outputs["img_feats"])
    ours = {
        "init_reference": (outputs["init_reference"], 1e-5),
        "states_sub": (outputs["states"][:, ::5, 0, ::4], 5e-3),
        "all_cls_scores": (outputs["all_cls_scores"], 2e-3),
        "all_pts_preds": (outputs["all_pts_preds"], 2e-4),
        "pv_seg": (outputs["pv_seg"], 1e-3),
    }
    for key, (value, tolerance) in ours.items():
        yield Row(name, key, largest_difference(value, data[key]), tolerance)
    off = fraction_beyond(outputs["seg"][..., ::2, ::2], data["seg"], 1e-3)
    yield Row(name, "cells with seg off by > 1e-3", off, 0.01)
    result = head.predict_by_feat(head(bev_outputs), [meta])[0]
    yield from decoded_rows(name, data, result, 1e-3)
    yield from training_rows(name, data, head, bev_outputs, 20, (2e-3, 2e-4))
