"""Runs of several configs and seeds, planned and checked before anything trains.

Each run has a work folder of ``tools/train.py``, which also contains the test of the trained model.
The folder contains the whole state of a run, so a comparison that was killed continues when its
command is given again.
"""

import math
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import torch
from mmdet3d.registry import METRICS, MODELS
from mmengine.config import Config
from mmengine.runner import Runner

from gsmap.checkpoints.building import building
from gsmap.checkpoints.named_models import find_checkpoint
from gsmap.checkpoints.reading import read_weights
from gsmap.checkpoints.settings import differences, plain, single_dataset_of
from gsmap.engine.arguments import parse_options
from gsmap.engine.checkpoint_hook import VALIDATED
from gsmap.engine.launch import check_config, read_config
from gsmap.engine.schedules import NEVER, check_schedules, find_milestones, find_schedulers
from gsmap.engine.targets import class_of_type
from gsmap.evaluation.core.evaluator import METRIC_NAMES
from gsmap.evaluation.map_metric import MapMetric
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_json
from gsmap.utils.shards import digest
from gsmap.utils.shipped import shipped_path

SETTINGS = "settings.json"  # settings at the start of a run; a later start must have equal ones
RECORD = "run.json"  # machine, load, command and end of a run
_MAX_DIFFERENCES = 10  # largest number of differences in a message
_digest = cache(digest)  # SHA-256 of a file, computed once for a file that many runs share
_TRAINING_KEYS = (  # settings of a config that affect the training
    "model",
    "optim_wrapper",
    "param_scheduler",
    "train_cfg",
    "randomness",
    "default_hooks",
    "custom_hooks",
    "auto_scale_lr",
    "sync_bn",
)
# Settings that the work folders of earlier versions do not have.
_ADDED_KEYS = ("auto_scale_lr", "load_from", "sync_bn")


class Entry(NamedTuple):
    """A config with overrides.

    Attributes:
        name: Name in tables and folders.
        config: Config file, or the name of a model.
        options: Overrides, ``KEY=VALUE``.
    """

    name: str
    config: str
    options: tuple[str, ...]


def parse_entry(text: str) -> Entry:
    """Read ``CONFIG`` or ``NAME=CONFIG[,KEY=VALUE...]``; commas in brackets belong to a value.

    Raises:
        ValueError: If the name is not valid for a folder, or an override has no value.
    """
    first, *options = _split_at_commas(text)
    name, separator, config = first.rpartition("=")
    if not separator:  # no name is given
        name = Path(config).stem
    if not re.fullmatch(r"[\w.+-]+", name):
        raise InputError(f"{text!r}: a name holds letters, digits and . _ + - only, got {name!r}.")
    for option in options:
        if "=" not in option:
            raise InputError(f"{text!r}: {option!r} is no override; write KEY=VALUE.")
    return Entry(name, config, tuple(options))


def _split_at_commas(text: str) -> list[str]:
    """Split a text at its commas outside of brackets.

    Raises:
        ValueError: If a bracket is not closed, or closed without being open.
    """
    parts = [""]
    depth = 0  # number of open brackets
    for character in text:
        if character == "," and depth == 0:
            parts.append("")
            continue
        parts[-1] += character
        if character in "([":
            depth += 1
        elif character in ")]":
            depth -= 1
            if depth < 0:
                break
    if depth != 0:
        raise InputError(f"{text!r}: close each bracket that you open.")
    return parts


@dataclass(frozen=True)
class Run:
    """One config with one seed.

    Attributes:
        name: Name of the config in the comparison.
        seed: Seed of all random numbers.
        folder: Work folder.
        config: Config file.
        options: All overrides.
        epochs: Number of epochs.
        iterations: Number of training iterations.
        processes: Number of processes that train together.
        settings: All settings that affect the result.
    """

    name: str
    seed: int
    folder: Path
    config: str
    options: tuple[str, ...]
    epochs: int
    iterations: int
    processes: int
    settings: Mapping[str, Any]

    @property
    def label(self) -> str:
        """Name and seed, as in the path of the folder."""
        return f"{self.name}/seed_{self.seed}"

    @property
    def checkpoint(self) -> Path:
        """Last checkpoint of the training."""
        return self.folder / f"epoch_{self.epochs}.pth"

    @property
    def is_trained(self) -> bool:
        """Whether training has ended, with its last validation."""
        # File that the training writes after each validation, with the iteration as its content.
        validated = self.folder / VALIDATED
        if not validated.is_file() or validated.read_text() != str(self.iterations):
            return False
        return self.checkpoint.is_file()

    @property
    def is_done(self) -> bool:
        """Whether the model is trained and tested."""
        return (self.folder / "metrics.json").is_file()

    @property
    def iterations_so_far(self) -> int:
        """Number of iterations in the log."""
        if self.is_done:
            return self.iterations
        # MMEngine names a folder by the time of each start, such as 20261127_093000.
        logs = sorted(self.folder.glob("2*/vis_data/scalars.json"))
        if not logs:
            return 0
        # Lines of the log end with their iteration, as in `"step": 100}`.
        steps = re.findall(r'"step": (\d+)}', logs[-1].read_text())
        return max(map(int, steps), default=0)

    def commands(self) -> dict[str, list[str]]:
        """Commands that train and test the model, by stage: ``train`` and ``test``.

        The training continues from the last checkpoint in the work folder, if there is one.
        """
        train = [str(shipped_path("tools/train.py")), self.config]
        train += ["--work-dir", str(self.folder), "--resume"]
        python = [sys.executable, "-u"]  # output is not buffered
        launcher = python
        if self.processes > 1:
            launcher = [str(shipped_path("tools/dist_run.sh")), str(self.processes)]
            launcher += ["--standalone", "--local_addr=127.0.0.1"]  # torchrun chooses a free port
            train += ["--launcher", "pytorch"]
        test = [str(shipped_path("tools/test.py")), self.config, str(self.checkpoint)]
        test += ["--work-dir", str(self.folder / "test"), "--eval", *METRIC_NAMES]
        test += ["--out", str(self.folder / "results.json")]
        test += ["--metrics-out", str(self.folder / "metrics.json")]
        options = ["--cfg-options", *self.options]
        return {
            "train": [*launcher, *train, *options],
            "test": [*python, *test, *options],
        }


@dataclass(frozen=True)
class Protocol:
    """Settings of all runs of a comparison.

    Attributes:
        seeds: Number of seeds; the seeds are 0, 1, 2 and so on.
        budget: Training iterations of each run.
        out: Folder of all work folders.
        batch: Number of samples of an iteration, over all processes.
        init: Checkpoint or named model at the start of all runs; None trains from scratch.
        options: Overrides of every config.
    """

    seeds: int
    budget: int
    out: Path
    batch: int = 4
    init: str | None = None
    options: tuple[str, ...] = ()


def plan(entries: Sequence[Entry], protocol: Protocol) -> list[Run]:
    """Plan all runs and check them, before anything trains.

    On a GPU, a run has one process. On a CPU, it has as many processes as earlier runs of the
    comparison or, without earlier runs, at most one per core. The batch is divided evenly among the
    processes. Their number affects the results, because batch normalization uses the samples of one
    process only.

    Args:
        entries: The configs with their overrides.
        protocol: Settings of all runs.

    Returns:
        The runs, seed by seed.

    Raises:
        FileNotFoundError: If a config, a checkpoint or a data set does not exist.
        ValueError: If names repeat, the budget is not a whole number of epochs, the configs use
            different data, accumulate gradients over different numbers of iterations or are
            equal, or a work folder has other settings.
    """
    names = [entry.name for entry in entries]
    if len(set(names)) < len(names):
        raise InputError(f"two configs have one name: {names}; write NAME=CONFIG.")
    if protocol.init is not None:
        read_weights(protocol.init)  # raises an error if the weights cannot be used
    processes = _processes(protocol)
    runs = []
    for seed in range(protocol.seeds):
        for entry in entries:
            runs.append(_plan_run(entry, seed, protocol, processes))
    # `differences` returns the unequal settings of two runs, with both values, by dotted name.
    for run in runs[1:]:
        _refuse_differences(
            differences(runs[0].settings["data"], run.settings["data"]),
            fault=f"{runs[0].label} and {run.label} use different data",
            remedy="Compare configs of one data set, split, range and class list.",
        )
        # Otherwise, equal numbers of iterations would be different numbers of optimizer steps.
        _refuse_differences(
            differences(_accumulation(runs[0]), _accumulation(run)),
            fault=f"{runs[0].label} and {run.label} have different numbers of optimizer steps",
            remedy="Set one accumulative_counts for all configs.",
        )
    # Other seeds need no check, since a seed changes the settings of all configs equally.
    runs_of_first_seed = runs[: len(entries)]
    for one, other in combinations(runs_of_first_seed, 2):
        if not differences(one.settings, other.settings):
            raise InputError(
                f"{one.name} and {other.name} would be the same run: no setting of training "
                "differs. Leave one out, or check its overrides."
            )
    for run in runs:
        _check_folder(run)
    return runs


def _accumulation(run: Run) -> dict[str, int]:
    """Number of iterations of an optimizer step, by the name of its setting."""
    counts = (run.settings["optim_wrapper"] or {}).get("accumulative_counts", 1)
    return {"optim_wrapper.accumulative_counts": counts}


def _processes(protocol: Protocol) -> int:
    """Number of processes of each run, which divides the batch."""
    if torch.cuda.device_count():
        return 1
    candidates = []  # in order of preference; the first one that divides the batch is taken
    for path in protocol.out.glob(f"*/seed_*/{SETTINGS}"):  # earlier runs
        candidates.append(_read_settings(path)["processes"])
    cores = len(os.sched_getaffinity(0))  # cores that this process may use
    candidates.extend(range(cores, 0, -1))
    for number in candidates:
        if number > 0 and protocol.batch % number == 0:
            return number
    return 1


def _map_metric(cfg: Config) -> str:
    """Dotted name of the settings of `MapMetric` in the validation, which may have other metrics.

    Raises:
        ValueError: If the validation has a list of metrics without a `MapMetric`.
    """
    name = "val_evaluator"
    metrics = cfg.get(name)
    if isinstance(metrics, Mapping) and "metrics" in metrics:
        name = "val_evaluator.metrics"
        metrics = metrics["metrics"]
    if not isinstance(metrics, list):
        return name
    for number, metric in enumerate(metrics):
        kind = metric.get("type") if isinstance(metric, Mapping) else None
        if issubclass(class_of_type(kind, METRICS) or object, MapMetric):
            return f"{name}.{number}"
    raise InputError(
        f"{cfg.filename}: {name} has no MapMetric, whose figures are compared: add it."
    )


def _plan_run(entry: Entry, seed: int, protocol: Protocol, processes: int) -> Run:
    """Plan one run. Its data set and its model are built once, so that faults are found early."""
    initial_weights = None
    # Overrides of the comparison. Overrides of the user come after them and take precedence.
    comparison_options = [
        f"train_dataloader.batch_size={protocol.batch // processes}",
        f"randomness.seed={seed}",
    ]
    if protocol.init is not None:
        initial_weights = find_checkpoint(protocol.init).resolve()
        comparison_options.append(f"load_from={initial_weights}")
    user_options = (*entry.options, *protocol.options)
    # The config is read twice: the overrides added below depend on its metrics, data and schedule.
    cfg = read_config(entry.config, parse_options([*comparison_options, *user_options]))
    comparison_options.insert(1, f"{_map_metric(cfg)}.eval=chamfer,raster")
    epochs = _count_epochs(entry, cfg, protocol=protocol, processes=processes)
    comparison_options.append(f"train_cfg.max_epochs={epochs}")
    comparison_options.append(f"train_cfg.val_interval={max(1, epochs // 4)}")
    comparison_options += _schedule_options(cfg, epochs=epochs, iterations=protocol.budget)
    options = (*comparison_options, *user_options)
    cfg = read_config(entry.config, parse_options(options))
    check_config(cfg)
    check_schedules(cfg, iterations=protocol.budget)
    if cfg.train_cfg.max_epochs != epochs:
        raise InputError(f"{entry.name}: the budget decides train_cfg.max_epochs; leave it out.")
    with building(cfg):  # adds the name of the config to errors
        MODELS.build(cfg.model)
    # `plain` copies settings as JSON types, so that they equal the settings read from a file.
    dataset = plain(cfg.train_dataloader.dataset)  # a copy, so the config is not changed
    # The data may be moved to other paths; "data" below has a digest of its content.
    for key in ("data_root", "ann_file"):
        dataset.pop(key, None)
    settings = {key: plain(cfg.get(key)) for key in _TRAINING_KEYS}
    settings["processes"] = processes
    settings["batch"] = protocol.batch
    settings["data"] = _data_settings(cfg)
    settings["sampler"] = plain(cfg.train_dataloader.get("sampler"))
    settings["dataset"] = dataset
    settings["init"] = None
    if initial_weights is not None:
        settings["init"] = _digest(initial_weights)
    settings["load_from"] = _weights_of(cfg)
    folder = protocol.out.resolve() / entry.name / f"seed_{seed}"
    return Run(
        name=entry.name,
        seed=seed,
        folder=folder,
        config=entry.config,
        options=options,
        epochs=epochs,
        iterations=protocol.budget,
        processes=processes,
        settings=settings,
    )


def _schedule_options(cfg: Config, epochs: int, iterations: int) -> list[str]:
    """Overrides that fit the schedules of a config to another length of the training.

    Args:
        cfg: Config whose schedules are fitted.
        epochs: New number of epochs.
        iterations: New number of iterations.

    Raises:
        ValueError: If a schedule has more milestones than there are epochs for them.
    """
    options: list[str] = []
    old_epochs = cfg.train_cfg.get("max_epochs") or epochs
    for name, scheduler in find_schedulers(cfg).items():
        if scheduler.get("by_epoch", True):
            options += _epoch_options(name, scheduler, old_end=old_epochs, end=epochs)
        # The config does not tell its number of iterations, so milestones cannot be scaled.
        elif "T_max" in scheduler and "end" not in scheduler:
            options.append(f"{name}.T_max={iterations - scheduler.get('begin', 0)}")
    return options


def _epoch_options(name: str, scheduler: Mapping[str, Any], old_end: int, end: int) -> list[str]:
    """Overrides that fit a schedule over epochs to another length of the training.

    A schedule that lasts until the end of the training does so again: milestones and the step sizes
    of ``StepLR`` are scaled in proportion. The begin of a schedule, and a whole schedule that ends
    before the training, stay as they are.

    Args:
        name: Dotted name of the schedule.
        scheduler: Its settings.
        old_end: Number of epochs of the config.
        end: New number of epochs.

    Raises:
        ValueError: If the schedule has more milestones than there are epochs for them.
    """
    options: list[str] = []
    own_end = scheduler.get("end", NEVER)
    if isinstance(own_end, int | float) and own_end < NEVER:  # `check_config` refuses other types
        if own_end < old_end:
            return []
        options.append(f"{name}.end={end}")
    begin = scheduler.get("begin", 0)
    length = end - begin
    if "T_max" in scheduler:
        options.append(f"{name}.T_max={length}")
    old_length = old_end - begin
    if old_length < 1 or length == old_length:
        return options
    milestones = find_milestones(scheduler)
    if milestones:
        scaled = _scale_milestones(name, milestones, old_length=old_length, length=length)
        options.append(f"{name}.milestones=[{','.join(map(str, scaled))}]")
    step_size = scheduler.get("step_size")
    if isinstance(step_size, int | float):
        options.append(f"{name}.step_size={max(1, round(step_size * length / old_length))}")
    return options


def _scale_milestones(
    name: str, milestones: Sequence[float], old_length: int, length: int
) -> list[int]:
    """Scale milestones to another length of their schedule.

    Args:
        name: Dotted name of the schedule, for the error.
        milestones: Epochs of the schedule.
        old_length: Number of epochs of the schedule.
        length: Number of epochs of the result.

    Returns:
        Different epochs in increasing order, from 1. They lie before the end if the milestones do;
        otherwise `check_config` refuses them.

    Raises:
        ValueError: If there are not enough epochs before the end.
    """
    if len(milestones) >= length:
        raise InputError(
            f"the budget is {length} epochs of {name}, too few for a change at each of its "
            f"{len(milestones)} milestones: give a larger --budget, or fewer milestones as an "
            f"override of the config, {name}.milestones=[...]."
        )
    scaled: list[int] = []
    for index, milestone in enumerate(sorted(milestones)):
        epoch = round(milestone * length / old_length)
        if milestone < old_length:
            # Each later milestone needs an epoch before the end.
            epoch = min(epoch, length - len(milestones) + index)
        earliest = scaled[-1] + 1 if scaled else 1
        scaled.append(max(epoch, earliest))
    return scaled


def _weights_of(cfg: Config) -> str | None:
    """Digest of the checkpoint that the training starts from, or its address; None without one."""
    source = cfg.get("load_from")
    if source is None or "://" in source:
        return source
    return _digest(find_checkpoint(source))


def _count_epochs(entry: Entry, cfg: Config, protocol: Protocol, processes: int) -> int:
    """Number of epochs that have the iterations of the budget.

    Raises:
        ValueError: If the budget is not a whole number of epochs, or an epoch has no iteration.
    """
    iterations_per_epoch = _count_iterations(cfg, processes=processes)
    if iterations_per_epoch == 0:
        raise InputError(
            f"an epoch of {entry.name} has no iteration: train_dataloader.drop_last leaves out its "
            f"only batch, of less than {protocol.batch} samples. Give a smaller --batch."
        )
    epochs = round(protocol.budget / iterations_per_epoch) or 1  # at least 1
    if epochs * iterations_per_epoch != protocol.budget:
        raise InputError(
            f"a budget of {protocol.budget} iterations is no whole number of epochs of {entry.name}"
            f" ({iterations_per_epoch} iterations each): give {epochs * iterations_per_epoch}."
        )
    return epochs


def _count_iterations(cfg: Config, processes: int) -> int:
    """Number of iterations of an epoch, by the data loader of the training."""
    single_dataset_of(cfg, part="train", purpose="a comparison")  # raises an error for wrappers
    settings = cfg.train_dataloader.to_dict()  # a copy
    settings |= {"num_workers": 0, "persistent_workers": False, "prefetch_factor": None}
    settings["multiprocessing_context"] = None  # not allowed without workers
    batch_size = settings["batch_size"]
    # This process builds the loader of all processes together, which have more streams.
    settings["batch_size"] *= processes
    with building(cfg):  # adds the name of the config to errors
        if "slots" in (settings["sampler"] or {}):
            settings["sampler"]["slots"] *= processes
        loader = Runner.build_dataloader(settings, seed=0)
    if settings.get("batch_sampler") is not None:
        return len(loader)
    samples_per_process = math.ceil(len(loader.sampler) / processes)
    rounded = math.floor if loader.drop_last else math.ceil
    return rounded(samples_per_process / batch_size)


def _data_settings(cfg: Config) -> dict[str, Any]:
    """Settings that identify the data of training and test."""
    settings: dict[str, Any] = {}
    # Paths are left out, but the digests of the annotation files are included.
    for part in ("train", "test"):
        dataset = single_dataset_of(cfg, part=part, purpose="a comparison")
        path = Path(dataset.get("data_root", ""), dataset.ann_file)
        keys = ("split", "classes", "grid", "frame", "cameras", "indices")
        settings[part] = {key: plain(dataset.get(key)) for key in keys}
        settings[part]["file"] = _digest(path)
    return settings


def _refuse_differences(unequal: Mapping[str, tuple[Any, Any]], *, fault: str, remedy: str) -> None:
    """Raise an InputError that names unequal settings, if there are any.

    Args:
        unequal: Both values of each unequal setting, by its name.
        fault: Beginning of the message.
        remedy: End of the message: advice to the user.
    """
    if not unequal:
        return
    pairs = [f"{key}: {one} and {other}" for key, (one, other) in unequal.items()]
    raise InputError(f"{fault}: {'; '.join(pairs[:_MAX_DIFFERENCES])}. {remedy}")


def _read_settings(path: Path) -> dict[str, Any]:
    """Read the settings of an earlier start."""
    settings = read_json(path)
    if not isinstance(settings, dict) or not isinstance(settings.get("processes"), int):
        raise InputError(f"{path} holds no settings of a run: give another --out, or remove it.")
    return settings


def _check_folder(run: Run) -> None:
    """Raise an InputError if the work folder belongs to another run or has other content."""
    path = run.folder / SETTINGS
    if path.is_file():
        unknown = {key: run.settings[key] for key in _ADDED_KEYS}
        _refuse_differences(
            differences({**unknown, **_read_settings(path)}, plain(run.settings)),
            fault=f"{run.folder} holds a run of other settings",
            remedy="Give another --out, or remove it.",
        )
    elif run.folder.is_dir() and any(run.folder.iterdir()):
        raise InputError(
            f"{run.folder} holds something else than a run of this comparison: give another --out."
        )
