"""The pretended GPU's cases, in a process of their own.

Gradients there start threads of torch, after which a process cannot fork trainings, as other tests
do.
"""

from pathlib import Path

import pytest
from processes import run_python

from benchmarks.pretended_gpu import available

CASES = Path(__file__).with_name("launches_cases.py")


@pytest.mark.skipif(not available(), reason="torch has no backends in Python")
@pytest.mark.timeout(1800)
def test_the_pretended_gpu_counts_and_every_config_runs_on_it():
    done = run_python("-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-n", "0", str(CASES))
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    assert " passed" in done.stdout
