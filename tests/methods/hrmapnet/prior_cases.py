"""A tiny MapTR with a raster prior, and frames of a drive."""

import numpy as np
import torch
from model_cases import build_small, make_samples, straight_elements

CLASSES = ("divider", "ped_crossing", "boundary")
PRIOR = {
    "type": "RasterPrior",
    "cell_m": 1.25,  # 4 x 4 cells in each BEV cell of 5 m
    "score_threshold": 0.0,  # an untrained model is sure of nothing
    "queries": {"num_heads": 4, "stride": 1, "threshold": 0.3},
    "bev": {
        "threshold": 0.3,
        "layer": {
            "layer_cfg": {"num_heads": 4, "ffn_dims": 16, "dropout": 0.0},
            "cross_attn": {
                "type": "SpatialCrossAttention",
                "num_heads": 4,
                "num_points": 8,
                "num_heights": 4,
            },
        },
    },
}


def prior_model(seed: int = 0, **settings) -> torch.nn.Module:
    """Return the tiny model; ``settings`` replace parts of its prior."""
    return build_small(seed, prior={**PRIOR, **settings})


def pose_at(x: float, y: float = 0.0, yaw_rad: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    pose[:2, 3] = x, y
    return pose


def frames(*places: tuple[str, str, float] | None) -> list:
    """Return a sample of each place: its town, its scene and its x in metres; None without pose."""
    lines = (((-3, -20), (-3, 20)), ((3, -20), (4, 20)))
    samples = make_samples(*(straight_elements(*lines, labels=[0, 2]) for _ in places))
    for number, (sample, place) in enumerate(zip(samples, places, strict=True)):
        meta = {"timestamp_ns": number, "can_bus": np.zeros(18)}
        if place is not None:
            town, scene, x = place
            meta |= {"map_name": town, "scene": scene, "lidar2global": pose_at(x)}
        sample.set_metainfo(meta)
    return samples
