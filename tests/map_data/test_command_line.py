"""How the commands that make data end: with a report, an error in words, or interrupted."""

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from argoverse2_road import write_log

from mapdata.argoverse2 import convert as argoverse2
from mapdata.nuscenes import convert as nuscenes
from minicity import argoverse2_render

TOOL = Path(__file__).resolve().parents[2] / "tools/create_data.py"


@pytest.mark.parametrize(
    ("module", "required", "expected"),
    [
        (argoverse2, [], {"x_range": (-30.0, 30.0), "y_range": (-15.0, 15.0), "max_sweeps": 0}),
        (nuscenes, [], {"x_range": (-15.0, 15.0), "y_range": (-30.0, 30.0), "max_sweeps": 10}),
        (argoverse2_render, ["--out", "b"], {"split": "val", "logs": (), "scale": 0.25}),
    ],
)
def test_shared_options_keep_each_command_s_defaults(module, required, expected):
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)
    found = vars(parser.parse_args(["--root", "a", *required]))
    assert found["workers"] >= 1
    assert {name: found[name] for name in expected} == expected


def interrupt(command: list[str], ready: Callable[[int], bool]) -> subprocess.CompletedProcess:
    """Start a command, press Ctrl-C (which a terminal sends to all its processes) when ready.

    Args:
        command: What to make, and options.
        ready: Says from the number of the process whether it is time.
    """
    process = subprocess.Popen(
        [sys.executable, str(TOOL), *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a job in the background ignores Ctrl-C, and hands that on to what it starts
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    while not ready(process.pid):
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate()
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def check_interrupted(done: subprocess.CompletedProcess) -> None:
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1] == "interrupted: nothing half-written is left"


@pytest.mark.faults
def test_ctrl_c_while_workers_render_leaves_nothing_half_written(tmp_path):
    """A picture is there when the signal comes; afterwards a log is there as a whole or not at all.

    On a busy machine, a log may be complete before the signal arrives.
    """
    out = tmp_path / "out"
    names = {"log-a", "log-b"}
    for name in names:
        write_log(tmp_path / "val" / name, seconds=60.0)
    command = ["av2-render", "--root", str(tmp_path), "--out", str(out), "--workers", "2"]
    done = interrupt([*command, "--rate", "all"], lambda _: bool(list(out.rglob("*.jpg"))))
    check_interrupted(done)
    # The folder of an unfinished log has another name.
    assert {folder.name for folder in (out / "val").iterdir()} < names


def has_starting_worker(pid: int) -> bool:
    """Whether a worker is in the midst of its imports, which take seconds: it has NumPy."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    try:
        return any(
            "spawn_main" in Path(f"/proc/{child}/cmdline").read_text()
            and "/numpy/" in Path(f"/proc/{child}/maps").read_text()
            for child in children
        )
    except OSError:  # one of them has just ended
        return False


@pytest.mark.faults
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
def test_ctrl_c_while_workers_start_brings_no_traceback_of_theirs(tmp_path):
    write_log(tmp_path / "val" / "log-a", seconds=20.0)
    write_log(tmp_path / "val" / "log-b", seconds=20.0)
    before = sorted(tmp_path.iterdir())
    command = ["av2", "--root", str(tmp_path), "--rate", "all", "--workers", "2"]
    check_interrupted(interrupt(command, has_starting_worker))
    root = tmp_path / "root"
    command = ["minicity", "--root", str(root), "--scenes", "4", "--workers", "2"]
    check_interrupted(interrupt(command, has_starting_worker))
    assert sorted(tmp_path.iterdir()) == before
