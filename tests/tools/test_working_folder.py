"""No command, worker or rank takes code or settings from the folder that it is started in.

The names of the traps are those of all modules that a command may import, and of the files that
``strace -f -e trace=file`` shows commands, workers and ranks to look for under relative paths.
"""

import ast
import ctypes
import os
import struct
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from processes import REPO, free_port

IN_OPEN, IN_ISDIR, IN_NONBLOCK = 0x20, 0x40000000, 0o4000
TRAP = "raise SystemExit('code of the working folder ran')\n"
SETTINGS = {
    "matplotlibrc": "savefig.dpi: 3\nbackend: module://torch\n",
    ".numba_config.yaml": "cache_dir: numba_cache\ndisable_jit: 1\n",
    "numba_config.yaml": "disable_jit: 1\n",
    ".style.yapf": "[style]\nindent_width = 7\n",
    "setup.cfg": "[yapf]\nindent_width = 7\n",
    "pyvenv.cfg": "home = .\n",
    "python311._pth": ".\n",
    "python._pth": ".\n",
    ".env": "OMP_NUM_THREADS=77\n",
    "opencv.cfg": "",
    "sitecustomize.pth": "import os; os._exit(7)\n",
}
LIBRARIES = ("libc.so.6", "libm.so.6", "libdl.so.2", "libpthread.so.0", "libsmartcols.so.1")
UNGUARDED = """
import sys
sys.meta_path[:] = [finder for finder in sys.meta_path if "SettingsGuard" not in repr(finder)]
import matplotlib, numba.core.config
"""
EVERYTHING = """
import importlib, subprocess, sys
from pathlib import Path

import gsmap
for package in ("gsmap", "mapdata", "drivemaps", "minicity"):
    root = Path(importlib.import_module(package).__file__).parent
    for file in sorted(root.rglob("*.py")):
        name = ".".join(file.relative_to(root.parent).with_suffix("").parts)
        if not name.endswith("__main__") and name != "gsmap.mmcv_ext":
            importlib.import_module(name.removesuffix(".__init__"))
import numba
from matplotlib.figure import Figure
from mmengine.utils.dl_utils import collect_env

from gsmap.utils.parallel import ordered_map

numba.njit(lambda x: x + 1)(1)
Figure().savefig(sys.argv[1])
collect_env()
if __name__ == "__main__":
    assert list(ordered_map(len, ["a", "bc"], workers=2)) == [1, 2]
subprocess.run(["true"], check=True)
assert not [entry for entry in sys.path if not entry.startswith("/")], sys.path
"""
CALLED_SO = {  # beside --help of all: what workers and ranks do
    "check": [
        "tools/create_data.py", "check", "{annotations}", "--data-root", "{root}", "--workers", "2",
    ],
    "ranks": [
        "tools/dist_train.sh", "{config}", "2", "--work-dir", "{out}", "--cfg-options",
        "train_cfg.max_epochs=1", "train_cfg.val_interval=1", "train_dataloader.num_workers=1",
    ],
}  # fmt: skip


class Traps:
    """A folder of traps, and Linux's account of which of its files are opened."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        modules = {*sys.stdlib_module_names, *packages_distributions(), "sitecustomize"}
        modules |= {
            "usercustomize",
            "gsmap",
            "mapdata",
            "drivemaps",
            "minicity",
            "comparison",
            "scoring",
        }
        for name in (name for name in modules if name.isidentifier()):
            (folder / f"{name}.py").write_text(TRAP)
        for name, text in SETTINGS.items():
            (folder / name).write_text(text)
        for name in LIBRARIES:
            (folder / name).write_bytes(b"no library")
        # an editable install may leave a relative name on Python's search path
        self.placeholder = folder / "__editable__.gsmap-0.1.0.finder.__path_hook__"
        self.placeholder.mkdir()
        (self.placeholder / "sitecustomize.py").write_text(TRAP)
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._account = self._libc.inotify_init1(IN_NONBLOCK)
        for place in (folder, self.placeholder):
            watch = self._libc.inotify_add_watch(self._account, os.fsencode(place), IN_OPEN)
            assert watch >= 0, os.strerror(ctypes.get_errno())

    def opened(self) -> set[str]:
        """Return the names of the files that were opened since the last call."""
        names: set[str] = set()
        while True:
            try:
                events = os.read(self._account, 1 << 20)
            except BlockingIOError:
                return names
            while events:
                _, mask, _, size = struct.unpack_from("iIII", events)
                if not mask & IN_ISDIR:  # whoever looks through /tmp opens folders
                    names.add(events[16 : 16 + size].rstrip(b"\0").decode())
                events = events[16 + size :]

    def run(self, *command: object) -> subprocess.CompletedProcess:
        """Run a command here as a user would."""
        removed = ("PYTHONPATH", "PYTHONSAFEPATH", "LD_LIBRARY_PATH")
        environment = {name: value for name, value in os.environ.items() if name not in removed}
        environment |= {"PYTHON": sys.executable, "PORT": str(free_port()), "OMP_NUM_THREADS": "1"}
        return subprocess.run(
            [str(word) for word in command], cwd=self.folder, env=environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False,
        )  # fmt: skip


@pytest.fixture
def traps(tmp_path) -> Traps:
    if sys.platform != "linux":
        pytest.skip("needs Linux's inotify")
    (tmp_path / "traps").mkdir()
    return Traps(tmp_path / "traps")


@pytest.mark.faults
def test_the_traps_work(traps):
    assert traps.run(sys.executable, "-c", "import multiprocessing").returncode == 1
    assert traps.opened() == {"multiprocessing.py"}
    safe = "-P" if sys.version_info >= (3, 11) else "-I"
    traps.run(sys.executable, safe, "-c", UNGUARDED)
    assert traps.opened() == {"matplotlibrc", ".numba_config.yaml"}


@pytest.mark.faults
def test_nothing_of_the_working_folder_is_opened_whatever_is_imported(traps, tmp_path):
    program = tmp_path / "everything.py"
    program.write_text(EVERYTHING)
    done = traps.run(sys.executable, program, tmp_path / "figure.png")
    assert done.returncode == 0, done.stdout[-3000:]
    assert traps.opened() == set()
    assert not (traps.folder / "numba_cache").exists()


@pytest.mark.faults
def test_no_command_opens_a_file_of_the_working_folder(traps):
    tools = sorted((REPO / "tools").glob("*.py"))
    assert len(tools) > 15
    for tool in tools:
        done = traps.run(sys.executable, tool, "--help")
        assert (done.returncode, traps.opened()) == (0, set()), f"{tool}: {done.stdout}"
    command = Path(sys.executable).with_name("gsmap")
    if command.exists():
        done = traps.run(command, "infer", "--help")
        assert (done.returncode, traps.opened()) == (0, set()), done.stdout


@pytest.mark.faults
@pytest.mark.parametrize("name", CALLED_SO)
def test_no_worker_and_no_rank_opens_a_file_of_the_working_folder(
    name, traps, tiny_config, minicity_root, minicity_annotations, tmp_path
):
    places = {
        "annotations": minicity_annotations["train"],
        "root": minicity_root,
        "config": tiny_config,
        "out": tmp_path / "out",
    }
    tool, *words = (word.format(**places) for word in CALLED_SO[name])
    interpreter = [sys.executable] if tool.endswith(".py") else []
    done = traps.run(*interpreter, REPO / tool, *words)
    assert done.returncode == 0, done.stdout[-3000:]
    assert traps.opened() == set()


@pytest.mark.parametrize("tool", sorted((REPO / "tools").glob("*.py")), ids=lambda tool: tool.stem)
def test_a_tool_imports_gsmap_and_its_guard_before_other_libraries(tool):
    for node in ast.parse(tool.read_text()).body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            name = getattr(node, "module", None) or node.names[0].name
            if name.split(".")[0] not in sys.stdlib_module_names:
                assert name.split(".")[0] == "gsmap"
                return
