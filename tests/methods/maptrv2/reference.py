"""MapTRv2: state, depth lifting, forward pass of both query groups, masks, assignment, losses."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from mmdet3d.structures import Det3DDataSample
from mmengine.model import BaseModel
from mmengine.structures import InstanceData
from predictions import stacked, triples
from reference.golden import NUM_CAMS, Golden
from reference.maptr import bev_rows, decoded_rows, head_rows, state_rows
from reference.registry import check
from reference.report import Row, fraction_beyond, largest_difference, largest_relative
from reference.targets import X_RANGE_M, Y_RANGE_M, gt_instances
from torch import Tensor

from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.transforms.masks import MakeBEVMask, MakePVMask
from gsmap.models.base.head import MapHead
from gsmap.models.base.pairs import Predictions
from gsmap.models.encoders.camera_encoder import stack_calibration
from gsmap.models.encoders.depth_net import camera_vector
from gsmap.models.encoders.lss import CAMERA_MATRICES
from gsmap.models.maptrv2.depth import depth_bins
from gsmap.ops.bev_pool import cell_indices

CONFIG = "maptrv2/maptrv2_r50_24e.py"
STATE = "maptrv2_r50_state.json"
STRIDE = 32
CLS_ATOL, PTS_ATOL = 2e-3, 3e-4
FLIPPED = (
    0.01  # share of cells, or of matches near a tie, that one point across a voxel's edge turns
)


@check(STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare MapTRv2's state with ours."""
    yield from state_rows(golden, name, CONFIG)


@contextmanager
def all_queries(head: MapHead) -> Iterator[None]:
    """Let the head run its training queries, while its layers stay in eval mode (no dropout)."""
    head.training = True
    try:
        yield
    finally:
        head.training = False


def encode(golden: Golden, size: str) -> tuple[BaseModel, dict[str, Tensor]]:
    """Return the model and its BEV encoder's outputs, which the files of one size share."""
    model = golden.model(CONFIG, STATE)

    def outputs() -> dict[str, Tensor]:
        feats = model.extract_img_feats(golden.images(size))
        return model.bev_encoder(feats, [golden.meta(size)])

    return model, golden.once(f"{STATE}: BEV features, {size}", outputs)


def training_outputs(golden: Golden, size: str) -> list[Predictions]:
    """Return the predictions of the training queries, which the files of one size share."""
    model, bev_outputs = encode(golden, size)

    def outputs() -> list[Predictions]:
        with all_queries(model.map_head):
            return model.map_head(bev_outputs)

    return golden.once(f"{STATE}: training queries, {size}", outputs)


@check("maptrv2_r50_forward_*_{variant}.npz")
@torch.no_grad()
def check_forward(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the way from the images to the detections."""
    data = golden.read_arrays(name)
    size = name.split("_")[3]
    model, bev_outputs = encode(golden, size)
    yield from lifting_rows(name, data, model, bev_outputs, golden.meta(size))
    yield from bev_rows(name, data, bev_outputs["bev_feats"][0], 1e-4, FLIPPED)
    head = model.map_head
    outputs = head(bev_outputs)
    yield from head_rows(name, data, outputs, CLS_ATOL, PTS_ATOL)
    result = head.predict_by_feat(outputs, [golden.meta(size)])[0]
    yield from decoded_rows(name, data, result, CLS_ATOL)
    masks = head.aux_heads
    seg = fraction_beyond(masks["seg"](bev_outputs["bev_feats"]), data["seg"], 1e-3)
    yield Row(name, "cells with seg off by > 1e-3", seg, FLIPPED)
    pv_seg = masks["pv_seg"](bev_outputs["img_feats"].flatten(0, 1))[None]
    yield Row(name, "pv_seg", largest_difference(pv_seg, data["pv_seg"]), 1e-4)
    groups = [part for _, part in head.split_groups(training_outputs(golden, size))]
    yield from group_rows(name, data, *groups)


def lifting_rows(
    name: str,
    data: dict[str, np.ndarray],
    model: BaseModel,
    bev_outputs: dict[str, Tensor],
    meta: dict[str, Any],
) -> Iterator[Row]:
    """Compare image features, the cameras' vectors, lifted points, their cells, and depth."""
    encoder, feats = model.bev_encoder, bev_outputs["img_feats"]
    yield Row(name, "FPN", largest_difference(feats[0, :, ::16], data["fpn_feat_sub"]), 1e-4)
    calibration = stack_calibration([meta], encoder.calibration, feats.device)
    vectors = camera_vector(*(calibration[key] for key in CAMERA_MATRICES)).flatten(0, 1)
    yield Row(name, "mlp_input", largest_difference(vectors[None], data["mlp_input"]), 1e-3)
    frame_from_img = calibration["frame_from_img"]
    points = encoder.points(frame_from_img, meta["batch_input_shape"], feats)[0]
    subset = points[:, ::16, ::3, ::5]
    reference = data["frustum_geom_sub"]
    yield Row(name, "frustum points (m)", largest_difference(subset, reference), 1e-4)
    cells = cell_indices(points, encoder.cells, encoder.z_range)
    grid = encoder.cells
    flat = torch.bincount(cells[cells >= 0], minlength=grid.height * grid.width)
    counts = flat.view(grid.height, grid.width).T.numpy()
    moved = np.abs(counts - data["voxel_count_x_y"]).sum() / 2 / data["voxel_count_x_y"].sum()
    yield Row(name, "share of points in another voxel", float(moved), 1e-3)
    depth = bev_outputs["depth"]
    saved = depth[..., ::4, ::6] if "full" in name else depth
    yield Row(name, "depth", largest_difference(saved, data["depth"]), 1e-5)
    other = (depth.argmax(2).numpy() != data["depth_argmax"]).mean()
    yield Row(name, "pixels with another likeliest depth", float(other), 1e-3)


def group_rows(
    name: str, data: dict[str, np.ndarray], first: list[Predictions], further: list[Predictions]
) -> Iterator[Row]:
    """Compare the predictions of the training queries."""
    ours = {
        "train_one2one_cls": stacked(first).scores,
        "train_one2one_pts": stacked(first).pts,
        "one2many_cls": stacked(further).scores,
        "one2many_pts": stacked(further).pts,
        "one2many_pts_layer_last": stacked(further).pts[-1],
        "one2many_pts_every10th": stacked(further).pts[:, :, ::10],
    }
    for key, value in ours.items():
        if key in data:
            atol = CLS_ATOL if key.endswith("cls") else PTS_ATOL
            yield Row(name, key, largest_difference(value, data[key]), atol)


@check("maptrv2_loss_*_{variant}.npz")
@torch.no_grad()
def check_loss(golden: Golden, name: str) -> Iterator[Row]:
    """Compare targets, assignment of both query groups, and all losses."""
    data = golden.read_arrays(name)
    size, case = name.split("_")[2:4]
    model, bev_outputs = encode(golden, size)
    head, meta = model.map_head, golden.meta(size)
    gt = gt_instances(golden.gt_sets[case])
    sample = auxiliary_targets(golden, size, case)
    yield from target_rows(name, data, gt, sample)
    outputs = training_outputs(golden, size)
    for group, part in head.split_groups(outputs):
        label = group.name or "one2one"
        yield from match_rows(name, data, label, head, part, gt, meta, group.repeats)
    losses = head.loss_by_feat(outputs, [gt], [meta])
    losses.update(
        {f"loss_{k}": aux.loss(bev_outputs, [sample]) for k, aux in head.aux_heads.items()}
    )
    for group, chosen in (("", "one2one and auxiliary"), ("_one2many", "one2many")):
        keys = [key for key in losses if key.endswith("_one2many") == bool(group)]
        ours = [losses[key].item() for key in keys]
        reference = [data[f"loss/{key}"] for key in keys]
        yield Row(name, f"losses, {chosen} (relative)", largest_relative(ours, reference), 1e-3)
    listed = {key.removeprefix("loss/") for key in data if key.startswith("loss/")}
    absent = [key for key in listed - set(losses) if data[f"loss/{key}"] != 0]
    yield Row(name, "losses that we do not have", len(absent), 0)


def auxiliary_targets(golden: Golden, size: str, case: str) -> Det3DDataSample:
    """Make depth and masks of a set of elements, as the data pipeline does."""
    height, width = golden.cameras[size]["padded_hw"]
    elements = golden.gt_sets[case]
    results: dict[str, Any] = {
        "map_instances": [MapInstance(e["label"], np.asarray(e["pts"])) for e in elements],
        "x_range": X_RANGE_M,
        "y_range": Y_RANGE_M,
        "img_shape": (height, width),
        "lidar2img": list(golden.meta(size)["lidar2img"]),
    }
    results = MakePVMask(stride=STRIDE).transform(MakeBEVMask().transform(results))
    depth = golden.inputs.gt_depth(height, width, NUM_CAMS, golden.seed)
    sample = Det3DDataSample()
    sample.gt_seg, sample.gt_pv_seg = results["gt_seg"], results["gt_pv_seg"]
    sample.gt_depth = torch.from_numpy(depth)
    return sample


def target_rows(
    name: str, data: dict[str, np.ndarray], gt: InstanceData, sample: Det3DDataSample
) -> Iterator[Row]:
    """Compare point orders, masks and depth bins."""
    orders = largest_difference(gt.pts_shifts, data["gt_shift_pts"])
    yield Row(name, "gt_shift_pts (m)", orders, 1e-4)
    yield Row(name, "gt_seg", largest_difference(sample.gt_seg, data["gt_seg"]), 0)
    yield Row(name, "gt_pv_seg", largest_difference(sample.gt_pv_seg, data["gt_pv_seg"]), 0)
    bins = depth_bins(sample.gt_depth, STRIDE, (1.0, 35.0, 0.5))
    yield Row(name, "depth_bins", largest_difference(bins, data["depth_bins"]), 0)


def match_rows(
    name: str,
    data: dict[str, np.ndarray],
    group: str,
    head: MapHead,
    outputs: list[Predictions],
    gt: InstanceData,
    meta: dict[str, Any],
    repeats: int,
) -> Iterator[Row]:
    """Compare the matches of all layers; copies of one ground truth stand for each other."""
    prepared = head.prepare_gts([gt])
    different = total = 0
    for layer, (ours,) in enumerate(triples(head.match(outputs, prepared, [meta], repeats))):
        listed = data[f"match_{group}_l{layer}"]
        reference = {(q, g % len(gt), order) for q, g, order in listed.tolist()}
        different += len(reference - set(map(tuple, ours.tolist())))
        total += len(listed)
    yield Row(name, f"share of {group} matches that differ", different / total, FLIPPED)
