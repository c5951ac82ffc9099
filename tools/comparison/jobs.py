"""Processes of a comparison: training and test of each run, and the progress of all runs."""

import json
import os
import re
import shlex
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from comparison.plan import RECORD, SETTINGS, Run
from gsmap.checkpoints.settings import plain
from gsmap.engine.torchrun import OWN_WORDS
from gsmap.utils.files import lock_folder, open_to_append, require_no_link, write_text
from gsmap.utils.parallel import die_with_parent
from gsmap.utils.progress import Progress

_PAUSE_S = 2.0  # pause between two polls of the runs
_MESSAGE_LENGTH = 200  # largest number of characters of a failed run's error


def devices() -> list[str | None]:
    """Values of ``CUDA_VISIBLE_DEVICES`` that select one GPU each, or [None] without a GPU."""
    count = torch.cuda.device_count()
    if not count:
        return [None]
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible:
        return list(visible.split(","))
    return [str(index) for index in range(count)]


def machine() -> str:
    """Number and name of the GPUs, or of the usable processor cores if there is no GPU."""
    if torch.cuda.is_available():
        return f"{torch.cuda.device_count()} x {torch.cuda.get_device_name()}"
    model = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    name = model[1] if model else "unknown processor"
    return f"{len(os.sched_getaffinity(0))} cores, {name}"


class Job:
    """Training and test of one run on one device.

    The training and the test are the two stages of a job. Each stage runs in a child process, which
    the operating system ends if this process ends.

    Args:
        run: The run. Its folder is locked until the end of the job.
        device: GPU for the run; None for the CPU.

    Raises:
        RuntimeError: If another process uses the folder.
    """

    def __init__(self, run: Run, device: str | None) -> None:
        self.run = run
        self.device = device
        comparison_folder = run.folder.parent.parent  # of <comparison>/<name>/seed_<seed>
        require_no_link(run.folder, below=comparison_folder)
        # The open lock file keeps the folder locked until `end` closes it.
        self._lock = lock_folder(run.folder, name=".lock", advice="wait for its end")
        # A later start of the run compares its settings with this file.
        write_text(run.folder / SETTINGS, json.dumps(plain(run.settings), indent=1))
        # Contents of the file `RECORD`. The load is the system's mean number of busy processes in
        # the last minute, which affects the times.
        self.record: dict[str, Any] = {"machine": machine(), "load_at_start": os.getloadavg()[0]}
        for stage, command in run.commands().items():  # stages "train" and "test"
            self.record[stage] = shlex.join(command)
        self._peak_mib = 0
        self.stage = "test" if run.is_trained else "train"
        self._start()

    @property
    def _log(self) -> Path:
        """File with the output of the current stage."""
        return self.run.folder / f"{self.stage}.log"

    def _start(self) -> None:
        """Start the process of the current stage."""
        environment = {**os.environ, "PYTHON": sys.executable}  # read by `tools/dist_run.sh`
        if self.device is None:
            # One thread for each process, also if the shell asks for more: there may be a process
            # for each core, and threads that wait for a core spin.
            environment["OMP_NUM_THREADS"] = "1"
        else:
            environment["CUDA_VISIBLE_DEVICES"] = self.device
        with open_to_append(self._log) as log:
            # Position in bytes at which the output of this process begins. Before it, the file may
            # have the output of an earlier attempt that was killed.
            self._log_start = log.seek(0, os.SEEK_END)
            self._process = subprocess.Popen(
                self.run.commands()[self.stage],
                env=environment,
                stdout=log,
                stderr=subprocess.STDOUT,
                preexec_fn=partial(die_with_parent, os.getpid()),
            )

    def poll(self) -> bool:
        """Start the test if the training has ended; record the end of the test or a failure.

        Returns:
            Whether the job has ended, by success or failure. Its state is then in ``record``.
        """
        if not self._collect_process():
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

    def _collect_process(self) -> bool:
        """Record exit code and peak memory if the process has ended; return whether it has."""
        # Unlike `Popen.poll`, `os.wait4` returns the memory of the process, but it does not set the
        # exit code of the `Popen` object.
        pid, status, usage = os.wait4(self._process.pid, os.WNOHANG)
        if pid == 0:
            return False
        self._process.returncode = os.waitstatus_to_exitcode(status)
        peak_mib = usage.ru_maxrss // 1024  # Linux counts in KiB
        self._peak_mib = max(self._peak_mib, peak_mib)
        return True

    def _error_message(self) -> str:
        """First error in the output of the stage, or else its last line.

        For a rank that ended with a traceback, this is the last line of the traceback.
        """
        output = self._log.read_bytes()[self._log_start :]
        lines = output.decode(errors="replace").splitlines()
        for before, line in zip(["", *lines], lines, strict=False):
            if line.startswith("error: "):
                # After a traceback of a rank, the launcher says only which rank has failed.
                message = before if OWN_WORDS in line else line
                return message[:_MESSAGE_LENGTH]
        if not lines:
            return ""
        return lines[-1][:_MESSAGE_LENGTH]

    def end(self, state: str) -> None:
        """End the job: kill its process if it runs, record the state and unlock the folder.

        Args:
            state: ``done``, a sentence about the failure, or ``cut off`` if the command ends before
                the job.
        """
        if self._process.returncode is None:
            self._process.kill()
            self._process.wait()
        self.record |= {"state": state, "load_at_end": os.getloadavg()[0]}
        self.record["peak_mib"] = self._peak_mib
        write_text(self.run.folder / RECORD, json.dumps(self.record, indent=1))
        self._lock.close()


def execute(runs: Sequence[Run]) -> Iterator[tuple[Run, str]]:
    """Train and test the unfinished runs, one after another on each device.

    If the caller ends early, the running jobs are killed and recorded as ``cut off``.

    Args:
        runs: Runs of the comparison, including finished ones.

    Yields:
        Each run when it has ended, with its state: ``done``, or a sentence about the failure.
    """
    waiting = deque([run for run in runs if not run.is_done])
    jobs: dict[str | None, Job] = {}  # the running job of each device
    usable_devices = devices()
    initial = sum(run.iterations_so_far for run in runs)
    total = sum(run.iterations for run in runs)
    progress = Progress(
        initial=initial,
        total=total,
        unit="iterations",
        smoothing=0,  # mean speed since the start
        disable=not waiting,
    )
    with progress as bar:
        try:
            while waiting or jobs:
                for device in usable_devices:
                    if device not in jobs and waiting:
                        jobs[device] = Job(waiting.popleft(), device)
                for job in list(jobs.values()):  # a copy, since jobs that end are removed
                    if job.poll():
                        del jobs[job.device]
                        yield job.run, job.record["state"]
                bar.set_description(_describe_progress(runs, jobs.values()), refresh=False)
                iterations = sum(run.iterations_so_far for run in runs)
                bar.update(iterations - bar.n)  # the argument is an increment
                if jobs:
                    time.sleep(_PAUSE_S)
        finally:
            for job in jobs.values():
                job.end("cut off")


def _describe_progress(runs: Sequence[Run], jobs: Iterable[Job]) -> str:
    """Number of finished runs, then the stage of each running job."""
    num_done = 0
    for run in runs:
        if run.is_done:
            num_done += 1
    texts = [f"{num_done} of {len(runs)} runs done"]
    for job in jobs:
        texts.append(f"{job.run.label} {job.stage}s")  # "NAME trains", "NAME tests"
    return ", ".join(texts)
