"""Small parts of VectorMapNet, and samples of straight lines."""

import numpy as np
import torch
from mmdet3d.structures import Det3DDataSample
from mmengine.registry import init_default_scope

import gsmap.registered  # noqa: F401
from gsmap.datasets.annotations.record import MapInstance
from gsmap.models.vectormapnet.canvas import Canvas
from gsmap.models.vectormapnet.generator import PolylineGenerator
from gsmap.models.vectormapnet.head import VectorMapNetHead
from gsmap.models.vectormapnet.targets import FormatPolylineTargets
from gsmap.structures.grid import BEVGrid

GRID = BEVGrid((-30.0, 30.0), (-15.0, 15.0))
CLASSES = ("ped_crossing", "divider", "boundary")
LAYERS = {"num_layers": 2, "num_heads": 4, "ffn_dims": 32, "dropout": 0.0}
SIZES = {"in_channels": 8, "embed_dims": 16}
DETECTOR = {
    "type": "KeyPointHead",
    "num_queries": 6,
    "decoder": LAYERS,
    "coder": {"max_num": 4},
    **SIZES,
}
GENERATOR = {**LAYERS, **SIZES, "max_points": 6, "noise_share": 0.0}


def head(detector=DETECTOR, generator=GENERATOR, **settings) -> VectorMapNetHead:
    init_default_scope("mmdet3d")
    torch.manual_seed(0)
    built = VectorMapNetHead(GRID, CLASSES, detector, generator, **settings)
    built.init_weights()
    opened(built.generator)
    return built


def opened(generator: PolylineGenerator) -> PolylineGenerator:
    """Open the gates, so that the layers count."""
    for layer in generator.layers:
        for gate in layer.gates:
            torch.nn.init.constant_(gate, 0.7)
    return generator


def generator(**settings) -> PolylineGenerator:
    torch.manual_seed(0)
    built = PolylineGenerator(Canvas(GRID), len(CLASSES), **{**GENERATOR, **settings})
    built.init_weights()
    return opened(built).eval()


def transformed(*lines, labels=None, transform=None, **results):
    """Return a sample's targets."""
    labels = labels or [1] * len(lines)
    elements = [
        MapInstance(label, np.array(line, float)) for label, line in zip(labels, lines, strict=True)
    ]
    given = {"map_instances": elements, "token": "a", **results}
    given |= {"x_range": GRID.x_range, "y_range": GRID.y_range}
    return (transform or FormatPolylineTargets()).transform(given)["gt_instances_3d"]


def sample(*lines, token="token-0", **settings) -> Det3DDataSample:
    found = Det3DDataSample(metainfo={"token": token})
    found.gt_instances_3d = transformed(*lines, **settings)
    return found


def bev(batch=1, channels=8, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return {"bev_feats": torch.randn(batch, channels, 4, 8, generator=generator)}


BOXES = {
    "num_queries": 40,
    "in_channels": 96,
    "embed_dims": 64,
    "decoder": {"num_layers": 2, "num_heads": 4, "ffn_dims": 64},
    "coder": {"max_num": 200},
}
EXPORTS = {
    "boxes": (
        "configs/vectormapnet/vectormapnet_r18_minicity.py",
        {"model.map_head": {"_delete_": True, "type": "KeyPointHead", **BOXES}},
    )
}
EXPORT_SIZES: dict[str, dict[str, object]] = {"boxes": {}}
EXPORT_CLASS_FACTOR = 0.003  # shaken states that no norm ends make every score 1

TARGETS = ({"canvas": {"margin_m": 3.0}}, {"margin_m": 3.0})

TRANSFORM_CASES = {
    "FormatPolylineTargets": {"changes": {"gt_instances_3d"}, "needs_truth": True},
    "StretchToPadding": {"changes": {"lidar2img", "img_aug_matrix"}},
}

ANY_NUMBER = True  # lines have no equal numbers of points


def check_targets(head, steps) -> None:
    """Lines have as many points as they need, so that no step of targets has their number."""
    assert not steps
