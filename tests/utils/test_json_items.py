"""The items of lists in JSON files, and what is said of files that hold none."""

import json

import pytest

from gsmap.utils import json_items
from gsmap.utils.json_items import items_of


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no '{' at byte 0"),
        ('{"a": 3}', "no '\\[' at byte 6"),
        ('{"a": [1], "a": []}', "a second 'a'"),
        ('{"a": [1 2]}', "no ']' at byte 9"),
        ('{"a": [1,]}', "Expecting value at byte 9"),
        ('{"a": [1]', "no '}' at byte 9"),
        ('{"a": [1]} x', "more text at byte 11"),
        ('{"a": [1], 3: 4}', "no name at byte 11"),
        ('{"b": [1', "Expecting ',' delimiter at byte 6"),
        ('{"a": ["' + "x" * (3 << 20), "Unterminated string starting at at byte 7"),
        ('{"a": ' + "[" * 200_000, "RecursionError"),
    ],
)
def test_what_is_no_list_is_named(text, message, tmp_path):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"a.json is empty or holds no complete list .*{message}"):
        list(items_of(path, "a", "mend it"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "a list"),
        ("{}", "an object with nothing"),
        ('{"b": 1, "c": [1]}', r"an object with \['b', 'c'\]"),
        ('{"a": {"b": 1}}', "an object under 'a'"),
        ('{"a": "b"}', "a text under 'a'"),
    ],
)
def test_another_form_than_a_list_is_named(text, message, tmp_path):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"a.json holds {message} and no list under 'a': mend it"):
        list(items_of(path, "a", "mend it"))


@pytest.mark.parametrize(
    "text", ['{"a":[1,[2],{"b":3}]}', ' {\n"b" : 1, "a" : [ 1 , [2],{"b":3}]}\n']
)
def test_items_come_as_they_are(text, tmp_path):
    path = tmp_path / "a.json"
    path.write_text(text)
    assert [item for item, _ in items_of(path, "a", "mend it")] == [1, [2], {"b": 3}]
    path.write_text('{"a": []}')
    assert list(items_of(path, "a", "mend it")) == []


def test_a_byte_order_mark_is_no_part_of_the_items_and_of_their_places(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"a": [1, {"b": 2}]}', encoding="utf-8-sig")
    content, items = path.read_bytes(), list(items_of(path, "a", "mend it"))
    assert [json.loads(content[start : start + size]) for _, (start, size) in items] == [
        1,
        {"b": 2},
    ]


def test_a_list_is_read_across_the_borders_of_blocks(tmp_path, monkeypatch):
    records = [{"token": str(i), "values": [i, {"deep": "ü" * i}]} for i in range(40)]
    path = tmp_path / "a.json"
    path.write_text(json.dumps(records, indent=1, ensure_ascii=False))
    for size in (1, 7, 256, 1 << 20):
        monkeypatch.setattr(json_items, "_BLOCK", size)
        found = list(items_of(path, None, "mend it"))
        assert [item for item, _ in found] == records
        content = path.read_bytes()
        assert [json.loads(content[at : at + size]) for _, (at, size) in found] == records
    path.write_text(path.read_text()[:-30])
    with pytest.raises(ValueError, match=r"a\.json is empty or holds no complete list .*: mend it"):
        list(items_of(path, None, "mend it"))
