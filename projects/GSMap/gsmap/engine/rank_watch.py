"""The end of a run of several ranks of which one no longer answers, in words that name it."""

import os
import platform
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from datetime import timedelta

import torch.distributed as dist

from gsmap.utils.cli import BAD_INPUT

TIMEOUT_S = 1800.0  # where a config does not say env_cfg.dist_cfg.timeout
_PATIENCE = 0.8  # share of the timeout after which a rank looks for who is missing
_MISSED = 3  # beats after which a rank counts as silent


class RankWatch:
    """Watches the ranks of a run, from a thread of each; a context manager.

    Every rank tells the store of the run that it is there and how many steps it has taken. A rank
    that has taken none for most of the timeout looks at what the others tell. It names those that
    are silent or else furthest behind, and ends its process, before the operation that it waits in
    ends with an error that names nobody.

    Args:
        timeout_s: Time that an operation of all ranks may take, in seconds.
    """

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._beat_s = min(5.0, timeout_s / 40)
        self._rank, self._ranks = dist.get_rank(), dist.get_world_size()
        self._beats = self._steps = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "RankWatch":
        host, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
        patience = timedelta(seconds=self._beat_s)
        store = dist.TCPStore(host, port, is_master=False, timeout=patience)
        start = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
        self._store = dist.PrefixStore(f"gsmap/{start}", store)
        self.step("its start")
        self._thread.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._ended.set()
        self._thread.join()

    def step(self, name: str) -> None:
        """Note that this rank goes on, and with what."""
        self._moved_s = time.monotonic()
        self._steps += 1
        self._name = name

    def _watch(self) -> None:
        self._beat()  # a rank may hang before its first turn
        while not self._ended.wait(self._beat_s):
            self._beat()
            if time.monotonic() - self._moved_s > _PATIENCE * self._timeout_s:
                self._judge()

    def _beat(self) -> None:
        """Tell that this rank is there, how far it is, and where it runs."""
        self._beats += 1
        who = f"process {os.getpid()} on {platform.node()}, at {self._name}"
        with suppress(RuntimeError):  # the store is silent: `_judge` will say so
            self._store.set(f"{self._rank}", f"{self._beats} {self._steps} {who}")

    def _told(self) -> dict[int, list[str]]:
        """Return what each rank has told last: its beats, its steps and who it is."""
        told = {}
        for rank in (self._rank, *range(self._ranks)):
            try:
                told[rank] = self._store.get(f"{rank}").decode().split(maxsplit=2)
            except RuntimeError:  # no answer in time
                told[rank] = ["", "0", "not begun"]
                if rank == self._rank:  # the store itself is silent; rank 0 or its launcher has it
                    return {0: told[rank]}
        return told

    def _judge(self) -> None:
        """End this process if the run does not go on, and name the rank that keeps it."""
        steps, before = self._steps, self._told()
        for _ in range(_MISSED):
            self._ended.wait(self._beat_s)
            self._beat()
        after = self._told()
        if self._steps != steps or self._ended.is_set():
            return
        silent = [rank for rank in after if before.get(rank, [""])[0] == after[rank][0]]
        count = Counter(int(told[1]) for told in after.values())
        last = [rank for rank in after if len(count) > 1 and int(after[rank][1]) == min(count)]
        who = " and ".join(f"rank {rank} ({after[rank][2]})" for rank in silent or last)
        what = f"{who} does not {'answer' if silent else 'go on'}" if who else "no rank goes on"
        text = (
            f"{what}; this one has waited {time.monotonic() - self._moved_s:.0f} s "
            f"(env_cfg.dist_cfg.timeout is {self._timeout_s:g}): see whether it is stopped, and "
            "what it reads."
        )
        sys.stderr.write(f"error: {text}\n")
        sys.stderr.flush()
        os._exit(BAD_INPUT)
