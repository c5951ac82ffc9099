"""How many small changes of the code the tests notice: a mutation is a test's test.

Each mutant changes one place of one module: a comparison, a sign, a number, a truth value, `min` or
`max`, `and` or `or`, a `not`. The test files nearest to the module, those of its room that import
it, then run on it, and if none of them fails all others of the room. It lives in the memory of a
child process alone: no file changes.
"""

import argparse
import ast
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from itertools import islice
from pathlib import Path
from types import CodeType

import numpy as np

from benchmarks.measure import markdown_table
from gsmap.utils.errors import InputError
from gsmap.utils.shipped import shipped

REPO = shipped()
TESTS = {"mapdata": "map_data", "drivemaps": "drive_maps"}  # folders of tests by room
FOLDERS = ("GSMap/gsmap", "MapData/mapdata", "DriveMaps/drivemaps")
ROOMS = ("models", "ops", "structures", "evaluation", "datasets", "mapdata", "drivemaps")
VERDICTS = CAUGHT, SURVIVED, LATE = "caught", "not caught", "timed out"
PRELOADED = ["gsmap", "pytest", "scipy.ndimage", "shapely", "mmdet3d.models", "mmdet3d.datasets"]
OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
NAMES = {"min": "max", "max": "min", "amin": "amax", "amax": "amin", "argmin": "argmax"}
NAMES |= {"argmax": "argmin", "minimum": "maximum", "maximum": "minimum"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=list(ROOMS), help="of code")
    parser.add_argument("--modules", nargs="+", help="only these, such as gsmap.structures.grid")
    parser.add_argument("--number", type=int, default=60, help="mutants, spread over the rooms")
    parser.add_argument("--seed", type=int, default=0, help="which places are drawn")
    parser.add_argument(
        "--seconds", type=float, default=300.0, help="limit of the nearest tests, and of the others"
    )


def run(args: argparse.Namespace) -> None:
    """Print each mutant and what became of it, then a row for each room."""
    rows, rng = [], np.random.default_rng(args.seed)
    for number, room in enumerate(args.rooms):
        modules = {n: f for n, f in modules_of(room).items() if n in (args.modules or [n])}
        places = [(n, i) for n, f in modules.items() for i in range(count_places(f.read_text()))]
        share = (args.number + number) // len(args.rooms)
        drawn = [places[k] for k in rng.permutation(len(places))[:share]]
        if verdict("", "", tests_of(room, None), None) != SURVIVED:
            raise InputError(f"the tests of {room} fail without a mutation: mend them first.")
        found = []
        for name, index in drawn:
            line, change, source = mutant(modules[name].read_text(), index)
            found.append(verdict_of_room(room, name, source, args.seconds))
            print(f"{found[-1]}: {modules[name].relative_to(REPO)}:{line} {change}", flush=True)
        rows.append([room, str(len(found)), *(str(found.count(v)) for v in VERDICTS)])
    print(markdown_table(["room", "mutants", *VERDICTS], rows))


def modules_of(room: str) -> dict[str, Path]:
    """Return the modules of a room that have near tests; numba would compile its own anew."""
    found = {}
    for folder in FOLDERS:
        root = REPO / "projects" / folder
        for path in sorted((root if root.name == room else root / room).rglob("*.py")):
            parts = path.relative_to(root.parent).with_suffix("").parts
            name = ".".join(parts).removesuffix(".__init__")
            if not {"numba", "triton"} & set(path.read_text().split()) and tests_of(room, name):
                found[name] = path
    return found


def tests_of(room: str, module: str | None) -> list[str]:
    """Return the test files of a room, those that import a module or all."""
    return [
        str(path)
        for path in sorted((REPO / "tests" / TESTS.get(room, room)).rglob("test_*.py"))
        if module is None or module in _imported(path.read_text())
    ]


def _imported(source: str) -> Iterator[str]:
    """Yield what a file imports, and what may be a module in it."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def count_places(source: str) -> int:
    """Return how many mutants a module has."""
    return sum(1 for _ in _places(ast.parse(source)))


def mutant(source: str, index: int) -> tuple[int, str, str]:
    """Return one mutant of a module: its line, the change, and the mutated source."""
    tree = ast.parse(source)
    node, fields = next(islice(_places(tree), index, None))
    before = ast.unparse(node)
    for name, value in fields.items():
        setattr(node, name, value)
    return node.lineno, f"{before} -> {ast.unparse(node)}", ast.unparse(tree)


def _places(tree: ast.AST) -> Iterator[tuple[ast.expr, dict[str, object]]]:
    """Yield what can change in a module but for types, decorators and texts of errors.

    Each is an expression and the fields that the change sets in it.
    """
    skipped: set[ast.AST] = set()
    for node in ast.walk(tree):
        parts = [getattr(node, name, None) for name in ("annotation", "returns")]
        parts += getattr(node, "decorator_list", [])
        parts += [node] if isinstance(node, ast.Raise | ast.JoinedStr) else []
        skipped.update(inner for part in parts if part for inner in ast.walk(part))
        if isinstance(node, ast.expr) and node not in skipped:
            yield from ((node, fields) for fields in _changes(node))


def _changes(node: ast.expr) -> list[dict[str, object]]:
    """Return the changes of an expression, each as the fields that it sets."""
    match node:
        case ast.Compare(ops=ops):
            swapped = [OPERATORS[type(op)]() for op in ops]
            return [{"ops": [*ops[:k], op, *ops[k + 1 :]]} for k, op in enumerate(swapped)]
        case ast.BinOp(op=op) | ast.BoolOp(op=op) if type(op) in OPERATORS:
            return [{"op": OPERATORS[type(op)]()}]
        case ast.UnaryOp(op=ast.Not() | ast.Invert() | ast.USub() as op, operand=operand):
            return [{"operand": ast.UnaryOp(op, operand)}]  # twice is never
        case ast.Constant(value=bool(value)):
            return [{"value": not value}]
        case ast.Constant(value=int(value) | float(value)):
            return [{"value": value + 1}]
        case ast.Name(id=name) if name in NAMES:
            return [{"id": NAMES[name]}]
        case ast.Attribute(attr=name) if name in NAMES:
            return [{"attr": NAMES[name]}]
    return []


def verdict_of_room(room: str, module: str, source: str, seconds: float) -> str:
    """Return the `verdict` of the nearest tests, or of the room's others if these all pass."""
    near = tests_of(room, module)
    result = verdict(module, source, near, seconds)
    others = [path for path in tests_of(room, None) if path not in near]
    return verdict(module, source, others, seconds) if result == SURVIVED and others else result


def verdict(module: str, source: str, tests: Sequence[str], seconds: float | None) -> str:
    """Run tests on a module with another source: ``caught``, ``not caught`` or ``timed out``."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    child = context.Process(target=_run_tests, args=(module, source, tests))
    child.start()
    child.join(seconds)
    if child.exitcode is None:
        with suppress(ProcessLookupError):  # it has no group of its own yet
            os.killpg(child.pid or 0, signal.SIGKILL)
        child.kill()
        child.join()
        return LATE
    return CAUGHT if child.exitcode else SURVIVED


def _run_tests(module: str, source: str, tests: Sequence[str]) -> None:
    """Run pytest in this process, which imports the mutant."""
    os.setsid()
    sys.meta_path.insert(0, _Finder(module, source))
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    os.dup2(sink, 2)
    import pytest

    options = ["-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", "--rootdir", str(REPO)]
    sys.exit(pytest.main([*options, "-m", "", *tests]))  # those of faults, too


class _Finder:
    """Finds one module as ever, with another source."""

    def __init__(self, module: str, source: str) -> None:
        self.module, self.source = module, source

    def find_spec(
        self, name: str, path: Sequence[str] | None, _: object = None
    ) -> ModuleSpec | None:
        spec = PathFinder.find_spec(name, path) if name == self.module else None
        if spec is not None and spec.origin is not None:
            spec.loader = _Loader(name, spec.origin)
            spec.loader.source = self.source
        return spec


class _Loader(SourceFileLoader):
    source: str

    def get_code(self, fullname: str) -> CodeType:
        return compile(self.source, self.path, "exec")
