"""Share of small changes of the code that the tests detect (mutation testing).

Each mutant changes one place of one module: a comparison, a sign, a number, a truth value, `min` or
`max`, `and` or `or`, a `not`. Code is grouped by rooms: a room is a package, or a folder of the
package ``gsmap``, that has a folder of tests. On a mutant, the test files of the room that import
the module are run first. If none of them fails, all other test files of the room are run. No file
is changed, as a mutant exists only in the memory of a child process.
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
from gsmap.utils.shipped import shipped_path

REPO = shipped_path()  # root folder of the repository
# Folder of tests of each room whose tests have another name than the room, below `tests`.
TESTS = {"mapdata": "map_data", "drivemaps": "drive_maps"}
# Folders of the packages, below `projects`.
FOLDERS = ("GSMap/gsmap", "MapData/mapdata", "DriveMaps/drivemaps")
ROOMS = ("models", "ops", "structures", "evaluation", "datasets", "mapdata", "drivemaps")
CAUGHT = "caught"  # a test has failed
SURVIVED = "not caught"  # all tests have passed
LATE = "timed out"
VERDICTS = (CAUGHT, SURVIVED, LATE)
# Modules that are imported once, before the child processes fork. None of them imports a module of
# a room, which would stay unchanged in the child processes.
PRELOADED = ["gsmap", "pytest", "scipy.ndimage", "shapely", "mmdet3d.models", "mmdet3d.datasets"]
# Replacement of each operator (`OPERATORS`) and of each function name (`NAMES`).
OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
NAMES = {"min": "max", "max": "min", "amin": "amax", "amax": "amin", "argmin": "argmax"}
NAMES |= {"argmax": "argmin", "minimum": "maximum", "maximum": "minimum"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks mutations`` to a parser."""
    parser.add_argument(
        "--rooms", nargs="+", choices=ROOMS, default=list(ROOMS), help="folders of code to change"
    )
    parser.add_argument("--modules", nargs="+", help="only these, such as gsmap.structures.grid")
    parser.add_argument("--number", type=int, default=60, help="mutants, spread over the rooms")
    parser.add_argument("--seed", type=int, default=0, help="seed of the selection of mutants")
    parser.add_argument("--seconds", type=float, default=300.0, help="time limit of the tests")


def run(args: argparse.Namespace) -> None:
    """Print each mutant and its verdict, then a table with one row per room.

    Args:
        args: Parsed options of ``add_arguments``.

    Raises:
        ValueError: If the tests of a room fail without a mutation.
    """
    rng = np.random.default_rng(args.seed)
    rows = []
    for room_index, room in enumerate(args.rooms):
        modules = {}
        places = []
        for name, path in modules_of(room).items():
            if args.modules and name not in args.modules:
                continue
            modules[name] = path
            for index in range(count_places(path.read_text())):
                places.append((name, index))
        # `args.number` mutants are spread evenly. If the division leaves a remainder of n,
        # `room_index` gives one mutant more to each of the last n rooms, so that the rooms together
        # get `args.number`.
        num_mutants = (args.number + room_index) // len(args.rooms)
        order = rng.permutation(len(places))
        # No module has an empty name, so these tests run on the unchanged code. They must pass.
        verdict_unchanged = verdict(module="", source="", tests=tests_of(room, None), seconds=None)
        if verdict_unchanged != SURVIVED:
            raise InputError(f"the tests of {room} fail without a mutation: repair them first.")
        verdicts = []
        for k in order[:num_mutants]:
            name, index = places[k]
            path = modules[name]
            line, change, source = mutant(path.read_text(), index)
            mutant_verdict = verdict_of_room(room, name, source=source, seconds=args.seconds)
            verdicts.append(mutant_verdict)
            print(f"{mutant_verdict}: {path.relative_to(REPO)}:{line} {change}", flush=True)
        row = [room, str(len(verdicts))]
        row += [str(verdicts.count(kind)) for kind in VERDICTS]
        rows.append(row)
    print(markdown_table(["room", "mutants", *VERDICTS], rows))


def modules_of(room: str) -> dict[str, Path]:
    """Find the modules of a room that at least one test file of the room imports.

    Modules with code for numba or Triton are left out, because these compilers read the file on
    disk, which is unchanged.

    Returns:
        Path of each module, by the name of the module.
    """
    modules = {}
    for folder in FOLDERS:
        root = REPO / "projects" / folder
        # The rooms `mapdata` and `drivemaps` are whole packages. The other rooms are folders of
        # `gsmap`, so the folder does not exist in other packages, and no file is found there.
        room_folder = root if root.name == room else root / room
        for path in sorted(room_folder.rglob("*.py")):
            parts = path.relative_to(root.parent).with_suffix("").parts
            name = ".".join(parts).removesuffix(".__init__")
            # A file that imports a compiler has its name as a word between blanks.
            words = set(path.read_text().split())
            if not {"numba", "triton"} & words and tests_of(room, name):
                modules[name] = path
    return modules


def tests_of(room: str, module: str | None) -> list[str]:
    """Find the test files of a room.

    Args:
        room: One of ``ROOMS``.
        module: Only test files that import this module are returned; None for all files.

    Returns:
        Paths in alphabetical order.
    """
    paths = sorted((REPO / "tests" / TESTS.get(room, room)).rglob("test_*.py"))
    if module is None:
        return list(map(str, paths))
    return [str(path) for path in paths if module in _imported_names(path.read_text())]


def _imported_names(source: str) -> Iterator[str]:
    """Yield ``MODULE`` and each ``MODULE.MEMBER`` of the ``from`` imports of a file."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            for alias in node.names:
                yield f"{node.module}.{alias.name}"


def count_places(source: str) -> int:
    """Count the mutants of a module."""
    return sum(1 for _ in _places(ast.parse(source)))


def mutant(source: str, index: int) -> tuple[int, str, str]:
    """Make one mutant of a module.

    Args:
        source: Source of the module.
        index: Number of the mutant, in [0, ``count_places(source)``).

    Returns:
        Line number, description of the change, and mutated source.
    """
    tree = ast.parse(source)
    node, fields = next(islice(_places(tree), index, None))
    before = ast.unparse(node)
    for name, value in fields.items():
        setattr(node, name, value)
    return node.lineno, f"{before} -> {ast.unparse(node)}", ast.unparse(tree)


def _places(tree: ast.AST) -> Iterator[tuple[ast.expr, dict[str, object]]]:
    """Find the possible changes of a module.

    Type annotations, decorators, ``raise`` statements and f-strings are not changed.

    Yields:
        An expression, and the fields that the change sets: their new values by name.
    """
    skipped_nodes: set[ast.AST] = set()
    # `ast.walk` yields a node before all nodes below it. Nodes that a node excludes are therefore
    # in `skipped_nodes` when their turn comes.
    for node in ast.walk(tree):
        skipped_parts = [getattr(node, name, None) for name in ("annotation", "returns")]
        skipped_parts += getattr(node, "decorator_list", [])
        if isinstance(node, ast.Raise | ast.JoinedStr):
            skipped_parts.append(node)
        for part in skipped_parts:
            if part:
                skipped_nodes.update(ast.walk(part))
        if isinstance(node, ast.expr) and node not in skipped_nodes:
            for fields in _changes(node):
                yield node, fields


def _changes(node: ast.expr) -> list[dict[str, object]]:
    """List the possible changes of an expression, each as new values of fields by name."""
    match node:
        case ast.Compare(ops=ops):
            changes: list[dict[str, object]] = []
            for k, op in enumerate(ops):  # several operators for `low <= x < high`
                changed_op = OPERATORS[type(op)]()
                changes.append({"ops": [*ops[:k], changed_op, *ops[k + 1 :]]})
            return changes
        case ast.BinOp(op=op) | ast.BoolOp(op=op) if type(op) in OPERATORS:
            return [{"op": OPERATORS[type(op)]()}]
        case ast.UnaryOp(op=ast.Not() | ast.Invert() | ast.USub() as op, operand=operand):
            # The operator is applied twice, which has the effect of removing it.
            return [{"operand": ast.UnaryOp(op, operand)}]
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
    """Test a mutant with the tests that import its module and, if they pass, with the others.

    Args:
        room: One of ``ROOMS``.
        module: Name of the module.
        source: Source of the mutant.
        seconds: Time limit in seconds of each of the two groups of tests.

    Returns:
        One of ``VERDICTS``.
    """
    near_tests = tests_of(room, module)
    near_verdict = verdict(module, source, near_tests, seconds)
    if near_verdict != SURVIVED:
        return near_verdict
    other_tests = [path for path in tests_of(room, None) if path not in near_tests]
    if not other_tests:
        return SURVIVED
    return verdict(module, source, other_tests, seconds)


def verdict(module: str, source: str, tests: Sequence[str], seconds: float | None) -> str:
    """Run tests in a child process in which one module has another source.

    Args:
        module: Name of the module; empty to change no module.
        source: Source of the mutant.
        tests: Paths of the test files.
        seconds: Time limit in seconds; None for no limit.

    Returns:
        One of ``VERDICTS``.
    """
    # A server process imports the modules of `PRELOADED` once and forks a child for each call. It
    # imports no module of a room, so each child imports the changed module itself.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    child = context.Process(target=_run_tests, args=(module, source, tests))
    child.start()
    child.join(seconds)
    if child.exitcode is None:  # the child still runs after the time limit
        # End the child and the processes that the tests have started. `killpg` raises
        # ProcessLookupError if the child has not created its process group yet.
        with suppress(ProcessLookupError):
            # The child was started, so `pid` is not None; `or 0` is only for the type checker.
            os.killpg(child.pid or 0, signal.SIGKILL)
        child.kill()  # in case that the child had no group
        child.join()
        return LATE
    # The exit code is 0 if all tests have passed. Other codes mean a failed test, or an error.
    return CAUGHT if child.exitcode else SURVIVED


def _run_tests(module: str, source: str, tests: Sequence[str]) -> None:
    """Run pytest in this process, which imports the mutant, and exit with the code of pytest."""
    os.setsid()  # a process group, so that `verdict` can end the processes of the tests as well
    sys.meta_path.insert(0, _Finder(module, source))
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)  # standard output
    os.dup2(sink, 2)  # standard error
    import pytest

    # The tests end at the first failure (-x). They run in this process alone, without the processes
    # of xdist, in which the finder of the mutant would be missing. The cache would write files.
    options = ["-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", "--rootdir", str(REPO)]
    options += ["-m", ""]  # also runs tests that pyproject.toml excludes by their mark (`faults`)
    sys.exit(pytest.main([*options, *tests]))


class _Finder:
    """Import finder that replaces the source of one module.

    Args:
        module: Name of the module.
        source: Source of the mutant.
    """

    def __init__(self, module: str, source: str) -> None:
        self.module = module
        self.source = source

    def find_spec(
        self, name: str, path: Sequence[str] | None, _: object = None
    ) -> ModuleSpec | None:
        """Return the module's import spec with a loader of the mutant; None for other modules.

        Python calls it for each module that is imported. After None it asks the next finder.

        Args:
            name: Name of a module.
            path: Search path of the module's package; None for a top-level module.
        """
        spec = PathFinder.find_spec(name, path) if name == self.module else None
        if spec is not None and spec.origin is not None:
            spec.loader = _Loader(name, spec.origin)
            spec.loader.source = self.source
        return spec


class _Loader(SourceFileLoader):
    """Loader that compiles ``source`` in place of the file."""

    source: str

    def get_code(self, fullname: str) -> CodeType:
        return compile(self.source, self.path, mode="exec")
