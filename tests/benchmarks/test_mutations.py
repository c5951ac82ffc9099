"""Mutants of small modules, and what tests say of them."""

import ast
from pathlib import Path

import pytest

from benchmarks import mutations

SOURCE = '''
"""A module: 7 < 8."""
LIMIT: Literal[5] = -1.5
@decorated(3)
def between(value: int, low=0, strict=True):
    if not strict or value <= low < 9:
        raise ValueError(f"{value + 1} is less than {low + 1}")
    return max(value - low, values.min()) in found
'''


def test_each_place_changes_alone_and_types_and_messages_do_not():
    found = [mutations.mutant(SOURCE, i) for i in range(mutations.count_places(SOURCE))]
    assert sorted(change for _, change, _ in found) == [
        "-1.5 -> --1.5",
        "0 -> 1",
        "1.5 -> 2.5",
        "9 -> 10",
        "True -> False",
        "max -> min",
        "max(value - low, values.min()) in found -> max(value - low, values.min()) not in found",
        "not strict -> not not strict",
        "not strict or value <= low < 9 -> not strict and value <= low < 9",
        "value - low -> value + low",
        "value <= low < 9 -> value < low < 9",
        "value <= low < 9 -> value <= low <= 9",
        "values.min -> values.max",
    ]
    sources = {source for _, _, source in found}
    assert len(sources) == len(found)
    assert ast.unparse(ast.parse(SOURCE)) not in sources
    assert [line for line, change, _ in found if "1.5" in change] == [3, 3]


def test_tests_of_a_module_are_those_of_its_room_that_import_it():
    tests = mutations.tests_of("structures", "gsmap.structures.rigid")
    names = [Path(path).name for path in tests]
    assert {"test_rigid.py", "test_vehicle_signals.py"} <= set(names)
    assert set(tests) < set(mutations.tests_of("structures", None))
    modules = mutations.modules_of("structures")
    assert modules["gsmap.structures.rigid"].name == "rigid.py"
    assert "gsmap.ops.raster_loss.numba" not in mutations.modules_of("ops")


@pytest.mark.parametrize("nearest", ["caught", "not caught", "timed out"])
def test_only_what_the_nearest_tests_miss_meets_the_others_of_the_room(nearest, monkeypatch):
    asked = []

    def verdict(_module, _source, tests, _seconds):
        asked.append([Path(path).name for path in tests])
        return nearest if len(asked) == 1 else "caught"

    monkeypatch.setattr(mutations, "verdict", verdict)
    mutations.verdict_of_room("structures", "gsmap.structures.rigid", "", 1.0)
    near, *others = asked
    assert "test_rigid.py" in near
    assert len(others) == (nearest == "not caught")
    for files in others:
        assert "test_gaussians.py" in files
        assert not set(near) & set(files)


@pytest.mark.parametrize(
    ("source", "verdict"),
    [
        ("LIMIT = 3", "not caught"),
        ("LIMIT = 4", "caught"),
        ("import time; time.sleep(600)", "timed out"),
    ],
)
def test_a_mutant_lives_in_its_process_alone(tmp_path, monkeypatch, source, verdict):
    monkeypatch.setattr(mutations, "PRELOADED", ["pytest"])
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "tried.py").write_text("LIMIT = 2")
    test = tmp_path / "test_tried.py"
    test.write_text("from tried import LIMIT\ndef test_it(): assert LIMIT < 4")
    seconds = 5.0 if "sleep" in source else 600.0
    assert mutations.verdict("tried", source, [str(test)], seconds) == verdict
    assert (tmp_path / "tried.py").read_text() == "LIMIT = 2"
