"""Shards: what each holds, and that a whole is joined only from all of its own."""

import argparse
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from gsmap.datasets.annotations.file import write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.evaluation.core.match_files import require_own_matches
from gsmap.utils.shards import WHOLE, Shard, find_shards, without_options


@pytest.mark.parametrize("count", [1, 3, 7, 20])
def test_shards_in_their_order_are_the_whole(count):
    parts = [Shard(i, count).part("abcdefghij") for i in range(count)]
    assert "".join(parts) == "abcdefghij"
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    assert WHOLE.part("abc") == "abc"


@pytest.mark.parametrize("text", ["3/3", "1", "/", "-1/3", "1/3/5", "a/b", "1.0/3", "0/0", ""])
def test_only_numbers_from_zero_to_the_last_are_shards(text):
    assert Shard.parse("0/1") == Shard(0, 1)
    assert Shard.parse("15/16") == Shard(15, 16)
    with pytest.raises(argparse.ArgumentTypeError, match="I from 0 to N - 1"):
        Shard.parse(text)


def test_options_are_taken_out_of_a_command():
    words = ["make", "--shard", "0/3", "--root", "a", "--shard=1/3", "--shards-of", "b"]
    assert without_options(words, "--shard") == ["make", "--root", "a", "--shards-of", "b"]


def write(folder: Path, count: int = 3, **options) -> Path:
    target = folder / "val.json"
    for index in range(count):
        shard = Shard(index, count)
        shard.path_of(target).write_text(f"part {index}")
        shard.write_manifest(target, "results", "digest", {"classes": ["a"], **options}, index)
    return target


def test_all_shards_are_found_in_their_order(tmp_path):
    target = write(tmp_path)
    assert [(file.path.read_text(), file.manifest["samples"]) for file in find_shards(target)] == [
        ("part 0", 0),
        ("part 1", 1),
        ("part 2", 2),
    ]
    WHOLE.write_manifest(target, "results", "", {}, 0)  # the whole has no manifest
    assert not target.with_name("val.json.manifest").exists()


def test_shards_of_a_file_with_a_longer_name_are_others(tmp_path):
    target = write(tmp_path)
    for path in list(tmp_path.iterdir()):
        path.rename(path.with_name(path.name.replace("val.", "val.v2.")))
    with pytest.raises(FileNotFoundError, match="no shards of"):
        find_shards(target)
    write(tmp_path)
    names = [file.path.name for file in find_shards(target)]
    assert names == [f"val.0000{index}-of-00003.json" for index in range(3)]


def part(target: Path, index: int, suffix: str = "") -> Path:
    return Shard(index, 3).path_of(target).with_name(f"val.0000{index}-of-00003.json{suffix}")


def rename_as_the_third(target: Path) -> None:
    for suffix in ("", ".manifest"):
        shutil.copy(part(target, 0, suffix), part(target, 2, suffix))


def change(where: Path, **entries) -> None:
    manifest = part(where, 1, ".manifest")
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | entries))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda t: part(t, 1, ".manifest").unlink(), r"lacks 1 of its 3 shards: 1; .*--shard 1/3"),
        (lambda t: part(t, 1).unlink(), "is missing or does not fit"),
        (lambda t: part(t, 1).write_text("part 7"), "is missing or does not fit"),
        (lambda t: part(t, 1, ".manifest").write_text("{"), r"manifest is damaged"),
        (lambda t: change(t, options=[]), r"manifest is damaged"),
        (lambda t: change(t, shard="1"), r"manifest is damaged"),
        (lambda t: change(t, shard=True), r"manifest is damaged"),
        (lambda t: change(t, of=10**12), r"manifest is damaged .*\['shard', 'of', 'samples'\]"),
        (lambda t: change(t, of=-3), r"manifest is damaged"),
        (lambda t: change(t, shard=3), r"manifest is damaged"),
        (lambda t: change(t, samples=None), r"manifest is damaged .*\['samples'\]"),
        (lambda t: change(t, kind=["results"]), r"manifest is damaged .*\['kind'\]"),
        (lambda t: change(t, target="../val.json"), r"manifest is damaged"),
        (rename_as_the_third, "than its manifest, which names shard 0 of 3"),
        (lambda t: change(t, version="0"), r"different work, which differs in version \("),
        (lambda t: change(t, input="other"), r"which differs in input \('digest', 'other'\)"),
        (lambda t: change(t, options={"classes": ["b"]}), r"in classes \(\['a'\], \['b'\]\)"),
        (lambda t: write(t.parent, 2), r"different work, which differs in of \(2, 3\)"),
    ],
)
def test_what_is_missing_damaged_double_or_foreign_is_refused(damage, message, tmp_path):
    target = write(tmp_path)
    assert len(find_shards(target)) == 3
    damage(target)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        find_shards(target)


def test_no_shard_at_all_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match="no shards of"):
        find_shards(tmp_path / "val.json")


def test_no_shard_replaces_a_file_of_another_program(tmp_path):
    target, meta = tmp_path / "val.arrow", AnnotationMeta("own", "lidar", "val")
    path = Shard(1, 3).path_of(target)
    manifest = path.with_name(f"{path.name}.manifest")
    for name in (path, manifest):
        for content in (b"", b"mine", b"ARROW1" + bytes(100_000), b'{"shard": 1}'):
            name.write_bytes(content)
            with pytest.raises(ValueError, match=f"{name.name} exists and is no file of this"):
                write_annotations(target, meta, [], Shard(1, 3))
            assert name.read_bytes() == content
        name.unlink()
    for _ in range(2):  # its own may be replaced
        write_annotations(target, meta, [], Shard(1, 3))
    target.write_bytes(b"named by the user")
    write_annotations(target, meta, [])
    manifest.unlink()  # as after a kill between both files
    write_annotations(target, meta, [], Shard(1, 3))


def test_no_shard_of_figures_replaces_a_file_of_another_program(tmp_path):
    target, shard = tmp_path / "figures.json", Shard(0, 2)
    path = shard.path_of(target)
    path.write_bytes(b"mine")
    with pytest.raises(ValueError, match="exists and is no file of this command"):
        require_own_matches(target, shard)
    np.savez_compressed(path.open("wb"), notes=np.array(["a"]))  # as `write_matches` writes it
    require_own_matches(target, shard)
    require_own_matches(path, WHOLE)
