"""All shards of a command on a Ray cluster: the same commands, started wherever there is room."""

import argparse
import math
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from gsmap.utils.errors import InputError, WorkError
from gsmap.utils.extras import import_extra
from gsmap.utils.parallel import die_with_parent
from gsmap.utils.shards import without_options

_POLL_S = 1.0
_RETRIES = 5


class ShardKilledError(Exception):
    """A shard's process ended by a signal; another try may end well."""


def run_on_ray(
    arguments: argparse.Namespace, words: Sequence[str], patience_s: float = 60.0
) -> str:
    """Run a command once for each shard on a Ray cluster that sees the same files.

    A shard that a signal, the end of its worker or of its node stops is run again. One that takes
    more than twice as long as the longest so far, while there is room, is run a second time beside
    the first; the first to end counts.

    Args:
        arguments: Parsed; ``shards`` and ``per_shard`` are used.
        words: The command's words, ``--executor`` and its like included.
        patience_s: Shortest time after which a shard is run a second time, in seconds.

    Returns:
        How many shards were made, and how long they took.

    Raises:
        RuntimeError: If Ray is not installed, or shards fail; the others are made.
    """
    if arguments.shards < 1 or arguments.shard.count:
        raise InputError("--executor needs --shards N of at least 1, and no --shard I/N.")
    ray = import_extra("ray", "ray")
    if not ray.is_initialized():
        ray.init(log_to_driver=False, include_dashboard=False)
    run = _Run(ray, _plain(words), arguments.shards, dict(arguments.per_shard), patience_s)
    failures = run.all()
    if failures:
        raise WorkError(f"{len(failures)} of {arguments.shards} shards failed: {failures[0]}")
    middle, longest = statistics.median(run.seconds), max(run.seconds)
    return (
        f"{arguments.shards} shards made, {middle:.1f} s each (median), at most {longest:.1f} s, "
        f"{run.repeated} run twice at once; tools/merge.py joins them"
    )


def _plain(words: Sequence[str]) -> list[str]:
    """Return a command's words without the options for all shards."""
    kept: list[str] = []
    skipping = False
    for word in without_options(words, "--executor", "--shards"):
        name = word.split("=")[0]
        skipping = name == "--per-shard" or (skipping and name.startswith(("num_", "memory")))
        kept += [] if skipping else [word]
    return kept


def _make(words: Sequence[str], shard: str, folder: str) -> tuple[str, float]:
    """Run a command for one shard; return what failed, if anything, and the time in seconds."""
    start = time.perf_counter()
    ended = subprocess.run(
        [*words, "--shard", shard],
        cwd=folder,
        capture_output=True,
        text=True,
        errors="replace",
        preexec_fn=partial(die_with_parent, os.getpid()),
    )
    if ended.returncode < 0 or ended.returncode >= 128:
        raise ShardKilledError(f"shard {shard} was killed: exit code {ended.returncode}")
    said = (ended.stderr or ended.stdout).strip().rsplit("\n", 1)[-1]
    failed = f"{shard} ended with exit code {ended.returncode}: {said}" if ended.returncode else ""
    return failed, time.perf_counter() - start


@dataclass
class _Run:
    """One command's shards on a cluster."""

    ray: Any
    words: list[str]
    count: int
    resources: Mapping[str, float]
    patience_s: float
    seconds: list[float] = field(default_factory=list)
    repeated: int = 0

    def all(self) -> list[str]:
        """Make all shards and return what failed."""
        under_way = {self._start(index): index for index in range(self.count)}
        again: set[int] = set()
        done: set[int] = set()
        failures: list[str] = []
        room_since: float | None = None
        while len(done) < self.count:
            ready, _ = self.ray.wait(list(under_way), num_returns=1, timeout=_POLL_S)
            for ref in ready:
                index, failed = under_way.pop(ref), self._result(ref)
                if index not in done and not (failed and index in under_way.values()):
                    done.add(index)
                    failures += [failed] if failed else []
            for ref in [ref for ref, index in under_way.items() if index in done]:
                self.ray.cancel(ref, force=True)
                del under_way[ref]
            now = time.monotonic()
            room_since = (room_since or now) if self._has_room() else None
            too_long_s = max(self.patience_s, 2 * max(self.seconds, default=math.inf))
            if room_since and now - room_since > too_long_s:
                late = set(under_way.values()) - again
                again |= late
                self.repeated += len(late)
                under_way |= {self._start(index): index for index in late}
        return failures

    def _start(self, index: int) -> Any:
        """Hand a shard to the cluster."""
        options = {"num_cpus": 1, **self.resources}
        task = self.ray.remote(_make).options(
            max_retries=_RETRIES,
            retry_exceptions=[ShardKilledError],
            scheduling_strategy="SPREAD",
            runtime_env={"env_vars": {"PYTHONPATH": os.environ.get("PYTHONPATH", "")}},
            **options,
        )
        words = [sys.executable, *self.words]
        return task.remote(words, f"{index}/{self.count}", os.getcwd())

    def _result(self, ref: Any) -> str:
        """Return what failed in a task that ended, if anything, and note its time."""
        try:
            failed, seconds = self.ray.get(ref)
        except self.ray.exceptions.RayError as error:
            return str(error).strip().rsplit("\n", 1)[-1]
        self.seconds.append(seconds)
        return failed

    def _has_room(self) -> bool:
        """Whether another shard could start, so that none is waiting."""
        free = self.ray.available_resources()
        cpus, gpus = self.resources.get("num_cpus", 1), self.resources.get("num_gpus", 0)
        return free.get("CPU", 0) >= cpus and free.get("GPU", 0) >= gpus
