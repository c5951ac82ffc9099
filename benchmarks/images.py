"""Speed of the image steps of nuScenes' pipelines: processor time, and samples per second."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from mmcv.transforms import Compose
from mmdet3d.registry import TRANSFORMS
from mmengine.dataset import pseudo_collate
from mmengine.registry import init_default_scope
from torch.utils.data import DataLoader, Dataset

import gsmap.registered  # noqa: F401
from gsmap.utils.errors import InputError

_CAMERAS = 6
_BATCH = 4  # samples of a batch of worker processes
# Steps of the pipelines. By default, images are converted to float32 directly after loading. With
# ``on_device``, they stay in uint8, and the later image steps are only recorded for the GPU.
_LOAD = {"type": "LoadCameraImages"}
_LOAD_UINT8 = {**_LOAD, "to_float32": False}
_LOAD_ON_DEVICE = {**_LOAD, "on_device": True}
_DISTORT = {"type": "DistortImages"}
_SCALE = {"type": "ScaleImages", "scale": 0.5}
_PACK = {"type": "PackMapInputs"}
PIPELINES = {
    "train": [_LOAD_UINT8, _DISTORT, _SCALE, _PACK],
    "train, images_on_device": [_LOAD_ON_DEVICE, _DISTORT, _SCALE, _PACK],
    "test": [_LOAD, _SCALE, _PACK],
    "test, images_on_device": [_LOAD_ON_DEVICE, _SCALE, _PACK],
}


class Frames(Dataset):
    """Data set that passes one frame of six images through a pipeline again and again.

    Args:
        files: Image files, one for each camera.
        pipeline: Key of ``PIPELINES``.
        count: Number of samples.
    """

    def __init__(self, files: Sequence[Path], pipeline: str, count: int) -> None:
        init_default_scope("mmdet3d")
        self.files = files
        self.pipeline = Compose([TRANSFORMS.build(step) for step in PIPELINES[pipeline]])
        self.count = count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, row: int) -> Any:
        cameras = {}
        for file in self.files:
            # The time of the steps does not depend on the values of the calibration.
            camera = {"img_path": str(file), "cam2img": np.eye(4), "lidar2cam": np.eye(4)}
            cameras[file.stem] = camera
        return self.pipeline({"images": cameras, "token": str(row), "cam_names": list(cameras)})


def measure_images(folder: Path, count: int = 10, workers: Sequence[int] = ()) -> dict[str, float]:
    """Measure the image steps of nuScenes' pipelines.

    Args:
        folder: Folder of six JPEG files or more, such as a frame of nuScenes; the first six are
            read.
        count: Number of samples of a measurement, >= 1. A measurement with worker processes reads
            this number for each of them.
        workers: Numbers of worker processes. The throughput of the training pipelines is measured
            with each of them.

    Returns:
        Measured values by name: for each pipeline, the processor time of one thread in milliseconds
        per sample; for each training pipeline and number of processes, the samples per second, in
        batches of four that are in pinned memory if there is a GPU.

    Raises:
        ValueError: If there are fewer than six images, or workers would measure no batch.
    """
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in (".jpg", ".jpeg"))
    if len(files) < _CAMERAS:
        raise InputError(f"{folder} has {len(files)} JPEG files: give a folder of six or more.")
    if workers and (count <= _BATCH or min(workers) < 1):
        # The first batch of each worker is not measured.
        raise InputError(f"--workers must be >= 1, with --samples of more than {_BATCH}.")
    # Let OpenCV and torch use one thread, so that processor time is the time of one process.
    cv2.setNumThreads(0)
    torch.set_num_threads(1)
    result = {}
    for name in PIPELINES:
        frames = Frames(files[:_CAMERAS], name, count=count)
        np.random.seed(0)  # noqa: NPY002  generator of mmdet's transforms
        frames[0]  # loads libraries and fills caches before the measurement
        start = time.process_time()
        for row in range(count):
            frames[row]
        result[f"{name}, ms a sample"] = 1e3 * (time.process_time() - start) / count
    for num_workers in workers:
        for name in ("train", "train, images_on_device"):
            frames = Frames(files[:_CAMERAS], name, count=count * num_workers)
            rate = _samples_per_second(frames, num_workers)
            result[f"{name}, samples/s, {num_workers} workers"] = rate
    return result


def _samples_per_second(frames: Frames, workers: int) -> float:
    """Measure the samples per second, after the first batch of every worker process."""
    loader = DataLoader(
        frames,
        batch_size=_BATCH,
        num_workers=workers,
        collate_fn=pseudo_collate,
        pin_memory=torch.cuda.is_available(),
    )
    num_samples = 0
    start = 0.0
    for num_batches, batch in enumerate(loader, start=1):
        if num_batches == workers:  # workers return batches in turn, so each has returned one
            start = time.perf_counter()
        elif num_batches > workers:
            num_samples += len(batch["data_samples"])
    return num_samples / (time.perf_counter() - start)
