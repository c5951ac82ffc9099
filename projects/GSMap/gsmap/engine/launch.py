"""What the tools share: reading a config, changing it, checking it, the work folder."""

import argparse
import errno
import inspect
import logging
import os
import re
import zipfile
from collections.abc import Callable, Iterator
from datetime import timedelta
from functools import cache
from pathlib import Path
from typing import Any

import torch
from mmdet3d.registry import DATA_SAMPLERS, OPTIMIZERS, RUNNERS
from mmengine.config import Config
from mmengine.logging import print_log
from mmengine.registry import Registry, init_default_scope
from mmengine.utils import import_modules_from_strings

from gsmap.checkpoints.building import reading_config
from gsmap.checkpoints.named_models import find_config
from gsmap.checkpoints.settings import pipeline_steps, scale_steps
from gsmap.engine.rank_watch import TIMEOUT_S
from gsmap.engine.targets import check_targets, class_of_type, share_settings
from gsmap.utils.errors import InputError
from gsmap.utils.faults import nearest, registered
from gsmap.utils.files import DAMAGED_ZIP
from gsmap.utils.parallel import LAUNCHER, die_with_parent

# mmengine accepts a misspelt top-level key in silence: only these mean something.
_COPIED = ("backend_args", "classes", "data_root", "grid", "vis_backends")  # read by no runner
_OWN_KEYS = (
    *_COPIED, "custom_imports", "find_unused_parameters", "model_wrapper_cfg", "runner_type",
    "images_on_device", "strategy", "sync_bn",
)  # fmt: skip
_MOST_WORKERS = 16
_SECTIONS = ("_cfg", "_dataloader", "default_hooks", "model", "optim_wrapper", "randomness")


@cache
def _known_keys() -> frozenset[str]:
    """Return the top-level keys of a config; mmengine's runner is slow to import."""
    from mmengine.runner import Runner

    return frozenset(inspect.signature(Runner).parameters) - {"cfg"} | set(_OWN_KEYS)


def read_config(config: str | Path | Config, cfg_options: dict | None = None) -> Config:
    """Return a config with overrides applied, ready to build from.

    What it registers is imported, and its scope is made the default one.

    Args:
        config: A config, by file or name (`find_config`), or a ``Config``, which is left as it is.
        cfg_options: Overrides, by dotted name; ``image_scale`` is the factor of all images.

    Raises:
        FileNotFoundError: If there is no such file or model.
        ValueError: If it cannot be read, has an unknown top-level key, or an override does not fit
            or would change nothing.
    """
    if isinstance(config, Config):
        cfg = Config(config.to_dict())
    else:
        path = find_config(config)
        with reading_config(path):
            cfg = Config.fromfile(path, import_custom_modules=False)
    options = dict(cfg_options or {})
    factor = options.pop("image_scale", None)
    for name in options:
        _check_effect(cfg, name)
    with reading_config(f"--cfg-options of {cfg.filename or 'a config'}"):
        cfg.merge_from_dict(options)
    if factor is not None:
        _scale_images(cfg, factor)
    _check_keys(cfg)
    _fit_loaders(cfg)
    with reading_config(f"custom_imports of {cfg.filename or 'a config'}"):
        import_modules_from_strings(["gsmap.registered"])
        import_modules_from_strings(**cfg.get("custom_imports", {"imports": []}))
    init_default_scope(cfg.get("default_scope", "mmdet3d"))
    share_settings(cfg)
    return cfg


def _scale_images(cfg: Config, factor: float) -> None:
    """Set the factor by which all pipelines of a config scale their images, in place.

    Raises:
        ValueError: If no pipeline scales images.
    """
    steps = scale_steps(cfg, "train", "val", "test")
    if not steps:
        raise InputError(f"--image-scale: no pipeline of {cfg.filename} has ScaleImages.")
    for step in steps:
        step.update(scale=factor, size=None)


def _fit_loaders(cfg: Config) -> None:
    """Fit the data loaders of a config to the machine, in place.

    ``num_workers='cores'`` is the number of cores that a process has, at most 16. With
    ``images_on_device``, images are copied to the device as they were decoded, from pinned memory,
    and the steps of the pipelines on pixels run there.

    Raises:
        ValueError: If a transform of another library reads the pixels before they are packed.
    """
    for part in ("train", "val", "test"):
        loader = cfg.get(f"{part}_dataloader")
        if not loader:
            continue
        if loader.get("num_workers") == "cores":
            cores = len(os.sched_getaffinity(0)) // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
            loader.num_workers = min(max(cores, 1), _MOST_WORKERS)
        if not cfg.get("images_on_device"):
            continue
        loader.pin_memory = True
        for step in pipeline_steps(cfg, part):
            if step.type == "LoadCameraImages":
                step.on_device = True
            elif step.type == "MultiViewWrapper":
                raise InputError(
                    f"{cfg.filename}: images_on_device does not go with {step.type}, which reads "
                    "pixels on the host: take DistortImages in its place, or leave out "
                    "images_on_device."
                )


def load_config(args: argparse.Namespace) -> Config:
    """Read ``args.config``, apply the command-line options to it, and check the result.

    The config's own values (``_name``) are left out: a run's log and config show what counts.
    Without a GPU several processes talk through gloo, whatever the config says. Errors are those of
    `read_config` and `check_config`.
    """
    os.environ.setdefault("LOCAL_RANK", str(args.local_rank))
    cfg = read_config(args.config, args.cfg_options)
    cfg.launcher = args.launcher
    if args.work_dir:
        cfg.work_dir = args.work_dir
    elif cfg.get("work_dir") is None:
        cfg.work_dir = str(Path("work_dirs") / Path(args.config).stem)
    check_config(cfg)
    for name in list(cfg):
        if name.startswith("_"):
            cfg.pop(name)  # a config's own values have done their work
    if args.launcher == "pytorch":
        # torchrun killed with SIGKILL cannot stop its ranks
        die_with_parent(int(os.environ.pop(LAUNCHER, os.getppid())))
    if args.launcher == "pytorch" and not torch.cuda.is_available():
        # mmengine would choose a CUDA device first, and wrap the model with its number
        timeout = timedelta(seconds=rank_timeout_s(cfg))
        torch.distributed.init_process_group("gloo", timeout=timeout)
        cfg.model_wrapper_cfg = {
            "type": "MMDistributedDataParallel",
            "device_ids": None,
            "find_unused_parameters": cfg.get("find_unused_parameters", False),
            "broadcast_buffers": False,
        }
    return cfg


def rank_timeout_s(cfg: Config) -> float:
    """Return how long ranks wait for each other, in seconds.

    Raises:
        ValueError: If ``env_cfg.dist_cfg.timeout`` is no positive number.
    """
    timeout_s = cfg.get("env_cfg", {}).get("dist_cfg", {}).get("timeout", TIMEOUT_S)
    if not isinstance(timeout_s, int | float) or not timeout_s > 0:
        raise InputError(
            f"{cfg.filename}: env_cfg.dist_cfg.timeout must be seconds > 0, got {timeout_s!r:.60}."
        )
    return timeout_s


def newest_checkpoint(
    work_dir: str | Path, read: Callable[[Path], object] | None = None
) -> Path | None:
    """Return the newest good checkpoint of a run; a warning names each one that is passed over.

    Args:
        work_dir: Folder of the run.
        read: Function that raises ``ValueError`` for a whole checkpoint that cannot be used.

    Returns:
        The path of the checkpoint, None if there is no good one.
    """
    numbers: dict[Path, int] = {}
    for path in Path(work_dir).glob("*.pth"):
        match = re.fullmatch(r"(?:epoch|iter)_(\d+)\.pth", path.name)
        if match:
            numbers[path] = int(match[1])
    for path in sorted(numbers, key=numbers.__getitem__, reverse=True):
        reason = f"{path} is damaged and is passed over."
        try:
            if _is_whole(path):
                if read is not None:
                    read(path)
                return path
        except ValueError as error:
            reason = f"{error} It is passed over."
        print_log(reason, level=logging.WARNING)
    return None


def _is_whole(path: Path) -> bool:
    """Whether a file is a zip archive without damage."""
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.testzip() is None
    except DAMAGED_ZIP:
        return False
    except OSError as error:
        if error.errno != errno.EINVAL:  # a place before the file's beginning
            raise
        return False


def check_config(cfg: Config) -> None:
    """Refuse the mistakes in the values of a config that the config system lets through.

    Raises:
        ValueError: If a learning-rate schedule ends at another epoch than the training, there is no
            such optimizer or runner, the pipeline lacks a transform that the head needs, or a
            loader tears the streams of a model with memory apart.
    """
    check_targets(cfg)
    _check_streams(cfg)
    _check_schedule(cfg)
    optimizer = ((cfg.get("optim_wrapper") or {}).get("optimizer") or {}).get("type")
    _check_registered(cfg, "optimizer", OPTIMIZERS, optimizer)  # mmengine goes on without it
    _check_registered(cfg, "runner", RUNNERS, cfg.get("runner_type", "Runner"))


def _check_schedule(cfg: Config) -> None:
    """Refuse a cosine schedule that ends at another epoch than the training."""
    end = (cfg.get("train_cfg") or {}).get("max_epochs")
    if end is None:
        return
    for scheduler in cfg.get("param_scheduler") or []:
        last = scheduler.get("T_max")
        if last is not None and scheduler.get("by_epoch", True) and last != end:
            raise InputError(
                f"{cfg.filename}: training lasts {end} epochs but the cosine schedule {last}: set "
                "both train_cfg.max_epochs and param_scheduler's T_max (a schedule is one base "
                "file)."
            )


def _check_registered(cfg: Config, what: str, registry: Registry, kind: Any) -> None:
    """Refuse a name of a class that a registry does not have."""
    if isinstance(kind, str) and registry.get(kind) is None:
        close = nearest(kind, registered(registry)) or "."
        raise InputError(f"{cfg.filename}: there is no {what} of type {kind!r}{close}")


def _check_effect(cfg: Config, name: str) -> None:
    """Refuse an override of a config's own value, of which the other settings have copies."""
    top, *keys = name.split(".")
    if not (top.startswith("_") or top in _COPIED):
        return
    value: Any = cfg.get(top)
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    last = keys[-1] if keys else top.removeprefix("_")
    if name == "data_root":
        copies = ["--data-root DIR"]
    else:
        settings = {k: v for k, v in cfg.items() if k not in _COPIED and not k.startswith("_")}
        copies = list(_places(settings, name=last, value=value, path=""))
    remedy = f"give {', '.join(copies)}, or edit" if copies else "edit"
    raise InputError(
        f"--cfg-options {name} changes nothing: the other settings have copies of it, made when "
        f"the config was read. Instead {remedy} {cfg.filename or 'the config'}."
    )


def _places(settings: Any, name: str, value: Any, path: str) -> Iterator[str]:
    """Yield where nested settings have a value under a name, by dotted name."""
    if isinstance(settings, list | tuple):
        settings = dict(enumerate(settings))
    for key, inner in settings.items() if isinstance(settings, dict) else ():
        if key == name and inner == value:
            yield f"{path}{key}"
        else:
            yield from _places(inner, name, value, f"{path}{key}.")


def _check_keys(cfg: Config) -> None:
    """Refuse top-level keys that no code reads, and sections that are no dictionaries."""
    for key, value in cfg.items():
        known = key in _known_keys()
        if known and key.endswith(_SECTIONS) and not isinstance(value, dict | None):
            raise InputError(f"{cfg.filename}: {key} must be dict(...), got {value!r:.60}.")
        if known or key.startswith("_"):
            continue
        hint = nearest(key, _known_keys()) or "; names of a config's own values start with '_'."
        raise InputError(f"{cfg.filename}: unknown top-level key {key!r}{hint}")


def _check_streams(cfg: Config) -> None:
    """Refuse loaders that would not hand a model with memory the frames of each scene in order."""
    temporal = (cfg.get("model") or {}).get("temporal")
    if temporal is None:
        return
    needed = dict.fromkeys(("val", "test"), "StreamTestSampler")
    if temporal.get("bev") is not None or temporal.get("queries") is not None:
        needed["train"] = "StreamTrainSampler"  # a memory of elements alone is not trained
    for part, wanted in needed.items():
        loader = cfg.get(f"{part}_dataloader") or {}
        sampler = loader.get("sampler") or {}
        kind = sampler.get("type")
        found = class_of_type(kind, DATA_SAMPLERS) or object
        bases = {base.__name__ for base in found.__mro__}
        if loader and wanted not in bases:
            raise InputError(
                f"{cfg.filename}: {part}_dataloader.sampler is {kind!r}, which tears scenes apart "
                "(several ranks take turns with their frames), so model.temporal would remember "
                f"other frames than the last: set its type to '{wanted}', or model.temporal=None."
            )
        slots = sampler.get("slots")
        size = loader.get("batch_size")
        if part == "train" and slots != size:
            raise InputError(
                f"{cfg.filename}: train_dataloader.batch_size is {size} and sampler.slots is "
                f"{slots}: a place of the batch is a stream, so set both to one number."
            )
