"""A short run of the fuzzing: `python -m fuzz` is the long one."""

import os
import re
from pathlib import Path

import pytest
from processes import run_python

pytestmark = pytest.mark.faults

TESTS = Path(__file__).resolve().parents[1]


def test_damaged_files_end_in_words(minicity_root: Path, minicity_annotations: dict[str, Path]):
    words = "--cases", 250, "--seed", 1, "--data", minicity_root, minicity_annotations["train"]
    paths = [
        str(TESTS.parent),
        str(TESTS),
        str(TESTS / "map_data"),
        os.environ.get("PYTHONPATH", ""),
    ]
    environment = {"PYTHONPATH": os.pathsep.join(paths)}
    done = run_python("-m", "fuzz", *words, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    assert int(re.search(r"\| all (\d+) \|", done.stdout)[1]) >= 250
