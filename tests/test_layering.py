"""Imports run down only: the arrows of docs/architecture.md, read from the source."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from gsmap.methods import METHODS

REPO = Path(__file__).resolve().parents[1]
ROOTS = {
    "gsmap": REPO / "projects/GSMap/gsmap",
    "mapdata": REPO / "projects/MapData/mapdata",
    "drivemaps": REPO / "projects/DriveMaps/drivemaps",
    "minicity": REPO / "projects/MiniCity/minicity",
    "benchmarks": REPO / "benchmarks",
    "tools": REPO / "tools",
    "comparison": REPO / "tools/comparison",
    "scoring": REPO / "tools/scoring",
}
OPENMMLAB = {"mmengine", "mmcv", "mmdet", "mmdet3d"}

# room -> the rooms that it may import, besides itself and outside packages
ALLOWED = {
    "utils": set(),
    "structures": {"utils"},
    "ops": {"structures", "utils"},
    "prior": {"ops", "structures", "utils"},
    "models": {"checkpoints", "ops", "prior", "structures", "utils"},
    "checkpoints": {"utils"},
    "datasets": {"structures", "utils"},
    "evaluation": {"datasets", "ops", "structures", "utils"},
    "visualization": {"datasets", "evaluation", "ops", "structures", "utils"},
    "engine": {"checkpoints", "utils"},
    "apis": {
        "checkpoints", "datasets", "engine", "evaluation", "prior", "structures", "utils",
        "visualization",
    },
    "mapdata": {"datasets", "structures", "utils", "visualization"},
    "drivemaps": {"datasets", "evaluation", "structures", "utils", "visualization"},
    "minicity": {"datasets", "mapdata", "utils"},  # the last two for argoverse2_render
    "comparison": {
        "checkpoints", "datasets", "engine", "evaluation", "mapdata", "structures", "utils",
        "visualization",
    },
    "scoring": {"datasets", "evaluation", "structures", "utils", "visualization"},
}  # fmt: skip
# folder of models that is no method -> the folders of models that it may import; "" is detector.py
COMMON = {
    "base": set(),
    "encoders": {"base"},
    "streams": {"base"},
    "priors": {"base"},
    "lines": {"base"},
    "": {"base", "encoders", "streams"},
}
MODELS = dict(COMMON)
for method in METHODS:
    MODELS[method.name] = {*method.built_on, "base", "encoders", "lines", "priors", "streams"}
FREE_OF_OPENMMLAB = ("structures", "ops", "utils", "minicity", "evaluation")


def folder(room: str) -> Path:
    return ROOTS[room] if room in ROOTS else ROOTS["gsmap"] / room


def imported(path: Path) -> set[str]:
    """Return the rooms and the outside packages that a file imports."""
    rooms = set()
    for name in imported_names(path):
        parts = name.split(".")
        is_in_gsmap = parts[0] == "gsmap" and len(parts) > 1
        rooms.add(parts[1] if is_in_gsmap else parts[0])
    return rooms


def imported_names(path: Path) -> list[str]:
    """Return the full names that a file imports."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: imports are absolute"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


def model_folders(path: Path) -> set[str]:
    """Return the folders of models that a file imports; "" for detector.py."""
    folders = set()
    for name in imported_names(path):
        if name.startswith("gsmap.models."):
            third = name.split(".")[2]
            folders.add(third if third in MODELS else "")
    return folders


def packages(root: Path) -> set[str]:
    """Return the names of the packages in a folder."""
    return {path.name for path in root.iterdir() if (path / "__init__.py").exists()}


@pytest.mark.parametrize("room", sorted(ALLOWED))
def test_imports_run_down_only(room: str):
    rooms = set(ALLOWED) | set(ROOTS)
    files = sorted(folder(room).rglob("*.py"))
    assert files, f"no files in {room}: was it renamed?"
    for path in files:
        of_metric = {"evaluation"} if room == "models" and path.stem == "metric" else set()
        wrong = (imported(path) & rooms) - ALLOWED[room] - {room, "gsmap"} - of_metric
        assert not wrong, f"{path.relative_to(REPO)} imports {sorted(wrong)}"


@pytest.mark.parametrize("room", FREE_OF_OPENMMLAB)
def test_the_lowest_rooms_need_nothing_of_openmmlab(room: str):
    for path in sorted(folder(room).rglob("*.py")):
        metric_of_mmengine = room == "evaluation" and path.stem.endswith("_metric")
        assert bool(imported(path) & OPENMMLAB) == metric_of_mmengine, path.relative_to(REPO)


def test_every_room_has_its_arrows():
    assert packages(ROOTS["gsmap"]) == set(ALLOWED) - set(ROOTS)


def test_no_two_rooms_import_each_other():
    for room, below in ALLOWED.items():
        for other in below:
            assert room not in ALLOWED[other], room


def modules() -> dict[str, Path]:
    """Return the files of all packages by the name under which they are imported."""
    found = {}
    for name, root in ROOTS.items():
        for path in sorted(root.rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join([name, *parts]).removesuffix(".__init__")] = path
    return found


def test_no_files_import_each_other_in_a_circle():
    """Not even for types alone, or within a function."""
    files = modules()
    below = {}
    for name, path in files.items():
        imports = set()
        for full_name in imported_names(path):  # a module, or a name in a module
            imports |= {full_name, full_name.rpartition(".")[0]}
        below[name] = imports & files.keys() - {name}
    assert "gsmap.models.base.pairs" in below["gsmap.models.base.losses"]
    tuple(TopologicalSorter(below).static_order())  # CycleError names the circle


def test_the_reader_of_imports_sees_what_a_file_imports():
    assert {"torch", "numpy"} <= imported(ROOTS["gsmap"] / "structures/grid.py")
    assert "structures" in imported(ROOTS["gsmap"] / "structures/gaussians.py")


@pytest.mark.parametrize("part", MODELS)
def test_a_paper_imports_only_what_it_is_built_on(part: str):
    models = ROOTS["gsmap"] / "models"
    files = sorted((models / part).glob("*.py"))
    assert len(files) > 1, f"no files in {part}: was it renamed?"
    for path in files:
        wrong = model_folders(path) - MODELS[part] - {part}
        assert not wrong, f"{path.relative_to(REPO)} imports {sorted(wrong)}"


def test_every_folder_of_models_has_its_arrows():
    assert packages(ROOTS["gsmap"] / "models") == set(MODELS) - {""}


def test_a_method_names_all_that_it_is_built_on():
    built_on = {method.name: {*method.built_on} for method in METHODS}
    assert len(built_on) == len(METHODS)
    for name, below in built_on.items():
        assert name not in below
        assert all(built_on[other] <= below for other in below), name
