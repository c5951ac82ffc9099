"""MapTR: state, forward pass, targets, assignment, losses and gradients."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from mmengine.structures import InstanceData
from predictions import predicted, stacked, triples
from scipy.optimize import linear_sum_assignment

from gsmap.checkpoints.convert import ours_from_upstream, upstream_from_ours
from gsmap.checkpoints.key_map import find_key_map
from gsmap.models.base.head import MapHead
from gsmap.models.base.pairs import Predictions
from gsmap.models.encoders.gkt import kernel_offsets
from gsmap.ops.deformable_sampling import sum_rows
from gsmap.ops.kernel_sampling.reference import border_pixels
from reference.golden import Golden
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm
from reference.targets import gt_instances

CONFIG = "maptr/maptr_r50_24e.py"
STATE = "maptr_r50_state.json"
_OTHER_CLASS_M = 1e3  # keeps detections of different classes from being paired
_MEAN_SHARE = 0.1  # a cell's mean over its channels moves less than its channels do
SAMPLES = {
    "empty": [("reduced", "empty")],
    "closed": [("reduced", "closed")],
    "many": [("reduced", "many")],
    "batch3": [("reduced", "empty"), ("full", "closed"), ("reduced", "many")],
}


def keys_and_shapes(state: Mapping[str, torch.Tensor]) -> set[tuple[str, tuple[int, ...]]]:
    """Return the keys of a state with the shapes of their tensors."""
    return {(key, tuple(value.shape)) for key, value in state.items()}


def state_rows(golden: Golden, name: str, config: str, shared: str = "-") -> Iterator[Row]:
    """Compare keys, shapes, counts and the round trip of an upstream state list with a model.

    Keys that begin with ``shared`` are further names of parameters.
    """
    listed = golden.read_json(name)
    model = golden.model(config, name)
    shapes = golden.state_shapes(name)
    renamed = ours_from_upstream({key: torch.empty(shape) for key, shape in shapes.items()})
    wrong = keys_and_shapes(model.state_dict()) ^ keys_and_shapes(renamed)
    yield Row(name, "keys or shapes that differ", len(wrong), 0)
    key_map = find_key_map(shapes)
    trainable = 0
    for parameter in model.parameters():
        if parameter.requires_grad:
            trainable += parameter.numel()
    twice = {other_name for other_name, _ in listed.get("shared_storage", [])}
    twice |= {key for key in shapes if key.startswith(shared)}
    unused = {key for key in shapes if key_map.is_unused(key)}
    for key in unused - twice:  # upstream trains them too, without effect
        if listed["state"][key].get("requires_grad"):
            trainable += math.prod(shapes[key])
    yield Row(name, "trainable parameters", abs(trainable - listed["trainable_params"]), 0)
    back = upstream_from_ours(model.state_dict())
    # what only some models have, or the config says, is not written
    kept = {key for key, value in key_map.unused.items() if value is not None}
    wanted = set()
    for key, shape in shapes.items():
        if key in kept or key not in unused:
            wanted.add((key, shape))
    lost = wanted ^ keys_and_shapes(back)
    yield Row(name, "keys lost on the way back", len(lost), 0)
    changes = []
    for key, value in golden.upstream_state(name).items():
        if key not in unused:
            changes.append(largest_difference(back[key], value))
    yield Row(name, "weights on the way back", max(changes), 0)


@check(STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the state of MapTR with ours."""
    yield from state_rows(golden, name, CONFIG)


@check("ops_gka_{variant}.npz")
def check_kernel_attention(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the geometry kernel attention alone."""
    data = golden.read_arrays(name)
    value = torch.from_numpy(data["value"])  # (B, h * w, heads, C)
    batch, num_pixels, heads, _ = value.shape
    height, width = data["spatial_shapes"][0].tolist()
    place = torch.from_numpy(data["loc_xy"])[:, :, :, 0]  # (B, Q, heads, S, 2)
    pixels = border_pixels(place, (height, width))
    sample = torch.arange(batch).view(-1, 1, 1, 1)
    rows = (sample * num_pixels + pixels) * heads + torch.arange(heads).view(-1, 1)
    weights = torch.from_numpy(data["weights"])[:, :, :, 0]
    out = sum_rows(value.flatten(0, 2), rows, weights)
    reference = data["out"].reshape(out.shape)
    yield Row(name, "out", largest_difference(out, reference), 1e-5)
    offsets = kernel_offsets((3, 5))
    wanted = data["kernel_offsets_xy_in_weight_order"]
    yield Row(name, "kernel offsets", largest_difference(offsets, wanted), 0)


def head_rows(
    name: str,
    data: dict[str, np.ndarray],
    outputs: Sequence[Predictions],
    cls_atol: float,
    pts_atol: float,
) -> Iterator[Row]:
    """Compare class scores, points and their boxes of all layers."""
    scores = stacked(outputs).scores
    pts = stacked(outputs).pts
    low = pts.amin(-2)
    high = pts.amax(-2)
    boxes = torch.cat([(low + high) / 2, high - low], -1)
    yield Row(name, "all_cls_scores", largest_difference(scores, data["all_cls_scores"]), cls_atol)
    yield Row(name, "all_pts_preds", largest_difference(pts, data["all_pts_preds"]), pts_atol)
    yield Row(name, "all_bbox_preds", largest_difference(boxes, data["all_bbox_preds"]), pts_atol)


def decoded_rows(
    name: str, data: dict[str, np.ndarray], result: InstanceData, score_atol: float = 5e-4
) -> Iterator[Row]:
    """Compare decoded detections, paired by class and points, as scores may tie."""
    labels = result.labels_3d.numpy()
    pts = result.pts.numpy()
    if pts.shape != data["dec_pts"].shape:
        yield Row(name, "number of detections", abs(len(pts) - len(data["dec_pts"])), 0)
        return
    distance = np.abs(pts[:, None] - data["dec_pts"]).max((-1, -2))
    other_class = labels[:, None] != data["dec_labels"]
    ours, theirs = linear_sum_assignment(distance + _OTHER_CLASS_M * other_class)
    yield Row(name, "dec_labels", float(other_class[ours, theirs].sum()), 0)
    yield Row(name, "dec_pts (m)", float(distance[ours, theirs].max(initial=0.0)), 0.01)
    if "dec_boxes" in data:
        boxes = np.concatenate([pts.min(1), pts.max(1)], -1)[ours]
        off = largest_difference(boxes, data["dec_boxes"][theirs])
        yield Row(name, "dec_boxes (m)", off, 0.01)
    scores = result.scores_3d.numpy()[ours]
    off = largest_difference(scores, data["dec_scores"][theirs])
    yield Row(name, "dec_scores", off, score_atol)


def bev_rows(
    name: str, data: dict[str, np.ndarray], bev: torch.Tensor, atol: float, fraction: float
) -> Iterator[Row]:
    """Compare BEV features: the mean of every cell, and all channels of a subset.

    A tie in rounding a position can change a whole cell. The means tell which cells those are;
    there may be few, and the subset is compared at the others.
    """
    off = np.abs(bev.mean(0).numpy() - data["bev_embed_channel_mean"]) > atol * _MEAN_SHARE
    yield Row(name, "fraction of BEV cells that differ", float(off.mean()), fraction)
    rows = data["bev_rows"]
    cols = data["bev_cols"]
    subset = bev.numpy()[:, rows][:, :, cols].reshape(len(bev), -1).T  # (cells, C)
    same = ~off[rows][:, cols].ravel()
    deviation = largest_difference(subset[same], data["bev_embed_sub"][same])
    yield Row(name, "channels of the other cells", deviation, atol)


@check("maptr_r50_forward_*_{variant}.npz")
@torch.no_grad()
def check_forward(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the way from the images to the detections."""
    data = golden.read_arrays(name)
    size = name.split("_")[3]
    model = golden.model(CONFIG, STATE)
    meta = golden.meta(size)
    feats = model.extract_img_feats(golden.images(size))
    yield Row(name, "FPN", largest_difference(feats[0][0, :, ::16], data["fpn_feat_sub"]), 1e-4)
    matrices = torch.as_tensor(meta["lidar2img"], dtype=torch.float32)[None]
    projection = model.bev_encoder.project(matrices, meta["batch_input_shape"])
    seen = np.packbits(projection.visible[0].numpy(), axis=-1)
    differing = np.unpackbits(seen ^ data["cam_hit"]).mean()
    yield Row(name, "cells seen by each camera", float(differing), 1e-4)

    bev_outputs = model.bev_encoder(feats, [meta])
    yield from bev_rows(name, data, bev_outputs["bev_feats"][0], 1e-4, 1e-3)
    head = model.map_head
    reference = head.reference.start(head.queries()[0])
    off = largest_difference(reference[None], data["init_reference"])
    yield Row(name, "init_reference", off, 1e-5)
    outputs = head(bev_outputs)
    states = stacked(outputs).point_states.flatten(2, 3)[:, 0, ::25, ::8]
    yield Row(name, "decoder states", largest_difference(states, data["hs_sub"]), 1e-3)
    yield from head_rows(name, data, outputs, 5e-4, 1e-4)
    yield from decoded_rows(name, data, head.predict_by_feat(outputs, [meta])[0])


def loss_prefixes(num_layers: int) -> list[str]:
    """Return the prefix of the losses of each layer; the last layer has none."""
    prefixes = [f"d{layer}." for layer in range(num_layers - 1)]
    return [*prefixes, ""]


def loss_rows(
    golden: Golden,
    name: str,
    data: dict[str, np.ndarray],
    head: MapHead,
    samples: Sequence[tuple[str, str]],
    forward_file: str = "maptr_r50_forward_{size}_{variant}.npz",
    names: Sequence[str] = ("loss_cls", "loss_pts", "loss_dir"),
) -> Iterator[Row]:
    """Compare assignment, losses and gradients on saved predictions.

    Args:
        golden: The reference data.
        name: The file.
        data: Its arrays.
        head: A head with the losses.
        samples: Input size and set of ground truth of every sample of the batch.
        forward_file: Pattern of the file of saved predictions.
        names: The losses to compare.

    Yields:
        The compared quantities.
    """
    saved_scores = []
    saved_pts = []
    batch_gt = []
    metas = []
    for size, gt_set in samples:
        saved = golden.read_arrays(forward_file.format(size=size, variant=golden.variant))
        saved_scores.append(saved["all_cls_scores"])
        saved_pts.append(saved["all_pts_preds"])
        batch_gt.append(gt_instances(golden.gt_sets[gt_set]))
        metas.append(golden.meta(size))
    scores = torch.from_numpy(np.concatenate(saved_scores, 1)).requires_grad_()
    pts = torch.from_numpy(np.concatenate(saved_pts, 1)).requires_grad_()
    outputs = predicted(head, scores, pts)
    yield from match_rows(name, data, head, outputs, batch_gt, metas)
    losses = head.loss_by_feat(outputs, batch_gt, metas)
    for key in names:
        ours = [losses[layer + key].item() for layer in loss_prefixes(len(scores))]
        yield Row(name, f"{key} (relative)", largest_relative(ours, data[key]), 1e-4)
    # without ground truth nothing reaches the points
    torch.stack(list(losses.values())).sum().backward()
    for key, tensor in (("grad_cls", scores), ("grad_pts", pts)):
        grad = torch.zeros_like(tensor) if tensor.grad is None else tensor.grad
        yield Row(name, f"{key} (relative)", relative_norm(grad, data[key]), 1e-3)


def head_loss_rows(
    golden: Golden, name: str, head: MapHead, forward_file: str, renamed: dict[str, str]
) -> Iterator[Row]:
    """Compare matches and losses of a method's head on saved predictions of reduced size.

    Args:
        golden: The reference data.
        name: The file, whose last part but one is the set of ground truth.
        head: A head with the method's losses.
        forward_file: The file of saved predictions.
        renamed: Names of the losses in the file, and ours.

    Yields:
        The compared quantities.
    """
    data = golden.read_arrays(name)
    saved = golden.read_arrays(forward_file)
    scores = torch.from_numpy(saved["all_cls_scores"])
    pts = torch.from_numpy(saved["all_pts_preds"])
    outputs = predicted(head, scores, pts)
    batch_gt = [gt_instances(golden.gt_sets[name.split("_")[2]])]
    metas = [golden.meta("reduced")]
    matches = {f"{key}_b0": value for key, value in data.items() if key.startswith("match_")}
    yield from match_rows(name, matches, head, outputs, batch_gt, metas)
    losses = head.loss_by_feat(outputs, batch_gt, metas)
    layers = loss_prefixes(len(scores))
    for theirs, ours in renamed.items():
        values = [losses[layer + ours].item() for layer in layers]
        wanted = [data[f"loss/{layer}{theirs}"] for layer in layers]
        yield Row(name, f"{ours} (relative)", largest_relative(values, wanted), 1e-4)


def match_rows(
    name: str,
    data: dict[str, np.ndarray],
    head: MapHead,
    outputs: Sequence[Predictions],
    batch_gt: Sequence[InstanceData],
    metas: Sequence[dict[str, Any]],
) -> Iterator[Row]:
    """Compare the pairs of query, ground truth and order of every layer."""
    gts = head.prepare_gts(batch_gt)
    wrong = 0.0
    for layer, matches in enumerate(triples(head.match(outputs, gts, metas))):
        for image, ours in enumerate(matches):
            wrong = max(wrong, largest_difference(ours, data[f"match_l{layer}_b{image}"]))
    yield Row(name, "query, ground truth and order of matches", wrong, 0)


@check("maptr_loss_*_{variant}.npz")
def check_loss(golden: Golden, name: str) -> Iterator[Row]:
    """Compare targets, matching costs, assignment, losses and gradients."""
    data = golden.read_arrays(name)
    case = name.split("_")[2]
    head = golden.model(CONFIG, STATE).map_head
    yield from loss_rows(golden, name, data, head, SAMPLES[case])
    if "gt_fixed_pts" in data:
        yield from target_rows(name, data, gt_instances(golden.gt_sets[case]))
    if "cost_pts_lastlayer" in data:
        saved = golden.read_arrays(f"maptr_r50_forward_reduced_{golden.variant}.npz")
        prediction = InstanceData(
            scores=torch.from_numpy(saved["all_cls_scores"][-1, 0]),
            pts=torch.from_numpy(saved["all_pts_preds"][-1, 0]),
        )
        gt = head.prepare_gts([gt_instances(golden.gt_sets[case])]).sample(0)
        keys = ("cost_cls_lastlayer", "cost_pts_lastlayer")
        for key, cost in zip(keys, head.assigner.match_costs, strict=True):
            ours = cost(prediction, gt, {})
            yield Row(name, f"{key} (relative)", largest_relative(ours, data[key]), 1e-4)


def target_rows(name: str, data: dict[str, np.ndarray], gt: InstanceData) -> Iterator[Row]:
    """Compare resampled points and their equivalent orders."""
    yield Row(name, "gt_fixed_pts (m)", largest_difference(gt.pts, data["gt_fixed_pts"]), 1e-4)
    yield Row(
        name, "gt_shift_pts (m)", largest_difference(gt.pts_shifts, data["gt_shift_pts"]), 1e-4
    )
    yield Row(name, "gt_bbox (m)", largest_difference(gt.boxes, data["gt_bbox"]), 1e-4)


@check("maptr_gt_shift_patterns_{variant}.npz")
def check_orders(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the equivalent orders of pattern v2."""
    ours = gt_instances(golden.gt_sets["closed"]).pts_shifts
    reference = golden.read_arrays(name)["v2"]
    yield Row(name, "v2 (m)", largest_difference(ours, reference), 1e-4)


@check("maptr_gt_bigring_{variant}.npz")
def check_many_orders(golden: Golden, name: str) -> Iterator[Row]:
    """Compare a ring of more orders than are kept: the reference's random ones are among ours."""
    data = golden.read_arrays(name)
    ring = np.array(golden.gt_sets["bigring"][0]["pts"])
    gt = gt_instances(golden.gt_sets["bigring"])
    yield Row(name, "gt_fixed_pts (m)", largest_difference(gt.pts, data["gt_fixed_pts"]), 1e-4)
    yield Row(name, "bbox (m)", largest_difference(gt.boxes, data["bbox"]), 1e-4)
    rings = []
    for k in range(len(ring) - 1):
        points = np.roll(ring[:-1], k, 0)
        rings.append({"label": 2, "pts": np.concatenate([points, points[:1]])})
    every = gt_instances(rings).pts.numpy()
    distance = np.abs(data["gt_shift_pts_seed0"][0][:, None] - every).max((-1, -2))
    yield Row(name, "drawn orders are orders of the ring (m)", float(distance.min(1).max()), 1e-4)
    missing = gt.pts_shifts.shape[1] - len(set(distance.argmin(1).tolist()))
    yield Row(name, "orders missing among the drawn ones", missing, 0)
