"""A comparison from its command to its tables: killed, resumed, with a run that fails."""

import fcntl
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import run_python, search_path, wait_for
from waiting import waiting_config

pytestmark = pytest.mark.faults

REPO = Path(__file__).resolve().parents[2]


def free(folder: Path) -> bool:
    """Whether nobody works in a run's folder."""
    with open(folder / ".lock") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True


def ranks(folder: Path) -> list[int]:
    """Return the processes that train in a folder."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes().split(b"\0")
                state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
            except (FileNotFoundError, ProcessLookupError):
                continue  # it has just ended
            if str(folder).encode() in words and state != "Z":
                found.append(int(entry.name))
    return found


@pytest.mark.timeout(1800)  # several trainings
def test_a_comparison_is_killed_goes_on_and_names_the_run_that_failed(tiny_config, tmp_path):
    config, waits = waiting_config(tiny_config, tmp_path)
    words = ["tools/compare.py", f"good={config}", "--seeds", "1"]
    words += ["--budget", "2", "--batch", "2", "--out", str(tmp_path)]
    threads = {"OMP_NUM_THREADS": "2", **search_path()}  # too many, if there is a process per core
    folder = tmp_path / "good/seed_0"
    command = [sys.executable, *words]
    with subprocess.Popen(command, cwd=REPO, env={**os.environ, **threads}) as comparison:
        wait_for(folder / "epoch_1.pth", comparison)
        processes = ranks(folder)
        assert processes
        for process in processes:
            environment = Path(f"/proc/{process}/environ").read_bytes().split(b"\0")
            assert b"OMP_NUM_THREADS=1" in environment
        comparison.send_signal(signal.SIGKILL)
    assert comparison.returncode == -signal.SIGKILL
    while ranks(folder) or not free(folder):  # training dies with it
        time.sleep(0.05)
    waits.unlink()

    bad = f"bad={config},optim_wrapper.optimizer.lr=-1.0"
    done = run_python(*words[:2], bad, *words[2:], env=threads)
    assert done.returncode == 2
    assert "error: bad/seed_0 did not end" in done.stderr
    assert "runs done" in done.stderr
    assert f"Load checkpoint from {folder}/epoch_" in (folder / "train.log").read_text()
    assert "| good | 1 |" in done.stdout
    assert "| bad | 0 (1 not done) |" in done.stdout
    assert "Invalid learning rate: -1.0" in (tmp_path / "comparison.md").read_text()
    assert "| bad | 0 | train ended with exit code" in done.stdout
    report = json.loads((tmp_path / "comparison.json").read_text())
    good = report["runs"][0]
    assert good["seed"] == 0
    assert good["costs"]["iterations"] == 2
    assert good["costs"]["peak MiB"] > 100
    assert good["figures"]["chamfer/num_samples"] == 2
    assert (tmp_path / "iterations.png").exists()
    assert (tmp_path / "comparison_precision_recall.png").exists()

    rules = ["--rescore", "thresholds=[0.2,0.5]", "ground_truth_points=20"]
    run_python(*words, *rules, env=threads, check=True)
    figures = json.loads((tmp_path / "rescored.json").read_text())["runs"][0]["figures"]
    assert {key for key in figures if key.startswith("chamfer/divider/AP@")} == {
        "chamfer/divider/AP@0.2",
        "chamfer/divider/AP@0.5",
    }

    slurm = run_python(*words[:2], bad, *words[2:], "--slurm=gpu", env=threads, check=True)
    (line,) = slurm.stdout.splitlines()  # the other run is done
    srun = ["srun", "--partition=gpu", "--gres=gpu:1", "--ntasks=1", "--cpus-per-task=5"]
    own = [sys.executable, *words[:2], bad, *words[2:], "--only", "bad/seed_0"]
    assert shlex.split(line) == [*srun, "--job-name=bad/seed_0", *own]
