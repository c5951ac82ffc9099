"""Reading, overriding and checking of configs, and the newest checkpoint of a work folder."""

import argparse
import errno
import inspect
import logging
import os
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from datetime import timedelta
from functools import cache
from pathlib import Path
from typing import Any

import torch
from mmdet3d.registry import DATA_SAMPLERS, LOOPS, OPTIMIZERS, RUNNERS
from mmengine.config import Config
from mmengine.logging import print_log
from mmengine.registry import Registry, init_default_scope
from mmengine.utils import import_modules_from_strings

from gsmap.checkpoints.building import reading_config
from gsmap.checkpoints.named_models import find_config
from gsmap.checkpoints.settings import innermost_datasets, pipeline_steps, scale_steps
from gsmap.engine.map_agreement import check_map_agreement
from gsmap.engine.rank_watch import TIMEOUT_S
from gsmap.engine.schedules import check_schedules
from gsmap.engine.targets import check_targets, class_of_type, share_settings
from gsmap.utils.errors import InputError
from gsmap.utils.faults import registry_names, suggestion
from gsmap.utils.files import DAMAGED_ZIP
from gsmap.utils.overrides import check_kinds
from gsmap.utils.parallel import LAUNCHER, die_with_parent

# Keys that configs copy into other sections; no code reads them at the top level. An override of
# such a key changes nothing (`_check_effect`).
_COPIED_KEYS = ("backend_args", "classes", "data_root", "grid", "vis_backends")
# Valid top-level keys in addition to the runner's arguments; mmengine ignores a misspelt key
_EXTRA_KEYS = (
    *_COPIED_KEYS, "custom_imports", "find_unused_parameters", "model_wrapper_cfg", "runner_type",
    "images_on_device", "strategy", "sync_bn",
)  # fmt: skip
NEWEST = "last_checkpoint"  # file in a work folder with the path of its latest checkpoint
_MAX_WORKERS = 16
# Endings of the top-level keys whose values must be dictionaries
_SECTIONS = ("_cfg", "_dataloader", "default_hooks", "model", "optim_wrapper", "randomness")
# Keys whose values are configs of a class (dictionaries), or lists of such configs
_PART_LISTS = ("custom_hooks", "param_scheduler")


@cache
def _known_keys() -> frozenset[str]:
    """Return the valid top-level keys of a config."""
    # this import is slow
    from mmengine.runner import Runner

    # The argument `cfg` of the runner is the whole config.
    runner_keys = frozenset(inspect.signature(Runner).parameters) - {"cfg"}
    return runner_keys | set(_EXTRA_KEYS)


def read_config(config: str | Path | Config, cfg_options: dict | None = None) -> Config:
    """Read a config and apply overrides to it.

    Imports the modules that register the config's classes, and makes its scope the default scope.

    Args:
        config: File or name of a config (`find_config`), or a ``Config``, which is copied.
        cfg_options: Overrides by dotted name. The name ``image_scale`` sets the scale of all
            images, and ``data_root`` the data root of all data sets.

    Returns:
        The config, complete for building a runner or a model.

    Raises:
        FileNotFoundError: If there is no such file or model.
        ValueError: If the config cannot be read or has an unknown top-level key, or if an override
            does not fit or has no effect.
    """
    if isinstance(config, Config):
        cfg = Config(config.to_dict())
    else:
        path = find_config(config)
        # `reading_config` names the config, or the part of it, in the message of an error.
        with reading_config(source=path):
            cfg = Config.fromfile(path, import_custom_modules=False)
    options = dict(cfg_options or {})
    factor = options.pop("image_scale", None)
    data_root = options.pop("data_root", None)
    for name in options:
        _check_effect(cfg, name=name)
    # Raises an error if an override has another kind of value than the setting, for example a
    # number in place of a dictionary.
    check_kinds(cfg.to_dict(), overrides=options, source=cfg.filename or "the config")
    if data_root is not None:  # before the overrides, which may set another root for a split
        _set_data_root(cfg, data_root=str(data_root))
    with reading_config(source=f"--cfg-options of {cfg.filename or 'a config'}"):
        cfg.merge_from_dict(options)
    if factor is not None:
        _scale_images(cfg, factor=factor)
    _check_keys(cfg)
    _fit_loaders(cfg)
    with reading_config(source=f"custom_imports of {cfg.filename or 'a config'}"):
        import_modules_from_strings(["gsmap.registered"])  # registers the classes of GSMap
        import_modules_from_strings(**cfg.get("custom_imports", {"imports": []}))
    init_default_scope(cfg.get("default_scope", "mmdet3d"))
    share_settings(cfg)  # copies settings of the head to the transforms that make its targets
    return cfg


def _set_data_root(cfg: Config, data_root: str) -> None:
    """Set the data root of all data sets of a config, in place.

    Raises:
        ValueError: If the config has no data set.
    """
    datasets: list[Any] = []
    for split in ("train", "val", "test"):
        dataset = (cfg.get(f"{split}_dataloader") or {}).get("dataset")
        if dataset:
            datasets += innermost_datasets(dataset)
    if not datasets:
        raise InputError(f"--data-root: {cfg.filename or 'the config'} has no data set.")
    for innermost_dataset in datasets:
        innermost_dataset.data_root = data_root


def _scale_images(cfg: Config, factor: float) -> None:
    """Set the image scale of all pipelines of a config, in place.

    Raises:
        ValueError: If no pipeline scales images.
    """
    steps = scale_steps(cfg, "train", "val", "test")
    if not steps:
        raise InputError(f"--image-scale: no pipeline of {cfg.filename} has ScaleImages.")
    for step in steps:  # ScaleImages takes either a scale or a size
        step.update(scale=factor, size=None)


def _fit_loaders(cfg: Config) -> None:
    """Adapt the data loaders of a config to the machine, in place.

    The value ``"cores"`` of ``num_workers`` is replaced by the number of cores per process, at most
    16. With ``images_on_device``, decoded images are copied to the device from pinned memory, and
    pixel transforms run on the device.

    Raises:
        ValueError: If ``images_on_device`` is set and a transform reads the pixels on the host.
    """
    for split in ("train", "val", "test"):
        loader = cfg.get(f"{split}_dataloader")
        if not loader:
            continue
        if loader.get("num_workers") == "cores":
            # torchrun sets the number of processes on this machine, which share the cores.
            processes = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
            cores = len(os.sched_getaffinity(0)) // processes
            loader.num_workers = min(max(cores, 1), _MAX_WORKERS)
        if not cfg.get("images_on_device"):
            continue
        loader.pin_memory = True
        for step in pipeline_steps(cfg, split):
            if step.type == "LoadCameraImages":
                step.on_device = True
            elif step.type == "MultiViewWrapper":
                raise InputError(
                    f"{cfg.filename}: images_on_device cannot be used with {step.type}, which "
                    "reads pixels on the host: take DistortImages in its place, or leave out "
                    "images_on_device."
                )


def load_config(args: argparse.Namespace, for_training: bool = True) -> Config:
    """Read the config of a command, apply the command-line options, and check the result.

    Top-level keys ``_name``, which configs copy into other sections, are removed. So logs and
    dumped configs show only settings with an effect.

    With the launcher ``pytorch``, the process ends when the launcher ends. Without a GPU, this
    function then also opens the process group, so that the processes communicate through gloo,
    independent of the config.

    Args:
        args: Parsed arguments; ``config`` and the options of `add_common_arguments` are used.
        for_training: Whether the command trains; `check_config` has the difference.

    Raises:
        FileNotFoundError: If there is no such file or model.
        ValueError: As in `read_config` and `check_config`.
    """
    # mmengine reads the number of this process on its machine from the environment. A number that
    # is set there already is kept.
    os.environ.setdefault("LOCAL_RANK", str(args.local_rank))
    cfg = read_config(args.config, cfg_options=args.cfg_options)
    cfg.launcher = args.launcher
    if args.work_dir:
        cfg.work_dir = args.work_dir
    elif cfg.get("work_dir") is None:
        cfg.work_dir = str(Path("work_dirs") / Path(args.config).stem)
    check_config(cfg, for_training=for_training)
    for name in list(cfg):  # a list, because the config loses keys in the loop
        if name.startswith("_"):
            cfg.pop(name)
    if args.launcher == "pytorch":
        # torchrun cannot stop its ranks (processes of the run) if it is killed with SIGKILL. So
        # each rank asks Linux to kill it when the launcher ends. The constant LAUNCHER is the name
        # of an environment variable with the launcher's process id. Without the variable, the
        # parent is the launcher.
        launcher_process = int(os.environ.pop(LAUNCHER, os.getppid()))
        die_with_parent(launcher_process)
    if args.launcher == "pytorch" and not torch.cuda.is_available():
        # Without these settings, mmengine would select a CUDA device, and pass its index to the
        # wrapper of the model.
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
    """Return the timeout of collective operations between ranks, in seconds.

    Raises:
        ValueError: If ``env_cfg.dist_cfg.timeout`` is not a positive number.
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
    """Find the newest valid checkpoint of a run.

    A checkpoint is valid if it is undamaged and ``read`` accepts it. A warning is logged for each
    invalid checkpoint that is newer than the result, and for those that an earlier run left.

    Args:
        work_dir: Folder of the run.
        read: Function that is called with the path of an undamaged checkpoint, from the newest on,
            until it accepts one. It raises ``ValueError`` if the checkpoint cannot be used. None
            accepts every undamaged checkpoint.

    Returns:
        Path of the checkpoint, or None if there is no valid one.
    """
    numbers = numbered_checkpoints(work_dir=work_dir)
    earlier = _left_by_earlier_run(numbers=numbers, noted=Path(work_dir, NEWEST))
    if earlier:
        names = ", ".join(path.name for path in earlier)
        text = f"{work_dir}: {names} left out, from an earlier run than the latest checkpoint."
        print_log(text, level=logging.WARNING)
    for path in earlier:
        del numbers[path]
    # A run counts either epochs or iterations, so its numbers can be compared.
    newest_first = sorted(numbers, key=numbers.__getitem__, reverse=True)
    for path in newest_first:
        reason = f"{path} is damaged and is passed over."
        try:
            if _is_undamaged_zip(path):
                if read is not None:
                    read(path)
                return path
        except ValueError as error:
            reason = f"{error} It is passed over."
        print_log(reason, level=logging.WARNING)
    return None


def numbered_checkpoints(work_dir: str | Path) -> dict[Path, int]:
    """Return the number of the epoch or iteration of each checkpoint in a work folder."""
    numbers: dict[Path, int] = {}
    for path in Path(work_dir).glob("*.pth"):
        match = re.fullmatch(r"(?:epoch|iter)_(\d+)\.pth", path.name)
        if match:
            numbers[path] = int(match[1])
    return numbers


def _left_by_earlier_run(numbers: dict[Path, int], noted: Path) -> list[Path]:
    """Return the checkpoints of an earlier run that a newer run has not replaced.

    They have a higher number than the latest checkpoint and are older. A newer file with a higher
    number was saved by a run that was killed before it noted its name.

    Args:
        numbers: Number of each checkpoint.
        noted: File with the path of the latest checkpoint; its text is untrusted.
    """
    if not noted.is_file():
        return []
    name = Path(noted.read_text(encoding="utf-8", errors="replace")).name
    path_of_name = {path.name: path for path in numbers}
    latest = path_of_name.get(name)
    if latest is None:
        return []
    written_ns = latest.stat().st_mtime_ns
    earlier = []
    for path, number in numbers.items():
        if number > numbers[latest] and path.stat().st_mtime_ns < written_ns:
            earlier.append(path)
    return sorted(earlier, key=numbers.__getitem__)


def _is_undamaged_zip(path: Path) -> bool:
    """Whether a file is a zip archive whose members have the right checksums.

    PyTorch writes checkpoints as zip archives.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.testzip() is None  # it returns the name of the first damaged member
    except DAMAGED_ZIP:
        return False
    except OSError as error:
        if error.errno == errno.EINVAL:  # the damaged archive refers to a negative file position
            return False
        raise


def check_config(cfg: Config, for_training: bool = True) -> None:
    """Check the values of a config for mistakes that mmengine accepts without an error.

    Args:
        cfg: Config, as returned by `read_config`.
        for_training: Whether the settings that only a training uses are checked, too. A config that
            cannot be trained here may still be tested.

    Raises:
        ValueError: If one of these mistakes is found. The training has no epoch, or a setting of a
            loop has a wrong type. The runner or backend does not exist. The sampler of a temporal
            model does not keep the order of frames. The range or the classes of the model differ
            from the test data set. For a training also: They differ from the data set of training
            or validation. A schedule does not fit the length of the training. The optimizer does
            not exist. The pipeline lacks a transform that the head needs, or settings of this
            transform contradict the head. The batch size of a temporal model is not the number of
            streams. A model with a memory is trained by iterations. Checkpoints count epochs in a
            training by iterations, or the reverse, or are written elsewhere.
    """
    _check_lengths(cfg)
    _check_backend(cfg)
    _check_streams(cfg, for_training=for_training)
    parts = ("train", "val", "test") if for_training else ("test",)
    check_map_agreement(cfg, *parts)  # range and classes of the model and its data sets
    runner_type = cfg.get("runner_type", "Runner")
    _check_registered(cfg, component="runner", registry=RUNNERS, type_name=runner_type)
    if not for_training:
        return
    check_targets(cfg)  # transforms that compute the targets of the head
    _check_memory_loop(cfg)
    _check_checkpoints(cfg)
    check_schedules(cfg)
    optimizer = (cfg.get("optim_wrapper") or {}).get("optimizer") or {}
    # Without this check, mmengine would build a run without an optimizer.
    _check_registered(
        cfg, component="optimizer", registry=OPTIMIZERS, type_name=optimizer.get("type")
    )


def _check_lengths(cfg: Config) -> None:
    """Require a training of at least one epoch or iteration, and valid settings of the loops.

    For 0 epochs, mmengine would train nothing and raise no error.
    """
    settings = cfg.get("train_cfg") or {}
    for name in ("max_epochs", "max_iters", "val_begin", "val_interval"):
        value = settings.get(name)
        if value is not None and (not isinstance(value, int) or value < 1):
            raise InputError(
                f"{cfg.filename}: train_cfg.{name} must be an integer >= 1, got {value!r:.60}."
            )
    for section in ("val_cfg", "test_cfg"):
        fp16 = (cfg.get(section) or {}).get("fp16", False)
        if not isinstance(fp16, bool):
            raise InputError(
                f"{cfg.filename}: {section}.fp16 must be True or False, got {fp16!r:.60}."
            )


def _check_backend(cfg: Config) -> None:
    """Require a backend of torch for the communication between ranks."""
    backend = cfg.get("env_cfg", {}).get("dist_cfg", {}).get("backend")
    if backend is None or not torch.distributed.is_available():
        return
    known = torch.distributed.Backend.backend_list
    if backend not in known:
        raise InputError(
            f"{cfg.filename}: env_cfg.dist_cfg.backend must be one of {', '.join(known)}, got "
            f"{backend!r:.60}."
        )


def _check_registered(cfg: Config, component: str, registry: Registry, type_name: Any) -> None:
    """Require that a class name of a config is in a registry.

    Args:
        cfg: Config that names the class.
        component: Part of the run that the class implements, for the error.
        registry: Registry of mmengine.
        type_name: Name of the class. A class itself, or None, is not checked.

    Raises:
        ValueError: If the registry has no such class.
    """
    if isinstance(type_name, str) and registry.get(type_name) is None:
        # The text "; did you mean ...?", or an empty text if no name is similar. A full stop then
        # ends the message.
        hint = suggestion(type_name, names=registry_names(registry)) or "."
        raise InputError(f"{cfg.filename}: there is no {component} of type {type_name!r}{hint}")


def _check_effect(cfg: Config, name: str) -> None:
    """Refuse an override of a template value, because the settings in use are copies of it.

    Template values are the top-level keys ``_name`` and `_COPIED_KEYS`. The error names the copies
    that the user can override in place of the template value.

    Args:
        cfg: Config before the override.
        name: Dotted name of the override.

    Raises:
        ValueError: If the override changes a template value.
    """
    top, *keys = name.split(".")
    if not (top.startswith("_") or top in _COPIED_KEYS):
        return
    value: Any = cfg.get(top)  # becomes the value of the name, None if there is none
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    # A copy of _name is expected in a setting of that name without the underscore.
    last_key = keys[-1] if keys else top.removeprefix("_")
    settings = {}
    for key, setting in cfg.items():
        if key not in _COPIED_KEYS and not key.startswith("_"):
            settings[key] = setting
    copies = list(_find_copies(settings, key=last_key, value=value, prefix=""))
    remedy = f"give {', '.join(copies)}, or edit" if copies else "edit"
    raise InputError(
        f"--cfg-options {name} changes nothing: the other settings have copies of it, made when "
        f"the config was read. Instead {remedy} {cfg.filename or 'the config'}."
    )


def _find_copies(settings: Any, key: str, value: Any, prefix: str) -> Iterator[str]:
    """Yield the dotted names of the settings that have a given key and value.

    Args:
        settings: Nested dictionaries and lists.
        key: Last part of the names.
        value: Value of the settings.
        prefix: Dotted name of ``settings``, with a final dot; empty at the top level.
    """
    if isinstance(settings, list | tuple):
        settings = dict(enumerate(settings))  # dotted names contain the indices of list entries
    if not isinstance(settings, dict):
        return
    for inner_key, inner_value in settings.items():
        if inner_key == key and inner_value == value:
            yield f"{prefix}{inner_key}"
        else:
            inner_prefix = f"{prefix}{inner_key}."
            yield from _find_copies(inner_value, key=key, value=value, prefix=inner_prefix)


def _check_keys(cfg: Config) -> None:
    """Refuse unknown top-level keys, and sections of the wrong type."""
    for key, value in cfg.items():
        is_known = key in _known_keys()
        is_section = is_known and key.endswith(_SECTIONS)
        if is_section and not isinstance(value, dict | None):
            raise InputError(f"{cfg.filename}: {key} must be dict(...), got {value!r:.60}.")
        if key in _PART_LISTS and not isinstance(value, dict | None):
            is_list = isinstance(value, list | tuple)
            if not is_list or not all(isinstance(entry, dict) for entry in value):
                raise InputError(
                    f"{cfg.filename}: {key} must be a list of dict(...), got {value!r:.60}."
                )
        if key == "load_from" and not isinstance(value, str | None):
            raise InputError(f"{cfg.filename}: load_from must be a path, got {value!r:.60}.")
        if key == "resume" and not isinstance(value, bool | None):
            raise InputError(
                f"{cfg.filename}: resume must be True or False, got {value!r:.60}; a checkpoint to "
                "resume from is load_from."
            )
        if is_known or key.startswith("_"):
            continue
        hint = suggestion(key, names=_known_keys())
        if not hint:
            hint = "; names of a config's own values start with '_'."
        raise InputError(f"{cfg.filename}: unknown top-level key {key!r}{hint}")


def _has_trained_stream_memory(temporal: Mapping[str, Any]) -> bool:
    """Whether a temporal model is trained with its memory: one of map elements alone is not."""
    return temporal.get("bev") is not None or temporal.get("queries") is not None


def has_trained_memory(cfg: Config) -> bool:
    """Whether the model of a config remembers earlier frames or a map of them in training."""
    model = cfg.get("model") or {}
    if _has_trained_stream_memory(model.get("temporal") or {}):
        return True
    # A prior that reads a window of a raster map is written to in training, too.
    prior_class = class_of_type(kind=(model.get("prior") or {}).get("type"))
    return getattr(prior_class, "reads_window", False)


def _check_memory_loop(cfg: Config) -> None:
    """Require a loop of epochs if the model has a memory in training.

    A loop of iterations sets the training mode before each iteration, and a change of the mode
    empties the memory.
    """
    if _counts_epochs(cfg) is False and has_trained_memory(cfg):
        raise InputError(
            f"{cfg.filename}: train_cfg counts iterations, in which the memory of the model "
            "(model.temporal or model.prior) would be empty: set train_cfg to "
            "dict(type='EpochBasedTrainLoop', max_epochs=...)."
        )


def _counts_epochs(cfg: Config) -> bool | None:
    """Whether the training loop counts epochs; None if this is unknown."""
    settings = cfg.get("train_cfg") or {}
    kind = settings.get("type")
    if kind is None:
        by_epoch = settings.get("by_epoch")
        return None if by_epoch is None else bool(by_epoch)
    from mmengine.runner import EpochBasedTrainLoop, IterBasedTrainLoop  # slow to import

    loop_class = class_of_type(kind=kind, registry=LOOPS) or object
    if issubclass(loop_class, EpochBasedTrainLoop):
        return True
    if issubclass(loop_class, IterBasedTrainLoop):
        return False
    return None


def _check_checkpoints(cfg: Config) -> None:
    """Require checkpoints from which ``--resume`` can continue.

    They count as the training loop does, and have the default names in the work folder.
    """
    hook = (cfg.get("default_hooks") or {}).get("checkpoint", {})
    if not isinstance(hook, dict):  # None: no checkpoints
        return
    setting = "default_hooks.checkpoint"
    counts_epochs = _counts_epochs(cfg=cfg)
    if counts_epochs is not None and hook.get("by_epoch", True) != counts_epochs:
        unit = "epochs" if counts_epochs else "iterations"
        raise InputError(
            f"{cfg.filename}: train_cfg counts {unit} and {setting} does not, so --resume could "
            f"not continue where a training stopped: set {setting}.by_epoch={counts_epochs}, and "
            f"{setting}.interval to a number of {unit}."
        )
    remedies = {"out_dir": "give --work-dir", "filename_tmpl": "leave it out"}
    for name, remedy in remedies.items():
        if hook.get(name) is not None:
            raise InputError(
                f"{cfg.filename}: {setting}.{name} is set, but --resume finds only checkpoints "
                f"with default names in the work folder: {remedy}."
            )


def _check_streams(cfg: Config, for_training: bool) -> None:
    """Require samplers that keep the frames of each scene in order if the model is temporal.

    A temporal model remembers features, queries or map elements of the previous frame.

    Args:
        cfg: Config to check.
        for_training: Whether the sampler of the training is checked, too.
    """
    temporal = (cfg.get("model") or {}).get("temporal")
    if temporal is None:
        return
    samplers = {"val": "StreamTestSampler", "test": "StreamTestSampler"}
    if for_training and _has_trained_stream_memory(temporal):
        samplers["train"] = "StreamTrainSampler"
    for split, needed_sampler in samplers.items():
        loader = cfg.get(f"{split}_dataloader") or {}
        sampler = loader.get("sampler") or {}
        kind = sampler.get("type")
        # For an unknown type, `class_of_type` returns None. `object` then takes its place, whose
        # name is not the needed one.
        sampler_class = class_of_type(kind=kind, registry=DATA_SAMPLERS) or object
        # Subclasses of the needed sampler are allowed.
        class_names = {base.__name__ for base in sampler_class.__mro__}
        if loader and needed_sampler not in class_names:
            raise InputError(
                f"{cfg.filename}: {split}_dataloader.sampler is {kind!r}, which may give the "
                "frames of a scene to several ranks, so model.temporal would not remember the "
                f"previous frame: set the sampler's type to '{needed_sampler}', or "
                "model.temporal=None."
            )
        slots = sampler.get("slots")  # number of streams of frames that are read in parallel
        batch_size = loader.get("batch_size")
        if split == "train" and slots != batch_size:
            raise InputError(
                f"{cfg.filename}: train_dataloader.batch_size is {batch_size} and sampler.slots is "
                f"{slots}: each place in the batch follows one stream, so set both to one number."
            )
