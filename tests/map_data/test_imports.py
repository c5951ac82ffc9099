"""What the worker processes of converters load."""

import pytest
from processes import run_python


@pytest.mark.parametrize("module", ["nuscenes.convert", "argoverse2.convert", "argoverse2.render"])
def test_converters_and_their_workers_do_without_torch(module: str):
    code = f"import mapdata.{module}, sys; sys.exit('torch' in sys.modules)"
    assert run_python("-c", code).returncode == 0
