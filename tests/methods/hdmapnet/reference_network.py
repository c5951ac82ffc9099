"""HDMapNet: key table, view transformation, decoders, targets, losses and the whole model."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import SimpleNamespace
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
from torch import Tensor

from gsmap.datasets.annotations.record import MapInstance
from gsmap.models.base.layers import resize_map
from gsmap.models.hdmapnet.decoder import LineMapDecoder, LineMaps
from gsmap.models.hdmapnet.encoder import ViewTransformEncoder, sample_maps
from gsmap.models.hdmapnet.keys import HDMAPNET
from gsmap.models.hdmapnet.losses import LineMapLosses
from gsmap.models.hdmapnet.targets import MakeLineMaps
from gsmap.structures.calibration import calibration_arrays
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import points_at_steps as sampled_line

CONFIG = "hdmapnet/hdmapnet_effb0_30e.py"
STATE = "hdmapnet_state.json"
GRID = BEVGrid((-30.0, 30.0), (-15.0, 15.0))
SETS = ("closed", "many", "hand")
OWN_BLOCK = ("bevencode.up1_direction.conv.", "map_head.decoder.joined.2.")  # not used by default
MAPS = {"seg": 4, "emb": 16, "dir": 37}  # channels


class HDMapParts(GoldenParts):
    """HDMapNet's modules and inputs."""

    def __init__(self, golden: Golden) -> None:
        super().__init__(golden, "hdmapnet", replace(HDMAPNET, rules=(*HDMAPNET.rules, OWN_BLOCK)))
        inputs = golden.inputs
        self.recipe = SimpleNamespace(
            tensor=self.recipe.tensor, normal=inputs.normal, in_rng=inputs.rng_for
        )

    def decoder(self, **settings: Any) -> LineMapDecoder:
        """Return the released BEV network with other settings."""
        cfg = Config.fromfile(self.golden.configs / CONFIG, import_custom_modules=False)
        head = {**cfg.model.map_head, "grid": GRID, "classes": cfg.classes, "decoder": settings}
        return self.load(MODELS.build(head).decoder, "map_head.decoder.")

    def cam_from_ground(self, moved_m: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Tensor:
        """Return the cameras' matrices from the vehicle, after a shift of the cameras. (6, 4, 4)"""
        cameras = [self.golden.cameras["cameras"][f"CAM_{camera}"] for camera in CAMERAS]
        poses = np.array([camera["camera2ego"] for camera in cameras])
        poses[:, :3, 3] += moved_m
        meta = {"lidar2cam": np.linalg.inv(poses), "lidar2ego": np.eye(4)}
        (matrices,) = calibration_arrays(meta, ["cam_from_ground"]).values()
        return torch.from_numpy(matrices)


@check(STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare HDMapNet's state with ours."""
    yield from state_rows(golden, name, CONFIG)


@check("hdmapnet_view_{variant}.npz")
def check_view(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the cameras' maps, where cells lie in them, and the plane of all."""
    data, parts = golden.read_arrays(name), HDMapParts(golden)
    small = BEVGrid((-7.5, 7.5), (-3.75, 3.75))
    encoder = ViewTransformEncoder(small, image_size=(64, 96))
    parts.load(encoder, "bev_encoder.")
    feats = parts.normal("hd_view_feat", (2, 6, 8, 4, 6)).requires_grad_()
    matrices = torch.stack([parts.cam_from_ground(), parts.cam_from_ground((0.5, -0.3, 0.1))])
    yield Row(name, "RTs", largest_difference(matrices, data["RTs"]), 1e-5)
    plane = encoder.cell_coordinates(matrices.device).flatten(0, 1).T[:, ::7]
    yield Row(name, "planes_sub", largest_difference(plane, data["planes_sub"][:2]), 1e-5)
    views, places = encoder.transform_views(feats), encoder.cell_positions(matrices)
    laid = sample_maps(views.flatten(0, 1), places.flatten(0, 1))
    topdown = encoder.encode(feats, {"cam_from_ground": matrices}, (64, 96))["bev_feats"]
    up = resize_map(topdown, (50, 100))
    ours = {
        "bv_feat": views[:, :, ::2],
        "pix": places.flatten(0, 1),
        "warped": laid[:, ::4].movedim(1, -1),
        "topdown": topdown,
        "up_sub": up[:, ::4],
    }
    for key, value in ours.items():
        yield Row(name, key, largest_difference(value.detach(), data[key]), 1e-4)
    scalar = (up * parts.normal("hd_view_g", tuple(up.shape))).sum()
    scalar.backward()
    yield Row(name, "scalar (relative)", largest_relative(scalar.detach(), data["scalar"]), 1e-4)
    yield Row(name, "grad_feat", relative_norm(feats.grad, data["grad_feat"]), 1e-3)
    gradients = parts.gradients_of(encoder, "bev_encoder.")
    yield from parts.gradient_rows(name, "", data, gradients, norm=1e-3)
    image = parts.normal("hd_bil_img", (1, 5, 6, 2)).movedim(-1, 1)
    taken = sample_maps(image, torch.from_numpy(data["bil_pix"])).movedim(1, -1)
    yield Row(name, "bil_out", largest_difference(taken, data["bil_out"]), 1e-5)


@check("hdmapnet_decoders_{variant}.npz")
def check_decoders(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the BEV network: its maps, gradients, and one pass with batch statistics."""
    data, parts = golden.read_arrays(name), HDMapParts(golden)
    decoder = parts.decoder()
    bev = parts.normal("hd_dec_in", (2, 64, 16, 32)).requires_grad_()
    first, _, last = decoder.stage_maps(bev)
    maps = dict(zip(MAPS, decoder(bev), strict=True))
    ours = {"x1": first[:, ::8], "x2": last[:, ::8], **maps}
    for key, value in ours.items():
        yield Row(name, key, largest_difference(value.detach(), data[key]), 1e-5)
    noises = {key: parts.normal(f"hd_dec_g_{key}", tuple(v.shape)) for key, v in maps.items()}
    scalar = sum((maps[key] * noise).sum() for key, noise in noises.items())
    scalar.backward()
    yield Row(name, "scalar", largest_difference(scalar.detach(), data["scalar"]), 1e-2)
    yield Row(name, "grad_in", relative_norm(bev.grad[:, ::8], data["grad_in"]), 1e-3)
    gradients = parts.gradients_of(decoder, "map_head.decoder.")
    yield from parts.gradient_rows(name, "", data, gradients, norm=1e-3)
    idle = {str(key) for key in data["no_grad_keys"]}
    yield Row(name, "parameters without gradient", len(idle - set(HDMAPNET.unused)), 0)
    yield from own_block_rows(name, data, parts, maps["dir"])
    decoder.train()
    with torch.no_grad():
        trained = dict(zip(MAPS, decoder(bev), strict=True))
    steps = {"seg": 1, "emb": 4, "dir": 8}
    for key, step in steps.items():
        off = largest_difference(trained[key][:, ::step], data[f"train_{key}"])
        yield Row(name, f"train_{key}", off, 2e-4)
    norms = {"up1e": decoder.joined[1][1], "up1": decoder.joined[0][1]}
    for key, norm in norms.items():
        for leaf, value in (("mean", norm.running_mean), ("var", norm.running_var)):
            if f"train_{key}_{leaf}" in data:
                off = largest_difference(value, data[f"train_{key}_{leaf}"])
                yield Row(name, f"train_{key}_{leaf}", off, 1e-4)


@torch.no_grad()
def own_block_rows(
    name: str, data: Mapping[str, np.ndarray], parts: HDMapParts, shared: Tensor
) -> Iterator[Row]:
    """Compare the direction that the block of its own, which the release leaves out, would give."""
    decoder = parts.decoder(shared_direction_block=False)
    bev = parts.normal("hd_dec_in", (2, 64, 16, 32))
    off = (decoder(bev).direction - shared).abs().max()
    wanted = data["dir_if_own_block_maxdiff"]
    yield Row(name, "dir_if_own_block_maxdiff", largest_difference(off, wanted), 1e-4)


@check("hdmapnet_targets_{variant}.npz")
def check_targets(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the sampled lines, and what is drawn of them."""
    data = golden.read_arrays(name)
    for chosen in SETS:
        own = {k[len(chosen) + 1 :]: v for k, v in data.items() if k.startswith(f"{chosen}_")}
        elements = elements_of(own)
        lines = [sampled_line(element.points, 1.0) for element in elements]
        counts = np.array([len(line) for line in lines])
        results = {"map_instances": elements, "x_range": GRID.x_range, "y_range": GRID.y_range}
        found = MakeLineMaps().transform(results)
        numbers, directions = found["gt_lines"].numpy(), found["gt_directions"].numpy()
        classes = np.concatenate([~(numbers > 0).any(0, keepdims=True), numbers > 0])
        onehot = np.eye(37)[directions].sum(0) / 2
        exact = {
            "vec_count": counts,
            "instance_by_class": numbers,
            "instance": numbers.max(0),
            "semantic": np.packbits(classes),
            "forward": directions[0],
            "backward": directions[1],
        }
        for key, value in exact.items():
            yield Row(name, f"{chosen}_{key}", largest_difference(value, own[key]), 0)
        off = largest_difference(np.concatenate(lines), own["vec_pts_f64"])
        yield Row(name, f"{chosen}_vec_pts_f64", off, 1e-9)
        off = largest_relative(onehot.sum((0, 1)), own["direction_sum"])
        yield Row(name, f"{chosen}_direction_sum (relative)", off, 1e-5)


def elements_of(own: Mapping[str, np.ndarray]) -> list[MapInstance]:
    """Return the elements of a set, as its input lines say."""
    ends = np.cumsum(own["in_count"])[:-1]
    lines = np.split(own["in_pts_f64"], ends)
    return [MapInstance(int(k), line) for k, line in zip(own["in_type"], lines, strict=True)]


@check("hdmapnet_losses_{variant}.npz")
def check_losses(golden: Golden, name: str) -> Iterator[Row]:
    """Compare all losses and gradients of a batch of two."""
    data, recipe, parts = golden.read_arrays(name), golden.recipe("hdmapnet"), HDMapParts(golden)
    masks = golden.read_arrays(name.replace("losses", "targets"))
    fields = ("instance_by_class", "forward", "backward")
    closed, many = ([masks[f"{chosen}_{key}"] for key in fields] for chosen in SETS[:2])
    pairs = {"two": (closed, many), "empty": (closed, [np.zeros_like(part) for part in closed])}
    for tag, pair in pairs.items():
        numbers = torch.stack([torch.from_numpy(own[0]) for own in pair]).long()
        directions = torch.from_numpy(np.array([own[1:] for own in pair])).long()
        size = numbers.shape[-2:]
        embedding = embeddings_of(recipe, tag, pair, golden.seed)
        maps = LineMaps(
            parts.normal(f"hd_loss_{tag}_seg", (2, 4, *size)).requires_grad_(),
            embedding.requires_grad_(),
            parts.normal(f"hd_loss_{tag}_dir", (2, 37, *size)).requires_grad_(),
        )
        losses = LineMapLosses()(maps, numbers, directions)
        total = sum(losses.values())
        total.backward()
        yield from loss_rows(name, tag, data, losses, total)
        steps = {"seg": 1, "emb": 1, "dir": 4}
        for (key, step), part in zip(steps.items(), maps, strict=True):
            off = relative_norm(part.grad[:, ::step, ::8, ::8], data[f"{tag}_grad_{key}"])
            yield Row(name, f"{tag}_grad_{key}", off, 1e-4)
        norms = [float(part.grad.double().norm()) for part in maps]
        off = largest_relative(norms, data[f"{tag}_grad_l2"])
        yield Row(name, f"{tag}_grad_l2", off, 1e-4)


def embeddings_of(recipe: Any, tag: str, pair: Any, seed: str) -> Tensor:
    """Return the embeddings of a batch. (2, 16, H, W)"""
    names = {"two": SETS[:2], "empty": (SETS[0], "empty")}[tag]
    made = [recipe.loss_embedding(n, own[0], seed) for n, own in zip(names, pair, strict=True)]
    return torch.from_numpy(np.stack(made))


def loss_rows(
    name: str,
    tag: str,
    data: Mapping[str, np.ndarray],
    losses: Mapping[str, Tensor],
    total: Tensor,
) -> Iterator[Row]:
    """Compare the losses of a batch, which the file has without their weights.

    Its ``angle_diff`` is a figure of the release's log, which nothing here computes.
    """
    ours = {
        "seg_loss": losses["loss_semantic"],
        "var_loss": losses["loss_pull"],
        "dist_loss": losses["loss_push"],
        "direction_loss": losses["loss_direction"] / LineMapLosses().direction,
        "total": total,
    }
    for key, value in ours.items():
        off = largest_relative(value.detach(), data[f"{tag}_{key}"])
        yield Row(name, f"{tag}_{key} (relative)", off, 1e-5)
    yield Row(name, f"{tag}_reg_loss", float(np.abs(data[f"{tag}_reg_loss"])), 0)


@check("hdmapnet_forward_{variant}.npz")
@torch.no_grad()
def check_forward(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the way from resized images to the maps of all pixels."""
    data, parts, size = golden.read_arrays(name), HDMapParts(golden), (128, 352)
    model = golden.model(CONFIG, STATE)
    images = torch.from_numpy(golden.inputs.images(*size, len(CAMERAS), golden.seed))[None]
    feats = model.extract_img_feats(images)[0]
    encoder = model.bev_encoder
    outputs = encoder.encode(feats, {"cam_from_ground": parts.cam_from_ground()[None]}, size)
    maps = LineMaps(*(own[0] for own in model.map_head(outputs)))
    ours = {
        "cam_feat": (feats[0][:, ::8], 1e-3),
        "bv_feat": (encoder.transform_views(feats)[0][:, ::16, ::4, ::4], 1e-3),
        "topdown": (outputs["bev_feats"][0, ::16, ::4, ::4], 1e-3),
        "seg": (maps.semantic[:, ::4, ::4], 2e-4),
        "emb": (maps.embedding[:, ::8, ::8], 2e-4),
        "dir": (maps.direction[:, ::8, ::8], 2e-4),
    }
    for key, (value, tolerance) in ours.items():
        yield Row(name, key, largest_difference(value, data[key]), tolerance)
    for key, value in zip(MAPS, maps, strict=True):
        means = value.double().mean((1, 2))
        off = largest_difference(means, data[f"{key}_channel_mean_f64"])
        yield Row(name, f"{key}_channel_mean_f64", off, 2e-4)
    wrong = (maps.semantic.argmax(0).numpy() != data["argmax"]).sum()
    yield Row(name, "argmax (pixels that differ)", wrong, 0)
