"""Conversion of the data set, pipeline and schedule of an upstream config to GSMap's settings.

An upstream config belongs to the code that the authors of a model published. Every setting that is
converted, or that has no counterpart here, is removed from the config. The caller reports the
settings that remain.
"""

import copy
from collections.abc import Iterator
from typing import Any

from gsmap.utils.errors import InputError
from mapdata.upstream_configs.fields import Fields

# Data sets that are supported, by upstream's names of their classes.
DATASETS = {
    "CustomNuScenesLocalMapDataset": "nuScenes",
    "CustomNuScenesOfflineLocalMapDataset": "nuScenes",
    "CustomAV2LocalMapDataset": "Argoverse 2",
    "CustomAV2OfflineLocalMapDataset": "Argoverse 2",
}
# Types of pipeline steps that GSMap does elsewhere (migration.md), or that only concern 3D boxes.
KNOWN_STEPS = {
    "LoadMultiViewImageFromFiles", "CustomLoadMultiViewImageFromFiles", "LoadAnnotations3D",
    "ObjectRangeFilter", "ObjectNameFilter", "DefaultFormatBundle3D", "LoadPointsFromFile",
}  # fmt: skip
# Names of settings that annotation files contain, or that only concern history and 3D boxes.
FILE_SETTINGS = (
    "ann_file map_ann_file classes modality test_mode use_valid_flag bev_size "
    "eval_use_same_gt_sample_num_flag padding_value box_type_3d samples_per_gpu "
    "fixed_ptsnum_per_line"
)
_HOLDER = "MultiScaleFlipAug3D"  # step that holds the other steps of a test pipeline
_CONSTRUCTOR = "DefaultOptimizerConstructor"  # of the original optimizers
_WARMUP_RATIO = 0.1  # default of the original warm-up
_GAMMA = 0.1  # default of the original decay by steps
_MIN_LR_RATIO = 1e-3  # of the base configs
_SIZE_DIVISOR = 32  # of padded images in all base configs
_NUM_GPUS = 8  # for which the learning rates of the releases are
FLAT = {"pred_z_flag": False, "gt_z_flag": False}  # setting `z_cfg` of points without heights
PARTS = ("train", "val", "test")
# Dotted names of settings in GSMap, by their dotted names in the upstream config.
SCHEDULE = {
    "evaluation.interval": "train_cfg.val_interval",
    "checkpoint_config.interval": "default_hooks.checkpoint.interval",
    "checkpoint_config.max_keep_ckpts": "default_hooks.checkpoint.max_keep_ckpts",
    "log_config.interval": "default_hooks.logger.interval",
    "load_from": "load_from",
    "cudnn_benchmark": "env_cfg.cudnn_benchmark",
    "find_unused_parameters": "find_unused_parameters",
}


def data_settings(fields: Fields) -> dict[str, Any]:
    """Convert the settings of the data and the image normalisation.

    Args:
        fields: Settings of the config. Converted settings are removed from it.

    Returns:
        Settings by dotted name in GSMap, and further entries for the conversion of the model:
        ``grid`` (``x_range`` and ``y_range``) and ``z_range`` in metres, ``classes``,
        ``data_root``, ``data_set`` (``nuScenes`` or ``Argoverse 2``), ``steps`` (settings of
        GSMap's pipeline steps by type, for each of `PARTS`; None removes a step), ``pc_range``
        (smallest x, y and z, then largest) and ``with_depth`` (whether the pipeline collects
        depth maps).

    Raises:
        ValueError: If the data set is unknown, a required setting is missing, or a pipeline is not
            a list.
    """
    # This copy keeps the settings that are removed from the config below.
    train = dict(fields.section("data.train"))
    if train.get("type") not in DATASETS:
        raise InputError(
            f"data.train.type must be one of {sorted(DATASETS)}, got {train.get('type')!r}."
        )
    classes = list(train["map_classes"])
    data_root = train.get("data_root")
    pc_range = train["pc_range"]  # smallest x, y, z, then largest x, y, z
    grid = {"x_range": [pc_range[0], pc_range[3]], "y_range": [pc_range[1], pc_range[4]]}
    # `take` removes a setting from the config and returns its value.
    batch_size = fields.take("data.samples_per_gpu")
    settings: dict[str, Any] = {
        "grid": grid,
        "classes": classes,
        "model.grid": grid,
        "model.classes": classes,
        "train_dataloader.batch_size": batch_size,
        "auto_scale_lr.base_batch_size": _NUM_GPUS * batch_size,
        "train_dataloader.num_workers": fields.take("data.workers_per_gpu"),
        "data_root": data_root,
        "data_set": DATASETS[train["type"]],
        "z_range": [pc_range[2], pc_range[5]],
        "pc_range": pc_range,
    }
    pipelines: dict[str, dict[str, Any]] = {}  # settings of the steps in the config, by part
    # `drop` removes the settings in `names`. It removes a setting that is given as a keyword only
    # if it has the given value, which is the only value that GSMap supports.
    fields.drop("data", names="shuffler_sampler nonshuffler_sampler")
    aux_seg = copy.deepcopy(fields.section("model.pts_bbox_head.aux_seg"))
    for part in PARTS:
        section = f"data.{part}"
        dataset = f"{part}_dataloader.dataset"
        # Our files of Argoverse 2 have every fourth sample for validation, as in the releases.
        is_every_fourth = part != "train" and settings["data_set"] == "Argoverse 2"
        settings[f"{dataset}.grid"] = grid
        settings[f"{dataset}.classes"] = classes
        settings[f"{dataset}.data_root"] = fields.take(f"{section}.data_root", default=data_root)
        fields.drop(
            section,
            names=FILE_SETTINGS,
            type=train["type"],
            pc_range=pc_range,
            map_classes=classes,
            z_cfg=FLAT,
            queue_length=1,
            aux_seg=aux_seg,
            load_interval=4 if is_every_fourth else 1,
        )
        if "pipeline" in fields.section(section):
            pipelines[part] = _read_pipeline(fields, part)
    settings["with_depth"] = any(pipeline["with_depth"] for pipeline in pipelines.values())
    settings |= _preprocessor_settings(fields, pipelines)
    settings["steps"] = {part: _step_changes(pipelines, part) for part in PARTS}
    changes = settings["steps"]["train"]
    changes["FormatMapTargets"] = {"num_points": train["fixed_ptsnum_per_line"]}
    changes["MakeBEVMask"] = {"num_classes": len(classes)}
    changes["MakePVMask"] = {**changes.get("MakePVMask", {}), "num_classes": len(classes)}
    return settings


def _read_pipeline(fields: Fields, part: str) -> dict[str, Any]:
    """Read the settings of a pipeline.

    Args:
        fields: Settings of the config. Converted settings are removed from it.
        part: One of `PARTS`.

    Returns:
        ``scale`` of the images, ``normalisation``, ``size_divisor`` of the padding, ``distorts``
        and ``with_depth``. Values without a step in the pipeline are None or False.
    """
    pipeline: dict[str, Any] = {
        "scale": None,
        "normalisation": None,
        "size_divisor": None,
        "distorts": False,
        "with_depth": False,
    }
    for step in _step_names(fields, f"data.{part}.pipeline"):
        _convert_step(fields, step, pipeline=pipeline, is_training=part == "train")
    return pipeline


def _step_names(fields: Fields, pipeline: str) -> Iterator[str]:
    """Yield the dotted names of the steps of a pipeline, such as ``data.train.pipeline.0``."""
    for step in fields.items(pipeline):
        holds_steps = fields.section(step).get("type") == _HOLDER
        yield step
        if holds_steps:
            yield from fields.items(f"{step}.transforms")


def _preprocessor_settings(fields: Fields, pipelines: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Convert normalisation and padding, which the model does for all parts in GSMap.

    The values of the first pipeline are converted. Other values of the other pipelines are
    reported.

    Args:
        fields: Settings of the config, for the report.
        pipelines: Results of `_read_pipeline` by part. Without any, the values of the base config
            remain.
    """
    if not pipelines:
        return {}
    first = next(iter(pipelines.values()))
    steps = {"normalisation": "NormalizeMultiviewImage", "size_divisor": "PadMultiViewImage"}
    for part, pipeline in pipelines.items():
        for key, step in steps.items():
            if pipeline[key] != first[key]:
                fields.note(f"data.{part}.pipeline.{step}", pipeline[key])
    normalisation = first["normalisation"] or {"mean": None, "std": None, "to_rgb": False}
    preprocessor = "model.data_preprocessor."
    return {
        preprocessor + "bgr_to_rgb": normalisation["to_rgb"],
        preprocessor + "mean": normalisation["mean"],
        preprocessor + "std": normalisation["std"],
        preprocessor + "pad_size_divisor": first["size_divisor"] or 1,
    }


def _step_changes(
    pipelines: dict[str, dict[str, Any]], part: str
) -> dict[str, dict[str, Any] | None]:
    """Changes of the steps of GSMap's pipeline of a part, by type of the step.

    Args:
        pipelines: Results of `_read_pipeline` by part. A part without a pipeline has the scale of
            the first one.
        part: One of `PARTS`.
    """
    if not pipelines:
        return {}
    first = next(iter(pipelines.values()))
    scale = pipelines.get(part, first)["scale"]
    changes: dict[str, dict[str, Any] | None] = {
        "ScaleImages": None if scale is None else {"scale": scale}
    }
    if part in pipelines and not pipelines[part]["distorts"]:
        changes["DistortImages"] = None
    divisor = first["size_divisor"] or 1
    if divisor != _SIZE_DIVISOR:
        changes["MakePVMask"] = changes["MakeDepthMap"] = {"pad_size_divisor": divisor}
    return changes


def _convert_step(fields: Fields, name: str, pipeline: dict[str, Any], is_training: bool) -> None:
    """Convert a pipeline step; unknown steps remain in ``fields``.

    Args:
        fields: Settings of the config. Converted settings are removed from it.
        name: Dotted name of the step.
        pipeline: Settings of the pipeline, as `_read_pipeline` returns them; changed in place.
        is_training: Whether the pipeline is the one of the training.
    """
    # `step` is a part of the config, not a copy. So `step.clear()` removes the step from the
    # config.
    step = fields.section(name)
    kind = step.get("type")
    if kind == _HOLDER:
        # Several scaled or flipped copies of a sample are not supported.
        if not isinstance(step.get("img_scale"), list):
            fields.drop(name, names="img_scale")
        fields.drop(name, names="type", flip=False, pts_scale_ratio=1)
    elif kind == "RandomScaleImageMultiViewImage":
        _convert_scale(step, pipeline)
    elif kind == "PhotoMetricDistortionMultiViewImage" and is_training:
        pipeline["distorts"] = True
        fields.drop(name, names="type")
    elif kind in ("PadMultiViewImage", "PadMultiViewImageDepth"):
        pipeline["size_divisor"] = fields.take(f"{name}.size_divisor", default=_SIZE_DIVISOR)
        fields.drop(name, names="type")
    elif kind == "NormalizeMultiviewImage":
        pipeline["normalisation"] = {
            "mean": list(fields.take(f"{name}.mean")),
            "std": list(fields.take(f"{name}.std")),
            "to_rgb": fields.take(f"{name}.to_rgb", default=True),
        }
        fields.drop(name, names="type")
    elif kind == "CustomPointToMultiViewDepth":
        fields.drop(name, names="type grid_config", downsample=1)
    elif kind == "CustomCollect3D":
        pipeline["with_depth"] |= "gt_depth" in step["keys"]
        step.clear()
    elif kind in KNOWN_STEPS:
        step.clear()


def _convert_scale(step: dict[str, Any], pipeline: dict[str, Any]) -> None:
    """Convert a step that scales images.

    Args:
        step: The step; emptied if it is converted. A step with several scales, or a second step,
            remains.
        pipeline: Settings of the pipeline; the scale is set.
    """
    is_first = pipeline["scale"] is None
    if is_first:
        pipeline["scale"] = step["scales"][0]
    if is_first and len(step["scales"]) == 1:
        step.clear()


def schedule_settings(fields: Fields) -> dict[str, Any]:
    """Convert the settings of optimizer, learning rate, epochs, checkpoints and log.

    Without an optimizer or a number of epochs in the config, the settings of the base config
    remain. This is reported.

    Args:
        fields: Settings of the config. Converted settings are removed from it.

    Returns:
        Settings by dotted name in GSMap.

    Raises:
        ValueError: If a setting of the learning rate is missing.
    """
    settings = fields.move(SCHEDULE, required=False)
    optimizer = fields.take("optimizer", default=None)
    if optimizer is None:
        fields.note("optimizer", None)
    else:
        # Upstream has this setting in the optimizer, GSMap beside it.
        settings["optim_wrapper.paramwise_cfg"] = optimizer.pop("paramwise_cfg", None)
        constructor = optimizer.pop("constructor", _CONSTRUCTOR)
        if constructor != _CONSTRUCTOR:
            fields.note("optimizer.constructor", constructor)
        settings["optim_wrapper.optimizer"] = optimizer
    # A config with an optimizer, but without one of these sections, trains without clipping or
    # with a constant rate.
    if optimizer is not None or fields.section("optimizer_config"):
        grad_clip = fields.take("optimizer_config.grad_clip", default=None)
        settings["optim_wrapper.clip_grad"] = grad_clip
    if optimizer is not None or fields.section("lr_config"):
        settings["param_scheduler"] = _schedulers(fields)
    # The number of epochs may be in either place; the runner takes precedence.
    epochs = fields.take("total_epochs", default=None)
    epochs = fields.take("runner.max_epochs", default=epochs)
    if epochs is None:
        fields.note("total_epochs", None)
    else:
        settings["train_cfg.max_epochs"] = epochs
    scale = fields.take("fp16.loss_scale", default=None)
    if scale is not None:  # the training used mixed precision
        settings["optim_wrapper.type"] = "AmpOptimWrapper"
        settings["optim_wrapper.loss_scale"] = scale
    fields.drop("runner", type="EpochBasedRunner")
    fields.drop("evaluation", names="pipeline save_best rule", metric="chamfer")
    fields.drop("evaluation", metric=["chamfer"])
    fields.drop("log_config", names="hooks")
    return settings


def _schedulers(fields: Fields) -> list[dict[str, Any]]:
    """Convert the settings of the learning rate to GSMap's ``param_scheduler``.

    A warm-up that is not linear remains in ``fields``.

    Raises:
        ValueError: If the length of the warm-up or the end of the decay is missing.
    """
    lr_config = fields.section("lr_config")  # the dict in `fields`, not a copy
    if not lr_config:
        return []  # the rate is constant
    schedulers: list[dict[str, Any]] = []
    if lr_config.get("warmup") == "linear":
        warm_up = {
            "type": "LinearLR",
            "start_factor": fields.take("lr_config.warmup_ratio", default=_WARMUP_RATIO),
            "by_epoch": False,
            "begin": 0,
            "end": fields.take("lr_config.warmup_iters"),
        }
        schedulers.append(warm_up)
        fields.drop("lr_config", names="warmup", warmup_by_epoch=False)
    elif lr_config.get("warmup") is None:
        # These have no effect.
        fields.drop("lr_config", names="warmup warmup_iters warmup_ratio warmup_by_epoch")
    fields.drop("lr_config", by_epoch=True)
    if lr_config.get("policy") == "fixed":
        fields.drop("lr_config", names="policy")
    else:
        schedulers.append(_decay(fields))
    return schedulers


def _decay(fields: Fields) -> dict[str, Any]:
    """Convert the decay of the learning rate.

    A policy other than ``CosineAnnealing`` and ``step`` becomes a cosine decay, and remains in
    ``fields``.

    Raises:
        ValueError: If the end of a cosine decay is missing.
    """
    lr_config = fields.section("lr_config")
    policy = lr_config.get("policy")
    if policy == "step" and isinstance(lr_config.get("step"), (list, tuple)):
        fields.drop("lr_config", names="policy")
        return {
            "type": "MultiStepLR",
            "by_epoch": True,
            "milestones": list(fields.take("lr_config.step")),
            "gamma": fields.take("lr_config.gamma", default=_GAMMA),
        }
    decay: dict[str, Any] = {"type": "CosineAnnealingLR", "by_epoch": True}
    if "min_lr" in lr_config:
        decay["eta_min"] = fields.take("lr_config.min_lr")
    elif policy == "CosineAnnealing":
        decay["eta_min_ratio"] = fields.take("lr_config.min_lr_ratio")
    else:
        decay["eta_min_ratio"] = fields.take("lr_config.min_lr_ratio", default=_MIN_LR_RATIO)
    fields.drop("lr_config", policy="CosineAnnealing")
    return decay
