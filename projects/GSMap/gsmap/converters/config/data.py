"""Data set, pipeline and schedule of an original config."""

from typing import Any

from gsmap.converters.config.fields import Fields

DATASETS = {
    "CustomNuScenesLocalMapDataset": "nuscenes",
    "CustomNuScenesOfflineLocalMapDataset": "nuscenes",
    "CustomAV2LocalMapDataset": "av2",
    "CustomAV2OfflineLocalMapDataset": "av2",
}
PARTS = ("train", "val", "test")
# steps that ours does elsewhere (migration.md), or that only concern 3D boxes
KNOWN_STEPS = {
    "LoadMultiViewImageFromFiles",
    "CustomLoadMultiViewImageFromFiles",
    "PhotoMetricDistortionMultiViewImage",
    "LoadAnnotations3D",
    "ObjectRangeFilter",
    "ObjectNameFilter",
    "PadMultiViewImage",
    "PadMultiViewImageDepth",
    "DefaultFormatBundle3D",
    "LoadPointsFromFile",
    "CustomPointToMultiViewDepth",
}
# what a converter's annotation file holds, or what only concerns history and 3D boxes
OF_THE_FILE = (
    "type", "ann_file", "map_ann_file", "classes", "modality", "test_mode", "use_valid_flag",
    "bev_size", "eval_use_same_gt_sample_num_flag", "padding_value", "queue_length", "box_type_3d",
    "samples_per_gpu", "load_interval", "aux_seg",
)  # fmt: skip


def data_settings(fields: Fields) -> dict[str, Any]:
    """Return the settings of data and image normalisation.

    Besides: ``steps`` (settings of pipeline steps by type), ``z_range``, ``with_depth``.

    Raises:
        ValueError: If the data set is unknown.
    """
    data = fields.section("data")
    train = data.section("train")
    kind = train.rest.get("type")
    if kind not in DATASETS:
        raise ValueError(f"data.train.type must be one of {sorted(DATASETS)}, got {kind!r}.")
    low_high = train.rest["pc_range"]
    grid = {"x_range": [low_high[0], low_high[3]], "y_range": [low_high[1], low_high[4]]}
    classes = list(train.rest["map_classes"])
    settings: dict[str, Any] = {
        "grid": grid,
        "classes": classes,
        "model.grid": grid,
        "model.classes": classes,
        "train_dataloader.batch_size": data.take("samples_per_gpu"),
        "train_dataloader.num_workers": data.take("workers_per_gpu"),
        "z_range": [low_high[2], low_high[5]],
        "steps": {"FormatMapTargets": {"num_points": train.rest["fixed_ptsnum_per_line"]}},
        "with_depth": False,
    }
    data.drop("shuffler_sampler", "nonshuffler_sampler")
    for part in PARTS:
        own = data.section(part)
        name = f"{part}_dataloader.dataset."
        settings[name + "data_root"] = own.take("data_root", train.rest.get("data_root"))
        settings |= {name + "grid": grid, name + "classes": classes}
        own.only(pc_range=low_high, map_classes=classes)
        own.drop(*OF_THE_FILE, "fixed_ptsnum_per_line")
        for step in own.items("pipeline") if "pipeline" in own.rest else []:
            _place_step(step, settings)
    settings["data_root"] = settings["train_dataloader.dataset.data_root"]
    return settings


def _place_step(step: Fields, settings: dict[str, Any]) -> None:
    """Place a step of a pipeline; one that is unknown stays."""
    kind = step.rest.get("type")
    if kind == "MultiScaleFlipAug3D" and not step.rest.get("flip"):
        for inner in step.items("transforms"):
            _place_step(inner, settings)
        step.drop("type", "flip", "img_scale", "pts_scale_ratio")
    elif kind == "RandomScaleImageMultiViewImage" and len(step.rest["scales"]) == 1:
        settings["steps"]["ScaleImages"] = {"scale": step.rest["scales"][0]}
        step.rest.clear()
    elif kind == "NormalizeMultiviewImage":
        name = "model.data_preprocessor."
        settings[name + "bgr_to_rgb"] = step.take("to_rgb")
        settings |= {name + key: step.take(key) for key in ("mean", "std")}
        step.drop("type")
    elif kind == "CustomCollect3D":
        settings["with_depth"] |= "gt_depth" in step.rest["keys"]
        step.rest.clear()
    elif kind in KNOWN_STEPS:
        step.rest.clear()


def schedule_settings(fields: Fields) -> dict[str, Any]:
    """Return the settings of optimizer, learning rate, epochs and checkpoints."""
    settings: dict[str, Any] = {}
    optimizer = fields.take("optimizer", {})
    if "paramwise_cfg" in optimizer:
        settings["optim_wrapper.paramwise_cfg"] = optimizer.pop("paramwise_cfg")
    settings["optim_wrapper.optimizer"] = optimizer
    settings["optim_wrapper.clip_grad"] = fields.section("optimizer_config").take("grad_clip", None)
    rate = fields.section("lr_config")
    rate.only(policy="CosineAnnealing", warmup="linear")
    epochs = fields.take("total_epochs", None)
    runner = fields.section("runner")
    runner.only(type="EpochBasedRunner")
    epochs = runner.take("max_epochs", epochs)
    evaluation = fields.section("evaluation")
    evaluation.drop("pipeline", "metric", "save_best", "rule")
    checkpoints, log = fields.section("checkpoint_config"), fields.section("log_config")
    log.drop("hooks")
    found = {
        "param_scheduler.0.end": rate.take("warmup_iters", None),
        "param_scheduler.0.start_factor": rate.take("warmup_ratio", None),
        "param_scheduler.1.eta_min_ratio": rate.take("min_lr_ratio", None),
        "param_scheduler.1.T_max": epochs,
        "train_cfg.max_epochs": epochs,
        "train_cfg.val_interval": evaluation.take("interval", None),
        "default_hooks.checkpoint.interval": checkpoints.take("interval", None),
        "default_hooks.checkpoint.max_keep_ckpts": checkpoints.take("max_keep_ckpts", None),
        "default_hooks.logger.interval": log.take("interval", None),
        "load_from": fields.take("load_from", None),
    }
    settings |= {name: value for name, value in found.items() if value is not None}
    scale = fields.section("fp16").take("loss_scale", None)
    if scale is not None:
        settings |= {"optim_wrapper.type": "AmpOptimWrapper", "optim_wrapper.loss_scale": scale}
    return settings
