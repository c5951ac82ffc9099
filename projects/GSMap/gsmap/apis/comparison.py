"""Runs of several configs and seeds, side by side: planned, checked, trained, tested.

Each run is a work folder of ``tools/train.py`` with its test in it; nothing is known of a run that
does not stand there, so a comparison that was killed goes on when its command is given again.
"""

import ctypes
import fcntl
import hashlib
import json
import math
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from mmdet3d.registry import DATASETS, MODELS
from mmengine.config import Config

from gsmap.apis.checkpoint import read_weights
from gsmap.checkpoints.settings import differences, plain
from gsmap.engine.launch import check_config, parse_options, read_config
from gsmap.engine.named_models import REPO, find_checkpoint
from gsmap.utils.files import write_text

_SETTINGS = "settings.json"  # what a run was started with; another start must agree
RECORD = "run.json"  # machine, load, command and end of a run
_SHOWN = 10
_DECIDING = ("model", "optim_wrapper", "param_scheduler", "train_cfg", "randomness", "custom_hooks")


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
        raise ValueError(f"{text!r}: a name holds letters, digits and . _ + - only, got {name!r}.")
    for option in options:
        if "=" not in option:
            raise ValueError(f"{text!r}: {option!r} is no override; write KEY=VALUE.")
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
        test = ["--work-dir", str(self.folder / "test"), "--out", str(self.folder / "results.json")]
        test += ["--metrics-out", str(self.folder / "metrics.json")]
        train = ["--work-dir", str(self.folder), "--resume"]
        train += ["--launcher", "pytorch"] if self.processes > 1 else []
        options = ["--cfg-options", *self.options]
        python = [sys.executable, "-u"]
        return {
            "train": [*python, str(REPO / "tools/train.py"), self.config, *train, *options],
            "test": [
                *(*python, str(REPO / "tools/test.py"), self.config, str(self.checkpoint)),
                *(*test, *options),
            ],
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


def devices() -> list[str | None]:
    """Return the GPUs, on which runs go side by side; without one the CPU, for one at a time."""
    count = torch.cuda.device_count()
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    return list(visible.split(",") if visible else map(str, range(count))) if count else [None]


def plan(entries: Sequence[Entry], protocol: Protocol) -> list[Run]:
    """Plan all runs and check them, before anything trains.

    On a CPU a run has a process a core, as far as these share a step's samples evenly; on a GPU
    one. Batch statistics are those of a process's samples.

    Args:
        entries: Configs to compare.
        protocol: What their runs share.

    Returns:
        The runs, seed by seed.

    Raises:
        FileNotFoundError: If a config, a checkpoint or a data set does not exist.
        ValueError: If names repeat, the budget is no whole number of epochs, the configs are of
            different data, or a work folder is of other settings.
    """
    names = [entry.name for entry in entries]
    if len(set(names)) < len(names):
        raise ValueError(f"two configs have one name: {names}; write NAME=CONFIG.")
    if protocol.init is not None:
        read_weights(protocol.init)
    cores = len(os.sched_getaffinity(0))
    possible = (n for n in range(cores, 0, -1) if protocol.batch % n == 0)
    processes = 1 if torch.cuda.device_count() else next(possible)
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
    for run in runs:
        _check_folder(run)
    return runs


def _plan_run(entry: Entry, seed: int, protocol: Protocol, processes: int) -> Run:
    """Plan one run, and build its data set and model once to see that they can be."""
    words = [f"train_dataloader.batch_size={protocol.batch // processes}"]
    words += ["val_evaluator.eval=chamfer,raster", f"randomness.seed={seed}"]
    init = None if protocol.init is None else find_checkpoint(protocol.init).resolve()
    words += [] if init is None else [f"load_from={init}"]
    own = (*entry.options, *protocol.options)
    cfg = read_config(entry.config, parse_options([*words, *own]))
    share = math.ceil(len(DATASETS.build(cfg.train_dataloader.dataset)) / processes)
    epoch = math.ceil(share / cfg.train_dataloader.batch_size)
    epochs = round(protocol.budget / epoch) or 1
    if epochs * epoch != protocol.budget:
        raise ValueError(
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
        raise ValueError(f"{entry.name}: the budget decides train_cfg.max_epochs; leave it out.")
    MODELS.build(cfg.model)
    settings = {key: plain(cfg.get(key)) for key in _DECIDING}
    settings |= {"processes": processes, "batch": protocol.batch, "data": _data_of(cfg)}
    settings["pipeline"] = plain(cfg.train_dataloader.dataset.get("pipeline"))
    settings["init"] = init and _digest(init)
    folder = protocol.out.resolve() / entry.name / f"seed_{seed}"
    return Run(
        *(entry.name, seed, folder, entry.config, (*words, *own), epochs, protocol.budget),
        *(processes, settings),
    )


@cache
def _digest(path: Path) -> str:
    """Return a file's digest."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


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
        raise ValueError(f"{what}: {shown}. {remedy[0].upper()}{remedy[1:]}.")


def _check_folder(run: Run) -> None:
    """Refuse a work folder that another run made."""
    path = run.folder / _SETTINGS
    if path.is_file():
        _refuse(
            differences(json.loads(path.read_text()), plain(run.settings)),
            f"{run.folder} holds a run of other settings",
            "give another --out, or remove it",
        )
    elif run.folder.is_dir() and any(run.folder.iterdir()):
        raise ValueError(
            f"{run.folder} holds something else than a run of this comparison: give another --out."
        )


def machine() -> str:
    """Name the processor or GPU, and how many there are."""
    if torch.cuda.is_available():
        return f"{torch.cuda.device_count()} x {torch.cuda.get_device_name()}"
    found = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    return f"{len(os.sched_getaffinity(0))} cores, {found[1] if found else 'unknown processor'}"


class Job:
    """A run under way on one device: its processes, which die with this one.

    Args:
        run: The run; its folder is locked while the job lives.
        device: GPU that it has; None for the CPU.

    Raises:
        RuntimeError: If another process works in its folder.
    """

    def __init__(self, run: Run, device: str | None) -> None:
        self.run = run
        self.device = device
        run.folder.mkdir(parents=True, exist_ok=True)
        self._lock = open(run.folder / ".lock", "w")  # noqa: SIM115 - held until the job ends
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RuntimeError(f"another process works in {run.folder}: wait for it.") from error
        write_text(run.folder / _SETTINGS, json.dumps(plain(run.settings), indent=1))
        self.record = {"machine": machine(), "load_at_start": os.getloadavg()[0], "peak_mib": 0}
        self.record |= {k: shlex.join(command) for k, command in run.commands().items()}
        self.stage = "test" if run.checkpoint.is_file() else "train"
        self._start()

    def _start(self) -> None:
        """Start the processes of a stage."""
        count = self.run.processes if self.stage == "train" else 1
        environment = {**os.environ, "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
        if self.device is not None:
            environment = {**os.environ, "CUDA_VISIBLE_DEVICES": self.device}
        if count > 1:
            with socket.socket() as probe:
                probe.bind(("127.0.0.1", 0))
                port = str(probe.getsockname()[1])
            environment |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
            environment["WORLD_SIZE"] = str(count)
        command = self.run.commands()[self.stage]
        with open(self.run.folder / f"{self.stage}.log", "a") as log:
            self._processes = [
                subprocess.Popen(
                    command,
                    env=environment | {"RANK": str(rank), "LOCAL_RANK": str(rank)}
                    if count > 1
                    else environment,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    preexec_fn=_die_with_parent,
                )
                for rank in range(count)
            ]

    def ended(self) -> bool:
        """Look at the processes, go on to the test after training, and note how the run ends."""
        for process in self._processes:
            if process.returncode is None:
                pid, status, usage = os.wait4(process.pid, os.WNOHANG)
                if pid:
                    process.returncode = os.waitstatus_to_exitcode(status)
                    peak = max(self.record["peak_mib"], usage.ru_maxrss // 1024)
                    self.record["peak_mib"] = peak
        codes = [process.returncode for process in self._processes]
        failed = [code for code in codes if code]
        if not failed and None in codes:
            return False
        if failed:
            self.end(f"{self.stage} ended with exit code {failed[0]}: {self.stage}.log")
        elif self.stage == "train":
            self.stage = "test"
            self._start()
            return False
        else:
            self.end("done")
        return True

    def end(self, state: str) -> None:
        """Stop what still runs, note the run's end and free its folder."""
        for process in self._processes:
            if process.returncode is None:
                process.kill()
                process.wait()
        self.record |= {"state": state, "load_at_end": os.getloadavg()[0]}
        write_text(self.run.folder / RECORD, json.dumps(self.record, indent=1))
        self._lock.close()


def _die_with_parent() -> None:
    """Have Linux kill this process when its parent dies, however that dies."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def execute(
    runs: Sequence[Run], progress: Callable[[str], None], pause_s: float = 2.0
) -> Iterator[tuple[Run, str]]:
    """Train and test the runs that are not done, one a device.

    Args:
        runs: From `plan`.
        progress: Called with one line on the whole, every ``pause_s``.
        pause_s: Time between two looks, in seconds.

    Yields:
        Each run with its state, as it ends: ``done``, or what went wrong.
    """
    waiting = deque(run for run in runs if not run.done)
    free, jobs = devices(), []
    start, before = time.monotonic(), sum(run.position for run in runs)
    try:
        while waiting or jobs:
            while waiting and free:
                jobs.append(Job(waiting.popleft(), free.pop(0)))
            for job in [job for job in jobs if job.ended()]:
                jobs.remove(job)
                free.append(job.device)
                yield job.run, job.record["state"]
            progress(_line(runs, jobs, before, time.monotonic() - start))
            time.sleep(pause_s if jobs else 0)
    finally:
        for job in jobs:
            job.end("cut off")


def _line(runs: Sequence[Run], jobs: Sequence[Job], before: int, seconds: float) -> str:
    """Tell how far all runs are, and how long the rest takes at the pace so far."""
    position, total = sum(run.position for run in runs), sum(run.iterations for run in runs)
    line = f"{sum(run.done for run in runs)} of {len(runs)} runs done"
    line += "".join(f", {job.run.label} {job.stage}s" for job in jobs)
    line += f"; iteration {position} of {total}"
    if position > before:
        minutes = (total - position) * seconds / (position - before) / 60
        line += f"; about {minutes // 60:.0f} h {minutes % 60:.0f} min left"
    return line
