"""Runs of several configs and seeds, planned and checked before anything trains.

Each run is a work folder of ``tools/train.py`` with its test in it; nothing is known of a run that
does not stand there, so a comparison that was killed goes on when its command is given again.
"""

import math
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain, combinations
from pathlib import Path
from typing import Any, NamedTuple

import torch
from mmdet3d.registry import DATASETS, MODELS
from mmengine.config import Config

from gsmap.checkpoints.building import building
from gsmap.checkpoints.named_models import find_checkpoint
from gsmap.checkpoints.reading import read_weights
from gsmap.checkpoints.settings import differences, plain
from gsmap.engine.arguments import parse_options
from gsmap.engine.checkpoint_hook import VALIDATED
from gsmap.engine.launch import check_config, read_config
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_json
from gsmap.utils.shards import digest
from gsmap.utils.shipped import shipped

SETTINGS = "settings.json"  # what a run was started with; another start must agree
RECORD = "run.json"  # machine, load, command and end of a run
_SHOWN = 10
_digest = cache(digest)  # of files that many runs share
_DECIDING = (
    *("model", "optim_wrapper", "param_scheduler", "train_cfg", "randomness"),
    *("default_hooks", "custom_hooks"),
)


class Entry(NamedTuple):
    """A config with overrides.

    Attributes:
        name: Its name in tables and folders.
        config: Config file, or the name of a model.
        options: Overrides, ``KEY=VALUE``.
    """

    name: str
    config: str
    options: tuple[str, ...]


def parse_entry(text: str) -> Entry:
    """Read ``CONFIG`` or ``NAME=CONFIG[,KEY=VALUE...]``; commas within brackets are a value's.

    Raises:
        ValueError: If the name cannot be a folder's, or an override has no value.
    """
    first, *options = re.split(r",(?![^\[(]*[\])])", text)
    name, given, config = first.rpartition("=")
    name = name if given else Path(config).stem
    if not re.fullmatch(r"[\w.+-]+", name):
        raise InputError(f"{text!r}: a name holds letters, digits and . _ + - only, got {name!r}.")
    for option in options:
        if "=" not in option:
            raise InputError(f"{text!r}: {option!r} is no override; write KEY=VALUE.")
    return Entry(name, config, tuple(options))


@dataclass(frozen=True)
class Run:
    """One config with one seed.

    Attributes:
        name: Name of its config in the comparison.
        seed: Seed of every random choice.
        folder: Its work folder.
        config: Config file.
        options: All overrides.
        epochs: Epochs to train.
        iterations: Optimizer steps of these.
        processes: Processes that train together.
        settings: Whatever decides its outcome.
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
        """Its name and seed, as the folder has them."""
        return f"{self.name}/seed_{self.seed}"

    @property
    def checkpoint(self) -> Path:
        """Checkpoint that training ends with."""
        return self.folder / f"epoch_{self.epochs}.pth"

    @property
    def trained(self) -> bool:
        """Whether training has ended, with its last validation."""
        validated = self.folder / VALIDATED
        ended = validated.is_file() and validated.read_text() == str(self.iterations)
        return ended and self.checkpoint.is_file()

    @property
    def done(self) -> bool:
        """Whether it is trained and tested."""
        return (self.folder / "metrics.json").is_file()

    @property
    def position(self) -> int:
        """Iterations that its log tells of."""
        if self.done:
            return self.iterations
        logs = sorted(self.folder.glob("2*/vis_data/scalars.json"))
        steps = re.findall(r'"step": (\d+)}', logs[-1].read_text()) if logs else []
        return max(map(int, steps), default=0)

    def commands(self) -> dict[str, list[str]]:
        """Return the commands that train and test it."""
        train = [str(shipped("tools/train.py")), self.config]
        train += ["--work-dir", str(self.folder), "--resume"]
        python = [sys.executable, "-u"]
        launcher = python
        if self.processes > 1:  # torchrun chooses a free port itself if it stands alone
            launcher = [str(shipped("tools/dist_run.sh")), str(self.processes)]
            launcher += ["--standalone", "--local_addr=127.0.0.1"]
            train += ["--launcher", "pytorch"]
        test = [str(shipped("tools/test.py")), self.config, str(self.checkpoint)]
        test += ["--work-dir", str(self.folder / "test")]
        test += ["--out", str(self.folder / "results.json")]
        test += ["--metrics-out", str(self.folder / "metrics.json")]
        options = ["--cfg-options", *self.options]
        return {
            "train": [*launcher, *train, *options],
            "test": [*python, *test, *options],
        }


@dataclass(frozen=True)
class Protocol:
    """What all runs of a comparison share.

    Attributes:
        seeds: Number of seeds, from 0 on.
        budget: Optimizer steps of each run.
        out: Folder of all work folders.
        batch: Samples of a step, over all processes.
        init: Checkpoint or named model that all start from; None trains from scratch.
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

    On a GPU a run has one process; on a CPU as many as the runs that are there, and the first of
    all one a core, as far as these share a step's samples evenly. Batch statistics are those of a
    process's samples.

    Returns:
        The runs, seed by seed.

    Raises:
        FileNotFoundError: If a config, a checkpoint or a data set does not exist.
        ValueError: If names repeat, the budget is no whole number of epochs, the configs are of
            different data or do not differ, or a work folder is of other settings.
    """
    names = [entry.name for entry in entries]
    if len(set(names)) < len(names):
        raise InputError(f"two configs have one name: {names}; write NAME=CONFIG.")
    if protocol.init is not None:
        read_weights(protocol.init)
    processes = _processes(protocol)
    runs = [
        _plan_run(entry, seed, protocol, processes)
        for seed in range(protocol.seeds)
        for entry in entries
    ]
    for run in runs[1:]:
        _refuse(
            differences(runs[0].settings["data"], run.settings["data"]),
            f"{runs[0].label} and {run.label} are of different data",
            "compare configs of one data set, split, range and class list",
        )
    for one, other in combinations(runs[: len(entries)], 2):
        if not differences(one.settings, other.settings):
            raise InputError(
                f"{one.name} and {other.name} would be the same run: no setting of training "
                "differs. Leave one out, or check its overrides."
            )
    for run in runs:
        _check_folder(run)
    return runs


def _processes(protocol: Protocol) -> int:
    """Return each run's number of processes, of which each gets as many samples."""
    if torch.cuda.device_count():
        return 1
    paths = protocol.out.glob(f"*/seed_*/{SETTINGS}")
    there = (_noted(path)["processes"] for path in paths)
    possible = chain(there, range(len(os.sched_getaffinity(0)), 0, -1))
    return next(n for n in possible if n > 0 and protocol.batch % n == 0)


def _plan_run(entry: Entry, seed: int, protocol: Protocol, processes: int) -> Run:
    """Plan one run, and build its data set and model once to see that they can be."""
    words = [f"train_dataloader.batch_size={protocol.batch // processes}"]
    words += ["val_evaluator.eval=chamfer,raster", f"randomness.seed={seed}"]
    init = None if protocol.init is None else find_checkpoint(protocol.init).resolve()
    words += [] if init is None else [f"load_from={init}"]
    own = (*entry.options, *protocol.options)
    cfg = read_config(entry.config, parse_options([*words, *own]))
    with building(cfg):
        share = math.ceil(len(DATASETS.build(cfg.train_dataloader.dataset)) / processes)
    epoch = math.ceil(share / cfg.train_dataloader.batch_size)
    epochs = round(protocol.budget / epoch) or 1
    if epochs * epoch != protocol.budget:
        raise InputError(
            f"a budget of {protocol.budget} iterations is no whole number of epochs of {entry.name}"
            f" ({epoch} iterations each): give {epochs * epoch}."
        )
    words += [f"train_cfg.max_epochs={epochs}", f"train_cfg.val_interval={max(1, epochs // 4)}"]
    for index, scheduler in enumerate(cfg.get("param_scheduler") or []):
        if "T_max" in scheduler and scheduler.get("by_epoch", True):
            words.append(f"param_scheduler.{index}.T_max={epochs}")
    cfg = read_config(entry.config, parse_options([*words, *own]))
    check_config(cfg)
    if cfg.train_cfg.max_epochs != epochs:
        raise InputError(f"{entry.name}: the budget decides train_cfg.max_epochs; leave it out.")
    with building(cfg):
        MODELS.build(cfg.model)
    settings = {key: plain(cfg.get(key)) for key in _DECIDING}
    settings |= {"processes": processes, "batch": protocol.batch, "data": _data_of(cfg)}
    settings["sampler"] = plain(cfg.train_dataloader.get("sampler"))
    dataset = plain(cfg.train_dataloader.dataset)  # wherever it lies: "data" has its file's digest
    settings["dataset"] = {k: v for k, v in dataset.items() if k not in ("data_root", "ann_file")}
    settings["init"] = init and _digest(init)
    folder = protocol.out.resolve() / entry.name / f"seed_{seed}"
    return Run(
        name=entry.name,
        seed=seed,
        folder=folder,
        config=entry.config,
        options=(*words, *own),
        epochs=epochs,
        iterations=protocol.budget,
        processes=processes,
        settings=settings,
    )


def _data_of(cfg: Config) -> dict[str, Any]:
    """Return what says which data a config trains and tests on."""
    found: dict[str, Any] = {}
    for part in ("train", "test"):
        dataset = cfg[f"{part}_dataloader"].dataset
        path = Path(dataset.get("data_root", ""), dataset.ann_file)
        keys = ("split", "classes", "grid", "frame", "cameras", "indices")
        found[part] = {key: plain(dataset.get(key)) for key in keys} | {"file": _digest(path)}
    return found


def _refuse(found: Mapping[str, tuple[Any, Any]], what: str, remedy: str) -> None:
    """Raise an error that names settings that differ, if any do."""
    if found:
        shown = "; ".join(f"{key}: {a} and {b}" for key, (a, b) in list(found.items())[:_SHOWN])
        raise InputError(f"{what}: {shown}. {remedy[0].upper()}{remedy[1:]}.")


def _noted(path: Path) -> dict[str, Any]:
    """Return what a run was started with."""
    found = read_json(path)
    if not isinstance(found, dict) or not isinstance(found.get("processes"), int):
        raise InputError(f"{path} is not what a run noted: give another --out, or remove the run.")
    return found


def _check_folder(run: Run) -> None:
    """Refuse a work folder that another run made."""
    path = run.folder / SETTINGS
    if path.is_file():
        _refuse(
            differences(_noted(path), plain(run.settings)),
            f"{run.folder} holds a run of other settings",
            "give another --out, or remove it",
        )
    elif run.folder.is_dir() and any(run.folder.iterdir()):
        raise InputError(
            f"{run.folder} holds something else than a run of this comparison: give another --out."
        )
