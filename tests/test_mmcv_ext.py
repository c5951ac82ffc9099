"""What stands in for mmcv's compiled operators, beside an mmcv of one empty file."""

import subprocess
import sys
from pathlib import Path

import pytest

import gsmap.mmcv_ext

LOAD = "import gsmap, mmcv._ext as ext; "


@pytest.fixture
def mmcv(tmp_path: Path) -> Path:
    (tmp_path / "mmcv").mkdir()
    (tmp_path / "mmcv/__init__.py").write_text("")
    return tmp_path / "mmcv"


def run(code: str, mmcv: Path) -> subprocess.CompletedProcess:
    code = f"import sys; sys.path.insert(0, {str(mmcv.parent)!r}); {code}"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_a_missing_operator_says_its_name_and_the_remedy(mmcv):
    done = run(LOAD + "nms = ext.nms; print('found'); nms(1, threshold=2)", mmcv)
    assert done.stdout == "found\n"
    last = done.stderr.splitlines()[-1]
    assert last.startswith(
        "gsmap.utils.errors.WorkError: the operator nms of mmcv is not compiled here:"
    )
    assert "GSMAP_MMCV_OPS=1 make setup" in last


def test_a_compiled_module_comes_first(mmcv):
    (mmcv / "_ext.py").write_text("nms = 'compiled'")
    assert run(LOAD + "print(ext.nms)", mmcv).stdout == "compiled\n"


def test_a_broken_compiled_module_is_not_hidden(mmcv):
    (mmcv / "_ext.py").write_text("raise ImportError('undefined symbol')")
    assert "ImportError: undefined symbol" in run(LOAD, mmcv).stderr


def test_it_is_there_before_anything_of_gsmap_is_imported_and_imports_neither_torch_nor_mmcv(mmcv):
    done = run("import gsmap; print(sorted({'torch', 'mmcv', 'numpy'} & set(sys.modules)))", mmcv)
    assert done.stdout == "[]\n"


def test_what_is_no_operator_is_not_found():
    assert not hasattr(gsmap.mmcv_ext, "__path__")
    assert gsmap.mmcv_ext.get_compiling_cuda_version() == "not available"
