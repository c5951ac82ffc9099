"""Forks of a process whose libraries have started threads."""

import os
import sys


def use_one_thread_in_forks() -> None:
    """Let torch use one thread in forked child processes.

    The threads of OpenMP do not exist in a fork. A child of a process that has computed with them
    would wait for them forever. torch limits the workers of its data loaders in this way.
    """
    if hasattr(os, "register_at_fork"):  # not on Windows
        os.register_at_fork(after_in_child=_use_one_thread)


def _use_one_thread() -> None:
    torch = sys.modules.get("torch")
    set_num_threads = getattr(torch, "set_num_threads", None)  # absent while torch is imported
    if set_num_threads is not None:
        set_num_threads(1)
