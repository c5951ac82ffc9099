"""Imports run down only: the arrows of docs/architecture.md, read from the source."""

import ast
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[1]
ROOTS = {
    "gsmap": REPO / "projects/GSMap/gsmap",
    "mapdata": REPO / "projects/MapData/mapdata",
    "drivemaps": REPO / "projects/DriveMaps/drivemaps",
    "minicity": REPO / "projects/MiniCity/minicity",
    "benchmarks": REPO / "benchmarks",
    "tools": REPO / "tools",
    "comparison": REPO / "tools/comparison",
}
OPENMMLAB = {"mmengine", "mmcv", "mmdet", "mmdet3d"}

# room -> the rooms that it may import, besides itself and outside packages
ALLOWED = {
    "utils": set(),
    "structures": {"utils"},
    "ops": {"structures", "utils"},
    "models": {"checkpoints", "ops", "structures", "utils"},
    "checkpoints": {"utils"},
    "datasets": {"structures", "utils"},
    "evaluation": {"datasets", "ops", "structures", "utils"},
    "visualization": {"datasets", "evaluation", "ops", "structures", "utils"},
    "engine": {"checkpoints", "utils"},
    "apis": {
        "checkpoints", "datasets", "engine", "evaluation", "structures", "utils", "visualization",
    },
    "mapdata": {"datasets", "minicity", "structures", "utils", "visualization"},
    "drivemaps": {"datasets", "evaluation", "structures", "utils", "visualization"},
    "minicity": {"utils"},
    "comparison": {
        "checkpoints", "datasets", "engine", "evaluation", "mapdata", "structures", "utils",
        "visualization",
    },
}  # fmt: skip
FREE_OF_OPENMMLAB = ("structures", "ops", "utils", "minicity", "evaluation")


def folder(room: str) -> Path:
    return ROOTS[room] if room in ROOTS else ROOTS["gsmap"] / room


def imported(path: Path) -> set[str]:
    """Return the rooms and the outside packages that a file imports."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: imports are absolute"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    parts = [name.split(".") for name in names]
    return {part[1] if part[0] == "gsmap" and len(part) > 1 else part[0] for part in parts}


@pytest.mark.parametrize("room", sorted(ALLOWED))
def test_imports_run_down_only(room: str):
    rooms = set(ALLOWED) | set(ROOTS)
    files = sorted(folder(room).rglob("*.py"))
    assert files, f"no files in {room}: was it renamed?"
    for path in files:
        wrong = (imported(path) & rooms) - ALLOWED[room] - {room, "gsmap"}
        assert not wrong, f"{path.relative_to(REPO)} imports {sorted(wrong)}"


@pytest.mark.parametrize("room", FREE_OF_OPENMMLAB)
def test_the_lowest_rooms_need_nothing_of_openmmlab(room: str):
    for path in sorted(folder(room).rglob("*.py")):
        metric_of_mmengine = room == "evaluation" and path.stem.endswith("_metric")
        assert bool(imported(path) & OPENMMLAB) == metric_of_mmengine, path.relative_to(REPO)


def test_every_room_has_its_arrows():
    rooms = {path.name for path in ROOTS["gsmap"].iterdir() if (path / "__init__.py").exists()}
    assert rooms == set(ALLOWED) - set(ROOTS)


def test_no_two_rooms_import_each_other():
    for room, below in ALLOWED.items():
        assert not {other for other in below if room in ALLOWED[other]}, room


def test_the_reader_of_imports_sees_what_a_file_imports():
    assert {"torch", "numpy"} <= imported(ROOTS["gsmap"] / "structures/grid.py")
    assert "structures" in imported(ROOTS["gsmap"] / "structures/gaussians.py")
