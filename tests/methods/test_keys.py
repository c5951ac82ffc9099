"""The contract of the tables between upstream's state keys and ours.

``tests/methods/<method>/keys.json`` has examples by the name of a table, all of them upstream's
keys: ``pairs`` with our key each; ``marks``, which together tell the architecture; ``rest``, keys
without a mark, which belong to ``table_of_rest``; ``unused``, keys without a counterpart.
Each method's ``reference.py`` checks all keys of a release.
"""

from pathlib import Path
from typing import Any

import pytest
import torch

from gsmap.checkpoints.convert import ours_from_upstream
from gsmap.checkpoints.key_map import find_key_map, key_maps
from gsmap.methods import METHODS
from gsmap.utils.files import read_json

TABLES = {key_map.name: key_map for key_map in key_maps()}


def read_examples() -> dict[str, dict[str, Any]]:
    """Return the examples of all methods by the name of their table."""
    found: dict[str, dict[str, Any]] = {}
    for method in METHODS:
        path = Path(__file__).with_name(method.name) / "keys.json"
        if path.is_file():
            found.update(read_json(path))
    return found


EXAMPLES = read_examples()
PAIRS = [(name, *pair) for name, example in EXAMPLES.items() for pair in example["pairs"].items()]
UNUSED = [(name, key) for name, example in EXAMPLES.items() for key in example.get("unused", [])]
RESTS = [name for name, example in EXAMPLES.items() if "rest" in example]


@pytest.mark.parametrize(("name", "upstream", "ours"), PAIRS)
def test_names_by_hand_in_both_directions(name, upstream, ours):
    assert TABLES[name].to_ours(upstream) == ours
    assert TABLES[name].to_upstream(ours) == upstream


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_table_is_found_by_its_marks(name):
    marks = EXAMPLES[name]["marks"]
    ours = [TABLES[name].to_ours(mark) for mark in marks]
    assert find_key_map([*marks, "img_neck.x"]) is TABLES[name]
    assert find_key_map([*ours, "img_neck.x"]) is TABLES[name]


@pytest.mark.parametrize("name", RESTS)
def test_without_its_marks_another_table_is_found(name):
    example = EXAMPLES[name]
    assert find_key_map(example["rest"]).name == example["table_of_rest"]


@pytest.mark.parametrize(("name", "key"), UNUSED)
def test_an_unused_key_has_no_place(name, key):
    pairs = EXAMPLES[name]["pairs"]
    state = {upstream: torch.ones(()) for upstream in (*pairs, key)}
    assert TABLES[name].is_unused(key)
    assert TABLES[name].to_ours(key) is None
    assert ours_from_upstream(state).keys() == set(pairs.values())


@pytest.mark.parametrize("name", [name for name, example in EXAMPLES.items() if example["pairs"]])
def test_an_unknown_key_is_refused_by_name(name):
    example = EXAMPLES[name]
    keys = (*example["pairs"], *example["marks"], f"{TABLES[name].upstream_prefix}riddle.x")
    state = {key: torch.ones(()) for key in keys}
    with pytest.raises(ValueError, match=rf"no {name} model has: .*riddle\.x"):
        ours_from_upstream(state)
