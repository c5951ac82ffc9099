"""StreamMapNet as a whole: three frames of one stream, from the images to the detections."""

from collections.abc import Iterator, Mapping

import numpy as np
import torch
from methods.streammapnet.reference import CONFIG, STATE, flipped
from predictions import stacked
from reference.golden import NUM_CAMS, Golden
from reference.registry import check
from reference.report import Row, largest_difference
from torch import Tensor, nn

from gsmap.structures.rigid import rigid


@check("streammapnet_forward_reduced_{variant}.npz")
@torch.no_grad()
def check_forward(golden: Golden, name: str) -> Iterator[Row]:
    """Compare three frames of one stream, from the images to the detections."""
    data, model = golden.read_arrays(name), golden.model(CONFIG, STATE)
    recipe = golden.recipe("streammapnet")
    model.eval()
    encoder, head = model.bev_encoder, model.map_head
    inside: dict[str, Tensor] = {}
    layer = encoder.layers[0]
    norms = {"tsa_sub": layer.norms[0], "sca_sub": layer.norms[1]}
    hooks = [
        norm.register_forward_pre_hook(lambda _, x, key=key: inside.update({key: x[0][0]}))
        for key, norm in norms.items()
    ]
    rows, cols = data["bev_rows"], data["bev_cols"]
    found: dict[str, list] = {}
    for frame in range(3):
        pose = rigid(data["e2g_rotation"][frame], data["e2g_translation"][frame])
        meta = {
            "token": str(frame), "scene": "a", "timestamp_ns": frame * 500_000_000,
            "lidar2global": pose, "lidar2img": data["ego2img"], "batch_input_shape": (192, 320),
        }  # fmt: skip
        images = torch.from_numpy(recipe.images(192, 320, NUM_CAMS, seed=golden.seed, frame=frame))[
            None
        ]
        res = model.img_backbone(images[0])
        fpn = model.extract_img_feats(images)
        if frame == 0:
            yield from image_rows(name, data, res, fpn)
            yield from projection_rows(name, data, encoder)
        outputs = encoder(fpn, [meta])
        raw = flipped(outputs["bev_feats"])[0]
        with model.temporal.remember_batch(outputs, [meta]) as batch:
            fused = flipped(batch.outputs["bev_feats"])[0]
            predictions = head(batch.outputs, **batch.hooks)
        results = head.predict_by_feat(predictions, [meta])[0]
        order = predictions[-1].scores[0].sigmoid().amax(-1).argsort(descending=True, stable=True)
        back = order.argsort()
        scores, lines = stacked(predictions).scores[:, 0], stacked(predictions).pts[:, 0].flatten(2)
        values = {
            "bev_raw_sub": raw[:, rows][:, :, cols],
            "bev_fused_sub": fused[:, rows][:, :, cols],
            "scores": scores,
            "lines_last": lines[-1],
            "lines_layers_q0": lines[:, ::10],
            "post_scores": results.scores_3d[back],
            "post_labels": results.labels_3d[back],
            "mem_topk": batch.propagation.best_inds[0],
        }
        for key in norms:
            cells = inside[key].unflatten(0, (50, 100))
            values[key] = cells[rows][:, cols][..., ::4]
        for key, value in values.items():
            found.setdefault(key, []).append(value)
    for hook in hooks:
        hook.remove()
    model.temporal.train(False)
    tolerances = {
        "bev_raw_sub": 1e-4, "bev_fused_sub": 5e-4, "tsa_sub": 1e-4, "sca_sub": 1e-4,
        "scores": 1e-3, "lines_last": 1e-4, "lines_layers_q0": 1e-4, "post_scores": 1e-3,
        "post_labels": 0, "mem_topk": 0,
    }  # fmt: skip
    for key, tolerance in tolerances.items():
        yield Row(name, key, largest_difference(torch.stack(found[key]), data[key]), tolerance)


def image_rows(
    name: str, data: Mapping[str, np.ndarray], res: tuple[Tensor, ...], fpn: list[Tensor]
) -> Iterator[Row]:
    """Compare the features of the images."""
    for level, (stride, channels) in enumerate(zip((4, 2, 1), (64, 128, 256), strict=True)):
        ours = res[level][::2, ::channels, ::stride, ::stride]
        off = largest_difference(ours, data[f"res{level}_sub"])
        yield Row(name, f"res{level}_sub", off, 1e-4)
        ours = fpn[level][0][:, ::16, ::stride, ::stride]
        off = largest_difference(ours, data[f"fpn{level}_sub"])
        yield Row(name, f"fpn{level}_sub", off, 1e-4)


def projection_rows(name: str, data: Mapping[str, np.ndarray], encoder: nn.Module) -> Iterator[Row]:
    """Compare which cells each camera sees."""
    matrices = torch.as_tensor(data["ego2img"], dtype=torch.float32)[None]
    seen = np.packbits(encoder.project(matrices, (192, 320)).visible[0].numpy(), axis=-1)
    off = np.unpackbits(seen ^ data["cam_hit"]).sum()
    yield Row(name, "cells seen by each camera that differ", float(off), 0)
