"""What the scripts for Slurm ask of ``srun``."""

import os
import subprocess
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools"


@pytest.fixture
def srun(tmp_path: Path) -> dict[str, str]:
    """An environment in which ``srun`` prints its words, one a line."""
    (tmp_path / "srun").write_text("#!/bin/sh\nprintf '%s\\n' \"$@\"\n")
    (tmp_path / "srun").chmod(0o755)
    return {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}


def asked(environment: dict[str, str], *words: str) -> list[str]:
    command = [str(TOOLS / words[0]), *words[1:]]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return run.stdout.splitlines()


def test_training_on_two_machines(srun):
    srun |= {"GPUS": "16", "PYTHON": "mine", "SRUN_ARGS": "--exclusive --qos=long"}
    found = asked(srun, "slurm_train.sh", "gpu", "my job", "c.py", "--cfg-options", "a='x y'")
    assert found == [
        *("-p", "gpu", "--job-name=my job", "--gres=gpu:8", "--ntasks=16", "--ntasks-per-node=8"),
        *("--cpus-per-task=5", "--kill-on-bad-exit=1", "--exclusive", "--qos=long", "mine", "-u"),
        *(f"{TOOLS}/train.py", "c.py", "--launcher", "slurm", "--cfg-options", "a='x y'"),
    ]


def test_a_test_on_two_gpus_of_one_machine(srun):
    found = asked(
        srun | {"GPUS": "2"}, "slurm_test.sh", "gpu", "j", "c.py", "w.pth", "--shuffle-images", "0"
    )
    assert {"--gres=gpu:2", "--ntasks=2", "--ntasks-per-node=2"} < set(found)
    assert found[-7:] == [
        *(f"{TOOLS}/test.py", "c.py", "w.pth", "--launcher", "slurm", "--shuffle-images", "0")
    ]


def test_missing_arguments_are_told(srun):
    with pytest.raises(subprocess.CalledProcessError) as error:
        asked(srun, "slurm_train.sh", "gpu", "job")
    assert error.value.returncode == 2
    assert "slurm_train.sh PARTITION JOB_NAME CONFIG" in error.value.stdout
