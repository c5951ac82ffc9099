"""docs/quickstart.ipynb: its cells run in order and end in a picture and figures."""

import json
from pathlib import Path

import cv2

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs/quickstart.ipynb"
CELLS = json.loads(NOTEBOOK.read_text())["cells"]
CODE = ["".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code"]


def test_it_has_ten_cells_without_outputs_and_begins_with_the_installation():
    assert len(CELLS) == 10
    for cell in CELLS:
        assert not cell.get("outputs"), "clear the outputs before you commit"
        assert cell.get("execution_count") is None
    assert CODE[0] == "%pip install -q ."
    assert not [
        line for code in CODE[1:] for line in code.splitlines() if line.startswith(("%", "!"))
    ]


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
