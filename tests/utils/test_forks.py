"""Forked child processes compute, whatever their parent has computed."""

from processes import run_python

COMPUTE_IN_A_FORK = """
import os
import signal

import gsmap
import torch

torch.set_num_threads(2)
values = torch.ones(1_000_000)
values.exp()  # starts the threads of OpenMP
child = os.fork()
if child == 0:
    signal.alarm(300)  # ends a child that waits for threads
    assert values.exp().sum() > 0
    torch.ones(500, 500) @ torch.ones(500, 500)
    os._exit(0)
_, status = os.waitpid(child, 0)
print(os.waitstatus_to_exitcode(status), torch.get_num_threads())
"""


def test_a_fork_computes_after_its_parent_has_started_threads():
    ended = run_python("-c", COMPUTE_IN_A_FORK, env={"OMP_NUM_THREADS": "2"})
    assert ended.stdout == "0 2\n", ended.stderr
