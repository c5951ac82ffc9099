"""The script of GPU checks, reduced and on the CPU: every part runs and leaves its trace."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.faults

REPO = Path(__file__).resolve().parents[2]


def test_every_part_runs_and_is_written_down(tmp_path):
    results = tmp_path / "gpu.md"
    environment = {**os.environ, "PYTHON": sys.executable, "RESULTS": str(results), "REDUCED": "1"}
    done = subprocess.run(
        ["tools/gpu_checks.sh", str(tmp_path / "work")],
        cwd=REPO, env=environment, text=True, capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:]
    text = results.read_text()
    assert "CPU, reduced: no figure of this block is a measurement" in text
    titles = [line.removeprefix("### ") for line in text.splitlines() if line.startswith("### ")]
    assert titles == [
        "Kernels",
        "Frames per second",
        "Frames per second, kernels",
        "Frames per second, kernels, half precision",
        "A training step, kernels",
        "A training step, kernels, bfloat16",
        "A training step, kernels, bfloat16, replayed",
        "Tests",
    ]
    assert " passed" in text
    assert text.count("| maptr_r18_minicity | ") == 6
    assert "kernels that are right here: GSMAP_TRITON_KERNELS=deformable_sample" in text
    assert "failed" not in text


def test_without_a_gpu_the_full_form_says_so(tmp_path):
    environment = {**os.environ, "PYTHON": sys.executable, "CUDA_VISIBLE_DEVICES": ""}
    environment["RESULTS"] = str(tmp_path / "gpu.md")
    done = subprocess.run(
        ["tools/gpu_checks.sh", str(tmp_path)],
        cwd=REPO, env=environment, text=True, capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "error: no GPU here; REDUCED=1 tries the script without one" in done.stdout
    assert not (tmp_path / "gpu.md").exists()
