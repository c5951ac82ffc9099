"""Test data sets that are built by a config from samples of any source."""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mmdet3d.registry import DATASETS
from mmengine.config import Config

from gsmap.checkpoints.building import building
from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import CLASSES, AnnotationMeta, MapSample
from gsmap.datasets.source import Mount, Source, change_frame
from gsmap.engine.map_agreement import check_map_agreement

if TYPE_CHECKING:
    from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset

INFERENCE_COMMAND = "tools/infer.py"  # in the metadata of annotation files for inference
_MAX_SAMPLES = 100  # number of samples that are searched for the names of cameras


def open_dataset(
    cfg: Config, source: Source, mount: Mount, ann_file: Path
) -> "VectorizedMapDataset":
    """Open samples as the test data set of a config, with the pipeline of the config.

    Samples in another annotation frame are transformed to the annotation frame of the model, if
    the config names it. If the samples have no camera of the config, all of their cameras are used.

    Args:
        cfg: Config of the model.
        source: The samples.
        mount: Annotation frame of the model, and its place in the vehicle. It is not used if the
            config names no frame.
        ann_file: File to which samples are written. Nothing is written if ``source`` is an
            annotation file in the annotation frame of the model.

    Returns:
        The data set in test mode. It reads ``ann_file``, or the annotation file of ``source``.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If the samples cannot be used with this config.
    """
    settings: dict[str, Any] = dict(cfg.test_dataloader.dataset)
    if not settings.get("frame"):  # the samples stay in their frame
        mount = Mount(source.frame, ground_z_m=source.ground_z_m)
    samples = source.samples
    in_model_frame = mount.suits(source.frame, ground_z_m=source.ground_z_m)
    if isinstance(samples, AnnotationFile) and in_model_frame:
        ann_file = samples.path
    else:
        # `change_frame` returns a sample as it is if it needs no transformation.
        samples = [
            change_frame(sample, frame=source.frame, wanted=mount, ground_z_m=source.ground_z_m)
            for sample in samples
        ]
        meta = _annotation_meta(cfg, samples=samples, mount=mount, has_poses=source.has_poses)
        write_annotations(ann_file, meta, samples)
        settings["ground_z_m"] = None  # the written file contains the height
    settings["ann_file"] = str(ann_file.resolve())
    settings["test_mode"] = True
    # With None, the data set accepts any split, and as many coordinates as the file has.
    settings["split"] = None
    settings["dim"] = None
    settings["cameras"] = _select_cameras(cfg, samples)
    # mmengine collects garbage when it serialises samples. For one sample, this would take most of
    # the time.
    settings["serialize_data"] = len(samples) > 1
    if source.data_root is not None:
        settings["data_root"] = str(source.data_root.resolve())
    with building(cfg):  # adds the name of the config to errors
        dataset = DATASETS.build(settings)
    check_map_agreement(cfg, "test", classes_only=True)
    return dataset


def _annotation_meta(
    cfg: Config, samples: Sequence[MapSample], mount: Mount, has_poses: bool
) -> AnnotationMeta:
    """Metadata of an annotation file for inference.

    Args:
        cfg: Config of the model.
        samples: Samples of the file.
        mount: Annotation frame of the samples, and the height of the road in it.
        has_poses: Whether the poses of the vehicle are known.
    """
    options = cfg.test_dataloader.dataset
    grid = options.get("grid") or cfg.model.grid
    dim = 2  # 3 if a point has a height
    for sample in samples:
        for instance in sample.instances or ():
            dim = max(dim, instance.points.shape[1])
    return AnnotationMeta(
        dataset="samples",
        frame=mount.frame,
        split="test",
        classes=tuple(options.get("classes") or CLASSES),
        x_range=tuple(grid["x_range"]),
        y_range=tuple(grid["y_range"]),
        dim=dim,
        # This entry marks a file whose poses are unknown.
        options={} if has_poses else {"poses": False},
        command=INFERENCE_COMMAND,
        ground_z_m=mount.ground_z_m,
    )


def _select_cameras(cfg: Config, samples: Sequence[MapSample]) -> Sequence[str] | None:
    """Select the cameras of the config, or all cameras of the samples if they lack all of these.

    Returns:
        Names of the cameras; None if the config names none, which selects all.
    """
    configured = cfg.test_dataloader.dataset.get("cameras")
    available: dict[str, None] = {}  # a set that keeps the order of the names
    for sample in islice(samples, _MAX_SAMPLES):
        for camera in sample.cameras:
            available[camera.name] = None
    if configured is not None and available and available.keys().isdisjoint(configured):
        return list(available)
    return configured
