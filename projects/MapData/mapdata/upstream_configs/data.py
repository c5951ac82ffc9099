"""Data set, pipeline and schedule of an original config."""

from typing import Any

from gsmap.utils.errors import InputError
from mapdata.upstream_configs.fields import Fields

DATASETS = (
    "CustomNuScenesLocalMapDataset", "CustomNuScenesOfflineLocalMapDataset",
    "CustomAV2LocalMapDataset", "CustomAV2OfflineLocalMapDataset",
)  # fmt: skip
# steps that ours does elsewhere (migration.md), or that only concern 3D boxes
KNOWN_STEPS = {
    "LoadMultiViewImageFromFiles", "CustomLoadMultiViewImageFromFiles",
    "PhotoMetricDistortionMultiViewImage", "LoadAnnotations3D", "ObjectRangeFilter",
    "ObjectNameFilter", "PadMultiViewImage", "PadMultiViewImageDepth", "DefaultFormatBundle3D",
    "LoadPointsFromFile", "CustomPointToMultiViewDepth",
}  # fmt: skip
# what a converter's annotation file holds, or what only concerns history and 3D boxes
OF_THE_FILE = (
    "type ann_file map_ann_file classes modality test_mode use_valid_flag bev_size "
    "eval_use_same_gt_sample_num_flag padding_value queue_length box_type_3d samples_per_gpu "
    "load_interval aux_seg fixed_ptsnum_per_line"
)
FLAT = {"pred_z_flag": False, "gt_z_flag": False}  # z_cfg of points without height
SCHEDULE = {
    "lr_config.warmup_iters": "param_scheduler.0.end",
    "lr_config.warmup_ratio": "param_scheduler.0.start_factor",
    "lr_config.min_lr_ratio": "param_scheduler.1.eta_min_ratio",
    "evaluation.interval": "train_cfg.val_interval",
    "checkpoint_config.interval": "default_hooks.checkpoint.interval",
    "checkpoint_config.max_keep_ckpts": "default_hooks.checkpoint.max_keep_ckpts",
    "log_config.interval": "default_hooks.logger.interval",
    "load_from": "load_from",
}


def data_settings(fields: Fields) -> dict[str, Any]:
    """Return the settings of data and image normalisation; ValueError if the data set is unknown.

    Besides: ``steps`` (settings of pipeline steps by type), ``z_range``, ``with_depth``.
    """
    train = dict(fields.section("data.train"))
    if train.get("type") not in DATASETS:
        raise InputError(
            f"data.train.type must be one of {sorted(DATASETS)}, got {train.get('type')!r}."
        )
    classes, root = list(train["map_classes"]), train.get("data_root")
    x_range, y_range, z_range = ([train["pc_range"][i], train["pc_range"][i + 3]] for i in range(3))
    shared = {"grid": {"x_range": x_range, "y_range": y_range}, "classes": classes}
    settings: dict[str, Any] = {
        **shared,
        **{f"model.{name}": value for name, value in shared.items()},
        "train_dataloader.batch_size": fields.take("data.samples_per_gpu"),
        "train_dataloader.num_workers": fields.take("data.workers_per_gpu"),
        "data_root": root,
        "z_range": z_range,
        "steps": {
            "FormatMapTargets": {"num_points": train["fixed_ptsnum_per_line"]},
            "MakeBEVMask": {"num_classes": len(classes)},
            "MakePVMask": {"num_classes": len(classes)},
        },
        "with_depth": False,
    }
    fields.drop("data", "shuffler_sampler nonshuffler_sampler")
    for part in ("train", "val", "test"):
        own, dataset = f"data.{part}", f"{part}_dataloader.dataset."
        settings |= {dataset + name: value for name, value in shared.items()}
        settings[dataset + "data_root"] = fields.take(own + ".data_root", root)
        fields.drop(own, OF_THE_FILE, pc_range=train["pc_range"], map_classes=classes, z_cfg=FLAT)
        for step in fields.items(own + ".pipeline") if "pipeline" in fields.section(own) else []:
            _place_step(fields, step, settings)
    return settings


def _place_step(fields: Fields, name: str, settings: dict[str, Any]) -> None:
    """Place a step of a pipeline; one that is unknown stays."""
    step = fields.section(name)
    kind = step.get("type")
    if kind == "MultiScaleFlipAug3D" and not step.get("flip"):
        for inner in fields.items(name + ".transforms"):
            _place_step(fields, inner, settings)
        fields.drop(name, "type flip img_scale pts_scale_ratio")
    elif kind == "RandomScaleImageMultiViewImage" and len(step["scales"]) == 1:
        settings["steps"]["ScaleImages"] = {"scale": step["scales"][0]}
        step.clear()
    elif kind == "NormalizeMultiviewImage":
        ours = {"to_rgb": "bgr_to_rgb", "mean": "mean", "std": "std"}
        settings |= fields.move(
            {f"{name}.{key}": f"model.data_preprocessor.{new}" for key, new in ours.items()}
        )
        fields.drop(name, "type")
    elif kind == "CustomCollect3D":
        settings["with_depth"] |= "gt_depth" in step["keys"]
        step.clear()
    elif kind in KNOWN_STEPS:
        step.clear()


def schedule_settings(fields: Fields) -> dict[str, Any]:
    """Return the settings of optimizer, learning rate, epochs and checkpoints."""
    optimizer = fields.take("optimizer", {})
    settings = {
        "optim_wrapper.optimizer": optimizer,
        "optim_wrapper.clip_grad": fields.take("optimizer_config.grad_clip", None),
        **fields.move(SCHEDULE, required=False),
    }
    if "paramwise_cfg" in optimizer:
        settings["optim_wrapper.paramwise_cfg"] = optimizer.pop("paramwise_cfg")
    epochs = fields.take("total_epochs", None)
    epochs = fields.take("runner.max_epochs", epochs)
    if epochs is not None:
        settings["train_cfg.max_epochs"] = epochs
    scale = fields.take("fp16.loss_scale", None)
    if scale is not None:
        settings |= {"optim_wrapper.type": "AmpOptimWrapper", "optim_wrapper.loss_scale": scale}
    fields.drop("lr_config", policy="CosineAnnealing", warmup="linear")
    fields.drop("runner", type="EpochBasedRunner")
    fields.drop("evaluation", "pipeline metric save_best rule")
    fields.drop("log_config", "hooks")
    return settings
