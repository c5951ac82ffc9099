"""Checks of ours raise errors of ours, so that a command can tell a user's fault from a bug."""

import ast
import pickle
from pathlib import Path

import pytest

from gsmap.datasets.errors import BrokenSampleError
from gsmap.utils.errors import GsmapError, InputError, InputTypeError, NotFiniteError, WorkError

REPO = Path(__file__).resolve().parents[2]
FOLDERS = ("projects", "tools")


def raised_names(path: Path) -> list[str]:
    """Names of the exceptions that a file raises with a call, such as ``raise ValueError(...)``."""
    raises = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Raise)]
    calls = [node.exc for node in raises if isinstance(node.exc, ast.Call)]
    return [call.func.id for call in calls if isinstance(call.func, ast.Name)]


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_check_raises_an_exception_of_python(folder: str):
    files = sorted((REPO / folder).rglob("*.py"))
    assert any("InputError" in raised_names(path) for path in files)
    for path in files:
        wrong = {"ValueError", "RuntimeError", "FloatingPointError"} & {*raised_names(path)}
        assert not wrong, f"{path.relative_to(REPO)}: raise an error of gsmap.utils.errors"


@pytest.mark.parametrize(
    ("kind", "documented"),
    [
        (InputError, ValueError),
        (InputTypeError, TypeError),
        (WorkError, RuntimeError),
        (NotFiniteError, FloatingPointError),
        (BrokenSampleError, ValueError),
    ],
)
def test_an_error_is_what_docstrings_promise_also_from_another_process(kind, documented):
    copy = pickle.loads(pickle.dumps(kind("no such split")))
    assert type(copy) is kind
    assert isinstance(copy, documented)
    assert isinstance(copy, GsmapError)
    assert str(copy) == "no such split"
