"""Programs that tests run in processes of their own."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

REPO = Path(__file__).resolve().parents[1]


def run_python(*words: object, env: Any = None, **options: Any) -> subprocess.CompletedProcess:
    """Run Python in the repository, with further variables of the environment; keep its output."""
    return subprocess.run(
        [sys.executable, *map(str, words)],
        **{"cwd": REPO, "capture_output": True, "text": True, "check": False, **options},
        env={**os.environ, **(env or {})},
    )
