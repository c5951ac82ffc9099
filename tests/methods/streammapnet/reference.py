"""StreamMapNet, its parts: state, attention, memory of BEV, losses and orders."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.registry import init_default_scope
from mmengine.structures import InstanceData
from predictions import predicted, triples
from reference.golden import Golden
from reference.maptr import state_rows
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm
from torch import Tensor, nn

from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.transforms.map_targets import map_targets
from gsmap.models.base.head import MapHead
from gsmap.models.streammapnet.attention import LinePointAttention
from gsmap.models.streammapnet.keys import STREAMMAPNET
from gsmap.models.streams.bev_memory import BEVMemory
from gsmap.models.streams.memory import StreamMemory
from gsmap.structures.grid import BEVGrid
from gsmap.structures.past import Past
from gsmap.structures.rigid import rigid
from gsmap.structures.streams import Frame

CONFIG = "streammapnet/streammapnet_r50_released_24e.py"
STATE = "streammapnet_state.json"
GRIDS = {"r60_": BEVGrid((-30, 30), (-15, 15)), "r100_": BEVGrid((-50, 50), (-25, 25))}
FRAMES, BATCH, ROWS, COLS = 4, 2, 10, 20


class StreamParts:
    """Our modules with the recipe's weights, and the recipe's inputs in our layout."""

    def __init__(self, golden: Golden) -> None:
        init_default_scope("mmdet3d")
        self.golden, self.recipe = golden, golden.recipe("streammapnet")

    def load(self, module: nn.Module, prefix: str) -> nn.Module:
        """Fill a module that lies at ``prefix`` of our model, without dropout."""
        state = {}
        for key, value in module.state_dict().items():
            upstream = STREAMMAPNET.to_upstream(prefix + key)
            array = self.recipe.tensor(upstream, value.shape, self.golden.seed)
            state[key] = torch.from_numpy(np.asarray(array))
        module.load_state_dict(state)
        for part in module.modules():
            if isinstance(part, nn.Dropout):
                part.p = 0.0
            if isinstance(part, nn.MultiheadAttention):
                part.dropout = 0.0
        return module

    def normal(self, name: str, shape: tuple[int, ...], **settings: float) -> Tensor:
        """Return a normal array of the recipe."""
        return torch.from_numpy(self.recipe.normal(name, shape, self.golden.seed, **settings))

    def head(self, grid: BEVGrid, num: int) -> MapHead:
        """Return the released head with a number of queries."""
        cfg = Config.fromfile(self.golden.configs / CONFIG, import_custom_modules=False)
        settings = {"grid": grid, "classes": cfg.classes, "query_groups": [{"num": num}]}
        return MODELS.build({**cfg.model.map_head, **settings})

    def gradient_rows(
        self, name: str, tag: str, data: Mapping[str, np.ndarray], gradients: Mapping[str, Tensor]
    ) -> Iterator[Row]:
        """Compare the norm of each parameter's gradient, and its product with a noise."""
        keys = [str(key) for key in data[f"{tag}grad_keys"]]
        yield Row(name, f"{tag}parameters without gradient", len(set(keys) - set(gradients)), 0)
        idle = {key for key in data[f"{tag}no_grad_keys"] if key in gradients}
        yield Row(name, f"{tag}parameters that only we train", len(idle), 0)
        norms, dots = [], []
        for key in keys:
            gradient = gradients[key].double().numpy()
            noise = self.recipe.in_rng(f"gdot:{key}", self.golden.seed)
            norms.append(np.linalg.norm(gradient))
            dots.append((gradient * noise.standard_normal(gradient.shape)).sum())
        wanted, products = data[f"{tag}grad_l2"], data[f"{tag}grad_dot"]
        # A bias of all keys moves no attention: its gradient is zero, and noise is in the file.
        floor = np.maximum(wanted, 1e-6 * wanted.max())
        off = largest_difference(norms / floor, wanted / floor)
        yield Row(name, f"{tag}gradient norms (relative)", off, 2e-3)
        off = largest_difference(dots, products) / np.abs(products).max()
        yield Row(name, f"{tag}gradient products (of the largest)", off, 1e-2)


def gradients_of(module: nn.Module, prefix: str) -> dict[str, Tensor]:
    """Return gradients by upstream's key; shared weights have the name of their first."""
    return {
        str(STREAMMAPNET.to_upstream(prefix + key)): parameter.grad
        for key, parameter in module.named_parameters()
        if parameter.grad is not None
    }


def flipped(values: Tensor) -> Tensor:
    """Turn the rows of a map between upstream's order, largest y first, and ours."""
    return values.flip(-2)


def metas_of(data: Mapping[str, np.ndarray], frame: int) -> list[dict[str, Any]]:
    """Return the metainfo of a frame's samples."""
    rotations, shifts = data["e2g_rotation"][frame], data["e2g_translation"][frame]
    return [
        {
            "token": f"{frame}-{slot}",
            "scene": str(data["scene"][frame, slot]),
            "timestamp_ns": frame * 500_000_000,
            "lidar2global": rigid(rotations[slot], shifts[slot]),
        }
        for slot in range(len(shifts))
    ]


@check(STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare StreamMapNet's state with ours."""
    yield from state_rows(golden, name, CONFIG)
    shapes = golden.state_shapes(name)
    wrong = [
        key
        for key, value in STREAMMAPNET.unused.items()
        if value is None or tuple(value.shape) != shapes.get(key)
    ]
    yield Row(name, "unused keys of another shape", len(wrong), 0)


@check("streammapnet_attention_{variant}.npz")
def check_attention(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the multi-point attention alone. Ours counts rows from the smallest y."""
    data, parts = golden.read_arrays(name), StreamParts(golden)
    prefix = "map_head.decoder.layers.0.cross_attn."
    module = LinePointAttention(512, 8, 20, dropout=0.0)
    start = module.sampling_offsets.bias.detach()
    off = largest_difference(start, data["init_sampling_offsets_bias"])
    yield Row(name, "initial offsets", off, 1e-6)
    attention = parts.load(module, prefix)
    query = parts.normal("smn_att_query", (12, 2, 512)).requires_grad_()
    value = parts.normal("smn_att_value", (200, 2, 512)).requires_grad_()
    ref = parts.recipe.uniform("smn_att_ref", (2, 12, 20, 2), -0.05, 1.05, golden.seed)
    reference = torch.from_numpy(ref).requires_grad_()
    mirrored = torch.stack([reference[..., 0], 1 - reference[..., 1]], -1).flatten(1, 2)
    feats = flipped(value.permute(1, 2, 0).unflatten(2, (ROWS, COLS)))
    tokens = query.transpose(0, 1)
    places = attention.locations(tokens, mirrored, (ROWS, COLS), None).detach()
    places = torch.stack([places[..., 0], 1 - places[..., 1]], -1)
    off = largest_difference(places[:, :, ::2, None], data["loc"])
    yield Row(name, "loc", off, 1e-5)
    weights = attention.weights(tokens).detach()
    yield Row(name, "weights", largest_difference(weights[:, :, :, None], data["weights"]), 1e-5)
    projected = attention.values(value.transpose(0, 1)).detach()[:, ::5, :, ::8]
    off = largest_difference(projected, data["value_proj_sub"])
    yield Row(name, "value_proj_sub", off, 1e-4)
    sampled: list[Tensor] = []
    attention.output_proj.register_forward_pre_hook(lambda _, x: sampled.append(x[0]))
    out = (tokens + attention(tokens, mirrored, feats)).transpose(0, 1)
    off = largest_difference(sampled[0].detach()[..., ::8], data["sampled_sub"])
    yield Row(name, "sampled_sub", off, 1e-4)
    yield Row(name, "out", largest_difference(out.detach(), data["out"]), 1e-4)
    scalar = (out * parts.normal("smn_att_g", (12, 2, 512))).sum()
    scalar.backward()
    yield Row(name, "scalar (relative)", largest_relative(scalar.item(), data["scalar"]), 1e-4)
    for key, ours in {
        "query": query.grad[..., ::4],
        "value": value.grad[..., ::16],
        "ref": reference.grad,
    }.items():
        off = relative_norm(ours, data[f"grad_{key}"])
        yield Row(name, f"gradient of {key} (relative)", off, 1e-3)
    yield from parts.gradient_rows(name, "", data, gradients_of(attention, prefix))


@check("streammapnet_fusion_{variant}.npz")
def check_fusion(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the memory of BEV features over four frames of two streams."""
    data, parts = golden.read_arrays(name), StreamParts(golden)
    for tag, grid in GRIDS.items():
        memory = StreamMemory(parts.head(grid, 24), bev={"end_points": True})
        parts.load(memory, "temporal.")
        yield from fusion_rows(name, tag, data, parts, memory)
    assert memory.bev is not None
    r60 = BEVMemory(GRIDS["r60_"], end_points=True)
    stood = parts.load(r60, "temporal.bev.")
    first = flipped(parts.normal("smn_bev_t0", (BATCH, 256, ROWS, COLS)))
    none = torch.zeros(BATCH, dtype=torch.bool)
    with torch.no_grad():
        fused = stood(first, Past({}, torch.eye(4).expand(BATCH, 4, 4), torch.zeros(BATCH), none))
    kept = flipped(fused)[:1]
    warped = stood.warp(flipped(kept), torch.eye(4, dtype=torch.float64)[None])
    off = largest_difference(kept[0, ::16], data["identity_memory_sub"])
    yield Row(name, "memory of a standing vehicle", off, 2e-4)
    change = (flipped(warped) - kept).abs().max()
    off = largest_difference(flipped(warped)[0, ::16], data["identity_warp_sub"])
    yield Row(name, "its warp", off, 2e-4)
    off = largest_difference(change, data["identity_warp_maxabs_change"])
    yield Row(name, "its largest change", off, 2e-4)
    right = BEVMemory(GRIDS["r60_"])
    moved = right.warp(flipped(kept), torch.eye(4, dtype=torch.float64)[None])
    off = largest_difference(moved, flipped(kept))
    yield Row(name, "change of a standing vehicle's memory without the bug", off, 1e-5)


def fusion_rows(
    name: str,
    tag: str,
    data: Mapping[str, np.ndarray],
    parts: StreamParts,
    memory: StreamMemory,
) -> Iterator[Row]:
    """Compare what happens in each frame, and the gradients of all."""
    bev = memory.bev
    assert bev is not None
    seen: dict[str, list[Tensor]] = {"convz": [], "convr": [], "convq": [], "h": [], "grid": []}
    for key in ("convz", "convr", "convq"):
        getattr(bev, key).register_forward_hook(
            lambda _, args, out, key=key: seen[key].append(flipped(out.detach()))
        )
    bev.convz.register_forward_pre_hook(
        lambda _, args: seen["h"].append(flipped(args[0].detach()[:, :256]))
    )
    original = bev.source_locations

    def source_locations(*args: Any, **kwargs: Any) -> Tensor:
        grid = original(*args, **kwargs)
        seen["grid"].append(grid.flip(1) * grid.new_tensor([1.0, -1.0]))
        return grid

    bev.source_locations = source_locations  # type: ignore[method-assign]
    feats = [
        parts.normal(f"smn_bev_t{frame}", (BATCH, 256, ROWS, COLS)).requires_grad_()
        for frame in range(FRAMES)
    ]
    fused, first, scalar = [], [], 0.0
    for frame, value in enumerate(feats):
        metas = metas_of(data, frame)
        before = memory.streams.previous([Frame.from_meta(meta) for meta in metas])
        first.append([state is None for state in before])
        with memory.remember_batch({"bev_feats": flipped(value)}, metas) as batch:
            fused.append(flipped(batch.outputs["bev_feats"]))
        scalar += (fused[-1] * parts.normal(f"smn_gf_t{frame}", tuple(value.shape))).sum()
    yield Row(name, f"{tag}is_first", largest_difference(first, data[f"{tag}is_first"]), 0)
    wanted = data[f"{tag}grid"][1:]
    known = ~np.isnan(wanted)
    off = largest_difference(torch.stack(seen["grid"]).numpy()[known], wanted[known])
    yield Row(name, f"{tag}grid", off, 1e-5)
    strides = {"h": 16, "convz": 32, "convr": 32, "convq": 32}
    for key, stride in strides.items():
        off = largest_difference(torch.stack(seen[key])[:, :, ::stride], data[f"{tag}{key}"])
        yield Row(name, f"{tag}{key}", off, 2e-4)
    stack = torch.stack(fused).detach()
    off = largest_difference(stack[:, :, ::16], data[f"{tag}fused"])
    yield Row(name, f"{tag}fused", off, 2e-4)
    scalar.backward()
    yield Row(
        name, f"{tag}scalar (relative)", largest_relative(scalar.item(), data[f"{tag}scalar"]), 1e-3
    )
    if f"{tag}grad_keys" not in data:
        return
    off = largest_difference(stack[-1][:, :, 4], data[f"{tag}fused_last_row4"])
    yield Row(name, f"{tag}fused_last_row4", off, 2e-4)
    plane = bev.cells(ROWS, COLS).flip(0)
    off = largest_difference(plane, data[f"{tag}plane_xy"])
    yield Row(name, f"{tag}plane_xy", off, 1e-5)
    gradients = torch.stack([value.grad for value in feats])
    off = relative_norm(gradients[:, :, ::32], data[f"{tag}grad_feats"])
    yield Row(name, f"{tag}gradient of the features (relative)", off, 1e-3)
    for key in ("weight", "bias"):
        off = relative_norm(getattr(bev.ln, key).grad, data[f"{tag}grad_ln_{key}"])
        yield Row(name, f"{tag}gradient of ln.{key} (relative)", off, 1e-3)
    yield from parts.gradient_rows(name, tag, data, gradients_of(bev, "temporal.bev."))


def polylines_of(data: Mapping[str, np.ndarray], tag: str, slot: int) -> list[MapInstance]:
    """Return a sample's annotated elements."""
    ends = np.cumsum(data[f"{tag}gt_poly_len_b{slot}"])[:-1]
    lines = np.split(data[f"{tag}gt_poly_xy_b{slot}"], ends)
    labels = data[f"{tag}gt_labels_b{slot}"].tolist()
    return [MapInstance(*each) for each in zip(labels, lines, strict=True)]


@check("streammapnet_losses_{variant}.npz")
def check_losses(golden: Golden, name: str) -> Iterator[Row]:
    """Compare targets, costs, matches, losses and gradients of fixed predictions."""
    data, parts = golden.read_arrays(name), StreamParts(golden)
    for tag, grid in GRIDS.items():
        head = parts.head(grid, 20)
        gts = [
            map_targets(
                polylines_of(data, tag, slot), 20, grid.x_range, grid.y_range, orders_of="points"
            )
            for slot in range(BATCH)
        ]
        for slot, gt in enumerate(gts):
            wanted = data[f"{tag}gt_perm_b{slot}"]
            norm = head.reference.norm(gt.pts_shifts)
            used = wanted[..., 0, 0] < 1e4
            ours_used = (gt.pts_shifts[..., 0, 0] > -1e3).numpy()
            yield Row(name, f"{tag}orders of sample {slot}", (used != ours_used).sum(), 0)
            off = largest_difference(norm.numpy()[used], wanted[used])
            yield Row(name, f"{tag}gt_perm_b{slot}", off, 1e-5)
        lines = torch.from_numpy(data[f"{tag}in_lines"]).requires_grad_()
        scores = parts.normal(f"smn_loss_cls{tag}", (3, 2, 20, 3), scale=1.0, shift=-1.0)
        scores.requires_grad_()
        outputs = predicted(head, scores, lines.unflatten(-1, (20, 2)))
        yield from loss_rows(name, tag, data, head, outputs, gts)
        gradients = {"lines": lines.grad, "scores": scores.grad}
        for key, ours in gradients.items():
            off = relative_norm(ours, data[f"{tag}grad_{key}"])
            yield Row(name, f"{tag}gradient of {key} (relative)", off, 1e-3)


def loss_rows(
    name: str,
    tag: str,
    data: Mapping[str, np.ndarray],
    head: MapHead,
    outputs: list,
    gts: list[InstanceData],
) -> Iterator[Row]:
    """Compare costs, matches and losses of three layers."""
    metas = [{"token": "a"}] * BATCH
    truths = head.prepare_gts(gts)
    for number, matches in enumerate(triples(head.match(outputs, truths, metas))):
        yield Row(name, f"{tag}matches of layer {number} that differ", sum(
            differing(matches[slot], data[f"{tag}match_l{number}_b{slot}"])
            for slot in range(BATCH)
        ), 0)  # fmt: skip
    for slot in range(BATCH):
        sample = outputs[-1].sample(slot), truths.sample(slot)
        for cost, key in zip(head.assigner.match_costs, ("cls", "reg"), strict=True):
            value = cost(*sample).detach()
            off = largest_relative(value, data[f"{tag}cost_{key}_b{slot}"])
            yield Row(name, f"{tag}cost_{key}_b{slot} (relative)", off, 1e-4)
    losses = head.loss_by_feat(outputs, gts, metas)
    for key, ours in (("cls", "loss_cls"), ("reg", "loss_pts")):
        each = [losses[f"{p}{ours}"].item() for p in ("d0.", "d1.", "")]
        off = largest_relative(each, data[f"{tag}loss_{key}"])
        yield Row(name, f"{tag}loss_{key} (relative)", off, 1e-4)
    sum(losses.values()).backward()


def differing(match: Tensor, wanted: np.ndarray) -> int:
    """Return how many pairs of a sample (query, ground truth, order) are only in one list."""
    return len(set(map(tuple, match.tolist())) ^ set(map(tuple, wanted.tolist())))
