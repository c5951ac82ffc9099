"""Processes of a comparison: training, test, exit states and common progress."""

import json
import os
import re
import shlex
import subprocess
import sys
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

_PAUSE_S = 2.0  # between two polls of the runs
_MESSAGE_LENGTH = 200  # characters of a failed run's error


def devices() -> list[str | None]:
    """GPUs, each for one run at a time; without a GPU, None for the CPU."""
    count = torch.cuda.device_count()
    if not count:
        return [None]
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible:
        return list(visible.split(","))
    return [str(index) for index in range(count)]


def machine() -> str:
    """Name and number of the GPUs, or of the processor cores."""
    if torch.cuda.is_available():
        return f"{torch.cuda.device_count()} x {torch.cuda.get_device_name()}"
    model = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    name = model[1] if model else "unknown processor"
    return f"{len(os.sched_getaffinity(0))} cores, {name}"


class Job:
    """Training and test of one run on one device, in a process that ends with this one.

    Args:
        run: The run. Its folder is locked until the end of the job.
        device: GPU for the run; None for the CPU.

    Raises:
        RuntimeError: If another process uses the folder.
    """

    def __init__(self, run: Run, device: str | None) -> None:
        self.run = run
        self.device = device
        require_no_link(run.folder, run.folder.parent.parent)
        self._lock = lock_folder(run.folder, ".lock", "wait for its end")
        write_text(run.folder / SETTINGS, json.dumps(plain(run.settings), indent=1))
        self.record: dict[str, Any] = {"machine": machine(), "load_at_start": os.getloadavg()[0]}
        for stage, command in run.commands().items():
            self.record[stage] = shlex.join(command)
        self._peak_mib = 0
        self.stage = "test" if run.is_trained else "train"
        self._start()

    @property
    def _log(self) -> Path:
        """File with the output of the stage."""
        return self.run.folder / f"{self.stage}.log"

    def _start(self) -> None:
        """Start the process of a stage."""
        environment = {**os.environ, "PYTHON": sys.executable}  # for the script of several ranks
        if self.device is None:
            environment.setdefault("OMP_NUM_THREADS", "1")
        else:
            environment["CUDA_VISIBLE_DEVICES"] = self.device
        with open_to_append(self._log) as log:
            self._begin = log.seek(0, os.SEEK_END)  # after the output of an attempt that was killed
            self._process = subprocess.Popen(
                self.run.commands()[self.stage],
                env=environment,
                stdout=log,
                stderr=subprocess.STDOUT,
                preexec_fn=partial(die_with_parent, os.getpid()),
            )

    def poll(self) -> bool:
        """Poll the process: start the test after the training, record the end of the test."""
        if not self._has_ended():
            return False
        code = self._process.returncode
        if code != 0:
            cause = f"{self._log.name}: {self._error_message()}"
            self.end(f"{self.stage} ended with exit code {code} ({cause})")
            return True
        if self.stage == "train":
            self.stage = "test"
            self._start()
            return False
        self.end("done")
        return True

    def _has_ended(self) -> bool:
        """Whether the process has ended; updates the peak memory of its largest process."""
        pid, status, usage = os.wait4(self._process.pid, os.WNOHANG)
        if pid == 0:
            return False
        self._process.returncode = os.waitstatus_to_exitcode(status)
        self._peak_mib = max(self._peak_mib, usage.ru_maxrss // 1024)
        return True

    def _error_message(self) -> str:
        """First error in the output of the stage, or else its last line."""
        text = self._log.read_bytes()[self._begin :].decode(errors="replace")
        lines = text.splitlines()
        errors = [line for line in lines if line.startswith("error: ")]
        if errors:
            return errors[0][:_MESSAGE_LENGTH]
        return lines[-1][:_MESSAGE_LENGTH] if lines else ""

    def end(self, state: str) -> None:
        """Stop a process that still runs, record the state of the run and unlock its folder."""
        if self._process.returncode is None:
            self._process.kill()
            self._process.wait()
        self.record |= {"state": state, "load_at_end": os.getloadavg()[0]}
        self.record["peak_mib"] = self._peak_mib
        write_text(self.run.folder / RECORD, json.dumps(self.record, indent=1))
        self._lock.close()


def execute(runs: Sequence[Run]) -> Iterator[tuple[Run, str]]:
    """Train and test the unfinished runs, one after another on each device.

    Args:
        runs: From `plan`.

    Yields:
        Each run at its end, with its state: ``done``, or the fault.
    """
    waiting = deque(run for run in runs if not run.done)
    jobs: dict[str | None, Job] = {}
    places = devices()
    initial = sum(run.position for run in runs)
    total = sum(run.iterations for run in runs)
    options = {"unit": "iterations", "smoothing": 0, "disable": not waiting}
    with Progress(initial=initial, total=total, **options) as bar:
        try:
            while waiting or jobs:
                for device in places:
                    if device not in jobs and waiting:
                        jobs[device] = Job(waiting.popleft(), device)
                for job in list(jobs.values()):
                    if job.poll():
                        del jobs[job.device]
                        yield job.run, job.record["state"]
                stages = [f"{job.run.label} {job.stage}s" for job in jobs.values()]
                done = f"{sum(run.done for run in runs)} of {len(runs)} runs done"
                bar.set_description(", ".join([done, *stages]), refresh=False)
                bar.update(sum(run.position for run in runs) - bar.n)
                time.sleep(_PAUSE_S if jobs else 0)
        finally:
            for job in jobs.values():
                job.end("cut off")
