"""Execution of all shards of a command on a Ray cluster."""

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

_POLL_S = 1.0  # longest time to wait for a result before the late shards are looked at
_RETRIES = 5  # further tries of a shard after a signal, or after a failure of its worker or node


class ShardKilledError(Exception):
    """Error of a shard whose process was ended by a signal, so that another try may succeed."""


def run_on_ray(
    arguments: argparse.Namespace, words: Sequence[str], patience_s: float = 60.0
) -> str:
    """Run a command once per shard on a Ray cluster whose nodes share a file system.

    A shard is run again if it was stopped by a signal, or by the failure of its worker or node.
    Once the cluster has had free resources for twice the duration of the longest shard so far, and
    for at least ``patience_s``, each unfinished shard is started a second time. The first result of
    a shard counts.

    Args:
        arguments: Parsed arguments; ``shards``, ``shard`` and ``per_shard`` are used.
        words: Words of the command, including ``--executor`` and the options for all shards.
        patience_s: Minimum time before a shard is started a second time, in seconds.

    Returns:
        A summary with the number of shards and their durations.

    Raises:
        ValueError: If ``--shards`` is below 1, or ``--shard`` is given as well.
        RuntimeError: If Ray is not installed, or if shards fail; all other shards are complete.
    """
    if arguments.shards < 1 or arguments.shard.count:
        raise InputError("--executor needs --shards N of at least 1, and no --shard I/N.")
    # Ray is an optional dependency. The error for a missing module names the command to install it.
    ray = import_extra(module="ray", extra="ray")
    if not ray.is_initialized():
        ray.init(log_to_driver=False, include_dashboard=False)
    run = _Run(
        ray=ray,
        words=_without_cluster_options(words),
        count=arguments.shards,
        resources=dict(arguments.per_shard),
        patience_s=patience_s,
    )
    failures = run.run_all()
    if failures:
        raise WorkError(f"{len(failures)} of {arguments.shards} shards failed: {failures[0]}")
    median_s = statistics.median(run.durations_s)
    longest_s = max(run.durations_s)
    return (
        f"{arguments.shards} shards made, {median_s:.1f} s each (median), at most {longest_s:.1f} "
        f"s, {run.repeated} run twice at once; tools/merge.py joins them"
    )


def _without_cluster_options(words: Sequence[str]) -> list[str]:
    """Remove the options for all shards from a command.

    ``--per-shard`` is followed by any number of words ``NAME=AMOUNT``, where NAME is a resource of
    Ray: ``num_cpus``, ``num_gpus`` or ``memory``.
    """
    shard_words: list[str] = []
    is_resource = False
    # `without_options` removes options with one value each, so --per-shard is removed here.
    for word in without_options(words, "--executor", "--shards"):
        name, _, _ = word.partition("=")
        # A word NAME=AMOUNT is removed if it follows --per-shard or another removed word.
        follows_resource = is_resource and name.startswith(("num_", "memory"))
        is_resource = name == "--per-shard" or follows_resource
        if not is_resource:
            shard_words.append(word)
    return shard_words


def _run_shard(words: Sequence[str], shard: str, folder: str) -> tuple[str, float]:
    """Run a command for one shard.

    Args:
        words: Words of the command.
        shard: Shard as ``I/N``.
        folder: Working folder of the command.

    Returns:
        Description of the failure, empty on success, and the duration in seconds.

    Raises:
        ShardKilledError: If the process was ended by a signal. Ray then tries the shard again.
    """
    start_s = time.perf_counter()
    process = subprocess.run(
        [*words, "--shard", shard],
        cwd=folder,
        capture_output=True,
        text=True,
        errors="replace",
        # The command ends with the worker of Ray, for example when Ray cancels the task.
        preexec_fn=partial(die_with_parent, os.getpid()),
    )
    code = process.returncode
    # Python returns the negative number of a signal, and a shell 128 plus the number.
    if code < 0 or code >= 128:
        raise ShardKilledError(f"shard {shard} was killed: exit code {code}")
    duration_s = time.perf_counter() - start_s
    if not code:
        return "", duration_s
    output = process.stderr or process.stdout
    return f"{shard} ended with exit code {code}: {_last_line(output)}", duration_s


def _last_line(text: str) -> str:
    return text.strip().rsplit("\n", maxsplit=1)[-1]


@dataclass
class _Run:
    """Run of all shards of a command on a cluster.

    Attributes:
        ray: Module of Ray.
        words: Words of the command without the options for all shards.
        count: Number of shards.
        resources: Resources of each shard, by Ray's names.
        patience_s: Minimum time before a shard is started a second time, in seconds.
        durations_s: Durations of the finished shards, in seconds.
        repeated: Number of shards that were started a second time.
    """

    ray: Any
    words: list[str]
    count: int
    resources: Mapping[str, float]
    patience_s: float
    durations_s: list[float] = field(default_factory=list)
    repeated: int = 0

    def run_all(self) -> list[str]:
        """Run all shards, and return a description of each shard that failed."""
        # Index of the shard of each task of Ray that is running.
        running = {self._start(index): index for index in range(self.count)}
        restarted: set[int] = set()  # shards that were started a second time
        finished: set[int] = set()
        failures: list[str] = []
        room_since_s: float | None = None  # time since which resources have been free
        while len(finished) < self.count:
            ready, _ = self.ray.wait(list(running), num_returns=1, timeout=_POLL_S)
            for task in ready:
                index = running.pop(task)
                failure = self._result(task)  # empty on success
                has_second_task = index in running.values()  # a second run, which may still succeed
                if index in finished or (failure and has_second_task):
                    continue
                finished.add(index)
                if failure:
                    failures.append(failure)
            self._cancel_duplicates(running, finished=finished)
            now_s = time.monotonic()
            if not self._has_room():
                room_since_s = None
            elif room_since_s is None:
                room_since_s = now_s
            # Until a shard has finished, no duration is known, and none is started a second time.
            longest_s = max(self.durations_s, default=math.inf)
            limit_s = max(self.patience_s, 2 * longest_s)
            if room_since_s is not None and now_s - room_since_s > limit_s:
                late = set(running.values()) - restarted
                restarted |= late  # a shard is started a second time only once
                self.repeated += len(late)
                for index in late:
                    running[self._start(index)] = index
        return failures

    def _cancel_duplicates(self, running: dict[Any, int], finished: set[int]) -> None:
        """Cancel and remove the running tasks of finished shards."""
        for task, index in list(running.items()):
            if index in finished:
                self.ray.cancel(task, force=True)
                del running[task]

    def _start(self, index: int) -> Any:
        """Submit a shard to the cluster."""
        options = {"num_cpus": 1, **self.resources}
        task = self.ray.remote(_run_shard).options(
            max_retries=_RETRIES,
            retry_exceptions=[ShardKilledError],
            scheduling_strategy="SPREAD",  # over all nodes
            # Nodes do not have the environment of this process.
            runtime_env={"env_vars": {"PYTHONPATH": os.environ.get("PYTHONPATH", "")}},
            **options,
        )
        words = [sys.executable, *self.words]
        return task.remote(words, shard=f"{index}/{self.count}", folder=os.getcwd())

    def _result(self, task: Any) -> str:
        """Return the failure of a finished task, empty on success, and record its duration."""
        try:
            failure, duration_s = self.ray.get(task)
        except self.ray.exceptions.RayError as error:
            return _last_line(str(error))
        self.durations_s.append(duration_s)
        return failure

    def _has_room(self) -> bool:
        """Whether the resources for one more shard are free. Then no shard waits for resources."""
        free = self.ray.available_resources()
        needed = {
            "CPU": self.resources.get("num_cpus", 1),
            "GPU": self.resources.get("num_gpus", 0),
            "memory": self.resources.get("memory", 0),
        }
        return all(free.get(name, 0) >= amount for name, amount in needed.items())
