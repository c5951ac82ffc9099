"""Few files elsewhere name a method, so that a reader finds a paper in one place.

Elsewhere is outside of the method's folders and page (`places`) and outside of files that are
deleted with it: methods that are built on it, and configs of GSMap that combine it. Measurements
(``results``) and the lists of all methods (``GENERAL``) may name each.
"""

import re
import subprocess
from functools import cache
from pathlib import Path

import pytest
from test_method_deletion import COMBINATIONS, DELETED, REPO, gone_with, leaves, places, used_by

GENERAL = {
    "README.md",
    "CHANGELOG.md",
    "docs/methods.md",
    "projects/GSMap/gsmap/methods.py",
}
MOST = 8
MORE = {
    # the rules of ground truth on Argoverse 2 (``--compat``), a form of info files and upstream
    # configs have its name
    "maptrv2": 29,
    # AP_raster, its form of results and upstream configs are its own; the paper of GSMap compares
    # with it
    "mapvr": 17,
}


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


def files_that_name(method: str) -> list[str]:
    """Paths of the files elsewhere that name a method, in their text or in their path.

    Args:
        method: Name of the method. Capitals do not count; a longer name, such as that of a class,
            is another name.
    """
    pattern = re.compile(rf"(?<![a-z0-9]){method}(?![a-z0-9])", re.IGNORECASE)
    elsewhere = [(name, text) for name, text in texts().items() if name not in deleted_with(method)]
    return [name for name, text in elsewhere if pattern.search(name) or pattern.search(text)]


@pytest.mark.parametrize("method", DELETED)
def test_few_files_elsewhere_name_a_method(method):
    found = files_that_name(method)
    most = MORE.get(method, MOST)
    assert len(found) <= most, "\n".join(found)


def test_names_are_counted_in_texts_and_paths(monkeypatch):
    given = {"a.py": "as in MapQR, ", "mapqr_b.py": "", "c.py": "MapQRHead", "d.md": "amapqr"}
    monkeypatch.setattr("test_method_names.texts", lambda: given)
    monkeypatch.setattr("test_method_names.deleted_with", lambda method: frozenset())
    assert files_that_name("mapqr") == ["a.py", "mapqr_b.py"]
