"""The ways to start the tools: ``gsmap NAME``, TensorBoard, and the demo's steps."""

import ast
import os
import runpy
import sys
from pathlib import Path

import pytest
from processes import run_python
from tensorboard import default

from gsmap import __version__
from gsmap.__main__ import main
from gsmap.utils.cli import CommandParser

REPO = Path(__file__).resolve().parents[2]


def gsmap(monkeypatch: pytest.MonkeyPatch, *words: str) -> object:
    """Run ``gsmap WORDS`` and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["gsmap", *words])
    with pytest.raises(SystemExit) as left:
        main()
    return left.value.code


def test_gsmap_runs_the_tools_from_any_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert gsmap(monkeypatch, "convert_checkpoint", "gsmap_r18_minicity", "x.pth") == 2
    assert "keys that upstream's maptr does not have" in capsys.readouterr().err
    monkeypatch.setattr(CommandParser, "program", None)  # put back after the test
    assert gsmap(monkeypatch, "create_data", "--help") == 0
    assert "usage: gsmap create_data [-h]" in capsys.readouterr().out
    assert gsmap(monkeypatch, "train", "--help") == 0
    said = capsys.readouterr().out
    assert "usage: gsmap train [-h]" in said
    assert "Train a model: ``gsmap train CONFIG``." in said
    assert gsmap(monkeypatch, "learn") == 2
    assert "there is no command learn; there are analyze_run, " in capsys.readouterr().err


def test_gsmap_says_what_there_is(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["gsmap"])
    main()
    lines = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    said = {line[0]: line[1] for line in lines if len(line) == 2}
    assert {path.stem for path in (REPO / "tools").glob("*.py")} <= set(said)
    assert (said["train"], said["test"]) == ("Train a model", "Test a model")
    assert said["report"].startswith("Write a page about a result file")
    monkeypatch.setattr(sys, "argv", ["gsmap", "--version"])
    main()
    assert capsys.readouterr().out == f"gsmap {__version__}\n"


# What each command may not import before it has read its words: it costs seconds.
SLOW = {"torch", "mmdet3d", "mmcv"}
SLOWER = {"mmdet3d.structures", "mmdet3d.models", "mmcv.ops"}


TOOLS = sorted(path.name for path in (REPO / "tools").glob("*.py"))
NEED_TORCH = ("compare.py", "export.py")
# One process for all tools: a module counts for the first one that imports it
HELP = """
import runpy, sys
tools = sys.argv[1:]
sys.path.insert(0, "tools")
for tool in tools:
    before = set(sys.modules)
    print("tool:", tool)
    sys.argv = [f"tools/{tool}", "--help"]
    try:
        runpy.run_path(sys.argv[0], None, "__main__")
    except SystemExit:
        pass
    print("modules:", *(set(sys.modules) - before), flush=True)
"""


@pytest.fixture(scope="module")
def help_of_tools() -> dict[str, str]:
    """The help of each tool, followed by the modules that it has imported."""
    done = run_python("-c", HELP, *sorted(TOOLS, key=NEED_TORCH.__contains__))
    parts = done.stdout.split("tool: ")[1:]
    assert len(parts) == len(TOOLS), done.stderr
    return {part.partition("\n")[0]: part for part in parts}


@pytest.mark.parametrize("tool", TOOLS)
def test_help_comes_without_what_is_slow_to_import(tool, help_of_tools):
    text, modules = help_of_tools[tool].split("modules:")
    assert "usage" in text.lower()
    assert not (SLOWER if tool in NEED_TORCH else SLOW) & set(modules.split())


def test_a_broken_plugin_of_another_package_does_not_stop_tensorboard(tmp_path, monkeypatch):
    """As open3d's on a machine without libusb."""
    package = tmp_path / "broken-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text("[tensorboard_plugins]\nbroken = riddle:Plugin\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ModuleNotFoundError, match="riddle"):
        default.get_dynamic_plugins()  # what the usual command does
    logs = tmp_path / "logs"
    logs.mkdir()
    paths = {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    done = run_python("tools/watch.py", "--logdir", logs, "--inspect", env=paths)
    assert (done.returncode, "No event files found" in done.stdout) == (0, True), done.stderr


def test_the_demo_trains_on_from_maptr_and_from_scratch_if_asked(tmp_path):
    demo = runpy.run_path(str(REPO / "tools/demo.py"))
    budget = demo["BUDGETS"]["demo"]
    (tuned,) = demo["trainings"](["GSMap"], False, tmp_path, budget)
    assert demo["trainings"](["GSMap"], True, tmp_path, budget)[0] == tuned
    scratch = demo["trainings"](["GSMap"], True, tmp_path, budget)[1]
    steps = list(demo["training_steps"](tuned, tmp_path, budget))
    assert [step.title for step in steps[:2]] == [
        "train GSMap trained on from MapTR",
        "draw losses and validations of GSMap trained on from MapTR",
    ]
    start = {"load_from=maptr_r18_minicity", "optim_wrapper.optimizer.lr=3e-4"}
    assert start <= set(steps[0].command)
    assert {"train_cfg.max_epochs=4", "train_cfg.val_interval=1"} <= set(steps[0].command)
    assert steps[1].products == [tmp_path / "gsmap_tuned/curves.png"]
    command = next(iter(demo["training_steps"](scratch, tmp_path, budget))).command
    assert {"train_cfg.max_epochs=11", "train_cfg.val_interval=2"} <= set(command)
    assert not start & set(command)


@pytest.mark.parametrize("path", sorted((REPO / "tools").glob("*.py")), ids=lambda path: path.stem)
def test_no_line_of_a_help_text_is_folded_into_the_one_before(path: Path):
    """A backslash at the end of a line of a text joins two lines, unless the text is raw."""
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    assert max(map(len, text.splitlines())) <= 100
    examples = [line for line in text.splitlines() if line.endswith("\\")]
    assert not examples or text.count("\\\n") == len(examples)
