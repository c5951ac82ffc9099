"""docs/quickstart.ipynb: its cells run in order and end in a picture and figures."""

import json
from pathlib import Path

import cv2
import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs/quickstart.ipynb"
CELLS = json.loads(NOTEBOOK.read_text())["cells"]
CODE = ["".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code"]


def test_it_has_ten_cells_without_outputs_and_begins_with_the_installation():
    assert len(CELLS) == 10
    for cell in CELLS:
        assert not cell.get("outputs"), "clear the outputs before you commit"
        assert cell.get("execution_count") is None
    assert "%pip install -q {repository}" in CODE[0]
    assert not [
        line for code in CODE[1:] for line in code.splitlines() if line.startswith(("%", "!"))
    ]


@pytest.mark.parametrize("folder", [".", "docs"])
def test_the_first_cell_installs_the_repository_only_where_it_is_missing(folder, monkeypatch):
    """From the root and from ``docs/``, where a kernel starts; an editable install stays."""
    monkeypatch.chdir(NOTEBOOK.parents[1] / folder)
    code = CODE[0].replace("%pip install -q {repository}", "installed.append(repository)")
    installed: list[Path] = []
    exec(code, {"installed": installed})
    assert installed == []
    with monkeypatch.context() as patch:
        patch.setattr("importlib.util.find_spec", lambda name: None)
        exec(code, {"installed": installed})
    assert installed == [NOTEBOOK.parents[1]]


def test_its_cells_make_a_picture(tmp_path, monkeypatch, capsys):
    """All but the installation, which this environment has."""
    monkeypatch.chdir(tmp_path)
    scope: dict = {}
    for code in CODE[1:]:
        exec(code, scope)
    picture = cv2.imread(str(tmp_path / "quickstart.png"))
    assert picture.shape[1] >= 1000
    assert picture.std() > 20
    assert len(scope["samples"]) == 2
    printed = capsys.readouterr().out
    assert "ped_crossing" in printed
    assert "mAP" in printed or "mean" in printed
