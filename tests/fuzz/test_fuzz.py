"""A short run of the fuzzing: `python -m fuzz` is the long one."""

import os
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]


def test_damaged_files_end_in_words(minicity_root: Path, minicity_annotations: dict[str, Path]):
    data = str(minicity_root), str(minicity_annotations["train"])
    command = [sys.executable, "-m", "fuzz", "--cases", "250", "--seed", "1", "--data", *data]
    paths = [
        str(TESTS.parent),
        str(TESTS),
        str(TESTS / "converters"),
        os.environ.get("PYTHONPATH", ""),
    ]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False, timeout=900
    )
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    assert "| all 252 |" in done.stdout
