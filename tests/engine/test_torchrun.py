"""Which rank torchrun names, and its exit code, whichever end it sees first."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import REPO, free_port
from torch.distributed.elastic.multiprocessing import SignalException
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError, ProcessFailure

from gsmap.engine import torchrun

ENDS_WHILE_TORCHRUN_IS_STOPPED = """
import os, signal, sys, time

def state():
    return open(f"/proc/{os.getppid()}/stat").read().rpartition(")")[2].split()[0]

if os.environ["RANK"] == "0":
    os.kill(os.getppid(), signal.SIGSTOP)
while state() != "T":
    time.sleep(0.01)
if os.environ["RANK"] == "1":
    os.kill(os.getpid(), signal.SIGKILL)
sys.exit(2)
"""


def failed(*codes: int, at_s: tuple[int, ...] = (0, 0)) -> ChildFailedError:
    """Make the error of ranks 0, 1, ..., whose processes are 100, 101, ..."""
    failures = {}
    for rank, code in enumerate(codes):
        failures[rank] = ProcessFailure(rank, 100 + rank, code, "")
        failures[rank].timestamp = 1000 + at_s[rank]
    return ChildFailedError("train.py", failures)


@pytest.mark.parametrize(
    ("codes", "at_s", "rank", "code"),
    [
        ((2, -9), (0, 0), 1, 137),  # rank 0 has lost its peer
        ((-9, 2), (0, 0), 0, 137),
        ((2, 130), (0, 0), 1, 130),  # Ctrl-C, and rank 0 hears of it from its peer
        ((-15, -11), (0, 0), 1, 139),  # the first was ended by torchrun
        ((2, -9), (0, 30), 0, 2),  # so was the second, which did not heed SIGTERM
        ((2, -9), (0, 29), 0, 2),
        ((-9, -9), (30, 0), 1, 137),
        ((-1, 2), (0, 0), 0, 129),
        ((2, 2), (0, 0), 0, 2),
        ((2, 3), (1, 0), 1, 3),  # of equal ends the earlier
        ((-15, -15), (1, 0), 1, 143),
    ],
)
def test_the_cause_is_named_and_not_what_follows_from_it(codes, at_s, rank, code):
    said, found = torchrun.reason(failed(*codes, at_s=at_s))
    assert said.startswith(f"rank {rank} ")
    assert found == code


def test_a_signal_is_found_behind_the_errors_that_follow_from_it():
    interrupt = SignalException("", signal.SIGINT)

    def fail_on_the_way_out() -> None:
        """Raise as torch's own wrapper does when a signal meets it before its first line."""
        try:
            raise interrupt
        finally:
            raise UnboundLocalError

    with pytest.raises(UnboundLocalError) as first:
        fail_on_the_way_out()
    assert torchrun.signal_behind(first.value) is interrupt
    with pytest.raises(ChildFailedError) as second:
        raise failed(2) from first.value
    assert torchrun.signal_behind(second.value) is interrupt
    assert torchrun.signal_behind(failed(2)) is None


@pytest.mark.faults
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
def test_two_ends_that_torchrun_sees_at_once_are_told_apart(tmp_path):
    (tmp_path / "ends.py").write_text(ENDS_WHILE_TORCHRUN_IS_STOPPED)
    command = [sys.executable, "-m", "gsmap.engine.torchrun", "--nproc_per_node=2"]
    command += [f"--master_port={free_port()}", str(tmp_path / "ends.py")]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        command, cwd=REPO, env=environment, text=True, stderr=subprocess.PIPE
    ) as launcher:
        while sorted(states_of_children(launcher.pid)) != ["Z", "Z"]:
            assert launcher.poll() is None, launcher.stderr.read()
            time.sleep(0.02)
        launcher.send_signal(signal.SIGCONT)
        assert launcher.stderr.read().splitlines()[-1] == (
            "error: rank 1 was killed (SIGKILL, most likely for want of memory), so the run was "
            "stopped."
        )
    assert launcher.returncode == 137


def states_of_children(pid: int) -> list[str]:
    """Return the state of each child of a process: Z of one that has ended."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [Path(f"/proc/{n}/stat").read_text().rpartition(")")[2].split()[0] for n in children]
