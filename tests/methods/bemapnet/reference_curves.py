"""BeMapNet: curves, fits to annotated lines, and the targets."""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from methods.bemapnet.reference import small_head
from mmcv.ops import point_sample
from mmdet3d.structures import Det3DDataSample
from mmengine.registry import init_default_scope
from mmengine.structures import InstanceData
from reference.golden import Golden
from reference.lines import elements
from reference.registry import check
from reference.report import Row, largest_difference

from gsmap.models.bemapnet.curves import Curve, control_points, neighbourhood, recovery_loss
from gsmap.models.bemapnet.head import BezierHead
from gsmap.models.bemapnet.targets import FormatBezierTargets
from gsmap.models.lines.targets import Part, draw_lines
from gsmap.structures.bezier import bernstein, curve_points, fit_piece, fit_pieces, mean_deviation
from gsmap.structures.grid import BEVGrid

ACCEPTED_M = 0.1
SHAPES = ((2, 3), (1, 1), (3, 7))  # degree and most pieces of each class
GRID = BEVGrid((-15.0, 15.0), (-30.0, 30.0))
SIZE = (400, 200)


@check("bemapnet_bezier_{variant}.npz")
def check_fits(golden: Golden, name: str) -> Iterator[Row]:
    """Compare fits of one piece, how far they are off, and fits of several pieces."""
    data = golden.read_arrays(name)
    for label, degree in enumerate((2, 1, 3)):
        off = largest_difference(bernstein(degree), data[f"coefficient{label}"])
        yield Row(name, f"weights of control points, degree {degree}", off, 1e-6)
    lines = annotated_lines(golden, name)
    for key in sorted(key for key in data if key.endswith("_one_f64")):
        fit = key.removesuffix("_one_f64")
        degree, number = map(int, re.findall(r"\d+", fit))
        one = fit_piece(lines[number], degree)
        yield Row(name, f"{fit}_one", largest_difference(one, data[key]), 1e-6)
        loss = mean_deviation(lines[number], curve_points(one, degree))
        yield Row(name, f"{fit}_loss", largest_difference(loss, data[f"{fit}_loss"]), 1e-4)
        pieces = fit_pieces(lines[number], degree, ACCEPTED_M, mean_deviation)
        off = largest_difference(pieces, data[f"{fit}_piecewise_f64"])
        yield Row(name, f"{fit}_piecewise", off, 1e-6)


def annotated_lines(golden: Golden, name: str) -> list[np.ndarray]:
    """Return the lines that are fitted: vertices every metre, in the frame of the vehicle."""
    data = golden.read_arrays(name.replace("bemapnet_bezier", "hdmapnet_targets"))
    ends = np.cumsum(data["many_vec_count"])[:-1]
    return np.split(data["many_vec_pts_f64"], ends)


@check("bemapnet_bezier_{variant}.npz")
def check_curves(golden: Golden, name: str) -> Iterator[Row]:
    """Compare curves of logits, what they miss of masks, and the gradients of both."""
    data, seed, inputs = golden.read_arrays(name), golden.seed, golden.inputs
    total = 0.0
    for label, (degree, pieces) in enumerate(SHAPES):
        shapes = {"im": (pieces + 1, 2), "ex": (pieces, degree - 1, 2), "end": (pieces,)}
        joints, inner, logits = (
            torch.from_numpy(inputs.normal(f"bm_bez_{key}{label}", (2, 4, *shape), seed))
            for key, shape in shapes.items()
        )
        joints.requires_grad_()
        inner.requires_grad_()
        controls, last = control_points(joints, inner), logits.argmax(-1)
        curve = Curve(degree, pieces)(controls, last)
        noise = torch.from_numpy(inputs.normal(f"bm_bez_g{label}", (2, 4, 100, 2), seed))
        scalar = (curve * noise).sum()
        scalar.backward()
        total += float(scalar.detach())
        ours = {"ctr": controls, "curve": curve, "end": last, "grad_im": joints.grad}
        if degree > 1:
            ours["grad_ex"] = inner.grad
        for key, value in ours.items():
            off = largest_difference(value.detach(), data[f"{key}{label}"])
            yield Row(name, f"{key}{label}", off, 1e-5)
    yield Row(name, "scalar (relative)", abs(total / float(data["scalar"]) - 1), 1e-4)
    masks = torch.from_numpy(inputs.mask("bm_rec", (3, 40, 20), seed, 0.3))
    points = torch.from_numpy(inputs.uniform("bm_rec_pts", (3, 100, 2), -0.05, 1.05, seed))
    points.requires_grad_()
    steps = -neighbourhood(torch.zeros(1, 2) + 0.5, (40, 20)) + 0.5
    yield Row(name, "rec_kernel", largest_difference(steps, data["rec_kernel"][0, 0]), 1e-6)
    losses = recovery_loss(point_sample(masks[:, None], neighbourhood(points, (40, 20)))[:, 0])
    losses.sum().backward()
    yield Row(name, "rec_loss", largest_difference(losses.detach(), data["rec_loss"]), 1e-5)
    yield Row(name, "rec_grad", largest_difference(points.grad, data["rec_grad"]), 1e-5)


def target_input(golden: Golden, tag: str) -> dict[str, Any]:
    """Return a set of ground truth as a transform reads it."""
    ranges = {"x_range": GRID.x_range, "y_range": GRID.y_range}
    return {"map_instances": elements(golden, tag), "token": tag, **ranges}


@check("bemapnet_targets_{variant}.npz")
def check_targets(golden: Golden, name: str) -> Iterator[Row]:
    """Compare control points before and after they are cut, masks, curves; redrawn masks."""
    init_default_scope("mmdet3d")
    data = golden.read_arrays(name)
    own = FormatBezierTargets(edge_classes=())  # the file's crossings are rings
    head = small_head((1, 1, 1), 0.15)
    head.grid = GRID
    for tag in ("closed", "many"):
        parts, grid = own.collect_parts(target_input(golden, tag))
        yield from fitted_rows(name, tag, parts, grid, data)
        sample = own.transform(target_input(golden, tag))["gt_instances_3d"]
        labels, kept = data[f"{tag}_labels"], data[f"{tag}_labels"][:, 0] >= 0
        degrees = np.array([degree for degree, _ in SHAPES])[sample.labels_3d]
        found = np.stack([sample.labels_3d, (sample.num_pts - 1) // degrees - 1, sample.num_pts], 1)
        yield Row(name, f"{tag}: labels", largest_difference(found, labels[kept]), 0)
        drawn_masks = np.zeros((3, *SIZE), int)
        for number, (mask, label) in enumerate(zip(sample.masks, sample.labels_3d, strict=True)):
            drawn_masks[label][mask] = 2 * number + 2
        wrong = largest_difference(drawn_masks, data[f"{tag}_instance_mask"][1])
        yield Row(name, f"{tag}: masks of width 8", wrong, 0)
        yield from truth_rows(name, tag, head, sample, data)
    # a class of which a line is hidden: redrawn by curves, whose targets then are in pixels
    sample.redrawn[:] = True
    curves = head.truth(sample_of(sample))[2].curves
    off = largest_difference(curves, data["fallback_c2_curve"]) / max(SIZE)
    yield Row(name, "fallback: curves (of the longer side)", off, 1e-6)
    lines = (curves / torch.tensor(SIZE).flip(0)).flip(-1).double().numpy()
    found = draw_lines(lines, SIZE, own.thickness_px)
    off = np.unpackbits(data["fallback_c2_mask"]).reshape(found.shape) != found
    yield Row(name, "fallback: share of pixels of masks that differ", off.mean(), 1e-3)


def fitted_rows(
    name: str, tag: str, parts: list[Part], grid: BEVGrid, data: dict[str, np.ndarray]
) -> Iterator[Row]:
    """Compare all control points of lines, before any is cut off."""
    whole = FormatBezierTargets(edge_classes=(), pieces=(99, 99, 99))
    ends = np.cumsum(data[f"{tag}_ctr_count"])[:-1]
    off = 0.0
    for (label, line), wanted in zip(parts, np.split(data[f"{tag}_ctr_f64"], ends), strict=True):
        controls_m = whole.points(line, label, grid)[:, ::-1] * (30, 60)
        off = max(off, largest_difference(controls_m, wanted))
    yield Row(name, f"{tag}: control points (metres)", off, 1e-6)


def truth_rows(
    name: str, tag: str, head: BezierHead, sample: InstanceData, data: dict[str, np.ndarray]
) -> Iterator[Row]:
    """Compare what the losses read of each class."""
    for label, truth in enumerate(head.truth(sample_of(sample))):
        used = head.curves[label].control_mask(truth.pieces)
        ours = {
            "ctr_points": (truth.controls, 1e-5),
            "end": (truth.pieces, 0),
            "valid": (used, 0),
            "curve": (truth.curves, 1e-5),
            "mask_pixels": (truth.masks.sum((1, 2)), 0),
        }
        for key, (value, tolerance) in ours.items():
            off = largest_difference(value, data[f"{tag}_c{label}_{key}"])
            yield Row(name, f"{tag}: {key} {label}", off, tolerance)


def sample_of(instances: InstanceData) -> Det3DDataSample:
    """Return a sample with targets."""
    sample = Det3DDataSample()
    sample.gt_instances_3d = instances
    return sample
