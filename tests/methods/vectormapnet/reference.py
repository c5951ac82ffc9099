"""VectorMapNet: key table, targets, element detector, its losses, and the whole model."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from mmengine.structures import InstanceData
from reference.golden import NUM_CAMS, Golden
from reference.maptr import state_rows
from reference.parts import GoldenParts
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm
from torch import Tensor

from gsmap.datasets.annotations.record import MapInstance
from gsmap.models.vectormapnet.canvas import Canvas
from gsmap.models.vectormapnet.detector import KeyPointHead, KeyPointPredictions
from gsmap.models.vectormapnet.generator import Elements
from gsmap.models.vectormapnet.head import VectorMapNetHead
from gsmap.models.vectormapnet.keys import VECTORMAPNET
from gsmap.models.vectormapnet.targets import FormatPolylineTargets
from gsmap.structures.calibration import calibration_arrays
from gsmap.structures.grid import BEVGrid

CONFIG = "vectormapnet/vectormapnet_r50_130e.py"
STATE = "vectormapnet_state.json"
GRID = BEVGrid((-30.0, 30.0), (-15.0, 15.0))
SIZE = np.array([200.0, 100.0])


class VectorParts(GoldenParts):
    """VectorMapNet's modules and inputs, which are those of the common recipe."""

    def __init__(self, golden: Golden) -> None:
        super().__init__(golden, "vectormapnet", VECTORMAPNET)

    def head(self) -> VectorMapNetHead:
        """Return the head of the released model."""
        return self.golden.model(CONFIG, STATE).map_head

    def normal(self, name: str, shape: tuple[int, ...], **settings: float) -> Tensor:
        """Return a normal array."""
        values = self.golden.inputs.normal(name, shape, self.golden.seed, **settings)
        return torch.from_numpy(values)

    def gradient_rows(  # type: ignore[override]
        self, name: str, data: Mapping[str, np.ndarray], gradients: Mapping[str, Tensor]
    ) -> Iterator[Row]:
        """Compare the norm of each parameter's gradient, and its product with a noise."""
        self.recipe.in_rng = lambda key, seed: self.golden.inputs.rng_for(key, seed)
        yield from super().gradient_rows(name, "", data, gradients)


@check(STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare VectorMapNet's state with ours."""
    yield from state_rows(golden, name, CONFIG)


def split(data: Mapping[str, np.ndarray], key: str, count: str) -> list[np.ndarray]:
    """Return the parts of a flat array."""
    return np.split(data[key], np.cumsum(data[count])[:-1])


def targets_of(data: Mapping[str, np.ndarray], tag: str) -> tuple[InstanceData, list[np.ndarray]]:
    """Return our targets of a set's annotated lines."""
    lines = split(data, f"{tag}_src_f64", f"{tag}_src_count")
    elements = []
    for label, line in zip(data[f"{tag}_label"], lines, strict=True):
        elements.append(MapInstance(int(label), line))
    results: dict[str, Any] = {"map_instances": elements, "token": tag}
    results |= {"x_range": GRID.x_range, "y_range": GRID.y_range}
    return FormatPolylineTargets().transform(results)["gt_instances_3d"], lines


@check("vectormapnet_targets_{variant}.npz")
def check_targets(golden: Golden, name: str) -> Iterator[Row]:
    """Compare simplified lines, key points, tokens and weights, and the noise of training."""
    data = golden.read_arrays(name)
    for tag in ("closed", "many"):
        ours, lines = targets_of(data, tag)
        canvas = Canvas(GRID)
        transform = FormatPolylineTargets()
        wanted = split(data, f"{tag}_vec_f64", f"{tag}_vec_count")
        offs = []
        for line, wanted_line in zip(lines, wanted, strict=True):
            simplified = canvas.norm_from_metres(transform.simplify(line))
            offs.append(largest_difference(simplified, wanted_line))
        yield Row(name, f"{tag}: simplified lines", max(offs), 1e-12)
        off = largest_difference(ours.keypoints, data[f"{tag}_keypoint"])
        yield Row(name, f"{tag}: key points (pixels)", off, 1e-4)
        off = largest_difference(ours.keypoint_tokens, data[f"{tag}_qkeypoint"])
        yield Row(name, f"{tag}: tokens of key points", off, 0)
        counts = data[f"{tag}_token_count"]
        for key, value in (("tokens", ours.tokens), ("weights_f64", ours.token_weights)):
            parts = []
            rest = 0  # sum of the entries behind the stops
            for row, count in zip(value.numpy(), counts, strict=True):
                parts.append(row[:count])
                rest += np.abs(row[count:]).sum()
            off = largest_difference(np.concatenate(parts), data[f"{tag}_{key}"])
            yield Row(name, f"{tag}: {key}", off, 1e-6 if "weights" in key else 0)
            yield Row(name, f"{tag}: {key} behind the stop", rest, 0)
    generator = VectorParts(golden).head().generator
    for key, by_x in (("bbox", True), ("poly", False)):
        before = torch.from_numpy(data[f"aug_{key}_in"]).long()
        after = torch.from_numpy(data[f"aug_{key}_out"]).long()
        noise = after - before  # of the numbers that the release drew
        moved = generator.shift(before, noise, by_x)
        if key == "poly":  # what is behind a line stays 0
            moved = moved.where(before > 0, 0)
        yield Row(name, f"noise of aug_{key}", largest_difference(moved, after), 0)


@check("vectormapnet_detector_{variant}.npz")
def check_detector(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the element detector: states, boxes, scores, gradients and what is kept."""
    data = golden.read_arrays(name)
    parts = VectorParts(golden)
    detector = KeyPointHead(GRID, ("a", "b", "c"), num_queries=12)
    initial = KeyPointHead(GRID, ("a", "b", "c"))
    initial.init_weights()
    off = largest_difference(initial.cls_branch.bias.detach(), data["init_cls_bias"])
    yield Row(name, "init_cls_bias", off, 1e-6)
    bias = initial.layers[0].cross_attn.sampling_offsets.bias.detach()
    yield Row(name, "init_offset_bias", largest_difference(bias, data["init_offset_bias"]), 1e-6)
    parts.load(detector, "map_head.detector.")
    bev = parts.normal("vm_det_bev", (2, 128, 10, 20)).requires_grad_()
    states: list[Tensor] = []
    for layer in detector.layers:
        layer.register_forward_hook(lambda _, __, out: states.append(out))
    outputs = detector({"bev_feats": bev})
    lines = torch.stack([output.references.flatten(2) for output in outputs])
    scores = torch.stack([output.scores for output in outputs])
    context = detector.context(bev).flatten(2)[:, ::16]
    queries = (detector.elements.weight[:, None] + detector.corners.weight).flatten(0, 1)
    start = detector.initial(queries.chunk(2, -1)[0]).sigmoid().expand(2, -1, -1)
    ours = {
        "context": (context, 1e-5),
        "states": (torch.stack(states).transpose(1, 2)[..., ::4], 5e-4),
        "init_reference": (start, 1e-5),
        "all_lines": (lines, 1e-2),
        "all_scores": (scores, 5e-4),
    }
    for key, (value, tolerance) in ours.items():
        yield Row(name, key, largest_difference(value.detach(), data[key]), tolerance)
    scalar = (lines * parts.normal("vm_det_gl", tuple(lines.shape))).sum() / 100
    scalar = scalar + (scores * parts.normal("vm_det_gs", tuple(scores.shape))).sum()
    scalar.backward()
    yield Row(name, "scalar (relative)", largest_relative(scalar.detach(), data["scalar"]), 1e-3)
    off = relative_norm(bev.grad[:, ::8], data["grad_bev"])
    yield Row(name, "grad_bev (relative)", off, 2e-3)
    gradients = parts.gradients_of(detector, "map_head.detector.")
    yield from parts.gradient_rows(name, data, gradients)
    yield from kept_rows(name, parts.head(), detector, outputs[-1], data)


def kept_rows(
    name: str,
    head: VectorMapNetHead,
    detector: KeyPointHead,
    output: KeyPointPredictions,
    data: Mapping[str, np.ndarray],
) -> Iterator[Row]:
    """Compare the elements that are kept, and their boxes for the generator."""
    output = KeyPointPredictions(*(part.detach() for part in output))
    results = detector.predict_by_feat([output], [{}] * len(output.scores))
    scores = []
    labels = []
    boxes = []
    boxes_for_generator = []
    for result in results:
        scores.append(result.scores_3d)
        labels.append(result.labels_3d)
        pixels = head.canvas.norm_from_metres(result.pts) * torch.tensor(SIZE)
        boxes.append(pixels.flatten(1))
        boxes_for_generator.append(head.boxes(result))
    ours = {
        "post_scores": (scores, 5e-4),
        "post_bbox": (boxes, 1e-2),
        "post_labels": (labels, 0),
    }
    for key, (value, tolerance) in ours.items():
        found = torch.stack(value).numpy()
        off = largest_difference(found.reshape(data[key].shape), data[key])
        yield Row(name, key, off, tolerance)
    off = largest_difference(torch.cat(boxes_for_generator), data["post_bbox_flat"])
    yield Row(name, "post_bbox_flat", off, 0)


@check("vectormapnet_losses_{variant}.npz")
def check_losses(golden: Golden, name: str) -> Iterator[Row]:
    """Compare costs, matches, losses and gradients on given predictions."""
    data = golden.read_arrays(name)
    head = VectorParts(golden).head().detector
    lines = torch.from_numpy(data["in_lines"]).requires_grad_()
    scores = torch.from_numpy(data["in_scores"]).requires_grad_()
    truths = []
    for i in range(2):
        keypoints = torch.from_numpy(data[f"gt_keypoint_b{i}"])
        labels = torch.from_numpy(data[f"gt_label_b{i}"])
        truths.append(InstanceData(keypoints=keypoints, labels_3d=labels))
    costs = head.costs(scores[-1, 0].detach(), lines[-1, 0].detach(), truths[0]).sum(0)
    yield Row(name, "cost_last_b0", largest_difference(costs, data["cost_last_b0"]), 1e-4)
    wrong = 0.0
    for layer in range(len(lines)):
        for i, truth in enumerate(truths):
            pairs = head.match(scores[layer, i].detach(), lines[layer, i].detach(), truth, "a")
            expected = data[f"match_l{layer}_b{i}"]
            wrong = max(wrong, largest_difference(torch.stack(pairs, 1), expected))
    yield Row(name, "pairs", wrong, 0)
    losses = []
    for layer_scores, corners in zip(scores, lines.unflatten(-1, (2, 2)), strict=True):
        output = KeyPointPredictions(layer_scores, corners)
        losses.append(torch.stack(head.layer_losses(output, truths, ["a", "b"])))
    both = torch.stack(losses, 1)
    for key, value in zip(("loss_cls", "loss_reg"), both, strict=True):
        off = largest_relative(value.detach(), data[key].reshape(-1))
        yield Row(name, f"{key} (relative)", off, 1e-4)
    both.sum().backward()
    for key, value in (("grad_lines", lines), ("grad_scores", scores)):
        yield Row(name, f"{key} (relative)", relative_norm(value.grad, data[key]), 1e-4)


@check("vectormapnet_forward_reduced_{variant}.npz")
@torch.no_grad()
def check_forward(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the way from the images to the lines of the first eight elements."""
    data = golden.read_arrays(name)
    model = golden.model(CONFIG, STATE)
    size = (192, 320)
    images = torch.from_numpy(golden.inputs.images(*size, NUM_CAMS, golden.seed))
    levels = model.extract_img_feats(images[None])
    encoder = model.bev_encoder
    head = model.map_head
    feats = encoder.merge_levels(levels)
    scale = np.diag([0.2, 0.2, 1, 1])
    matrices = []
    for key in golden.cameras["camera_order"]:
        camera = golden.cameras["cameras"][key]
        cam_from_ego = np.linalg.inv(camera["camera2ego"])
        matrices.append(scale @ np.array(camera["intrinsics_1600x900"]) @ cam_from_ego)
    meta = {"lidar2img": matrices, "lidar2ego": np.eye(4)}
    (ground,) = calibration_arrays(meta, ["img_from_ground"]).values()
    seen = encoder.project(torch.from_numpy(ground)[None], size)
    visible = seen.visible[0].numpy()
    packed = np.unpackbits(data["cam_mask"]).reshape(visible.shape).astype(bool)
    yield Row(name, "points that a camera sees", (visible ^ packed).mean(), 1e-4)
    shown = visible[:, ::317]
    places = 2 * seen.uv[0, :, ::317, 0].numpy() - 1
    off = largest_difference(places[shown], data["cam_uv_sub"][shown])
    yield Row(name, "cam_uv_sub, where seen", off, 1e-3)
    any_seen = np.unpackbits(data["ipm_any"]).astype(bool)
    yield Row(name, "ipm_any", (visible.any(0) ^ any_seen).mean(), 1e-4)
    planes = encoder.sample_planes(feats, seen)
    bev = encoder.flatten_planes(planes)
    neck = encoder.neck(bev)
    whole = torch.cat([planes[0], encoder.planes])
    outputs = head({"bev_feats": neck})
    chosen = [outputs[0], outputs[-1]]
    ours = {
        "fpn3": (levels[3][0, :, ::16], 1e-3),
        "up_sub": (feats[0, :, ::16, ::4, ::4], 1e-3),
        "ipm_sub": (whole[::10, :, ::5, ::5], 1e-3),
        "bev_sub": (bev[0, ::8, ::5, ::5], 1e-3),
        "neck": (neck[0, ::8], 1e-3),
        "all_lines": (torch.stack([output.references.flatten(2) for output in chosen]), 1e-2),
        "all_scores": (torch.stack([output.scores for output in chosen]), 1e-3),
    }
    for key, (value, tolerance) in ours.items():
        yield Row(name, key, largest_difference(value, data[key]), tolerance)
    yield from kept_rows(name, head, head.detector, outputs[-1], data)
    yield from line_rows(name, head, neck[0], data)


def line_rows(
    name: str, head: VectorMapNetHead, bev: Tensor, data: Mapping[str, np.ndarray]
) -> Iterator[Row]:
    """Compare the greedy lines of the first elements."""
    number = len(data["tokens"])
    boxes = torch.from_numpy(data["post_bbox_flat"][:number]).long()
    elements = Elements(torch.from_numpy(data["post_labels"][:number]), boxes)
    head.generator.max_points = 24
    tokens = head.generator.generate(bev, elements, lambda laws: laws.argmax(-1))
    off = largest_difference(tokens * data["token_masks"], data["tokens"] * data["token_masks"])
    yield Row(name, "tokens", off, 0)
    points, count = head.generator.lines(tokens)
    yield Row(name, "lines_count", largest_difference(count, data["lines_count"]), 0)
    lines = []
    for line, num_points in zip(points.numpy(), count, strict=True):
        lines.append(line[:num_points])  # without padding
    found = np.concatenate(lines)
    off = largest_difference(head.canvas.norm_from_metres(found), data["lines_norm"])
    yield Row(name, "lines_norm", off, 1e-5)
