"""A tiny MapTR on a tiny config of the project, with cameras and ground truth, for fast tests."""

from pathlib import Path

import torch
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.config import Config
from mmengine.registry import init_default_scope
from mmengine.structures import InstanceData

import gsmap.registered  # noqa: F401
from benchmarks.model import ring_of_cameras

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
IMAGE_SHAPE = (64, 96)
NUM_CAMS = 6


def small_config() -> dict:
    """Return MiniCity's MapTR with few channels, queries and cells."""
    cfg = Config.fromfile(CONFIGS / "maptr/maptr_r18_minicity.py", import_custom_modules=False)
    del cfg.model.map_head["aux_heads"]
    heads = {"num_heads": 4, "ffn_dims": 16}
    overrides = {
        "img_backbone": {"base_channels": 8},
        "img_neck": {"in_channels": [16, 32, 64], "out_channels": [8, 4, 4]},
        "bev_encoder": {
            "embed_dims": 16,
            "bev_pixel_m": 5.0,
            "layer_cfg": {"num_heads": 4, "ffn_dims": 16},
        },
        "map_head": {
            "query_groups": [{"num": 8}],
            "embed_dims": 16,
            "decoder": {"num_layers": 2, "layer": heads},
            "coder": {"max_num": 8},
        },
    }
    cfg.merge_from_dict({"model": overrides})
    return cfg.model


def build_small(seed: int = 0, **overrides) -> torch.nn.Module:
    """Build the tiny model with reproducible weights; ``overrides`` replace parts of its config."""
    init_default_scope("mmdet3d")
    torch.manual_seed(seed)
    model = MODELS.build({**small_config(), **overrides})
    model.init_weights()
    return model


def disable_dropout(model: torch.nn.Module) -> torch.nn.Module:
    """Set every dropout of a model to zero, also inside of attentions; return the model."""
    for part in model.modules():
        if isinstance(part, torch.nn.Dropout):
            part.p = 0.0
        elif isinstance(part, torch.nn.MultiheadAttention):
            part.dropout = 0.0
    return model


def straight_elements(*lines, labels=None, num_points: int = 20) -> InstanceData:
    """Return the targets of straight lines ((x0, y0), (x1, y1)) in metres, two orders each."""
    ends = torch.tensor(lines, dtype=torch.float32).view(-1, 2, 2)
    steps = torch.linspace(0, 1, num_points)[:, None]
    pts = ends[:, :1] * (1 - steps) + ends[:, 1:] * steps
    if labels is None:
        labels = [0] * len(pts)
    return InstanceData(
        labels_3d=torch.tensor(labels, dtype=torch.long),
        pts=pts,
        pts_shifts=torch.stack([pts, pts.flip(1)], 1),
        boxes=torch.cat([pts.amin(1), pts.amax(1)], -1),
        polylines=ends,
        closed=torch.zeros(len(pts), dtype=torch.bool),
    )


def make_samples(*ground_truths: InstanceData) -> list[Det3DDataSample]:
    """Return one sample per ground truth, with tokens ``token-0``, ``token-1`` and so on."""
    samples = []
    for number, ground_truth in enumerate(ground_truths):
        sample = Det3DDataSample(
            metainfo={
                "token": f"token-{number}",
                "lidar2img": ring_of_cameras(NUM_CAMS, *IMAGE_SHAPE),
            }
        )
        sample.gt_instances_3d = ground_truth
        samples.append(sample)
    return samples


def make_images(batch: int) -> dict[str, torch.Tensor]:
    """Return normalised random images."""
    return {"imgs": torch.randn(batch, NUM_CAMS, 3, *IMAGE_SHAPE)}
