"""What `tools/setup_env.sh` asks pip for, told by a Python that only notes it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[2]
PYTHON = """#!{python}
import os, pathlib, re, shutil, sys
here, words = pathlib.Path({here!r}), sys.argv[1:]
if words[:2] == ["-m", "venv"]:
    target = pathlib.Path(words[2], "bin")
    target.mkdir(parents=True)
    shutil.copy(__file__, target / "python")
elif words[:2] == ["-m", "pip"]:
    words = [word for word in words[2:] if not word.startswith("-q")]
    if "/dev/stdin" in words:
        words += [line for line in sys.stdin.read().split("\\n") if "==" in line]
    with open(here / "asked", "a") as notes:
        notes.write(" ".join(words) + "\\n")
    if "wheel" in words:
        folder = pathlib.Path(words[words.index("-w") + 1])
        folder.mkdir()
        (folder / "mmcv-2.1.0-cp311.whl").touch()
elif found := re.search(r"version\\('([\\w-]+)'\\)", " ".join(words)):
    file = here / f"{{found[1]}}.version"
    print(file.read_text()) if file.exists() else sys.exit(1)
elif "_ext" in " ".join(words):
    sys.exit(not (here / "mmcv.version").exists())
elif "purelib" in " ".join(words):
    print(here)
"""


class Machine:
    """A folder with that Python; ``installed`` says what its environment has."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.python = folder / "python"
        self.python.write_text(PYTHON.format(python=sys.executable, here=str(folder)))
        self.python.chmod(0o755)

    def installed(self, **versions: str) -> None:
        for name, version in versions.items():
            (self.folder / f"{name}.version").write_text(version)

    def set_up(self, **settings: str) -> list[str]:
        """Run the script, and return what pip was asked for."""
        keep = {name: os.environ[name] for name in ("PATH", "HOME")}
        done = subprocess.run(
            [REPO / "tools/setup_env.sh", self.folder / "venv"],
            env={**keep, "PYTHON": str(self.python), **settings},
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert not done.returncode, done.stdout + done.stderr
        notes = self.folder / "asked"
        asked = notes.read_text().splitlines() if notes.exists() else []
        notes.unlink(missing_ok=True)
        return [line.removeprefix("--disable-pip-version-check --no-input ") for line in asked]


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_neither_operators_nor_tools_of_tests_by_default(machine):
    _, torch, rest, own = machine.set_up()
    assert torch == "install --no-compile torch==2.13.0"
    assert "mmcv-lite==2.1.0" in rest.split()
    assert "requirements-dev.txt" not in rest
    assert "--no-deps" in own
    assert (machine.folder / "gsmap-mmcv.pth").read_text() == "import gsmap\n"
    machine.installed(torch="2.13.0")
    assert machine.set_up() == []  # ready
    assert "requirements-dev.txt" in machine.set_up(GSMAP_DEV="1")[1]
    assert machine.set_up(GSMAP_DEV="1") == machine.set_up() == []


def test_the_torch_that_is_there_stays(machine):
    machine.set_up()
    machine.installed(torch="2.6.0+cu124")
    for stamp in (machine.folder / "venv").glob(".gsmap-*"):
        stamp.unlink()
    asked = machine.set_up()
    assert len(asked) == 3  # pip, the rest, GSMap
    assert "torch==2.6.0+cu124" in asked[1].split()
    assert machine.set_up(TORCH="2.6.0") == []
    torch = machine.set_up(TORCH="2.4.0", TORCH_INDEX_URL="https://index")[1]
    assert torch == "install --no-compile --index-url https://index torch==2.4.0"


def test_operators_replace_mmcv_lite_and_stay(machine):
    machine.set_up()
    machine.installed(torch="2.13.0+cpu")
    asked = machine.set_up(GSMAP_MMCV_OPS="1")
    wheel = next(line for line in asked if line.startswith("wheel"))
    assert wheel.endswith("gsmap/torch-2.13.0+cpu mmcv==2.1.0")
    assert asked[-2] == "uninstall -y mmcv-lite mmcv"  # both own the same folder
    assert asked[-1].endswith("/mmcv-2.1.0-cp311.whl")
    assert not any("mmcv-lite==" in line for line in asked)
    machine.installed(mmcv="2.1.0")
    assert machine.set_up() == machine.set_up(GSMAP_MMCV_OPS="1") == []
    asked = machine.set_up(GSMAP_MMCV_OPS="0")
    assert asked[1] == "uninstall -y mmcv"
    assert "mmcv-lite==2.1.0" in asked[2].split()
