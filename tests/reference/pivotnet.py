"""PivotNet: key table, targets, matching, decoder, head, projection and the whole model."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, permutations, product
from typing import Any, ClassVar

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.registry import init_default_scope
from mmengine.structures import InstanceData
from scipy.ndimage import binary_dilation
from torch import Tensor, nn

from gsmap.checkpoints.key_map import PIVOTNET
from gsmap.datasets.annotations.record import MapInstance
from gsmap.models.pivotnet.encoder import PivotBEVEncoder
from gsmap.models.pivotnet.front import turned
from gsmap.models.pivotnet.head import PivotHead, PivotPredictions, packed, true_lines
from gsmap.models.pivotnet.losses import Lines, spaced
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
        made = golden.recipe("pivotnet").tensor(upstream, value.shape, golden.seed)
        state[key] = torch.from_numpy(np.asarray(made))
    model.load_state_dict(state)
    return model.eval()


def head_of(golden: Golden, **settings: Any) -> PivotHead:
    """Return the head of the released model; masks of 100 x 50 pixels."""
    return build(golden, map_head={"mask_pixel_m": 0.6, **settings}).map_head


def normal(golden: Golden, name: str, shape: tuple[int, ...], **settings: float) -> Tensor:
    """Return a normal array of the recipe."""
    return torch.from_numpy(golden.recipe("pivotnet").normal(name, shape, golden.seed, **settings))


def gradient_rows(
    golden: Golden, name: str, data: Mapping[str, np.ndarray], parameters: Any, prefix: str
) -> Iterator[Row]:
    """Compare the norm of each parameter's gradient, and its product with a noise."""
    gradients = {
        PIVOTNET.to_upstream(prefix + key): parameter.grad
        for key, parameter in parameters
        if parameter.grad is not None
    }
    keys = [str(key) for key in data["grad_keys"]]
    yield Row(name, "parameters without gradient", len(set(keys) - set(gradients)), 0)
    norms, dots = [], []
    for key in keys:
        gradient = gradients[key].double().numpy()
        noise = golden.recipe("pivotnet").in_rng(f"gdot:{key}", golden.seed)
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
    data, recipe = golden.read_arrays(name), golden.recipe("pivotnet")
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
        yield Row(
            name,
            f"lines without a path, ends + {weight}",
            (np.isinf(ours) ^ np.isinf(wanted)).sum(),
            0,
        )
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
        off = max(
            largest_difference(p, data[f"{tag}_map_pivot_input{i}"]) for i, p in enumerate(pixels)
        )
        yield Row(name, f"{tag}: lines (pixels)", off, 1e-4)
        pivots = [
            thick.pivots(line * (60, 30), thick.num_points[label]) / (60, 30)
            for label, line in parts
        ]
        for label in range(3):
            own = [line for line, kind in zip(pivots, labels, strict=True) if kind == label]
            numbers = [len(line) for line in own]
            yield Row(
                name,
                f"{tag}: numbers of pivots {label}",
                largest_difference(numbers, data[f"{tag}_lengths{label}"]),
                0,
            )
            wanted = data[f"{tag}_pivots{label}"]
            off = max(
                (
                    largest_difference(line, row[: len(line)])
                    for line, row in zip(own, wanted, strict=True)
                ),
                default=0,
            )
            yield Row(name, f"{tag}: pivots {label}", off, 1e-9)
        masks = thick.masks(parts, pivots, (400, 200))
        drawn = np.zeros((3, 400, 200), int)
        for number, (mask, label) in enumerate(zip(masks, labels, strict=True)):
            drawn[label][mask] = 2 * number + 2
        off = largest_difference(drawn, data[f"{tag}_mask8"])
        yield Row(name, f"{tag}: masks of width 8", off, 0)
        # no loss reads the masks of width 1, and versions of OpenCV draw such lines differently
        lines = FormatPivotTargets(thickness_px=1).masks(parts, pivots, (400, 200))
        thin = np.stack([lines[labels == label].any(0) for label in range(3)])
        far = sum((a & ~wide(b)).sum() for a, b in permutations((thin, data[f"{tag}_mask1"] > 0)))
        yield Row(name, f"{tag}: pixels of width 1 that are more than one off", far, 0)


def wide(masks: np.ndarray) -> np.ndarray:
    """Return masks widened by one pixel. (n, H, W)"""
    return binary_dilation(masks, np.ones((1, 3, 3)))


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
    head = head_of(golden)
    decoder = head.decoder
    bev = normal(golden, "pv_bev", (B, C, *BEV)).requires_grad_()
    outputs = decoder(bev)
    logits = [torch.cat([own.logits for own in layer], 1) for layer in outputs]
    masks = [torch.cat([own.masks for own in layer], 1) for layer in outputs]
    states = [torch.cat([own.states.flatten(1, 2) for own in layer], 1) for layer in outputs]
    blocked = [decoder.blocked(layer) for layer in outputs]
    with torch.no_grad():
        memory = bev.flatten(2).transpose(1, 2) + decoder.level.weight
        key = memory + decoder.position(bev.new_zeros(1, *BEV)).flatten(2).transpose(1, 2)
        start = decoder.query.weight.expand(B, -1, -1)
        cross = decoder.layers[0].look(start, decoder.query_pos.weight, memory, key, blocked[0])
    ours = {
        "pred_logits": (torch.stack(logits), 3e-4),
        "mask_sub": (torch.stack(masks)[:, :, ::6, ::4, ::4], 3e-4),
        "mask_mean": (torch.stack(masks).mean((3, 4)), 3e-4),
        "mask_last_sub": (masks[-1][:, ::12], 3e-4),
        "states_sub": (torch.stack(states)[:, :, ::35, ::8], 3e-4),
        "states_last_sub": (states[-1][:, ::10, ::2], 3e-4),
        "cross0_sub": (cross[:, ::35, ::8], 3e-4),
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
    scalar = sum(
        (value * normal(golden, f"pv_gd_logits{i}", tuple(value.shape))).sum()
        + 0.01 * (mask * normal(golden, f"pv_gd_masks{i}", tuple(mask.shape))).sum()
        for i, (value, mask) in enumerate(zip(logits, masks, strict=True))
    )
    last = states[-1]
    scalar = scalar + 0.1 * (last * normal(golden, "pv_gd_states", tuple(last.shape))).sum()
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
    yield from gradient_rows(golden, name, data, decoder.named_parameters(), "map_head.decoder.")


@check("pivotnet_head_{variant}.npz")
def check_head(golden: Golden, name: str) -> Iterator[Row]:
    """Compare points, their kinds and masks from the decoder's states, and gradients."""
    data, head = golden.read_arrays(name), head_of(golden)
    bev = normal(golden, "pv_bev", (B, C, *BEV))
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
        points, logits = (
            torch.stack([getattr(o, f) for o in own]) for f in ("points", "point_logits")
        )
        ours = {
            f"points_{kind}": (points, 3e-5),
            f"point_logits_{kind}": (logits, 3e-4),
            f"ins_mask_{kind}_sub": (head.enlarged(own[-1].masks)[:, ::5, ::4, ::2], 3e-4),
        }
        for key, (value, tolerance) in ours.items():
            yield Row(name, key, largest_difference(value.detach(), data[key]), tolerance)
        for word, value in (("ctr", own[-1].points), ("cls", own[-1].point_logits)):
            weight = normal(golden, f"pv_gh_{word}{label}", tuple(value.shape))
            scalar = scalar + (value * weight).sum()
    levels = [normal(golden, f"pv_bev_level{i}", (B, C, *BEV)) for i in range(3)]
    with torch.no_grad():
        masks = torch.stack(
            [head.class_masks(turned(level, head.grid)) for level in (*levels, bev)]
        )
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
    parameters = [(k, v) for k, v in head.named_parameters() if not k.startswith("decoder.")]
    yield from gradient_rows(golden, name, data, parameters, "map_head.")


class Given:
    """The recipe's predictions of all layers on a map of 100 x 50 pixels."""

    SHAPES: ClassVar = {  # our part of a line: its name, its shape behind the lines
        "logits": ("obj", (2,)),
        "points": ("ctr", (2,)),
        "point_logits": ("pt", (2,)),
        "masks": ("mask", (100, 50)),
    }

    def __init__(self, golden: Golden, head: PivotHead, tag: str, layers: Iterable[int]) -> None:
        self.golden, self.tag = golden, tag
        self.layers = [
            [self.lines(f"{i}_{j}", n, p) for j, (n, p) in enumerate(head.decoder.queries)]
            for i in layers
        ]

    def lines(self, number: str, n: int, p: int) -> Lines:
        """Return the lines of a layer and class."""
        parts = {}
        for ours, (theirs, shape) in self.SHAPES.items():
            full = (1, n, *((p,) if "point" in ours else ()), *shape)
            key = f"{self.tag}{theirs}{number}"
            if ours == "points":
                made = self.golden.recipe("pivotnet").uniform(
                    key, full, 0.02, 0.98, self.golden.seed
                )
                parts[ours] = torch.from_numpy(made)
            else:
                parts[ours] = normal(self.golden, key, full, shift=-float(ours == "masks"))
            parts[ours].requires_grad_()
        return Lines(**parts)


LOSS_NAMES = {
    "mask": "ins_msk_loss",
    "cls": "ins_obj_loss",
    "pivots": "pts_loss",
    "collinear": "collinear_pts_loss",
    "point_cls": "pt_logits_loss",
    "semantic": "sem_msk_loss",
}


@check("pivotnet_losses_{variant}.npz")
def check_losses(golden: Golden, name: str) -> Iterator[Row]:
    """Compare matches, losses, gradients and what is decoded."""
    data, head = golden.read_arrays(name), head_of(golden)
    for tag in ("closed", "many", "dividers_only"):
        yield from loss_rows(golden, name, head, tag, data)
    yield from post_rows(golden, name, head, data)


def truth_of(golden: Golden, tag: str) -> InstanceData:
    """Return the targets of a set, with masks of every fourth pixel."""
    only = tag == "dividers_only"
    found = elements(golden, "many" if only else tag)
    results = {
        "map_instances": [e for e in found if e.label == 0 or not only],
        "token": tag,
        "x_range": GRID.x_range,
        "y_range": GRID.y_range,
    }
    gt = FormatPivotTargets().transform(results)["gt_instances_3d"]
    gt.masks = gt.masks[:, ::4, ::4]
    return gt


def loss_rows(
    golden: Golden, name: str, head: PivotHead, tag: str, data: Mapping[str, np.ndarray]
) -> Iterator[Row]:
    """Compare matches, losses and gradients with a set of ground truth."""
    given = Given(golden, head, "pv_loss_", range(6))
    semantic = [
        [normal(golden, f"pv_loss_sem{i}_{j}", (1, 2, 100, 50), shift=-1) for j in range(3)]
        for i in range(4)
    ]
    for part in chain.from_iterable(semantic):
        part.requires_grad_()
    truth = true_lines(truth_of(golden, tag), head.grid, head.decoder.queries, head.mask_size)
    nothing = torch.empty(0)
    outputs = [PivotPredictions(nothing, nothing, lines) for lines in given.layers]
    losses, matches = head.line_losses(outputs, [truth], [tag])
    losses["semantic"] = sum(
        weight * head.semantic_loss(torch.cat([part[:, 1:] for part in level], 1), [truth])
        for weight, level in zip(head.level_weights, semantic, strict=True)
    ) / (4 * 3)
    wrong, paths = 0.0, []
    for i, j in product(range(6), range(3)):
        rows, cols = matches[i][j][0]
        pairs = torch.stack([rows, cols], 1)
        expected = data.get(f"{tag}_match_l{i}_c{j}", np.empty((0, 2)))
        wrong = max(wrong, largest_difference(pairs, expected))
        lines = Lines(*(part[0] for part in given.layers[i][j]))
        found, _ = spaced(lines, truth[j], rows, cols)
        paths += [np.flatnonzero(path) for path in found.numpy()]
    yield Row(name, f"{tag}: pairs of prediction and ground truth", wrong, 0)
    width = data[f"{tag}_pivot_matches"].shape[1]
    filled = [np.pad(path, (0, width - len(path)), constant_values=-1) for path in paths]
    off = largest_difference(np.stack(filled), data[f"{tag}_pivot_matches"])
    yield Row(name, f"{tag}: paths of pivots", off, 0)
    for ours, theirs in LOSS_NAMES.items():
        off = largest_relative(losses[ours].detach(), data[f"{tag}_{theirs}"])
        yield Row(name, f"{tag}: {ours} (relative)", off, 1e-4)
    total = sum(losses.values())
    off = largest_relative(total.detach(), data[f"{tag}_total_loss"])
    yield Row(name, f"{tag}: total (relative)", off, 1e-4)
    total.backward()
    for j in range(3 * (tag != "dividers_only")):
        lines = given.layers[5][j]
        gradients = {
            f"ctr_im_l5_c{j}": lines.points.grad,
            f"pts_logits_l5_c{j}": lines.point_logits.grad,
            f"obj_logits_l5_c{j}": lines.logits.grad,
            f"mask_l5_c{j}_sub": lines.masks.grad[:, ::5, ::4, ::4],
            f"sem_l3_c{j}_sub": semantic[3][j].grad[..., ::5, ::5],
        }
        for key, value in gradients.items():
            off = relative_norm(value, data[f"{tag}_grad_{key}"])
            yield Row(name, f"{tag}: gradient {key} (relative)", off, 1e-3)


def post_rows(
    golden: Golden, name: str, head: PivotHead, data: Mapping[str, np.ndarray]
) -> Iterator[Row]:
    """Compare the decoded lines."""
    lines = Given(golden, head, "pv_post_", [5]).layers[0]
    yield from decoded_rows(name, head, predicted(lines), data, "post", (100, 50))


def predicted(lines: Sequence[Lines]) -> PivotPredictions:
    """Return what the head would say of such lines."""
    return packed([Lines(*(part.detach() for part in own)) for own in lines])


def decoded_rows(
    name: str,
    head: PivotHead,
    output: PivotPredictions,
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
    found = np.concatenate([line[:number] for line, number in zip(points, numbers, strict=True)])
    off = largest_difference(found, data[f"{tag}_pivots"]) / max(size)
    yield Row(name, f"{tag}: pivots ([0, 1])", off, 1e-5 if tag == "post" else 1e-3)


@check("pivotnet_forward_reduced_{variant}.npz")
@torch.no_grad()
def check_forward(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the way from resized images to the lines, in the frame of the vehicle."""
    data, size = golden.read_arrays(name), (192, 320)
    model = build(
        golden,
        grid={"x_range": (-30.0, 30.0), "y_range": (-15.0, 15.0)},
        bev_encoder={"image_size": size},
    )
    images = golden.recipe("pivotnet").images(*size, len(CAMERAS), golden.seed)
    order = [golden.cameras["camera_order"].index(f"CAM_{camera}") for camera in CAMERAS]
    feats = model.extract_img_feats(torch.from_numpy(images[order])[None])
    subsets = {
        "feat16_sub": feats[0][0][:, ::32, ::3, ::4],
        "feat32_sub": feats[1][0][:, ::32, ::2, ::2],
    }
    encoder, head = model.bev_encoder, model.map_head
    subsets["memory_sub"] = encoder.sources(feats).tokens[0, ::20, ::8]
    bev = encoder.encode(feats, {"img_from_ground": ground_matrices(golden, size)}, size)
    levels = [turned(level, head.grid) for level in bev["bev_levels"]]
    subsets["bev_sub"] = torch.cat(levels)[:, ::8, ::8, ::8]
    for key, value in subsets.items():
        yield Row(name, key, largest_difference(value, data[key]), 1e-4)
    outputs = head(bev)
    logits = torch.stack([torch.cat([own.logits for own in o.lines], 1) for o in outputs])
    # one line of a layer may have a mask logit so near 0 that noise lets it see another cell
    off = np.sort(np.abs(logits.numpy() - data["obj_logits"]).max((1, 3)), 1)  # (layers, lines)
    yield Row(name, "obj_logits, but for one line of a layer", float(off[:, :-1].max()), 3e-4)
    yield Row(name, "obj_logits", float(off.max()), 3e-2)
    masks = head.class_masks(bev["bev_feats"])
    for label, kind in enumerate(CLASSES):
        own = [output.lines[label] for output in outputs]
        points = torch.stack([own[0].points, own[-1].points])
        off = np.abs(points.numpy() - data[f"points_{kind}"]).max((0, 1, 3, 4))
        yield Row(name, f"points of {kind}, but for one line", float(np.sort(off)[:-1].max()), 3e-5)
        yield Row(name, f"points of {kind}", float(off.max()), 3e-3)
        enlarged = head.enlarged(own[-1].masks)[:, ::5, ::20, ::10]
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
