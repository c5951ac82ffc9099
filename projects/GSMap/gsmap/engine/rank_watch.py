"""Detection of ranks that no longer answer. The run then ends with an error that names them."""

import os
import platform
import sys
import threading
import time
from contextlib import suppress
from datetime import timedelta
from typing import NamedTuple

import torch.distributed as dist

from gsmap.utils.cli import BAD_INPUT

TIMEOUT_S = 1800.0  # default of env_cfg.dist_cfg.timeout
_PATIENCE = 0.8  # share of the timeout after which a rank without progress checks all ranks
_MISSED_BEATS = 3  # number of missed heartbeats after which a rank counts as silent


class _Report(NamedTuple):
    """Latest heartbeat of a rank.

    Attributes:
        beats: Number of heartbeats, as text; empty if there was none.
        steps: Number of hook calls that the rank has begun.
        description: Process, machine and current hook, for messages.
    """

    beats: str
    steps: int
    description: str


class RankWatch:
    """Context manager that watches the ranks of a run from a background thread in each rank.

    Every rank writes a heartbeat and its number of steps to the distributed store of the run. A
    rank that has made no step for most of the timeout reads the heartbeats of all ranks. It prints
    which ranks are silent or, if all ranks answer, which ranks have made the fewest steps. Then it
    ends its process. This happens before the pending collective operation times out, whose error
    names no rank.

    Args:
        timeout_s: Time that a collective operation may take, in seconds.
    """

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._beat_s = min(5.0, timeout_s / 40)  # time between two heartbeats, in seconds
        self._rank = dist.get_rank()
        self._ranks = dist.get_world_size()
        self._beats = 0
        self._steps = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "RankWatch":
        host = os.environ["MASTER_ADDR"]
        port = int(os.environ["MASTER_PORT"])
        # A separate connection to the store of the run, which waits only shortly for an answer.
        answer_timeout = timedelta(seconds=self._beat_s)
        store = dist.TCPStore(host, port, is_master=False, timeout=answer_timeout)
        # The prefix keeps heartbeats from before a restart by torchrun from being read.
        restart_count = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
        self._store = dist.PrefixStore(f"gsmap/{restart_count}", store)
        self.step("its start")
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._ended.set()
        self._thread.join()

    def step(self, name: str) -> None:
        """Record that this rank begins a step, such as a call of a hook, with the given name."""
        self._step_start_s = time.monotonic()
        self._steps += 1
        self._name = name

    def _watch(self) -> None:
        """Send heartbeats until the context ends, and check all ranks after a step without end."""
        self._beat()  # at once, because a rank may hang before the first wait ends
        while not self._ended.wait(self._beat_s):
            self._beat()
            if time.monotonic() - self._step_start_s > _PATIENCE * self._timeout_s:
                self._end_if_stuck()

    def _beat(self) -> None:
        """Write the heartbeat, the number of steps and the process of this rank to the store."""
        self._beats += 1
        description = f"process {os.getpid()} on {platform.node()}, at {self._name}"
        # An error means that the store does not answer, which `_end_if_stuck` reports.
        with suppress(RuntimeError):
            # `_read_reports` splits this text at the first two spaces.
            self._store.set(f"{self._rank}", f"{self._beats} {self._steps} {description}")

    def _read_reports(self) -> dict[int, _Report]:
        """Return the latest heartbeat of each rank.

        If the store does not answer, the result contains only rank 0, because the store runs on the
        machine of rank 0.
        """
        reports: dict[int, _Report] = {}
        for rank in (self._rank, *range(self._ranks)):  # first this rank, as a test of the store
            try:
                text = self._store.get(f"{rank}").decode()
            except RuntimeError:  # the rank has written nothing, or the store does not answer
                missing = _Report(beats="", steps=0, description="not begun")
                if rank == self._rank:  # this rank has written, so the store does not answer
                    return {0: missing}
                reports[rank] = missing
            else:
                beats, steps, description = text.split(maxsplit=2)
                reports[rank] = _Report(beats, steps=int(steps), description=description)
        return reports

    def _end_if_stuck(self) -> None:
        """Name the ranks that this rank waits for and end its process, if it is still stuck."""
        steps = self._steps
        before = self._read_reports()
        for _ in range(_MISSED_BEATS):
            self._ended.wait(self._beat_s)
            self._beat()
        after = self._read_reports()
        if self._steps != steps or self._ended.is_set():  # this rank has gone on in the meantime
            return
        wait_s = time.monotonic() - self._step_start_s
        text = (
            f"{_missing_ranks(before=before, after=after)}; this one has waited {wait_s:.0f} s "
            f"(env_cfg.dist_cfg.timeout is {self._timeout_s:g}): check whether that process is "
            "stopped, and which file it is reading."
        )
        sys.stderr.write(f"error: {text}\n")
        sys.stderr.flush()
        # The main thread waits in the collective operation and would not receive an exception.
        os._exit(BAD_INPUT)


def _missing_ranks(before: dict[int, _Report], after: dict[int, _Report]) -> str:
    """Describe the ranks without a new heartbeat, or else the ranks with the fewest steps.

    Args:
        before: Reports of the ranks at the beginning of the check.
        after: Reports after the time of some heartbeats.

    Returns:
        Clause for the message, such as "rank 1 (process ...) does not answer".
    """
    silent_ranks = []
    for rank, report in after.items():
        previous_beats = before[rank].beats if rank in before else ""
        if previous_beats == report.beats:
            silent_ranks.append(rank)
    last_ranks = []
    all_steps = {report.steps for report in after.values()}
    if len(all_steps) > 1:  # otherwise no rank is behind the others
        fewest_steps = min(all_steps)
        last_ranks = [rank for rank, report in after.items() if report.steps == fewest_steps]
    verb = "answer" if silent_ranks else "go on"
    ranks = silent_ranks or last_ranks  # silent ranks are named alone: the others wait for them
    if not ranks:
        return "no rank goes on"
    names = " and ".join(f"rank {rank} ({after[rank].description})" for rank in ranks)
    return f"{names} does not {verb}"
