"""What the worker processes of converters load."""

import pytest
from processes import run_python

MODULES = ["mapdata.nuscenes.convert", "mapdata.argoverse2.convert", "minicity.argoverse2_render"]


@pytest.mark.parametrize("module", MODULES)
def test_converters_and_their_workers_do_without_torch(module: str):
    code = f"import {module}, sys; sys.exit('torch' in sys.modules)"
    assert run_python("-c", code).returncode == 0
