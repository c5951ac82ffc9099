"""Heads of few queries and channels, and the BEV features that they read."""

import copy

import torch
from mmdet3d.registry import MODELS
from mmengine.structures import InstanceData
from model_cases import straight_elements

import gsmap.registered  # noqa: F401

N, P, C = 4, 5, 16
HEAD = {
    "type": "MapHead",
    "num_classes": 3,
    "pc_range": [-15.0, -30.0, -10.0, 15.0, 30.0, 10.0],
    "num_instances": N,
    "num_points": P,
    "embed_dims": C,
    "decoder": {
        "type": "MapDecoder",
        "num_layers": 2,
        "layer": {"embed_dims": C, "num_heads": 4, "ffn_dims": 32, "dropout": 0.0},
    },
    "assigner": {
        "type": "MapAssigner",
        "match_costs": [
            {"type": "mmdet.FocalLossCost", "weight": 2.0},
            {"type": "OrderedPointsCost", "weight": 5.0},
        ],
    },
    "coder": {"type": "MapCoder", "max_num": 8, "post_center_range": [-20, -35, 20, 35]},
    "loss_cls": {"type": "mmdet.FocalLoss", "use_sigmoid": True, "loss_weight": 2.0},
    "loss_weights": {"pts": 5.0, "dir": 0.005},
}
GAUSSIANS = {
    "loss_raster": {"type": "RasterLoss", "loss_weight": 10.0},
    "iou_cost": {"type": "IoUCost", "weight": 2.0},
}


def with_layer(config: dict, **settings) -> dict:
    """Return a head's decoder config with other settings of its layer."""
    return {**config["decoder"], "layer": {**config["decoder"]["layer"], **settings}}


def build_head(config: dict, **settings) -> torch.nn.Module:
    """Build a head with reproducible weights; ``settings`` replace parts of its config."""
    torch.manual_seed(0)
    head = MODELS.build(copy.deepcopy({**config, **settings}))
    head.init_weights()
    return head


def bev(batch: int = 1) -> dict[str, torch.Tensor]:
    """Return what a BEV encoder gives a head; the same at every call."""
    generator = torch.Generator().manual_seed(1)
    return {
        "bev_feats": torch.randn(batch, C, 10, 5, generator=generator),
        "img_feats": torch.randn(batch, 2, C, 3, 4, generator=generator),
    }


def elements(*lines, labels=None) -> InstanceData:
    """Return the ground truth of one sample from straight lines ((x0, y0), (x1, y1)) in metres."""
    return straight_elements(*lines, labels=labels, num_points=P)


def along_y(*xs: float) -> list:
    """Return lines of 40 m along y, at these x."""
    return [((x, -20), (x, 20)) for x in xs]
