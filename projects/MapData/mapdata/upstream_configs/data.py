"""Conversion of the data set, pipeline and schedule of an upstream config to GSMap's settings.

An upstream config belongs to the code that the authors of a model published. Every setting that is
converted, or that has no counterpart here, is removed from the config. The caller reports the
settings that remain.
"""

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
    "CustomPointToMultiViewDepth",
}  # fmt: skip
# Names of settings that annotation files contain, or that only concern history and 3D boxes.
FILE_SETTINGS = (
    "ann_file map_ann_file classes modality test_mode use_valid_flag bev_size "
    "eval_use_same_gt_sample_num_flag padding_value box_type_3d samples_per_gpu aux_seg "
    "fixed_ptsnum_per_line"
)
_NUM_GPUS = 8  # for which the learning rates of the releases are
FLAT = {"pred_z_flag": False, "gt_z_flag": False}  # setting `z_cfg` of points without heights
# Dotted names of settings in GSMap, by their dotted names in the upstream config. Of the schedulers
# in `param_scheduler`, 0 is the warm-up and 1 the decay of the learning rate.
SCHEDULE = {
    "lr_config.warmup_iters": "param_scheduler.0.end",
    "lr_config.warmup_ratio": "param_scheduler.0.start_factor",
    "lr_config.min_lr_ratio": "param_scheduler.1.eta_min_ratio",
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
        GSMap's pipeline steps by type) and ``with_depth`` (whether the pipeline collects depth
        maps).

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
        "steps": {
            "FormatMapTargets": {"num_points": train["fixed_ptsnum_per_line"]},
            "MakeBEVMask": {"num_classes": len(classes)},
            "MakePVMask": {"num_classes": len(classes)},
            "DistortImages": None if "pipeline" in train else {},
        },
        "with_depth": False,
    }
    # `drop` removes the settings in `names`. It removes a setting that is given as a keyword only
    # if it has the given value, which is the only value that GSMap supports.
    fields.drop("data", names="shuffler_sampler nonshuffler_sampler")
    for part in ("train", "val", "test"):
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
            load_interval=4 if is_every_fourth else 1,
        )
        if "pipeline" in fields.section(section):
            # `items` lists the dotted names of the steps, such as `data.train.pipeline.0`.
            for step in fields.items(f"{section}.pipeline"):
                _convert_step(fields, step, settings=settings)
    return settings


def _convert_step(fields: Fields, name: str, settings: dict[str, Any]) -> None:
    """Convert a pipeline step and add it to ``settings``; unknown steps remain in ``fields``.

    Args:
        fields: Settings of the config. Converted settings are removed from it.
        name: Dotted name of the step.
        settings: Settings of GSMap, as `data_settings` returns them; changed in place.
    """
    # `step` is a part of the config, not a copy. So `step.clear()` removes the step from the
    # config.
    step = fields.section(name)
    kind = step.get("type")
    # This step holds the other steps of a test pipeline. Flipped copies of a sample are not
    # supported.
    if kind == "MultiScaleFlipAug3D" and not step.get("flip"):
        for inner_step in fields.items(f"{name}.transforms"):
            _convert_step(fields, inner_step, settings=settings)
        fields.drop(name, names="type flip img_scale pts_scale_ratio")
    elif kind == "RandomScaleImageMultiViewImage" and len(step["scales"]) == 1:
        settings["steps"]["ScaleImages"] = {"scale": step["scales"][0]}
        step.clear()
    elif kind == "PhotoMetricDistortionMultiViewImage":
        settings["steps"]["DistortImages"] = {}
        fields.drop(name, names="type")
    elif kind in ("PadMultiViewImage", "PadMultiViewImageDepth"):
        fields.drop(name, names="type", size_divisor=32)
    elif kind == "NormalizeMultiviewImage":
        settings["model.data_preprocessor.bgr_to_rgb"] = fields.take(f"{name}.to_rgb")
        settings["model.data_preprocessor.mean"] = fields.take(f"{name}.mean")
        settings["model.data_preprocessor.std"] = fields.take(f"{name}.std")
        fields.drop(name, names="type")
    elif kind == "CustomCollect3D":
        settings["with_depth"] |= "gt_depth" in step["keys"]
        step.clear()
    elif kind in KNOWN_STEPS:
        step.clear()


def schedule_settings(fields: Fields) -> dict[str, Any]:
    """Convert the settings of optimizer, learning rate, epochs, checkpoints and log.

    Args:
        fields: Settings of the config. Converted settings are removed from it.

    Returns:
        Settings by dotted name in GSMap.
    """
    optimizer = fields.take("optimizer", default={})
    settings = {
        "optim_wrapper.optimizer": optimizer,
        "optim_wrapper.clip_grad": fields.take("optimizer_config.grad_clip", default=None),
        **fields.move(SCHEDULE, required=False),
    }
    # Upstream has this setting in the optimizer, GSMap beside it.
    if "paramwise_cfg" in optimizer:
        settings["optim_wrapper.paramwise_cfg"] = optimizer.pop("paramwise_cfg")
    # The number of epochs may be in either place; the runner takes precedence.
    epochs = fields.take("total_epochs", default=None)
    epochs = fields.take("runner.max_epochs", default=epochs)
    if epochs is not None:
        settings["train_cfg.max_epochs"] = epochs
    scale = fields.take("fp16.loss_scale", default=None)
    if scale is not None:  # the training used mixed precision
        settings["optim_wrapper.type"] = "AmpOptimWrapper"
        settings["optim_wrapper.loss_scale"] = scale
    fields.drop("lr_config", policy="CosineAnnealing", warmup="linear")
    fields.drop("runner", type="EpochBasedRunner")
    fields.drop("evaluation", names="pipeline metric save_best rule")
    fields.drop("log_config", names="hooks")
    return settings
