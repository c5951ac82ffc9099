"""Each promise of SECURITY.md has its test."""

import ast
import re
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]


def promises() -> list[str]:
    """Lines of the tables of promises."""
    text = (REPO / "SECURITY.md").read_text()
    promised = text[text.index("## What is promised") : text.index("## What is not promised")]
    lines = [line for line in promised.splitlines() if line.startswith("|")]
    return [line for line in lines if not line.startswith(("| promise", "| ---"))]


def named_tests(promise: str) -> list[tuple[str, str]]:
    return re.findall(r"`([\w/]+\.py)::(\w+)`", promise)


def test_each_promise_names_a_test():
    assert len(promises()) > 30
    assert [promise for promise in promises() if not named_tests(promise)] == []


def test_the_tests_that_promises_name_are_there():
    named = {test for promise in promises() for test in named_tests(promise)}
    absent = []
    for file, name in sorted(named):
        path = REPO / "tests" / file
        tree = ast.parse(path.read_text()) if path.is_file() else ast.Module([], [])
        if name not in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}:
            absent.append(f"{file}::{name}")
    assert absent == []
