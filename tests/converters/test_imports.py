"""What the worker processes of converters load."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize("module", ["nuscenes.convert", "argoverse2.convert", "argoverse2.render"])
def test_converters_and_their_workers_do_without_torch(module: str):
    code = f"import gsmap.converters.{module}, sys; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
