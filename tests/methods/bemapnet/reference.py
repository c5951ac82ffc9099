"""BeMapNet: state, neck, encoder, decoder, head and the whole model."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from mmdet.models.layers import coordinate_to_encoding
from reference.golden import Golden
from reference.lines import CAMERAS
from reference.maptr import state_rows
from reference.parts import GoldenParts
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm
from torch import Tensor, nn

from gsmap.models.bemapnet.encoder import BezierBEVEncoder
from gsmap.models.bemapnet.head import BezierHead
from gsmap.models.bemapnet.keys import BEMAPNET
from gsmap.models.bemapnet.neck import BiFPN
from gsmap.models.lines.decoder import PointLineDecoder
from gsmap.models.lines.front import turn_raster
from gsmap.structures.grid import BEVGrid

CONFIG = "bemapnet/bemapnet_r50_30e.py"
STATE = "bemapnet_state.json"
GRID = BEVGrid((-30.0, 30.0), (-15.0, 15.0))
IMAGE = np.diag([0.16, 0.19, 1.0, 1.0])  # from the pixels of full images to those of small ones
IMAGE[1, 2] = -43
SHARED = "bev_decoder.bev_encoder.tgt_pos_embed_layer."  # listed twice, one module
KEYS = ("im", "ex", "end")  # theirs of the same


class BezierParts(GoldenParts):
    """BeMapNet's modules and inputs."""

    def __init__(self, golden: Golden) -> None:
        super().__init__(golden, "bemapnet", BEMAPNET)
        inputs = golden.inputs
        self.recipe: Any = SimpleNamespace(
            tensor=self.recipe.tensor,
            normal=inputs.normal,
            images=inputs.images,
            in_rng=inputs.rng_for,
        )


@check(STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare BeMapNet's state with ours."""
    yield from state_rows(golden, name, CONFIG, SHARED)


@check("bemapnet_bifpn_{variant}.npz")
def check_neck(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the neck: its levels, what it joins, gradients."""
    data, parts = golden.read_arrays(name), BezierParts(golden)
    channels, size = (8, 16, 32), (7, 14)
    neck = parts.load(BiFPN(channels, size, 12), "img_neck.")
    feats = [
        parts.normal(f"bm_fpn_{i}", (1, c, 16 >> i, 32 >> i)).requires_grad_()
        for i, c in enumerate(channels)
    ]
    levels: list[Tensor] = []
    neck.rounds[-1].register_forward_hook(lambda _, __, out: levels.extend(out))
    (out,) = neck(feats)
    ours = {"out": out, **{f"level{i}": level for i, level in enumerate(levels)}}
    for key, value in ours.items():
        yield Row(name, key, largest_difference(value.detach(), data[key]), 5e-4)
    scalar = (out * parts.normal("bm_fpn_g", tuple(out.shape))).sum()
    scalar.backward()
    yield from scalar_rows(parts, name, data, scalar, neck, "img_neck.")
    for i, feat in enumerate(feats):
        off = relative_norm(feat.grad, data[f"grad_in{i}"])
        yield Row(name, f"grad_in{i} (relative)", off, 1e-3)


def scalar_rows(
    parts: BezierParts, name: str, data: dict, scalar: Tensor, module: nn.Module, prefix: str
) -> Iterator[Row]:
    """Compare a scalar and its gradients."""
    yield Row(name, "scalar (relative)", largest_relative(scalar.detach(), data["scalar"]), 1e-4)
    gradients = parts.gradients_of(module, prefix)
    yield from parts.gradient_rows(name, "", data, gradients, 1e-3)


def ground_matrices(golden: Golden, image: np.ndarray) -> Tensor:
    """Return the matrices from images, made of the full ones by a matrix, to the ground."""
    cameras = [golden.cameras["cameras"][f"CAM_{camera}"] for camera in CAMERAS]
    intrinsics = np.array([camera["intrinsics_1600x900"] for camera in cameras])
    ego_from_cam = np.array([camera["camera2ego"] for camera in cameras])
    matrices = ego_from_cam @ np.linalg.inv(image @ intrinsics)
    return torch.from_numpy(matrices.astype(np.float32))[None]


@check("bemapnet_bevdecoder_{variant}.npz")
def check_encoder(golden: Golden, name: str) -> Iterator[Row]:
    """Compare positions, the cameras' tokens, BEV features of all layers, gradients."""
    data, parts = golden.read_arrays(name), BezierParts(golden)
    layers = {"num_heads": 4, "ffn_dims": 96}
    sizes = {"position_dims": 256, "position_size": (171, 256)}
    built = BezierBEVEncoder(GRID, 24, 7.5, 64, (2, 3), layers, **sizes)
    built.grid = GRID.with_size(6, 8)
    built.bev_embedding = nn.Embedding(48, 64)
    encoder = parts.load(built, "bev_encoder.")
    matrices = ground_matrices(golden, IMAGE).expand(2, -1, -1, -1)
    points, seen = encoder.ground_points(matrices[:1], (5, 7), (171, 256))
    valid = data["ipm_valid"][..., 0]
    found = seen.view(valid.shape)
    yield Row(name, "pixels below the horizon", largest_difference(found, valid), 0)
    places = points.view(*valid.shape, 2)
    off = largest_difference(places[valid], data["ipm_xy"][valid])
    yield Row(name, "points on the ground", off, 1e-3)
    for key, sign in (("ipm_code", 1), ("ipm_code_flip", -1)):
        turned_points = places * torch.tensor([1, sign])
        code = coordinate_to_encoding(turned_points.flatten(0, 1), 32, scale=1.0)
        code = torch.where(found[..., None], code.view(*found.shape, -1), 0.0)
        code = code.permute(3, 1, 0, 2).flatten(2)  # side by side
        off = largest_difference(code[:: 64 // len(data[key])], data[key])
        yield Row(name, key, off, 1e-4)
    tokens: list[Tensor] = []
    encoder.source_layers[-1].register_forward_hook(lambda _, __, out: tokens.append(out))
    source = parts.normal("bm_bev_src", (2, 24, 5, 42)).requires_grad_()
    feats = source.unflatten(3, (6, 7)).permute(0, 3, 1, 2, 4)
    out = encoder.encode(feats, {"ground_from_img": matrices}, (171, 256))
    memory = tokens[0].unflatten(1, (6, 5, 7)).permute(2, 1, 3, 0, 4).flatten(0, 2)
    bev = torch.stack([turn_raster(level, GRID) for level in out["bev_levels"]])
    for key, value in {"memory": memory[..., ::4], "bev": bev[:, :, ::4]}.items():
        yield Row(name, key, largest_difference(value.detach(), data[key]), 1e-4)
    scalar = (bev * parts.normal("bm_bev_g", tuple(bev.shape))).sum()
    scalar.backward()
    yield from scalar_rows(parts, name, data, scalar, encoder, "bev_encoder.")
    off = relative_norm(source.grad[:, ::4], data["grad_src"])
    yield Row(name, "grad_src (relative)", off, 1e-3)


@check("bemapnet_insdecoder_{variant}.npz")
def check_decoder(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the instance decoder: states, classes, masks, what they block, gradients."""
    data, parts = golden.read_arrays(name), BezierParts(golden)
    decoder = PointLineDecoder([(10, 1)], 64, num_layers=3, num_heads=4, ffn_dims=96)
    parts.load(decoder, "map_head.decoder.")
    bev = parts.normal("bm_ins_x", (2, 64, 12, 8)).requires_grad_()
    outputs = decoder(bev)
    lines = [own for (own,) in outputs]
    ours = {
        "decoder_outputs": (torch.stack([own.states[:, :, 0] for own in lines]), "gd", 1.0, 1e-4),
        "pred_logits": (torch.stack([own.logits for own in lines]), "gc", 1.0, 1e-4),
        "pred_masks": (torch.stack([own.masks for own in lines]), "gm", 0.1, 1e-3),
    }
    scalar = torch.zeros(())
    for key, (values, word, weight, tolerance) in ours.items():
        yield Row(name, key, largest_difference(values.detach(), data[key]), tolerance)
        for i, value in enumerate(values):
            noise = parts.normal(f"bm_ins_{word}{i}", tuple(value.shape))
            scalar = scalar + weight * (value * noise).sum()
    code = decoder.position(torch.zeros(1, 12, 8))[0, ::8]
    yield Row(name, "pe", largest_difference(code, data["pe"]), 1e-5)
    blocked = torch.stack([decoder.attention_mask(layer) for layer in outputs])
    packed = np.packbits(blocked.numpy().ravel())
    wrong = np.unpackbits(packed ^ data["attn_blocked"]).sum()
    yield Row(name, "blocked cells", wrong, 0)
    scalar.backward()
    yield from scalar_rows(parts, name, data, scalar, decoder, "map_head.decoder.")
    off = relative_norm(bev.grad[:, ::4], data["grad_x"])
    yield Row(name, "grad_x (relative)", off, 1e-3)


def small_head(queries: tuple[int, int, int], pixel_m: float, **settings: Any) -> BezierHead:
    """Return a head of three classes on the map of the references."""
    decoder = {"num_layers": 2, "num_heads": 4, "ffn_dims": 96}
    sizes = {"mask_pixel_m": pixel_m, "bev_pixel_m": 3.0, "embed_dims": 64, "point_dims": 8}
    return BezierHead(GRID, ("a", "b", "c"), queries, decoder=decoder, **sizes, **settings)


@check("bemapnet_head_{variant}.npz")
@torch.no_grad()
def check_head(golden: Golden, name: str) -> Iterator[Row]:
    """Compare logits of curves, masks and class masks from the recipe's states and BEV features."""
    data, parts = golden.read_arrays(name), BezierParts(golden)
    queries = (3, 4, 2)
    head = parts.load(small_head(queries, 3.0), "map_head.")
    mean = head.coordinate_feature()
    yield Row(name, "coords_mean", largest_difference(mean[None], data["coords_mean"]), 1e-5)
    for layer in range(2):
        states = parts.normal(f"bm_head_q{layer}", (2, 9, 64)).split(queries, 1)
        for label, own in enumerate(states):
            for key, value in zip(KEYS, head.curve_logits(label, own, mean), strict=True):
                wanted = data[f"{key}_l{layer}c{label}"]
                off = largest_difference(value, wanted)
                yield Row(name, f"{key}_l{layer}c{label}", off, 1e-5)
    masks = head.resize_masks(parts.normal("bm_head_m0", (2, 9, 10, 5)))
    off = largest_difference(masks[:, :3], data["ins_mask_l0c0"])
    yield Row(name, "ins_mask_l0c0", off, 1e-5)
    head.bev_size = (10, 5)
    classes = head.class_masks(turn_raster(parts.normal("bm_head_b0", (2, 64, 10, 5)), GRID))
    for label in range(3):
        off = largest_difference(classes[:, label], data[f"sem_l0c{label}"][:, 1])
        yield Row(name, f"sem_l0c{label}", off, 1e-5)
