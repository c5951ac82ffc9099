"""PivotNet: key table, projection, decoder, head and the whole model."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config
from reference.golden import Golden
from reference.lines import CAMERAS
from reference.maptr import state_rows
from reference.parts import GoldenParts
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm
from torch import Tensor, nn

from gsmap.models.lines.front import turn_raster
from gsmap.models.lines.head import LinePredictions
from gsmap.models.pivotnet.encoder import PivotBEVEncoder
from gsmap.models.pivotnet.head import PivotHead
from gsmap.models.pivotnet.keys import PIVOTNET
from gsmap.structures.calibration import calibration_arrays
from gsmap.structures.grid import BEVGrid

CONFIG = "pivotnet/pivotnet_r50_30e.py"
STATE = "pivotnet_state.json"
CLASSES = ("divider", "crossing", "boundary")
B, C, BEV = 2, 256, (64, 32)


class PivotParts(GoldenParts):
    """PivotNet's modules and inputs."""

    def __init__(self, golden: Golden) -> None:
        super().__init__(golden, "pivotnet", PIVOTNET)

    def model(self, **settings: Any) -> nn.Module:
        """Return the released model with other settings of its parts."""
        path = self.golden.configs / CONFIG
        cfg = Config.fromfile(path, import_custom_modules=False).model
        for part, values in settings.items():
            cfg[part] = {**cfg[part], **values} if cfg[part] else values
        cfg.img_backbone.init_cfg = None
        return self.load(MODELS.build(cfg), "")

    def head(self) -> PivotHead:
        """Return the head of the released model; masks of 100 x 50 pixels."""
        return self.model(map_head={"mask_pixel_m": 0.6}).map_head


@check(STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare PivotNet's state with ours."""
    yield from state_rows(golden, name, CONFIG)


@check("pivotnet_projection_{variant}.npz")
@torch.no_grad()
def check_projection(golden: Golden, name: str) -> Iterator[Row]:
    """Compare where BEV cells look, from cameras in the frame of the vehicle."""
    data = golden.read_arrays(name)
    encoder = PivotBEVEncoder(BEVGrid((-30.0, 30.0), (-15.0, 15.0)))
    uv, seen = encoder.project(ground_matrices(golden, (900, 1600)), (900, 1600))
    valid = np.unpackbits(data["valid"]).astype(bool)
    yield Row(name, "cells that are seen", largest_difference(seen[0], valid), 0)
    shown = valid.reshape(BEV)[::2, ::2]
    off = largest_difference(uv[0].view(*BEV, 2)[::2, ::2][shown], data["points"][:, :, 0][shown])
    yield Row(name, "points", off, 1e-5)


def ground_matrices(golden: Golden, size: tuple[int, int], frame: str = "ego") -> Tensor:
    """Return the matrices from the ground to images of a size. (1, 6, 4, 4)"""
    cameras = [golden.cameras["cameras"][f"CAM_{camera}"] for camera in CAMERAS]
    intrinsics = np.array([camera["intrinsics_1600x900"] for camera in cameras])
    scale = np.diag([size[1] / 1600, size[0] / 900, 1.0, 1.0])
    ego_from_frame = np.eye(4)
    cam_from_ego = np.linalg.inv([camera["camera2ego"] for camera in cameras])
    meta = {"lidar2img": scale @ intrinsics @ cam_from_ego, "lidar2ego": ego_from_frame}
    (matrices,) = calibration_arrays(meta, ["img_from_ground"]).values()
    return torch.from_numpy(matrices)[None]


SUBSETS = {  # what the file holds of each gradient
    "grad_bev_sub": np.s_[:, ::16, ::2, ::2],
    "grad_query_feat_sub": np.s_[::20, ::4],
    "grad_query_embed_sub": np.s_[::20, ::4],
}


@check("pivotnet_decoder_{variant}.npz")
def check_decoder(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the point decoder: states, classes, masks, gradients."""
    data = golden.read_arrays(name)
    parts = PivotParts(golden)
    decoder = parts.head().decoder
    bev = parts.normal("pv_bev", (B, C, *BEV)).requires_grad_()
    cross: list[Tensor] = []  # behind the first attention
    decoder.layers[0].norms[0].register_forward_hook(lambda _, __, out: cross.append(out))
    outputs = decoder(bev)
    logits: list[Tensor] = []
    masks: list[Tensor] = []
    states: list[Tensor] = []
    blocked: list[Tensor] = []
    for layer in outputs:  # the lines of all classes, one class after another
        logits.append(torch.cat([lines.logits for lines in layer], 1))
        masks.append(torch.cat([lines.masks for lines in layer], 1))
        states.append(torch.cat([lines.states.flatten(1, 2) for lines in layer], 1))
        blocked.append(decoder.attention_mask(layer))
    ours = {
        "pred_logits": (torch.stack(logits), 3e-4),
        "mask_sub": (torch.stack(masks)[:, :, ::6, ::4, ::4], 3e-4),
        "mask_mean": (torch.stack(masks).mean((3, 4)), 3e-4),
        "mask_last_sub": (masks[-1][:, ::12], 3e-4),
        "states_sub": (torch.stack(states)[:, :, ::35, ::8], 3e-4),
        "states_last_sub": (states[-1][:, ::10, ::2], 3e-4),
        "cross0_sub": (cross[0][:, ::35, ::8], 3e-4),
    }
    for key, (value, tolerance) in ours.items():
        yield Row(name, key, largest_difference(value.detach(), data[key]), tolerance)
    packed = np.packbits(blocked[0][0, ::50].numpy().ravel())
    wrong = np.unpackbits(packed ^ data["attn_blocked0_packed"]).sum()
    yield Row(name, "blocked cells of the first layer", wrong, 0)
    ends = [0, 199, 200, 249, 250, 699]  # the first and the last point of every class
    shares = torch.stack(blocked).float().mean(3)[..., ends]
    off = largest_difference(shares, data["attn_blocked_fraction"])
    yield Row(name, "shares of blocked cells", off, 1e-3)
    scalar = torch.zeros(())
    for i, (value, mask) in enumerate(zip(logits, masks, strict=True)):
        logits_noise = parts.normal(f"pv_gd_logits{i}", tuple(value.shape))
        masks_noise = parts.normal(f"pv_gd_masks{i}", tuple(mask.shape))
        scalar = scalar + ((value * logits_noise).sum() + 0.01 * (mask * masks_noise).sum())
    states_noise = parts.normal("pv_gd_states", tuple(states[-1].shape))
    scalar = scalar + 0.1 * (states[-1] * states_noise).sum()
    scalar.backward()
    yield Row(name, "scalar (relative)", largest_relative(scalar.detach(), data["scalar"]), 1e-4)
    gradients = {
        "grad_bev_sub": bev.grad,
        "grad_query_feat_sub": decoder.query.weight.grad,
        "grad_query_embed_sub": decoder.query_pos.weight.grad,
    }
    for key, gradient in gradients.items():
        steps = SUBSETS[key]
        yield Row(name, f"{key} (relative)", relative_norm(gradient[steps], data[key]), 1e-2)
    gradients = parts.gradients_of(decoder, "map_head.decoder.")
    yield from parts.gradient_rows(name, "", data, gradients)


@check("pivotnet_head_{variant}.npz")
def check_head(golden: Golden, name: str) -> Iterator[Row]:
    """Compare points, their kinds and masks from the decoder's states, and gradients."""
    data = golden.read_arrays(name)
    parts = PivotParts(golden)
    head = parts.head()
    bev = parts.normal("pv_bev", (B, C, *BEV))
    with torch.no_grad():
        layers = head.decoder(bev)[1:]
    leaves = [own.states.requires_grad_() for own in layers[-1]]
    mean = head.coordinate_feature()
    off = largest_difference(mean.detach(), data["coords_feature_mean"])
    yield Row(name, "coords_feature_mean", off, 1e-5)
    outputs = [head.predictions(layer, mean) for layer in layers]
    scalar = torch.zeros(())
    for label, kind in enumerate(CLASSES):
        own = [output.lines[label] for output in outputs]
        ours = {
            f"points_{kind}": (torch.stack([lines.points for lines in own]), 3e-5),
            f"point_logits_{kind}": (torch.stack([lines.point_logits for lines in own]), 3e-4),
            f"ins_mask_{kind}_sub": (head.resize_masks(own[-1].masks)[:, ::5, ::4, ::2], 3e-4),
        }
        for key, (value, tolerance) in ours.items():
            yield Row(name, key, largest_difference(value.detach(), data[key]), tolerance)
        for word, value in (("ctr", own[-1].points), ("cls", own[-1].point_logits)):
            weight = parts.normal(f"pv_gh_{word}{label}", tuple(value.shape))
            scalar = scalar + (value * weight).sum()
    levels = [parts.normal(f"pv_bev_level{i}", (B, C, *BEV)) for i in range(3)]
    level_masks = []
    with torch.no_grad():
        for level in (*levels, bev):
            level_masks.append(head.class_masks(turn_raster(level, head.grid)))
    masks = torch.stack(level_masks)
    for label, kind in enumerate(CLASSES):
        off = largest_difference(
            masks[:, :, label, ::5, ::5], data[f"sem_mask_{kind}_sub"][:, :, 1]
        )
        yield Row(name, f"class masks of {kind}", off, 3e-4)
    scalar.backward()
    yield Row(name, "scalar (relative)", largest_relative(scalar.detach(), data["scalar"]), 1e-4)
    gradient = torch.cat([leaf.grad.flatten(1, 2) for leaf in leaves], 1)
    off = relative_norm(gradient[:, ::10, ::4], data["grad_states_sub"])
    yield Row(name, "gradient of the states (relative)", off, 1e-2)
    yield from parts.gradient_rows(name, "", data, parts.gradients_of(head, "map_head."))


def decoded_rows(
    name: str,
    head: PivotHead,
    output: LinePredictions,
    data: Mapping[str, np.ndarray],
    tag: str,
    size: tuple[int, int],
) -> Iterator[Row]:
    """Compare the lines, in the file's order: by class and query."""
    (result,) = head.predict_by_feat([output], [{}])
    best = head.coder.decode(output.scores[0], result.pts)
    order = best.query_inds.argsort().numpy()
    labels = result.labels_3d.numpy()[order] + 1
    yield Row(name, f"{tag}: classes", largest_difference(labels, data[f"{tag}_labels"]), 0)
    numbers = result.num_pts.numpy()[order]
    yield Row(name, f"{tag}: points", largest_difference(numbers, data[f"{tag}_lengths"]), 0)
    scores = result.scores_3d.numpy()[order]
    yield Row(name, f"{tag}: scores", largest_difference(scores, data[f"{tag}_scores"]), 1e-4)
    points = head.grid.front_from_metres(result.pts).numpy()[order] * size
    pivots = []
    for line, number in zip(points, numbers, strict=True):
        pivots.append(line[:number])  # without padding
    found = np.concatenate(pivots)
    off = largest_difference(found, data[f"{tag}_pivots"]) / max(size)
    yield Row(name, f"{tag}: pivots ([0, 1])", off, 1e-5 if tag == "post" else 1e-3)


@check("pivotnet_forward_reduced_{variant}.npz")
@torch.no_grad()
def check_forward(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the way from resized images to the lines, in the frame of the vehicle."""
    data = golden.read_arrays(name)
    parts = PivotParts(golden)
    size = (192, 320)
    model = parts.model(
        grid={"x_range": (-30.0, 30.0), "y_range": (-15.0, 15.0)},
        bev_encoder={"image_size": size},
    )
    images = parts.recipe.images(*size, len(CAMERAS), golden.seed)
    order = [golden.cameras["camera_order"].index(f"CAM_{camera}") for camera in CAMERAS]
    feats = model.extract_img_feats(torch.from_numpy(images[order])[None])
    subsets = {
        "feat16_sub": feats[0][0][:, ::32, ::3, ::4],
        "feat32_sub": feats[1][0][:, ::32, ::2, ::2],
    }
    encoder = model.bev_encoder
    head = model.map_head
    memory = [level.flatten(2) for level in encoder.sources(feats)]
    subsets["memory_sub"] = torch.cat(memory, 2)[0, ::8, ::20].T
    bev = encoder.encode(feats, {"img_from_ground": ground_matrices(golden, size)}, size)
    levels = [turn_raster(level, head.grid) for level in bev["bev_levels"]]
    subsets["bev_sub"] = torch.cat(levels)[:, ::8, ::8, ::8]
    for key, value in subsets.items():
        yield Row(name, key, largest_difference(value, data[key]), 1e-4)
    outputs = head(bev)
    layer_logits = []
    for output in outputs:
        layer_logits.append(torch.cat([lines.logits for lines in output.lines], 1))
    logits = torch.stack(layer_logits).numpy()
    # one line of a layer may have a mask logit so near 0 that noise lets it see another cell
    off = np.sort(np.abs(logits - data["obj_logits"]).max((1, 3)), 1)  # (layers, lines)
    yield Row(name, "obj_logits, but for one line of a layer", float(off[:, :-1].max()), 3e-4)
    yield Row(name, "obj_logits", float(off.max()), 3e-2)
    masks = head.class_masks(bev["bev_feats"])
    for label, kind in enumerate(CLASSES):
        own = [output.lines[label] for output in outputs]
        points = torch.stack([own[0].points, own[-1].points])
        off = np.abs(points.numpy() - data[f"points_{kind}"]).max((0, 1, 3, 4))
        yield Row(name, f"points of {kind}, but for one line", float(np.sort(off)[:-1].max()), 3e-5)
        yield Row(name, f"points of {kind}", float(off.max()), 3e-3)
        enlarged = head.resize_masks(own[-1].masks)[:, ::5, ::20, ::10]
        ours = {
            f"point_logits_{kind}": (own[-1].point_logits, data[f"point_logits_{kind}"]),
            f"ins_mask_{kind}_sub": (enlarged, data[f"ins_mask_{kind}_sub"]),
            f"class masks of {kind}": (
                masks[:, label, ::20, ::10],
                data[f"sem_mask_{kind}_sub"][:, 1],
            ),
        }
        for key, (value, wanted) in ours.items():
            yield Row(name, key, largest_difference(value, wanted), 3e-4)
    yield from decoded_rows(name, head, outputs[-1], data, "dec", (400, 200))
