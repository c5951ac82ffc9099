"""PivotNet: key table, targets, matching, decoder, head, projection and the whole model."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.registry import init_default_scope
from torch import Tensor, nn

from gsmap.checkpoints.key_map import PIVOTNET
from gsmap.datasets.annotations.record import MapInstance
from gsmap.models.pivotnet.encoder import PivotBEVEncoder
from gsmap.models.pivotnet.head import PivotHead
from gsmap.models.pivotnet.matching import match_pivots, path_costs, sequence_costs
from gsmap.models.pivotnet.targets import FormatPivotTargets
from gsmap.structures.calibration import calibration_arrays
from gsmap.structures.grid import BEVGrid
from reference.golden import Golden
from reference.maptr import state_rows
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm

CONFIG = "pivotnet/pivotnet_r50_30e.py"
STATE = "pivotnet_state.json"
CLASSES = ("divider", "crossing", "boundary")
GRID = BEVGrid((-15.0, 15.0), (-30.0, 30.0))
B, C, BEV = 2, 256, (64, 32)
CAMERAS = ("FRONT_LEFT", "FRONT", "FRONT_RIGHT", "BACK_LEFT", "BACK", "BACK_RIGHT")
# our parameter that stands for two keys of the release, which differ in a dot
LEAVES = {"query_feat": "query.weight"}


def build(golden: Golden, **settings: Any) -> nn.Module:
    """Return the released model with the recipe's weights and other settings of its parts."""
    init_default_scope("mmdet3d")
    cfg = Config.fromfile(golden.configs / CONFIG, import_custom_modules=False).model
    for part, values in settings.items():
        cfg[part] = {**cfg[part], **values} if cfg[part] else values
    cfg.img_backbone.init_cfg = None
    model = MODELS.build(cfg)
    state = {}
    for key, value in model.state_dict().items():
        upstream = PIVOTNET.to_upstream(key)
        assert upstream is not None, key
        made = golden.pivotnet.tensor(upstream, value.shape, golden.seed)
        state[key] = torch.from_numpy(np.asarray(made))
    model.load_state_dict(state)
    return model.eval()


def head_of(golden: Golden, **settings: Any) -> PivotHead:
    """Return the head of the released model; masks of 100 x 50 pixels."""
    return build(golden, map_head={"mask_pixel_m": 0.6, **settings}).map_head


def normal(golden: Golden, name: str, shape: tuple[int, ...], **settings: float) -> Tensor:
    """Return a normal array of the recipe."""
    return torch.from_numpy(golden.pivotnet.normal(name, shape, golden.seed, **settings))


def gradient_rows(
    golden: Golden, name: str, data: Mapping[str, np.ndarray], module: nn.Module, prefix: str
) -> Iterator[Row]:
    """Compare the norm of each parameter's gradient, and its product with a noise."""
    gradients = {
        PIVOTNET.to_upstream(prefix + key): parameter.grad
        for key, parameter in module.named_parameters()
        if parameter.grad is not None
    }
    keys = [str(key) for key in data["grad_keys"]]
    yield Row(name, "parameters without gradient", len(set(keys) - set(gradients)), 0)
    norms, dots = [], []
    for key in keys:
        gradient = gradients[key].double().numpy()
        noise = golden.pivotnet.in_rng(f"gdot:{key}", golden.seed)
        norms.append(np.linalg.norm(gradient))
        dots.append((gradient * noise.standard_normal(gradient.shape)).sum())
    # A bias of all keys moves no attention: its gradient is zero, and noise is in the file.
    floor = np.maximum(data["grad_l2"], 1e-6 * data["grad_l2"].max())
    off = largest_difference(norms / floor, data["grad_l2"] / floor)
    yield Row(name, "gradient norms (relative)", off, 2e-3)
    off = largest_difference(dots, data["grad_dot"]) / np.abs(data["grad_dot"]).max()
    yield Row(name, "gradient products (of the largest)", off, 1e-2)


@check(STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare PivotNet's state with ours."""
    yield from state_rows(golden, name, CONFIG)


@check("pivotnet_matching_{variant}.npz")
def check_matching(golden: Golden, name: str) -> Iterator[Row]:
    """Compare both dynamic programmes."""
    data, recipe = golden.read_arrays(name), golden.pivotnet
    wrong, off = 0, 0.0
    for index in range(sum(key.startswith("dp_size") for key in data)):
        shape = tuple(data[f"dp_size{index}"])
        costs = recipe.uniform(f"pv_cost{index}", shape, seed=golden.seed)
        wrong += not np.array_equal(match_pivots(costs), data[f"dp_match{index}"])
        off = max(off, largest_relative(path_costs(costs)[-1, -1], data[f"dp_cost{index}"]))
    tied = data["dp_tie_input"]
    wrong += not np.array_equal(match_pivots(tied), data["dp_tie_match"])
    off = max(off, largest_relative(path_costs(tied)[-1, -1], data["dp_tie_cost"]))
    yield Row(name, "paths that differ", wrong, 0)
    batch = recipe.uniform("pv_cost_batch", (5, 10, 10), seed=golden.seed).astype(float)
    for weight in (0, 5):
        ours = sequence_costs(batch[None], data["batch_lens"], weight)[0]
        wanted = data[f"batch_cost_endpoints{weight}"]
        yield Row(name, f"lines without a path, ends + {weight}", (np.isinf(ours) ^ np.isinf(wanted)).sum(), 0)
        finite = np.isfinite(wanted)
        off = max(off, largest_relative(ours[finite], wanted[finite]))
    yield Row(name, "costs (relative)", off, 1e-6)


def elements(golden: Golden, name: str) -> list[MapInstance]:
    """Return the elements of a set of ground truth, by class."""
    found = sorted(golden.gt_sets[name], key=lambda element: element["label"])
    return [MapInstance(element["label"], np.array(element["pts"])) for element in found]


@check("pivotnet_pivots_{variant}.npz")
def check_pivots(golden: Golden, name: str) -> Iterator[Row]:
    """Compare lines, pivots and masks of the ground truth."""
    data = golden.read_arrays(name)
    grid = GRID.rasterized(0.15)
    for tag in ("closed", "many"):
        thick, thin = FormatPivotTargets(), FormatPivotTargets(thickness_px=1)
        parts = [
            (element.label, line)
            for element in elements(golden, tag)
            for line in thick.lines(element.points.astype(float), element.label, grid)
        ]
        labels = np.array([label for label, _ in parts])
        off = largest_difference(labels, data[f"{tag}_lines_kept_pivot_types"])
        yield Row(name, f"{tag}: classes of lines", off, 0)
        pixels = [(line * (400, 200))[:, ::-1] for _, line in parts]
        off = max(largest_difference(p, data[f"{tag}_map_pivot_input{i}"]) for i, p in enumerate(pixels))
        yield Row(name, f"{tag}: lines (pixels)", off, 1e-4)
        pivots = [thick.pivots(line * (60, 30), thick.num_points[label]) / (60, 30) for label, line in parts]
        for label in range(3):
            own = [line for line, kind in zip(pivots, labels, strict=True) if kind == label]
            numbers = [len(line) for line in own]
            yield Row(name, f"{tag}: numbers of pivots {label}", largest_difference(numbers, data[f"{tag}_lengths{label}"]), 0)
            wanted = data[f"{tag}_pivots{label}"]
            off = max((largest_difference(line, row[: len(line)]) for line, row in zip(own, wanted, strict=True)), default=0)
            yield Row(name, f"{tag}: pivots {label}", off, 1e-9)
        for width, transform in (("1", thin), ("8", thick)):
            masks = transform.masks(parts, pivots, (400, 200))
            numbers = 2 * np.arange(1, len(parts) + 1) - (width == "1")
            drawn = np.zeros((3, 400, 200), int)
            for mask, label, number in zip(masks, labels, numbers, strict=True):
                drawn[label][mask] = number
            yield Row(name, f"{tag}: masks of width {width}", largest_difference(drawn, data[f"{tag}_mask{width}"]), 0)


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
