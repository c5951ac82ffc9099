"""A small MapTR with random weights, and generated samples for it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from mmengine.config import Config

from gsmap.apis.map_inferencer import MapInferencer
from gsmap.datasets.annotations.record import CameraRecord, LidarRecord, MapSample

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
NAMES = ("CAM_FRONT", "CAM_BACK")


def make_config():
    cfg = Config.fromfile(CONFIGS / "_base_/default_runtime.py")
    cfg.model = Config.fromfile(CONFIGS / "maptr/maptr_r18_minicity.py").model
    del cfg.model.map_head["aux_heads"]
    cfg.merge_from_dict(
        {
            "model.bev_encoder.num_cams": 2,
            "model.bev_encoder.bev_pixel_m": 6.0,
            "model.img_backbone.base_channels": 8,
            "model.img_neck.in_channels": [16, 32, 64],
            "model.map_head.query_groups": [{"num": 6}],
            "model.map_head.coder.max_num": 6,
            "visualizer.width_px": 400,
            "test_dataloader": {
                "dataset": {
                    "type": "VectorizedMapDataset",
                    "ann_file": "none.arrow",
                    "frame": "lidar",
                    "split": "val",
                    "cameras": list(NAMES),
                    "pipeline": [
                        {"type": "LoadCameraImages"},
                        {"type": "ScaleImages", "scale": 0.5},
                        {"type": "PackMapInputs"},
                    ],
                }
            },
        }
    )
    return cfg


def camera(folder, name, token, seed):
    path = folder / f"{token}_{name}.jpg"
    pixels = np.random.default_rng(seed).integers(0, 255, (12, 20, 3), dtype=np.uint8)
    image = cv2.resize(pixels, (320, 180), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(path), image)
    sign = 1 if name == "CAM_FRONT" else -1
    cam_from_frame = np.eye(4)
    cam_from_frame[:3, :3] = [[sign, 0, 0], [0, 0, -1], [0, sign, 0]]
    intrinsics = np.array([[250.0, 0, 160], [0, 250, 90], [0, 0, 1]])
    return CameraRecord(name, path.name, 320, 180, intrinsics, cam_from_frame)


def make_samples(folder, count=3):
    points = np.array([[1, 2, -1.8, 0, 0], [3, 4, -1.8, 0, 0]], np.float32)
    points.tofile(folder / "sweep.bin")
    shifted = np.eye(4)
    shifted[0, 3] = 10
    return [
        MapSample(
            token=f"t{i}",
            scene="scene",
            map_name="",
            timestamp_ns=i,
            cameras=[camera(folder, name, f"t{i}", 10 * i + j) for j, name in enumerate(NAMES)],
            global_from_frame=np.eye(4),
            lidar=LidarRecord("sweep.bin", shifted),
        )
        for i in range(count)
    ]


def drive(folder, count=4, scene="scene"):
    """Return samples of one drive, 2 m and half a second apart."""
    return [
        replace(
            sample,
            token=f"{scene}{i}",
            scene=scene,
            timestamp_ns=i * 500_000_000,
            global_from_frame=np.array(
                [[1, 0, 0, 0], [0, 1, 0, 2.0 * i], [0, 0, 1, 0], [0, 0, 0, 1]]
            ),
        )
        for i, sample in enumerate(make_samples(folder, count))
    ]


def make_remembering() -> MapInferencer:
    """Return the small model with memory."""
    cfg = make_config()
    temporal = {"bev": {}, "queries": {"num": 2}, "embed_dims": 128}
    cfg.merge_from_dict({"model.temporal": temporal})
    torch.manual_seed(0)
    return MapInferencer(cfg, None, device="cpu")
