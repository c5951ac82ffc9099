"""A method comes and goes with its folder, its configs, its tests, its page and its list entry.

What GSMap itself is built on stays. A method goes with those that are built on it and with the
configs of GSMap that combine it.
"""

import ast
import os
import re
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from mmengine.config import Config
from processes import run_python

from gsmap.methods import METHODS

REPO = Path(__file__).resolve().parents[1]
MODELS = Path("projects/GSMap/gsmap/models")
COMBINATIONS = Path("projects/GSMap/configs")
PACKAGES = ("GSMap", "MapData", "DriveMaps", "MiniCity")
BUILT_ON = {method.name: method.built_on for method in METHODS}
STAYS = {"gsmap", *BUILT_ON["gsmap"]}
DELETED = [method.name for method in METHODS if method.name not in STAYS]
BUILD = """
import sys
from mmdet3d.registry import MODELS
from parsed_configs import keep_parsed_configs
from unset_weights import unset_weights
import gsmap.registered
from gsmap.engine.launch import check_config, read_config
assert gsmap.__file__.startswith(sys.argv[1]), gsmap.__file__
keep_parsed_configs()
for path in sys.argv[2:]:
    cfg = read_config(path)
    check_config(cfg)
    for part in ("img_backbone", "img_neck"):
        if cfg.model.get(part):
            cfg.model[part].init_cfg = None
    with unset_weights():
        MODELS.build(cfg.model)
"""
BUILT = "all configs are built"
COLLECT = f"""
print({BUILT!r}, flush=True)
import pytest
sys.exit(pytest.main(["--collect-only", "-q", "-p", "no:cacheprovider", "tests"]))
"""


def gone_with(name: str) -> set[str]:
    """Return a method and those that are built on it."""
    names = {name}
    for method in METHODS:
        if name in method.built_on:
            names.add(method.name)
    return names


def places(name: str) -> list[Path]:
    """Return a method's folders and its pages, from the repository's root."""
    folders = [MODELS / name, Path("configs") / name, Path("tests/methods") / name]
    return [*folders, Path(f"docs/methods/{name}.md"), Path(f"docs/methods/names/{name}.md")]


@cache
def names_in(path: Path) -> frozenset[str]:
    """Return the full names that a file imports, within functions too."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(names)


@cache
def registered(name: str) -> frozenset[str]:
    """Return the classes that a method registers."""
    names = set()
    for path in (REPO / MODELS / name).glob("*.py"):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and node.decorator_list:
                names.add(node.name)
    return frozenset(names)


def leaves() -> list[Path]:
    """Return all configs but the bases, from the repository's root."""
    files = [*(REPO / "configs").rglob("*.py"), *(REPO / COMBINATIONS).rglob("*.py")]
    return sorted(path.relative_to(REPO) for path in files if "_base_" not in path.parts)


def chain(path: Path) -> set[Path]:
    """Return a config and all that it inherits from, from the repository's root."""
    paths = {path}
    for base in Config._get_base_files(str(REPO / path)):
        paths |= chain(Path(os.path.normpath(path.parent / base)))
    return paths


def types_of(value: Any) -> set[str]:
    """Return the registry names in a config's value."""
    types = set()
    if isinstance(value, dict):
        if "type" in value:
            types.add(str(value["type"]))
        for entry in value.values():
            types |= types_of(entry)
    elif isinstance(value, (list, tuple)):
        for entry in value:
            types |= types_of(entry)
    return types


@cache
def used_by(path: Path) -> frozenset[str]:
    """Return the methods that a config uses: by its bases, or by the types of its parts."""
    bases = {base.parts[1] for base in chain(path) if base.parts[0] == "configs"}
    config = Config.fromfile(REPO / path, import_custom_modules=False)
    types = types_of(config.to_dict())
    names = set()
    for method in METHODS:
        if method.name in bases or types & registered(method.name):
            names.add(method.name)
    return frozenset(names)


@pytest.mark.parametrize("name", [method.name for method in METHODS])
def test_a_method_has_its_places(name):
    roots = {path.parts[0] for path in places(name)}
    there = {path.parts[0] for path in places(name) if (REPO / path).exists()}
    missing = roots - there
    # GSMap has a project of its own, with its configs and its page; docs/migration.md is MapTR's
    assert missing == {"gsmap": {"configs", "docs"}, "maptr": {"docs"}}.get(name, set())
    assert registered(name)


@pytest.mark.parametrize("name", DELETED)
def test_what_is_left_imports_nothing_of_a_method(name):
    gone = gone_with(name)
    assert not gone & STAYS
    gone_places = []
    for method in gone:
        gone_places += places(method)
    for path in sorted(REPO.glob("*/**/*.py")):
        where = path.relative_to(REPO)
        if where.parts[0] not in ("projects", "tools", "benchmarks", "tests", "docs"):
            continue
        if any(where.is_relative_to(place) for place in gone_places):
            continue
        for full in names_in(path):
            match = re.match(r"(?:gsmap\.models|methods)\.(\w+)(?:\.|$)", full)
            assert match is None or match[1] not in gone, where


@pytest.mark.parametrize("path", leaves(), ids=str)
def test_a_config_uses_only_what_its_method_is_built_on(path):
    """Configs of GSMap combine methods; each goes with any of those."""
    if path.is_relative_to(COMBINATIONS) or len(path.parts) == 2:
        return
    name = path.parts[1]
    assert used_by(path) <= {name, *BUILT_ON[name]}


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Path:
    """A copy of the repository in which only GSMap and what it is built on are left.

    It has the compiled modules, too, which Python reads for files of the same time and size.
    """
    root = tmp_path_factory.mktemp("deleted")
    unneeded = shutil.ignore_patterns("*.pth", "*.egg-info", "*.jpg", "*.png")
    for path in REPO.iterdir():
        if path.name in ("projects", "configs", "tests", "tools", "benchmarks", "docs", "models"):
            shutil.copytree(path, root / path.name, ignore=unneeded, symlinks=True)
        elif path.is_file() and path.name != ".git":
            shutil.copy(path, root)
    deleted = [path for path in leaves() if used_by(path) & {*DELETED}]
    for name in DELETED:
        deleted += places(name)
    for path in deleted:
        if (root / path).is_dir():
            shutil.rmtree(root / path)
        else:
            (root / path).unlink(missing_ok=True)
    listed = root / "projects/GSMap/gsmap/methods.py"
    entry = re.compile(rf'^    Method\("({"|".join(DELETED)})",.*\n', re.MULTILINE)
    text, number = entry.subn("", listed.read_text())
    assert number == len(DELETED)
    listed.write_text(text)
    return root


def run_in(root: Path, *words: object) -> Any:
    """Run Python in a copy, with its packages before those that are installed."""
    folders = [root / "projects" / name for name in PACKAGES]
    folders += [root, root / "tools", root / "tests"]
    path = os.pathsep.join(map(str, folders))
    return run_python(*words, cwd=root, env={"PYTHONPATH": path})


def test_without_all_further_methods_configs_build_and_the_other_tests_are_collected(copy):
    left = [path for path in leaves() if (copy / path).is_file()]
    assert len(left) > 20
    done = run_in(copy, "-c", BUILD + COLLECT, copy, *left)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert f"{BUILT}\n" in done.stdout
    assert re.search(r"tests/methods/gsmap/\S+::test_", done.stdout)
    assert not re.search(rf"tests/methods/({'|'.join(DELETED)})/", done.stdout)
