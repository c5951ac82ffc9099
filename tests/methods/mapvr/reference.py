"""MapVR: soft rasters, the dice loss between them with its gradient, matching cost, head."""

from collections.abc import Iterator

import torch
from mmengine.structures import InstanceData
from predictions import pairs_of
from reference.golden import Golden
from reference.maptr import head_loss_rows, state_rows
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm

from gsmap.models.mapvr.cost import RenderedDiceCost
from gsmap.models.mapvr.losses import RenderedDiceLoss
from gsmap.ops.polyline_raster import soft_rasters

CONFIG, STATE = "mapvr/mapvr_r50_24e.py", "mapvr_r50_state.json"
LOSSES = {
    "loss_cls": "loss_cls",
    "loss_pts": "loss_pts",
    "loss_dir": "loss_dir",
    "loss_rendered_mask": "loss_dice",
}
# How the suffix of a raster's name says it was rendered: whether as a polygon. Boundaries of
# polygons and hard masks serve nothing in MapVR's training and have no counterpart here.
KINDS = {"lane_boundary_s2": False, "as_lane_s2": False, "mask_s4": True}


@check(STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the state, which is that of MapTR, with ours."""
    yield from state_rows(golden, name, "maptr/maptr_r50_24e.py")


@check("mapvr_rasters_{variant}.npz")
def check_rasters(golden: Golden, name: str) -> Iterator[Row]:
    """Compare soft rasters of lines and polygons."""
    data = golden.read_arrays(name)
    elements = sorted(key.removesuffix("_vertices") for key in data if key.endswith("_vertices"))
    for element in elements:
        vertices = torch.from_numpy(data[f"{element}_vertices"])[None]
        for kind, is_polygon in KINDS.items():
            key = f"{element}_{kind}"
            if key not in data:
                continue
            height, width = data[key].shape
            raster = soft_rasters(vertices, height, width, torch.tensor([is_polygon]))[0]
            yield Row(name, key, largest_difference(raster, data[key]), 1e-5)


@check("mapvr_dice_{variant}.npz")
def check_dice(golden: Golden, name: str) -> Iterator[Row]:
    """Compare dice loss, its true gradient, and the cost.

    The original's gradient of lines is not the derivative of its loss; the file holds both.
    """
    data = {key: torch.from_numpy(value) for key, value in golden.read_arrays(name).items()}
    for case in sorted(key.removesuffix("_labels") for key in data if key.endswith("_labels")):
        labels, gt = data[f"{case}_labels"], data[f"{case}_gt"]
        pred = data[f"{case}_pred"].clone().requires_grad_()
        pairs = pairs_of(pred_pts=pred, gt_first_pts=gt, gt_labels=labels, avg_factor=len(gt))
        loss = RenderedDiceLoss()(pairs)
        loss.backward()
        assert pred.grad is not None
        off = largest_relative(loss.detach(), data[f"{case}_loss_w15"])
        yield Row(name, f"{case}: loss (relative)", off, 1e-4)
        off = relative_norm(pred.grad, data[f"{case}_grad_analytic"])
        yield Row(name, f"{case}: true gradient (relative)", off, 1e-3)
        predictions = InstanceData(pts=data[f"{case}_cost_pred"])
        cost = RenderedDiceCost()(predictions, InstanceData(first_pts=gt, labels=labels))
        off = largest_difference(cost, data[f"{case}_cost_w10"])
        yield Row(name, f"{case}: cost", off, 1e-4)


@check("mapvr_headloss_*_{variant}.npz")
def check_head(golden: Golden, name: str) -> Iterator[Row]:
    """Compare matches and losses of the head on MapTR's predictions."""
    head = golden.model(CONFIG, STATE).map_head
    predictions = f"maptr_r50_forward_reduced_{golden.variant}.npz"
    yield from head_loss_rows(golden, name, head, predictions, LOSSES)
