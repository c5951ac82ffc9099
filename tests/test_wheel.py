"""The package as others install it: a wheel, used far from the repository."""

import ast
import importlib.metadata
import json
import os
import re
import shutil
import sys
import tarfile
from pathlib import Path

import pytest
from processes import run_python

from gsmap import __version__

REPO = Path(__file__).resolve().parents[1]
PARTS = ("setup.py", "pyproject.toml", "README.md", "LICENSE", "configs", "projects", "tools")
# what nuscenes-devkit, tensorboard and a GPU's torch bring
BROUGHT = {"absl-py", "descartes", "pyquaternion", "triton"}
LOAD_CONFIGS = """
import sys
from mmengine.config import Config
from gsmap.utils.shipped import shipped_path
files = list(shipped_path("configs").rglob("*.py"))
files += shipped_path("projects/GSMap/configs").glob("*.py")
for file in files:
    Config.fromfile(file, import_custom_modules=False)
print(len(files), shipped_path())
"""


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what the package is made of: building leaves files beside its sources."""
    copy = tmp_path_factory.mktemp("source")
    leave = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in PARTS:
        part = REPO / name
        if part.is_dir():
            shutil.copytree(part, copy / name, ignore=leave)
        else:
            shutil.copy(part, copy)
    shutil.copytree(REPO / "models", copy / "models")
    (copy / "models/maptr_tiny_r50_24e.pth").write_bytes(b"fetched by its user")
    (copy / "build/lib/gsmap").mkdir(parents=True)
    (copy / "build/lib/gsmap/gone.py").write_text("built from an earlier version")
    return copy


@pytest.fixture(scope="module")
def site(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that the wheel is installed in; all that it requires is in the environment."""
    wheels = tmp_path_factory.mktemp("wheels")
    site = tmp_path_factory.mktemp("site")
    pip = ("-m", "pip", "--disable-pip-version-check")
    options = ("--no-deps", "--no-index", "-q")
    done = run_python(*pip, "wheel", *options, "--no-build-isolation", "-w", wheels, source)
    assert not done.returncode, done.stderr
    done = run_python(*pip, "install", *options, "--target", site, *wheels.glob("*.whl"))
    assert not done.returncode, done.stderr
    return site


def gsmap(site: Path, folder: Path, *words: object) -> str:
    """Run the installed command ``gsmap`` in a folder and return its output."""
    done = run_python(site / "bin/gsmap", *words, cwd=folder, env={"PYTHONPATH": str(site)})
    assert not done.returncode, done.stderr
    return done.stdout


def test_a_wheel_infers_from_any_folder_by_the_name_of_a_model(site, minicity_root, tmp_path):
    words = ("--model", "gsmap_r18_minicity", "--max-samples", 1, "--out", "map.json")
    assert "1 of 1 sample predicted" in gsmap(site, tmp_path, "infer", minicity_root, *words)
    (sample,) = json.loads((tmp_path / "map.json").read_text())["results"]
    assert len(sample["vectors"][0]["pts"]) == 20


def test_the_wheels_commands_name_themselves(site, tmp_path):
    assert gsmap(site, tmp_path, "--version") == f"gsmap {__version__}\n"
    assert re.search(r"^  train +Train a model$", gsmap(site, tmp_path, "--help"), re.MULTILINE)
    assert "usage: gsmap train [-h]" in gsmap(site, tmp_path, "train", "--help")
    assert "tools/train.py configs/" in gsmap(site, tmp_path, "compare", "--list")


def test_every_config_of_the_wheel_finds_its_bases(site, tmp_path):
    done = run_python("-c", LOAD_CONFIGS, cwd=tmp_path, env={"PYTHONPATH": str(site)})
    assert not done.returncode, done.stderr
    here = [*(REPO / "configs").rglob("*.py"), *(REPO / "projects/GSMap/configs").glob("*.py")]
    assert done.stdout.split() == [str(len(here)), str(site / "gsmap/.mim")]


def test_the_wheel_holds_the_models_that_ship_and_scripts_that_run(site):
    shipped = set(os.listdir(site / "gsmap/.mim/models"))
    weights = {path.name for path in (REPO / "models").glob("*.pth")}
    assert shipped == {"registry.json", "README.md", *weights}
    assert not (site / "gsmap/gone.py").exists()
    assert os.access(site / "gsmap/.mim/tools/dist_train.sh", os.X_OK)
    lists = set(os.listdir(REPO / "projects/MapData/mapdata/split_lists"))
    assert set(os.listdir(site / "mapdata/split_lists")) == lists != set()


def imported() -> set[str]:
    """Return the packages that the library and its commands import."""
    names = []
    for path in [*(REPO / "projects").rglob("*.py"), *(REPO / "tools").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names.append(str(node.module))
    packages = {name.split(".")[0] for name in names}
    return packages - set(sys.stdlib_module_names)


def test_the_wheel_says_what_it_is_and_needs(site):
    (package,) = importlib.metadata.distributions(path=[str(site)])
    meta = package.metadata
    assert (package.version, meta["License-Expression"]) == (__version__, "Apache-2.0")
    assert any(file.name == "LICENSE" for file in package.files)
    assert "Programming Language :: Python :: 3.11" in meta.get_all("Classifier")
    required = set()
    for line in package.requires:
        requirement = line.split(";")[0]
        assert "==" not in requirement
        required.add(re.match(r"[\w-]+", requirement)[0].lower())
    assert "torchvision" not in required
    owners = importlib.metadata.packages_distributions()
    shipped = {"gsmap", "mapdata", "drivemaps", "minicity", "tools", "comparison", "scoring"}
    for name in imported() - shipped:
        owner = {o.lower() for o in owners.get(name, [name])}
        owner |= {"mmcv-lite"} if name == "mmcv" else set()
        assert owner & (required | BROUGHT), f"{name} is imported, but {owner} is not required"


def test_a_source_distribution_holds_what_a_wheel_needs(source, tmp_path):
    build = "from setuptools import build_meta; import sys; build_meta.build_sdist(sys.argv[1])"
    done = run_python("-c", build, tmp_path, cwd=source)
    assert not done.returncode, done.stderr
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    files = {"setup.py", "LICENSE", "configs/tables.json", "tools/dist_train.sh"}
    files.add("projects/GSMap/gsmap/models/maptr/paper.json")
    assert files | {"models/gsmap_r18_minicity.pth", "configs/maptr/maptr_r50_24e.py"} <= names
    assert "models/maptr_tiny_r50_24e.pth" not in names


def test_no_place_of_the_repository_is_found_by_counting_folders():
    for folder in ("projects", "tools", "benchmarks"):
        for path in (REPO / folder).rglob("*.py"):
            assert ".parents[" not in path.read_text(), path
