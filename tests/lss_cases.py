"""A small LSS encoder with its inputs, which tests of it and of its depth loss share."""

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample

import gsmap.registered  # noqa: F401
from gsmap.models.encoders.lss import LSSEncoder
from gsmap.structures.grid import BEVGrid

GRID = BEVGrid((-4, 4), (-8, 8))
DEPTH_RANGE = (1.0, 7.0, 1.0)


def encoder(**settings) -> LSSEncoder:
    torch.manual_seed(0)
    config = {
        "type": "LSSEncoder",
        "grid": GRID,
        "z_range": (-5.0, 5.0),
        "bev_pixel_m": 2.0,
        "embed_dims": 8,
        "depth_range": DEPTH_RANGE,
        "aspp_channels": 4,
    }
    module = MODELS.build({**config, **settings})
    module.init_weights()
    return module.eval()


def meta(num_cams: int = 1) -> dict:
    """Cameras at the origin that look along y, f = 32 px, in images of 33 x 65 px."""
    lidar2cam = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    cam2img = np.eye(4)
    cam2img[:2, :3] = [[32, 0, 32], [0, 32, 16]]
    return {
        "token": "a",
        "batch_input_shape": (33, 65),
        "lidar2img": np.stack([cam2img @ lidar2cam] * num_cams),
        "lidar2cam": np.stack([lidar2cam] * num_cams),
        "cam2img": np.stack([cam2img] * num_cams),
        "img_aug_matrix": np.stack([np.eye(4)] * num_cams),
        "lidar2ego": np.eye(4),
    }


def feats(batch: int = 1, num_cams: int = 1) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(batch, num_cams, 8, 3, 5, generator=generator)


def sample_with_depth(depth_m: float) -> Det3DDataSample:
    sample = Det3DDataSample(metainfo={"token": "a"})
    sample.gt_depth = torch.full((1, 6, 10), depth_m)
    return sample
