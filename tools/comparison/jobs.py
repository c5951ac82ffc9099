"""Runs of a comparison under way: their processes, their end, and how far the whole is."""

import json
import os
import re
import shlex
import socket
import subprocess
import time
from collections import deque
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from comparison.plan import RECORD, SETTINGS, Run
from gsmap.checkpoints.settings import plain
from gsmap.utils.files import lock_folder, open_to_append, require_no_link, write_text
from gsmap.utils.parallel import die_with_parent
from gsmap.utils.progress import Progress

_PAUSE_S = 2.0  # between two looks at the runs
_SAID = 200  # characters of a failed run's last line


def devices() -> list[str | None]:
    """Return the GPUs, on which runs go side by side; without one the CPU, for one at a time."""
    count = torch.cuda.device_count()
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    return list(visible.split(",") if visible else map(str, range(count))) if count else [None]


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
        require_no_link(run.folder, run.folder.parent.parent)
        self._lock = lock_folder(run.folder, ".lock", "wait for its end")
        write_text(run.folder / SETTINGS, json.dumps(plain(run.settings), indent=1))
        self.record: dict[str, Any] = {"machine": machine(), "load_at_start": os.getloadavg()[0]}
        self.record |= {k: shlex.join(command) for k, command in run.commands().items()}
        self._peak_mib = 0
        self.stage = "test" if run.trained else "train"
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
        with open_to_append(self.run.folder / f"{self.stage}.log") as log:
            self._processes = [
                subprocess.Popen(
                    command,
                    env=environment | {"RANK": str(rank), "LOCAL_RANK": str(rank)}
                    if count > 1
                    else environment,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    preexec_fn=partial(die_with_parent, os.getpid()),
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
                    self._peak_mib = max(self._peak_mib, usage.ru_maxrss // 1024)
        codes = [process.returncode for process in self._processes]
        failed = [code for code in codes if code]
        if not failed and None in codes:
            return False
        if failed:
            last = (self.run.folder / f"{self.stage}.log").read_text().splitlines()[-1:]
            said = " ".join(last)[:_SAID]
            self.end(f"{self.stage} ended with exit code {failed[0]} ({self.stage}.log: {said})")
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
        self.record["peak_mib"] = self._peak_mib
        write_text(self.run.folder / RECORD, json.dumps(self.record, indent=1))
        self._lock.close()


def execute(runs: Sequence[Run]) -> Iterator[tuple[Run, str]]:
    """Train and test the runs that are not done, one a device, and show how far all are.

    Args:
        runs: From `plan`.

    Yields:
        Each run with its state, as it ends: ``done``, or what went wrong.
    """
    waiting = deque(run for run in runs if not run.done)
    free, jobs = devices(), list[Job]()
    before, total = sum(run.position for run in runs), sum(run.iterations for run in runs)
    options = {"unit": "iterations", "smoothing": 0, "disable": not waiting}
    with Progress(initial=before, total=total, **options) as bar:
        try:
            while waiting or jobs:
                while waiting and free:
                    jobs.append(Job(waiting.popleft(), free.pop(0)))
                for job in [job for job in jobs if job.ended()]:
                    jobs.remove(job)
                    free.append(job.device)
                    yield job.run, job.record["state"]
                stages = [f"{job.run.label} {job.stage}s" for job in jobs]
                done = f"{sum(run.done for run in runs)} of {len(runs)} runs done"
                bar.set_description(", ".join([done, *stages]), refresh=False)
                bar.update(sum(run.position for run in runs) - bar.n)
                time.sleep(_PAUSE_S if jobs else 0)
        finally:
            for job in jobs:
                job.end("cut off")
