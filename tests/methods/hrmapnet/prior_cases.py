"""A tiny MapTR with a raster prior."""

import torch
from model_cases import build_small

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
