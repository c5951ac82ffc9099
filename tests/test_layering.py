"""Imports run down only: the arrows of docs/architecture.md, read from the source."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "projects/GSMap/gsmap"
MODEL = {"detectors", "heads", "layers", "matching"}
OPENMMLAB = {"mmengine", "mmcv", "mmdet", "mmdet3d"}

# part -> the parts it must not import, directly
FORBIDDEN = {
    "geometry": MODEL
    | {"ops", "losses", "datasets", "evaluation", "visualization", "inference", "engine"}
    | OPENMMLAB,
    "ops": MODEL
    | {"losses", "datasets", "evaluation", "visualization", "inference", "engine"}
    | OPENMMLAB,
    "losses": MODEL
    | {"datasets", "evaluation", "visualization", "inference", "engine"}
    | OPENMMLAB,
    "matching": {
        "detectors",
        "heads",
        "layers",
        "datasets",
        "evaluation",
        "visualization",
        "inference",
        "engine",
    },
    "layers": {
        "detectors",
        "heads",
        "datasets",
        "evaluation",
        "visualization",
        "inference",
        "engine",
    },
    "heads": {"detectors", "datasets", "evaluation", "visualization", "inference", "engine"},
    "detectors": {"datasets", "evaluation", "visualization", "inference", "engine"},
    "datasets": MODEL | {"losses", "evaluation", "visualization", "inference", "engine"},
    "evaluation": MODEL | {"losses", "visualization", "inference", "engine"},
    "visualization": MODEL | {"losses", "inference", "engine"},
}


def imported_parts(path: Path) -> set[str]:
    """Return the parts of the package and the outside packages that a file imports."""
    parts = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = list(path.relative_to(PACKAGE).parts[:-1])
            if node.level:
                base = base[: len(base) - node.level + 1]
                module = ".".join(["gsmap", *base] + ([node.module] if node.module else []))
            else:
                module = node.module or ""
            names = [f"{module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            head, *rest = name.split(".")
            parts.add(rest[0] if head == "gsmap" and rest else head)
    return parts


@pytest.mark.parametrize("part", sorted(FORBIDDEN))
def test_imports_run_down_only(part: str):
    files = sorted((PACKAGE / part).rglob("*.py"))
    assert files, f"no files in {part}: was it renamed?"
    for path in files:
        wrong = imported_parts(path) & FORBIDDEN[part]
        assert not wrong, f"{path.relative_to(PACKAGE)} imports {sorted(wrong)}"


def test_the_reader_of_imports_sees_relative_and_absolute_ones():
    assert imported_parts(PACKAGE / "geometry/__init__.py") == {"geometry"}
    assert {"mmengine", "torch", "numpy"} <= imported_parts(PACKAGE / "engine/checkpoint_io.py")
