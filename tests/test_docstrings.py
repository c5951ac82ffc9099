"""Docstrings of public functions say what each argument is."""

import ast
from functools import cache
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[1]
KERNELS = ("numba.py", "_numba.py", "triton.py")  # a torch reference beside them says it
FILES = [
    path
    for package in ("GSMap/gsmap", "MapData/mapdata", "DriveMaps/drivemaps", "MiniCity/minicity")
    for path in sorted((REPO / "projects" / package).rglob("*.py"))
    if path.name not in KERNELS
]


@cache
def imported() -> set[str]:
    """Return the names that some file imports from another, with their modules."""
    trees = (
        ast.parse(path.read_text())
        for folder in ("projects", "tools", "benchmarks")
        for path in (REPO / folder).rglob("*.py")
    )
    found = (n for tree in trees for n in ast.walk(tree) if isinstance(n, ast.ImportFrom))
    return {f"{node.module}.{alias.name}" for node in found for alias in node.names}


def undescribed(function: ast.FunctionDef) -> list[str]:
    """Return the arguments of a function, of three and more, that its docstring leaves out."""
    args = function.args
    names = [arg.arg for arg in (*args.posonlyargs, *args.args, *args.kwonlyargs)]
    section = (ast.get_docstring(function) or "").partition("\nArgs:\n")[2]
    lines = section.partition("\n\n")[0].splitlines()
    said = {line.partition(":")[0] for line in lines}
    return [name for name in names if f"    {name}" not in said] if len(names) > 2 else []


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(REPO / "projects")))
def test_a_function_that_other_files_import_describes_three_arguments_and_more(path):
    *_, module = path.relative_to(REPO / "projects").with_suffix("").as_posix().partition("/")
    module = module.replace("/", ".").removesuffix(".__init__")
    places = {module, module.rpartition(".")[0]}  # a package hands on what its modules have
    for node in ast.parse(path.read_text()).body:
        if not isinstance(node, ast.FunctionDef) or node.name.startswith("_"):
            continue
        if any(f"{place}.{node.name}" in imported() for place in places):
            assert undescribed(node) == [], f"{path.name}:{node.lineno} {node.name}"
