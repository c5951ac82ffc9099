"""Few files elsewhere name a method, so that a reader finds a paper in one place.

Elsewhere is outside of the method's folders and page (`places`) and outside of files that are
deleted with it: methods that are built on it, and configs of GSMap that combine it. Measurements
(``results``) and the lists of all methods (``GENERAL``) may name each.
"""

import re
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import pytest
from test_method_deletion import COMBINATIONS, DELETED, REPO, gone_with, leaves, places, used_by

GENERAL = {
    "README.md",
    "CHANGELOG.md",
    "docs/methods.md",
    "projects/GSMap/gsmap/methods.py",
    "tests/test_method_names.py",
}
MOST = 8


@cache
def texts() -> dict[str, str]:
    """Text of each file that the repository tracks or would add, by its path."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=REPO,
        capture_output=True,
        text=True,
        check=True,
    )
    found = {}
    for name in listed.stdout.splitlines():
        path = REPO / name
        if not path.is_file() or name.startswith("results/") or name in GENERAL:
            continue
        try:
            found[name] = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:  # a picture or weights
            continue
    return found


@cache
def deleted_with(method: str) -> frozenset[str]:
    """Paths of the files that are deleted with a method."""
    gone = gone_with(method)
    folders = [place for name in gone for place in places(name)]
    own = [name for name in texts() if any(Path(name).is_relative_to(f) for f in folders)]
    combined = [
        path.as_posix()
        for path in leaves()
        if path.is_relative_to(COMBINATIONS) and used_by(path) & gone
    ]
    return frozenset([*own, *combined])


def files_that_name(method: str, contents: Mapping[str, str]) -> list[str]:
    """Paths of the files that name a method, in their text or in their path.

    Args:
        method: Name of the method. Capitals do not count; a longer name, such as that of a class,
            is another name.
        contents: Text of each file, by its path.
    """
    pattern = re.compile(rf"(?<![a-z0-9]){method}(?![a-z0-9])", re.IGNORECASE)
    return [name for name, text in contents.items() if pattern.search(f"{name}\n{text}")]


@pytest.mark.parametrize("method", DELETED)
def test_few_files_elsewhere_name_a_method(method):
    gone = deleted_with(method)
    elsewhere = {name: text for name, text in texts().items() if name not in gone}
    found = files_that_name(method, elsewhere)
    assert len(found) <= MOST, "\n".join(found)


def test_names_are_counted_in_texts_and_paths():
    given = {"a.py": "as in NewMap, ", "newmap_b.py": "", "c.py": "NewMapHead", "d.md": "anewmap"}
    assert files_that_name("newmap", given) == ["a.py", "newmap_b.py"]
