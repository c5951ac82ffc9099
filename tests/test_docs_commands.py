"""Every command of README, docs and tools: it exists, takes its words, and names what is there.

bash itself reads the blocks, with every program replaced by a function that notes its words. So
variables, loops and comments mean what they mean to a reader; nothing is run.
"""

import argparse
import ast
import importlib
import re
import runpy
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from comparison.plan import parse_entry

from gsmap.engine.arguments import parse_options
from gsmap.engine.launch import check_config, read_config

REPO = Path(__file__).resolve().parents[1]
PAGES = [
    REPO / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "models/README.md")
]
PAGES += sorted([*(REPO / "docs").rglob("*.md"), *(REPO / "projects").glob("*/README.md")])
PAGES += sorted((REPO / "results").glob("*.md"))
PAGES += sorted((REPO / "tools").glob("*.py"))
STAND_INS = {"CONFIG": "configs/maptr/maptr_r18_minicity.py", "ITERATIONS": "100"}
STAND_INS |= {"COMMAND": "check", "GROUND_TRUTH": "truth.arrow"}
SCRIPTS = tuple(str(path.relative_to(REPO)) for path in (REPO / "tools").glob("*.sh"))
PROGRAMS = ("python", "make", "pip", "cp", "source", "trtexec", *SCRIPTS)
SETTINGS = {"PATH": "", "SLURM_ARRAY_TASK_ID": "0", "SLURM_ARRAY_TASK_COUNT": "16"}
FENCED = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`(python (?:tools/\w+\.py|-m \w+) [^`]+)`")
QUOTED = re.compile(r"``(python tools/\w+\.py [^`]+)``")
INDENTED = re.compile(r"^ +(python .*)$", re.MULTILINE)
COMMAND = re.compile(rf"^ *(\w+=\S+ +)?({'|'.join(map(re.escape, PROGRAMS))}|for) ", re.MULTILINE)
HERE = re.compile(r"(configs|projects|tools|tests|benchmarks|models|docs)/[\w./-]+")


class Parsed(Exception):
    """A tool has understood its words."""


def script(page: Path) -> str:
    """Return the blocks that hold commands, and the inline commands, a line each."""
    text = page.read_text()
    if page.suffix == ".py":  # a tool's docstring
        text = (ast.get_docstring(ast.parse(text)) or "").replace("\\\n", " ")
        return "\n".join([*QUOTED.findall(text.replace("\n", " ")), *INDENTED.findall(text)])
    shell = [block for language, block in FENCED.findall(text) if language in ("", "bash", "sh")]
    fenced = [block for block in shell if COMMAND.search(block)]
    return "\n".join([*fenced, *INLINE.findall(text.replace("\n", " "))])


def words_of(block: str) -> list[list[str]]:
    """Let bash read a script, and return the words of each of its commands."""
    note = "printf '%s\\0' {} \"$@\"; printf '\\n\\0'; "
    functions = "".join(f"{name}() {{ {note.format(name)}}}\n" for name in PROGRAMS)
    unknown = f"command_not_found_handle() {{ {note.format('')}}}\n"
    shell = str(shutil.which("bash"))
    for word, stand_in in STAND_INS.items():
        block = re.sub(rf"\b{word}\b", stand_in, block)
    done = subprocess.run(
        [shell, "-f", "-c", functions + unknown + block],
        cwd="/", env=SETTINGS, text=True, capture_output=True, check=False,
    )  # fmt: skip
    assert not done.stderr, f"{block}\n{done.stderr}"
    commands = [part.strip("\0").split("\0") for part in done.stdout.split("\n\0") if part]
    return [[word for word in words if word != "..."] for words in commands]


@cache
def commands(page: Path) -> list[list[str]]:
    return words_of(script(page))


MADE = {words[-1] for page in PAGES for words in commands(page) if words[0] == "cp"}
MADE |= {words[-1] for page in PAGES for words in commands(page) if "convert_config" in words[1]}
MADE.add("make_my_data.py")  # the reader saves it


@cache
def tool(name: str) -> Any:
    """Return the main function of a tool or a module."""
    if name.endswith(".py"):
        scope = runpy.run_path(str(REPO / name), run_name="tool")
        return scope.get("make") or scope["main"]
    module = importlib.import_module(name)
    if hasattr(module, "__path__"):
        module = importlib.import_module(f"{name}.__main__")
    return module.main


def parse(name: str, words: list[str], monkeypatch: pytest.MonkeyPatch) -> argparse.Namespace:
    """Let a tool read its words, and stop it there."""
    original = argparse.ArgumentParser.parse_args

    def stop(self: Any, *args: Any, **kwargs: Any) -> None:
        raise Parsed(original(self, *args, **kwargs))

    main = tool(name)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "argv", [name, *words])
        patch.setattr(argparse.ArgumentParser, "parse_args", stop)
        with pytest.raises(Parsed) as understood:
            main()
    return understood.value.args[0]


def check_configs(name: str, args: argparse.Namespace) -> None:
    """Read the configs that a command names, with its overrides."""
    if name == "tools/compare.py":
        for entry in map(parse_entry, args.configs):
            options = parse_options(entry.options) if entry.options else {}
            check_config(read_config(entry.config, options))
    elif isinstance(getattr(args, "config", None), str) and args.config not in MADE:
        check_config(read_config(args.config, getattr(args, "cfg_options", None)))


def names_alone(words: list[str]) -> bool:
    """Whether a text only mentions a subcommand, as ``python -m benchmarks fps``."""
    return words[:2] == ["python", "-m"] and words[2] != "pytest" and len(words) == 4


def check(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Raise an error unless a command can be right."""
    program, *rest = words
    named = {word for text in words for word in re.split("[=,]", text) if HERE.fullmatch(word)}
    assert not [word for word in named - MADE if not (REPO / word).exists()], words
    if rest[-1] == "--help" or names_alone(words):
        name, *asked = rest[1:] if rest[0] == "-m" else rest
        with pytest.raises(SystemExit, match="0"):
            parse(name, [*asked, "--help"], monkeypatch)
    elif program == "python" and rest[0] == "-m" and rest[1] != "pytest":
        parse(rest[1], rest[2:], monkeypatch)
    elif program == "python" and rest[0].startswith("tools/") and rest[0] != "tools/watch.py":
        check_configs(rest[0], parse(rest[0], rest[1:], monkeypatch))
    elif program in SCRIPTS:  # CONFIG GPUS ..., or PARTITION JOB_NAME CONFIG ...
        launcher, name = re.fullmatch(r"tools/(dist|slurm)_(\w+)\.sh", program).groups()
        rest = [rest[0], *rest[2:]] if launcher == "dist" else rest[2:]
        check_configs(f"tools/{name}.py", parse(f"tools/{name}.py", rest, monkeypatch))
    elif program == "make":
        assert re.search(rf"^{rest[0]}:", (REPO / "Makefile").read_text(), re.MULTILINE), words
    elif program == "pip":
        place = re.fullmatch(r"\.(?:\[(\w+)\])?|pyproj", rest[-1])
        assert place, words
        assert f"\n{place[1]} = [" in (REPO / "pyproject.toml").read_text() or not place[1]
    else:
        known = ("cp", "source", "trtexec") if program != "python" else (program,)
        assert program in known, words
        assert program != "python" or rest[0] in ("-m", "tools/watch.py", *MADE), words


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPO)))
def test_every_command_is_understood(page: Path, monkeypatch: pytest.MonkeyPatch):
    for word in ("tests", "tests/map_data"):  # as PYTHONPATH of the pages says
        monkeypatch.syspath_prepend(str(REPO / word))
    monkeypatch.chdir(REPO)
    for words in commands(page):
        try:
            check(words, monkeypatch)
        except SystemExit as error:
            raise AssertionError(f"not understood: {words}") from error


@pytest.mark.parametrize(
    "block",
    [
        "python tools/trainer.py CONFIG",
        "python tools/test.py CONFIG CHECKPOINT --evil chamfer",
        "C=configs/maptr/nowhere.py\npython tools/train.py $C",
        "python tools/train.py CONFIG --cfg-options train_cgf.max_epochs=2",
        "make dmeo",
        "pip install -e .[riddle]",
    ],
)
def test_a_stale_command_is_found(block: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(REPO)
    (words,) = words_of(block)
    with pytest.raises((AssertionError, SystemExit, ValueError)):
        check(words, monkeypatch)
