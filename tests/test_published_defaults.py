"""The settings of each method's config against the numbers that its paper or release prints.

A setting that no number is known of is not here.
"""
# Over 400 lines: one table of all papers is easier to check against them than parts of it.

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.registry import init_default_scope
from torch import nn

import gsmap.registered  # noqa: F401
from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.raster_ap import MIN_SCORE, RasterConfig
from gsmap.models.bemapnet.head import BezierHead
from gsmap.models.bemapnet.losses import BezierLosses
from gsmap.models.bemapnet.targets import FormatBezierTargets
from gsmap.models.hdmapnet.encoder import ViewTransformEncoder
from gsmap.models.hdmapnet.losses import LineMapLosses
from gsmap.models.hdmapnet.targets import MakeLineMaps
from gsmap.models.pivotnet.head import PivotHead
from gsmap.models.pivotnet.losses import PivotLosses
from gsmap.models.pivotnet.targets import FormatPivotTargets
from gsmap.models.streams.memory import StreamMemory
from gsmap.models.vectormapnet.targets import FormatPolylineTargets
from gsmap.structures.grid import BEVGrid

REPO = Path(__file__).resolve().parents[1]
GSMAP = "../projects/GSMap/configs/"

SCHEDULE = {  # MapTR's, which all others took over
    "optim_wrapper.optimizer": {"type": "AdamW", "lr": 6e-4, "weight_decay": 0.01},
    "optim_wrapper.paramwise_cfg.custom_keys.img_backbone.lr_mult": 0.1,
    "optim_wrapper.clip_grad.max_norm": 35,
    "param_scheduler.0.start_factor": 1 / 3,
    "param_scheduler.0.end": 500,
    "param_scheduler.1.type": "CosineAnnealingLR",
    "param_scheduler.1.eta_min_ratio": 1e-3,
    "train_cfg.max_epochs": 24,
    "train_dataloader.batch_size": 4,
}
NUSCENES = {"grid.x_range": (-15.0, 15.0), "grid.y_range": (-30.0, 30.0)}
CAMERAS = {  # GKT
    "model.bev_encoder.cross_attn": {
        "type": "GeometryKernelAttention",
        "num_heads": 4,
        "kernel_size": (3, 5),
    },
    "model.bev_encoder.z_range": (-2.0, 2.0),
    "model.bev_encoder.bev_pixel_m": 0.3,  # 200 x 100 cells
    "model.bev_encoder.num_layers": 1,
}
DEPTH = {  # LSS of MapTRv2
    "model.bev_encoder.type": "LSSEncoder",
    "model.bev_encoder.z_range": (-10.0, 10.0),
    "model.bev_encoder.depth_range": (1.0, 35.0, 0.5),
}
MAPQR = {  # GKT-h
    "model.bev_encoder.cross_attn": {
        "type": "HeightKernelAttention",
        "num_heads": 8,
        "kernel_size": (2, 4),
    },
    "model.bev_encoder.z_range": (-2.0, 2.0),
    "model.bev_encoder.bev_pixel_m": 0.3,
    "model.bev_encoder.num_layers": 3,
    "model.bev_encoder.layer_cfg": {"num_heads": 8, "ffn_dims": 512, "dropout": 0.1},
    "model.map_head.coder.max_num": 50,
}
GEMAP = {**SCHEDULE, "optim_wrapper.optimizer.weight_decay": 0.03}
MGMAPNET = {**SCHEDULE, "train_dataloader.batch_size": 2}
STREAMMAPNET = {
    **SCHEDULE,
    "optim_wrapper.optimizer.lr": 5e-4,
    "param_scheduler.1.eta_min_ratio": 3e-3,
    "train_dataloader.sampler.slots": 4,
    "model.data_preprocessor.mean": [103.53, 116.28, 123.675],
    "model.bev_encoder.z_range": pytest.approx((-11 / 3, 17 / 3)),  # slices at -2.5 to 4.5 m
    "model.temporal": {"bev": {}, "queries": {"num": 33}},
    "sync_bn": "torch",
}
CONFIGS: dict[str, dict[str, Any]] = {
    "maptr/maptr_r50_24e.py": {**SCHEDULE, **NUSCENES, **CAMERAS},
    "maptr/maptr_r50_110e.py": {**SCHEDULE, "train_cfg.max_epochs": 110},
    "maptr/maptr_r50_av2_6e.py": {
        "train_dataloader.dataset.rate_hz": 10.0,  # every sweep
        "grid.x_range": (-30.0, 30.0),
        "grid.y_range": (-15.0, 15.0),
        "train_cfg.max_epochs": 6,
    },
    "maptr/maptr_r18_nano_110e.py": {
        "optim_wrapper.optimizer.lr": 4e-3,
        "optim_wrapper.clip_grad.max_norm": 50,
        "train_dataloader.batch_size": 24,
        "model.map_head.query_groups": [{"num": 100}],
        "model.map_head.decoder.num_layers": 2,
    },
    "maptrv2/maptrv2_r50_24e.py": {**SCHEDULE, **NUSCENES, **DEPTH},
    "mapvr/mapvr_r50_24e.py": {**SCHEDULE, **CAMERAS, "model.bev_encoder.layer_cfg.dropout": 0.0},
    "gemap/gemap_simple_r50_110e.py": {**GEMAP, **CAMERAS, "train_cfg.max_epochs": 110},
    "gemap/gemap_full_r50_110e.py": {**GEMAP, **DEPTH, "train_cfg.max_epochs": 110},
    "gemap/gemap_full_v299_110e.py": {"train_dataloader.batch_size": 3},
    "gemap/gemap_full_swint_110e.py": {
        "optim_wrapper.optimizer.lr": 4e-4,
        "train_dataloader.batch_size": 3,
    },
    "mgmapnet/mgmapnet_r50_110e.py": {
        **MGMAPNET,
        **DEPTH,
        "optim_wrapper.optimizer.lr": 4e-4,
        "train_cfg.max_epochs": 110,
    },
    "mapqr/mapqr_r50_24e.py": {**SCHEDULE, **NUSCENES, **MAPQR, "train_cfg.val_interval": 4},
    "mapqr/mapqr_r50_110e.py": {**SCHEDULE, **MAPQR, "train_cfg.max_epochs": 110},
    "mapqr/mapqr_r50_masked_24e.py": {"model.map_head.decoder.layer.mask_groups": True},
    "mapqr/mapqr_r50_av2_6e.py": {
        **SCHEDULE,
        **MAPQR,
        "grid.x_range": (-30.0, 30.0),
        "grid.y_range": (-15.0, 15.0),
        "model.bev_encoder.z_range": (-5.0, 3.0),
        "model.bev_encoder.num_cams": 7,
        "param_scheduler.0.end": 200,
        "train_cfg.max_epochs": 6,
        "train_cfg.val_interval": 1,
    },
    "mgmap/mgmap_r50_30e.py": {
        **SCHEDULE,
        **NUSCENES,
        **CAMERAS,
        "optim_wrapper.optimizer.lr": 3e-4,
        "train_cfg.max_epochs": 30,
        "train_cfg.val_interval": 6,
        "auto_scale_lr.base_batch_size": 8,
        "find_unused_parameters": True,
        "model.map_head.decoder.patches": False,
        "train_dataloader.dataset.pipeline.4": {
            "type": "MakeInstanceMasks",
            "size": (200, 100),
            "mirrored": True,
        },
    },
    "pivotnet/pivotnet_r50_30e.py": {
        **NUSCENES,
        "optim_wrapper.optimizer": {"type": "AdamW", "lr": 2e-4, "weight_decay": 0.01},
        "optim_wrapper.paramwise_cfg.custom_keys.img_backbone.lr_mult": 0.25,
        "param_scheduler.0.milestones": [21, 27],
        "param_scheduler.0.gamma": 0.2,
        "train_cfg.max_epochs": 30,
        "train_dataloader.batch_size": 1,
        "auto_scale_lr.base_batch_size": 8,
        "model.data_preprocessor.bgr_to_rgb": False,
        "model.map_head.queries": ((20, 10), (25, 2), (15, 30)),
    },
    "hdmapnet/hdmapnet_effb0_30e.py": {
        "grid.x_range": (-30.0, 30.0),  # the vehicle's frame
        "grid.y_range": (-15.0, 15.0),
        "optim_wrapper.optimizer": {"type": "Adam", "lr": 1e-3, "weight_decay": 1e-7},
        "optim_wrapper.clip_grad.max_norm": 5,
        "param_scheduler.0.step_size": 10,
        "param_scheduler.0.gamma": 0.1,
        "train_cfg.max_epochs": 30,
        "train_dataloader.batch_size": 4,
        "model.data_preprocessor.mean": [123.675, 116.28, 103.53],
        "model.bev_encoder.image_size": (128, 352),
        "train_dataloader.dataset.pipeline.1.size": (352, 128),
    },
    "pivotnet/pivotnet_r50_110e.py": {
        "train_cfg.max_epochs": 110,
        "param_scheduler.0.milestones": [77, 99],
    },
    "vectormapnet/vectormapnet_r50_130e.py": {
        "grid.x_range": (-30.0, 30.0),  # the vehicle's frame
        "grid.y_range": (-15.0, 15.0),
        "classes": ["ped_crossing", "divider", "boundary"],
        "optim_wrapper.optimizer": {"type": "AdamW", "lr": 1e-3, "weight_decay": 0.01},
        "optim_wrapper.paramwise_cfg.custom_keys.img_backbone.lr_mult": 0.1,
        "optim_wrapper.clip_grad.max_norm": 0.5,
        "param_scheduler.0.start_factor": 0.1,
        "param_scheduler.0.end": 400,
        "param_scheduler.1.milestones": [100, 120],
        "train_cfg.max_epochs": 130,
        "train_dataloader.batch_size": 5,
        "train_dataloader.dataset.pipeline.1.size": (455, 256),
        "train_dataloader.dataset.pipeline.2.type": "StretchToPadding",
        "model.data_preprocessor.mean": [103.53, 116.28, 123.675],
        "model.data_preprocessor.std": [1.0, 1.0, 1.0],
        "model.data_preprocessor.bgr_to_rgb": False,
        "model.img_backbone.stage_with_dcn": (False, False, True, True),
        "model.bev_encoder.heights_m": (-1.1, 0.0, 0.5, 1.1),
        "model.map_head.generator.redraw": True,
    },
    "bemapnet/bemapnet_r50_30e.py": {
        **NUSCENES,
        "optim_wrapper.optimizer": {"type": "AdamW", "lr": 2e-4, "weight_decay": 0.01},
        "optim_wrapper.paramwise_cfg.custom_keys.img_backbone.lr_mult": 0.25,
        "param_scheduler.0.milestones": [21, 27],
        "param_scheduler.0.gamma": 1 / 3,
        "train_cfg.max_epochs": 30,
        "train_dataloader.batch_size": 1,
        "auto_scale_lr.base_batch_size": 8,
        "model.data_preprocessor.bgr_to_rgb": False,
        "model.img_backbone.frozen_stages": 1,
    },
    "bemapnet/bemapnet_r50_110e.py": {
        "train_cfg.max_epochs": 110,
        "param_scheduler.0.milestones": [77, 99],
    },
    "streammapnet/streammapnet_r50_24e.py": {
        **STREAMMAPNET,
        "grid.x_range": (-30.0, 30.0),  # the vehicle's frame
        "grid.y_range": (-15.0, 15.0),
        "model.bev_encoder.bev_pixel_m": 0.6,  # 100 x 50 cells
        "train_cfg.max_epochs": 24,
        "train_dataloader.sampler.single_frame_iters": 3480,
    },
    "streammapnet/streammapnet_r50_100x50_24e.py": {
        **STREAMMAPNET,
        "train_cfg.max_epochs": 24,
        "grid.x_range": (-50.0, 50.0),
        "model.bev_encoder.bev_pixel_m": 1.0,
        "test_evaluator.thresholds": [1.0, 1.5, 2.0],
    },
    "streammapnet/streammapnet_r50_single_30e.py": {
        "model.temporal": None,
        "model.map_head.loss_cls.loss_weight": 4.0,
        "model.map_head.match_costs.0.weight": 4.0,
        "train_cfg.max_epochs": 30,
    },
    "streammapnet/streammapnet_r50_av2_30e.py": {
        **STREAMMAPNET,
        "model.bev_encoder.num_cams": 7,
        "train_dataloader.dataset.rate_hz": 2.0,
        "train_dataloader.dataset.pipeline.2.size": (608, 608),
        "train_dataloader.sampler.single_frame_iters": 3750,
        "train_cfg.max_epochs": 30,
    },
    "streammapnet/streammapnet_r50_av2_100x50_30e.py": {
        "train_dataloader.dataset.pipeline.2.size": (640, 640),
        "train_cfg.max_epochs": 30,
    },
    f"{GSMAP}gsmap_maptr_r50_24e.py": {**SCHEDULE, **NUSCENES, **CAMERAS},
    f"{GSMAP}gsmap_maptr_r50_110e.py": {**SCHEDULE, "train_cfg.max_epochs": 110},
    f"{GSMAP}gsmap_maptr_r50_av2_6e.py": {
        **SCHEDULE,
        "train_cfg.max_epochs": 6,
        "train_dataloader.batch_size": 6,
    },
}

# the built head: queries of each group, weights of losses by name, weights of costs in order
MAPTR = {"queries": [50], "losses": {"pts": 5.0, "dir": 0.005}, "costs": [2.0, 5.0]}
MASKS = {"seg": 1.0, "pv_seg": 2.0, "depth": 3.0}
HEADS: dict[str, dict[str, Any]] = {
    "maptr/maptr_r50_24e.py": MAPTR,
    "maptrv2/maptrv2_r50_24e.py": {**MAPTR, "queries": [50, 300], "aux": MASKS},
    "mapvr/mapvr_r50_24e.py": {
        "queries": [50],
        "losses": {"pts": 1.0, "dir": 0.002, "dice": 15.0},
        "costs": [2.0, 1.0, 10.0],
    },
    "gemap/gemap_simple_r50_110e.py": {
        **MAPTR,
        "losses": {"pts": 5.0, "dir": 0.005, "euclidean": 0.005},
    },
    "gemap/gemap_full_r50_110e.py": {
        **MAPTR,
        "losses": {"pts": 5.0, "dir": 0.005, "euclidean": 0.005},
        "aux": MASKS,
    },
    "mgmapnet/mgmapnet_r50_110e.py": {
        "queries": [100, 600],
        "losses": {"pts": 5.0, "dir": 0.005, "mean_loc": 5.0, "ins_seg": 3.0},
        "costs": [2.0, 5.0],
        "aux": {"seg": 3.0, "pv_seg": 2.0, "depth": 3.0},
    },
    "mapqr/mapqr_r50_24e.py": {
        **MAPTR,
        "queries": [100, 600],
        "aux": {"seg": 1.0, "pv_seg": 2.0},
    },
    "mgmap/mgmap_r50_30e.py": {
        **MAPTR,
        "losses": {"pts": 5.0, "dir": 0.005, "ins": 1.0, "seg": 1.0},
    },
    f"{GSMAP}gsmap_maptr_r50_24e.py": {
        "queries": [50],
        "losses": {"pts": 5.0, "dir": 0.005, "raster": 10.0},
        "costs": [2.0, 5.0, 2.0],  # the paper names no weight of the IoU cost: ours
    },
}


@cache
def load(name: str) -> Config:
    """Return a config that all tests share; none changes it."""
    return Config.fromfile(REPO / "configs" / name, import_custom_modules=False)


@cache
def head_of(name: str) -> nn.Module:
    """Return a config's head, which all tests share; none changes it."""
    init_default_scope("mmdet3d")
    cfg = load(name)
    shared = {"grid": BEVGrid(**cfg.grid), "classes": cfg.classes}
    return MODELS.build({**shared, **cfg.model.map_head})


def setting(cfg: Any, path: str) -> Any:
    for key in path.split("."):
        cfg = cfg[int(key)] if key.isdecimal() else cfg[key]
    return cfg


def cases() -> Iterator[tuple[str, str, Any]]:
    for name, settings in CONFIGS.items():
        for path, value in settings.items():
            if path != "optim_wrapper.optimizer":
                yield name, path, value
                continue
            for key, part in value.items():
                if f"{path}.{key}" not in settings:
                    yield name, f"{path}.{key}", part


@pytest.mark.parametrize(("name", "path", "value"), cases())
def test_a_config_says_what_was_published(name: str, path: str, value: Any):
    found = setting(load(name), path)
    assert (tuple(found) if isinstance(value, tuple) else found) == value


@pytest.mark.parametrize("name", HEADS)
def test_a_head_has_the_published_queries_and_weights(name: str):
    head, published = head_of(name), HEADS[name]
    assert [group.num for group in head.query_groups] == published["queries"]
    assert {name: loss.loss_weight for name, loss in head.losses.items()} == published["losses"]
    assert [cost.weight for cost in head.assigner.match_costs] == published["costs"]
    weights = {name: aux.loss_weight for name, aux in head.aux_heads.items()}
    assert weights == published.get("aux", {})
    focal = head.loss_cls
    assert (focal.loss_weight, focal.alpha, focal.gamma) == (2.0, 0.25, 2.0)
    assert (head.num_points, head.embed_dims, len(head.decoder.layers)) == (20, 256, 6)


def test_mgmaps_masks_and_refinement_weigh_as_published():
    head = head_of("mgmap/mgmap_r50_30e.py")
    assert (head.losses["ins"].dice_weight, head.losses["seg"].dice_weight) == (2.0, 15.0)
    assert head.losses["seg"].pos_weight == 4.0
    assert head.decoder.branches == [0, 1, 2, 3, 4, 5, 4, 5]
    attention, stage = head.decoder.layers[0].cross_attn, head.decoder.refinements[0].layer
    assert (attention.num_parts, attention.num_points, attention.num_heads) == (4, 16, 8)
    assert (stage.linear1.out_features, stage.self_attn.num_heads) == (1024, 8)


def test_mapqr_scatters_and_masks_as_published():
    head = head_of("mapqr/mapqr_r50_24e.py")
    layer = head.decoder.layers[0]
    assert not layer.mask_groups
    assert (layer.cross_attn.num_heads, layer.cross_attn.num_points) == (8, 4)
    gather = [part.out_features for part in layer.cross_attn.output_proj if hasattr(part, "bias")]
    assert gather == [2560, 256, 256]
    assert (layer.ffn.feedforward_channels, layer.cross_attn.dropout.p) == (512, 0.1)
    masks = head.aux_heads
    assert (masks["seg"].pos_weight, masks["pv_seg"].pos_weight) == (4.0, 1.0)


def test_streammapnets_head_and_memory_weigh_as_released():
    """Section 3 and 4 of the release's description: 5 and 50 for classes and lines, 0.1 x 50."""
    cfg, head = (of("streammapnet/streammapnet_r50_24e.py") for of in (load, head_of))
    assert [group.num for group in head.query_groups] == [100]
    assert [(loss.loss_weight, loss.beta) for loss in head.losses.values()] == [(50.0, 0.01)]
    assert [cost.weight for cost in head.assigner.match_costs] == [5.0, 50.0]
    assert (head.loss_cls.loss_weight, head.loss_cls.alpha, head.loss_cls.gamma) == (5.0, 0.25, 2.0)
    assert (head.num_points, head.embed_dims, len(head.decoder.layers)) == (20, 512, 6)
    attention = head.decoder.layers[0].cross_attn
    assert (attention.num_heads, attention.num_points) == (8, 20)
    assert head.coder.max_num == 100
    memory = StreamMemory(head, **cfg.model.temporal)
    assert (memory.bev.end_points, memory.bev.kept_dims, memory.half) == (False, None, False)
    queries = memory.queries
    assert (queries.num, queries.loss_weight, queries.beta) == (33, 5.0, 0.01)
    released = load("streammapnet/streammapnet_r50_released_24e.py")
    assert released.model.temporal.bev.end_points
    assert released.model.bev_encoder.mirrored_self_attn
    assert released.train_dataloader.sampler.late_switch


@pytest.mark.parametrize(
    "name",
    ["maptrv2/maptrv2_r50_24e.py", "mgmapnet/mgmapnet_r50_110e.py", "mapqr/mapqr_r50_24e.py"],
)
def test_each_element_is_matched_six_times_by_the_further_queries(name: str):
    first, further = head_of(name).query_groups
    assert (first.repeats, further.repeats, further.weight) == (1, 6, 1.0)


def test_masks_of_maptrv2_and_mgmapnet_weigh_as_published():
    maptrv2 = head_of("maptrv2/maptrv2_r50_24e.py").aux_heads
    assert (maptrv2["seg"].pos_weight, maptrv2["seg"].dice_weight) == (4.0, 0.0)
    assert maptrv2["pv_seg"].pos_weight == 1.0
    head = head_of("mgmapnet/mgmapnet_r50_110e.py")
    assert (head.aux_heads["seg"].pos_weight, head.aux_heads["seg"].dice_weight) == (1.0, 3.0)
    assert head.losses["ins_seg"].dice_weight == 3.0
    assert head.losses["ins_seg"].last_layer_only
    assert head.losses["ins_seg"].first_group_only


def test_gsmap_renders_and_weighs_as_in_its_paper():
    """Section 4.1: rasters of 200 x 100; Eq. 12 with 3DGS's weights and SSIM's usual window."""
    head = head_of(f"{GSMAP}gsmap_maptr_r50_24e.py")
    assert (head.masks.grid.height, head.masks.grid.width) == (200, 100)
    assert head.losses["raster"].settings == {
        "alpha": 0.8,
        "foreground_weight": 1.0,
        "normalize": "both",
        "window_size": 11,
        "window_sigma": 1.5,
    }
    assert not head.losses["raster"].last_layer_only
    space = head.reference.space
    assert (space.min_scale_m, space.init_scales_m) == (0.15, (1.0, 0.4))  # half a pixel, and ours


def test_mapvr_renders_as_released():
    head = head_of("mapvr/mapvr_r50_24e.py")
    loss, cost = head.losses["dice"].renderer, head.assigner.match_costs[-1].renderer
    assert (loss.size, cost.size) == ((256, 128), (128, 64))
    for renderer in (loss, cost):
        assert (renderer.line_softness, renderer.polygon_softness) == (2.0, 4.0)
        assert (renderer.polygon_classes, renderer.distance) == ((1,), "squared")
    assert all(part.p == 0 for part in head.modules() if isinstance(part, nn.Dropout))


def test_pivotnet_weighs_as_released():
    head = head_of("pivotnet/pivotnet_r50_30e.py")
    assert head.losses == PivotLosses(
        cls=2.0, mask=5.0, pivots=30.0, collinear=10.0, point_cls=2.0, semantic=3.0, end_weight=5.0,
        none_weight=0.5, between_weight=0.2, point_cls_per_line=True,
    )  # fmt: skip
    assert head.layer_weights == (0.4, 0.4, 0.4, 0.8, 1.2, 1.6)
    assert PivotHead.level_weights == (0.4, 0.8, 1.6, 2.4)
    assert head.mask_size == (400, 200)
    targets = FormatPivotTargets()
    assert (targets.num_points, targets.edge_classes) == ((10, 2, 30), (1,))
    assert (targets.pixel_m, targets.thickness_px) == (0.15, 8)
    assert (targets.step_m, targets.min_area_m2) == (1.0, 2.0)
    assert not targets.keep_end
    assert not targets.sort_rings


def test_vectormapnet_weighs_and_draws_as_released():
    head = head_of("vectormapnet/vectormapnet_r50_130e.py")
    detector, generator, targets = head.detector, head.generator, FormatPolylineTargets()
    assert (detector.box_weight, detector.giou_weight, head.loss_weight) == (0.1, 1.0, 1.0)
    assert (detector.loss_cls.loss_weight, detector.cost_cls.weight) == (2.0, 2.0)
    assert (detector.elements.num_embeddings, detector.coder.max_num) == (120, 35)
    assert (detector.coder.margin_m, detector.coder.score_threshold) == (None, None)
    assert len(detector.layers) == len(generator.layers) == 6
    layers = detector.layers[0], generator.layers[0]
    assert [layer.self_attn.num_heads for layer in layers] == [8, 8]
    assert [layer.self_attn.dropout for layer in layers] == [0.1, 0.2]
    assert layers[0].ffn.feedforward_channels == layers[1].ffn[0].out_features == 512
    assert (layers[0].cross_attn.num_heads, layers[0].cross_attn.num_points) == (8, 4)
    assert (generator.top_p, generator.max_points, generator.redraw) == (0.9, 64, True)
    noise = generator.noise_share, generator.noise_px, generator.box_noise_by_x
    assert noise == (0.3, (2.0, 1.0), True)
    canvas = head.canvas
    assert (canvas.size, canvas.num_tokens, canvas.margin_m) == ((200, 100), 201, 2.0)
    assert (targets.pixel_m, targets.margin_m, targets.tolerance_m) == (0.3, 2.0, 0.2)
    assert (targets.smallest_box, targets.border_px) == (0.02, 0.1)
    assert targets.edge_classes == (2,)


def test_bemapnet_weighs_as_released():
    head = head_of("bemapnet/bemapnet_r50_30e.py")
    assert head.losses == BezierLosses(
        cls=2.0, mask=5.0, controls=5.0, pieces=2.0, curve=10.0, recovery=1.0, semantic=0.5,
        none_weight=0.5, mask_points=20000, redrawn_in_px=True,
    )  # fmt: skip
    assert head.layer_weights == (0.4, 0.4, 0.4, 0.8, 1.2, 1.6)
    assert BezierHead.level_weights == (0.5, 0.8, 1.2, 1.8)
    assert (head.mask_size, head.bev_size) == ((400, 200), (200, 100))
    assert tuple(head.queries) == (20, 25, 15)
    assert [curve.weights.shape[-1] for curve in head.curves] == [7, 2, 22]
    targets = FormatBezierTargets()
    assert (targets.degrees, targets.pieces) == ((2, 1, 3), (3, 1, 7))
    assert (targets.edge_classes, targets.max_error_m) == ((1,), 0.1)
    assert (targets.pixel_m, targets.thickness_px, targets.step_m) == (0.15, 8, 1.0)
    assert not targets.sort_rings


def test_hdmapnet_weighs_and_draws_as_released():
    head, targets = head_of("hdmapnet/hdmapnet_effb0_30e.py"), MakeLineMaps()
    assert head.losses == LineMapLosses(1.0, 1.0, 1.0, 0.2, 2.13, 0.5, 3.0)
    assert [maps[-1].out_channels for maps in head.decoder.maps] == [4, 16, 37]
    assert len(head.decoder.joined) == 2  # directions have no block of their own
    assert head.map_size == (200, 400)
    assert (targets.pixel_m, targets.thickness_px, targets.gap_px) == (0.15, 5, 9)
    assert (targets.step_m, targets.num_directions) == (1.0, 36)
    assert ViewTransformEncoder(head.grid, num_cams=0).released_units


def test_detections_are_chosen_as_by_maptr():
    coder = head_of("maptr/maptr_r50_24e.py").coder
    assert (coder.max_num, coder.margin_m, coder.score_threshold) == (50, 5.0, None)


def test_the_metrics_have_their_published_rules():
    classes = ("divider", "ped_crossing", "boundary")
    chamfer, raster = ChamferConfig(classes), RasterConfig(classes)
    assert (chamfer.thresholds, chamfer.num_points) == ((0.5, 1.0, 1.5), 100)
    assert (raster.size_px, raster.dilation_px, MIN_SCORE) == ((240, 480), 5, 0.05)
    lines, polygons = raster.thresholds["divider"], raster.thresholds["ped_crossing"]
    assert lines == pytest.approx((0.25, 0.3, 0.35, 0.4, 0.45, 0.5))
    assert polygons == pytest.approx((0.5, 0.55, 0.6, 0.65, 0.7, 0.75))
