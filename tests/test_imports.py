"""What docs/architecture.md says of which packages need torch and OpenMMLab."""

import re
from pathlib import Path

import pytest
from processes import run_python

REPO = Path(__file__).resolve().parents[1]
PROJECTS = {path.name: path for path in (REPO / "projects").glob("*/*") if path.is_dir()}
OPENMMLAB = ("mmcv", "mmdet", "mmdet3d", "mmengine")
TABLE = re.findall(
    r"^\| (neither torch nor OpenMMLab|torch, not OpenMMLab) \| (.*) \|$",
    (REPO / "docs/architecture.md").read_text(),
    re.MULTILINE,
)
CODE = """
import importlib, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {absent}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Absent())
for name in {names}:
    importlib.import_module(name)
"""


def modules(package: str) -> set[str]:
    """Return the names of all modules of a package, but those that are run."""
    name, *rooms = package.split(".")
    root = PROJECTS[name].parent
    files = PROJECTS[name].joinpath(*rooms).rglob("*.py")
    names = {".".join(file.relative_to(root).with_suffix("").parts) for file in files}
    return {each.removesuffix(".__init__") for each in names if not each.endswith("__main__")}


def inside(name: str, packages: set[str]) -> bool:
    return any(f"{name}.".startswith(f"{package}.") for package in packages)


def named(cell: str) -> set[str]:
    """Return the modules that a cell names: "`package` (not `module`, `module`), `package`"."""
    found = set()
    for package, others in re.findall(r"`([\w.]+)`(?: \(not ([^)]*)\))?", cell):
        left_out = {f"{package}.{other}" for other in re.findall(r"`(\w+)`", others)}
        assert left_out <= modules(package), cell
        found |= {name for name in modules(package) if not inside(name, left_out)}
    return found


@pytest.mark.parametrize(("needs", "packages"), TABLE, ids=[needs for needs, _ in TABLE])
def test_packages_need_no_more_than_the_page_says(needs: str, packages: str):
    absent = (*OPENMMLAB, *(["torch"] if needs.startswith("neither") else []))
    names = sorted(named(packages))
    assert len(names) > 25
    done = run_python("-c", CODE.format(absent=absent, names=names))
    assert done.returncode == 0, done.stderr[-500:]


def test_the_page_says_it_for_both_groups_and_each_left_out_module_needs_more():
    assert [needs for needs, _ in TABLE] == ["neither torch nor OpenMMLab", "torch, not OpenMMLab"]
    for needs, packages in TABLE:
        absent = (*OPENMMLAB, *(["torch"] if needs.startswith("neither") else []))
        for package, others in re.findall(r"`([\w.]+)` \(not ([^)]*)\)", packages):
            for other in re.findall(r"`(\w+)`", others):
                names = [n for n in modules(package) if inside(n, {f"{package}.{other}"})]
                done = run_python("-c", CODE.format(absent=absent, names=names))
                assert "ModuleNotFoundError" in done.stderr, names
