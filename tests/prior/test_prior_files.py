"""Files of map priors: written whole, reserved by one writer, checked when they are read."""

import json
import os
import signal
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
import torch

from gsmap.prior import (
    ElementPrior,
    GaussianPrior,
    HitMissCounts,
    KeepMaximum,
    LastSeen,
    MapPrior,
    PriorSettings,
    open_prior,
)
from gsmap.prior.file_format import _FOOTER, _INDEX, _START, RASTER_MAGIC
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid

SETTINGS = PriorSettings(("divider", "boundary"), "town")
GRID = BEVGrid((-15, 15), (-30, 30), 40, 20)
PLACES = (-400, -60, 0, 130)


def pose_at(x):
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = x
    return pose


def filled_prior(rule=None):
    prior = MapPrior(SETTINGS, rule)
    rng = np.random.default_rng(0)
    for x in PLACES:
        prior.write(pose_at(x), GRID, rng.random((2, 40, 20)))
    return prior


def readings(prior):
    return torch.stack([prior.read(pose_at(x), GRID) for x in PLACES])


@pytest.mark.parametrize("rule", [KeepMaximum(), LastSeen(gain=20.0), HitMissCounts(decay=0.9)])
def test_a_file_holds_everything(rule, tmp_path):
    prior = filled_prior(rule)
    before = readings(prior)
    path = tmp_path / "town.prior"
    prior.save(path)
    found = MapPrior.load(path, SETTINGS, memory_bytes=1)
    assert found.rule == rule
    assert found.settings == SETTINGS
    assert found.num_tiles == prior.num_tiles
    for each in (prior, found):
        torch.testing.assert_close(readings(each), before, rtol=0, atol=0)


def test_a_file_is_changed_and_saved_again(tmp_path):
    path = tmp_path / "town.prior"
    filled_prior(KeepMaximum()).save(path)
    with MapPrior.load(path, update=True, memory_bytes=1) as prior:
        for x in (0, 5000, 7000):
            prior.write(pose_at(x), GRID, torch.ones(2, 40, 20))
        expected = readings(prior)
        prior.save(path)
        prior.write(pose_at(9000), GRID, torch.ones(2, 40, 20))
        prior.save(path)
    found = MapPrior.load(path)
    torch.testing.assert_close(readings(found), expected, rtol=0, atol=0)
    for x in (0, 5000, 7000, 9000):
        assert bool((found.read(pose_at(x), GRID) == 1).all())


def test_a_prior_without_tiles_is_a_file(tmp_path):
    MapPrior(SETTINGS).save(tmp_path / "empty.prior")
    assert MapPrior.load(tmp_path / "empty.prior").num_tiles == 0


@pytest.mark.parametrize(
    "make",
    [
        lambda: filled_prior(KeepMaximum()),
        lambda: GaussianPrior(SETTINGS),
        lambda: ElementPrior(SETTINGS, MapElements.from_polylines([np.eye(2)], [0])),
    ],
)
def test_a_file_knows_the_samples_that_its_prior_was_made_of(make, tmp_path):
    path = tmp_path / "town.prior"
    prior = make()
    prior.save(path)
    unknown = path.read_bytes()
    assert b"sources" not in unknown  # as files of earlier versions
    assert open_prior(path).sources.count(["a", "b"]) == 0
    for token in ("a", "b", "a", "", "é" * 40):
        prior.sources.add(token)
    prior.save(path)
    found = open_prior(path)
    assert len(found.sources) == 3
    assert found.sources.count(["a", "c", "é" * 40, ""]) == 2
    found.save(tmp_path / "again.prior")
    assert (tmp_path / "again.prior").read_bytes() == path.read_bytes()
    if isinstance(found, MapPrior):
        torch.testing.assert_close(readings(found), readings(prior), rtol=0, atol=0)


def test_two_writers_are_refused(tmp_path):
    path = tmp_path / "town.prior"
    filled_prior().save(path)
    with MapPrior.load(path, update=True) as first:
        for second in (lambda: MapPrior.load(path, update=True), lambda: filled_prior().save(path)):
            with pytest.raises(RuntimeError, match=rf"in use by process {os.getpid()}"):
                second()
        MapPrior.load(path).close()  # reading is allowed
        first.save(path)
    MapPrior.load(path, update=True).close()


def test_the_lock_of_a_killed_process_is_free(tmp_path):
    path = tmp_path / "town.prior"
    filled_prior().save(path)
    code = (
        "import sys, time; from gsmap.prior import MapPrior\n"
        "prior = MapPrior.load(sys.argv[1], update=True); print('held', flush=True)\n"
        "sys.stdin.read()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        assert process.stdout.readline() == b"held\n"
        with pytest.raises(RuntimeError, match=f"in use by process {process.pid}"):
            MapPrior.load(path, update=True)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdin.close()
        process.stdout.close()
    MapPrior.load(path, update=True).close()


def test_a_kill_while_saving_keeps_the_old_file(tmp_path):
    """The process dies in the middle of the tiles."""
    path = tmp_path / "town.prior"
    filled_prior(KeepMaximum()).save(path)
    before = path.read_bytes()
    code = """
import os, signal, sys, torch
from gsmap.prior import MapPrior
from gsmap.prior.tiles import TileStore
from gsmap.structures.grid import BEVGrid
prior = MapPrior.load(sys.argv[1], update=True)
prior.write(torch.eye(4), BEVGrid((-15, 15), (-30, 30), 40, 20), torch.ones(2, 40, 20))
packed_tiles = TileStore.packed_tiles
def dying(self):
    for number, tile in enumerate(packed_tiles(self)):
        if number == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        yield tile
TileStore.packed_tiles = dying
prior.save(sys.argv[1])
"""
    done = subprocess.run([sys.executable, "-c", code, path], check=False)
    assert done.returncode == -signal.SIGKILL
    assert path.read_bytes() == before
    prior = MapPrior.load(path, update=True)
    prior.save(path)
    prior.close()
    assert sorted(os.listdir(tmp_path)) == [".town.prior.lock", "town.prior"]


def test_a_save_that_fails_keeps_file_and_prior(tmp_path, monkeypatch):
    path = tmp_path / "town.prior"
    prior = filled_prior(KeepMaximum())
    prior.save(path)
    before = path.read_bytes()
    prior.write(pose_at(0), GRID, torch.ones(2, 40, 20))
    expected = readings(prior)

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("gsmap.prior.map_prior.write_tiles", fail)
        with pytest.raises(OSError, match=r"No space left.*town\.prior"):
            prior.save(path)
    assert path.read_bytes() == before
    torch.testing.assert_close(readings(prior), expected, rtol=0, atol=0)
    prior.save(path)
    torch.testing.assert_close(readings(MapPrior.load(path)), expected, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("other", "name"),
    [
        (PriorSettings(("boundary", "divider"), "town"), "classes"),
        (PriorSettings(("divider", "boundary"), "city"), "place"),
        (PriorSettings(("divider", "boundary"), "town", cell_m=0.15), "cell_m"),
        (PriorSettings(("divider", "boundary"), "town", tile_m=30.0), "tile_m"),
    ],
)
def test_a_prior_of_other_settings_is_refused(other, name, tmp_path):
    path = tmp_path / "town.prior"
    filled_prior().save(path)
    with pytest.raises(ValueError, match=rf"town\.prior has {name} .* is needed: give") as error:
        MapPrior.load(path, other)
    assert "\n" not in str(error.value)


def file_of(header, tiles=(), index=None, version=1):
    """File of a header, tiles (bytes) and an index."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    start = _START.pack(RASTER_MAGIC, version, len(text)) + text
    rows, body = [], b""
    for number, tile in enumerate(tiles):
        rows.append((number, 0, len(start) + len(body), len(tile), zlib.crc32(tile)))
        body += tile
    rows = rows if index is None else index
    packed = np.array(rows, _INDEX).tobytes()
    offset = len(start) + len(body)
    footer = _FOOTER.pack(offset, len(rows), zlib.crc32(packed), zlib.crc32(text), RASTER_MAGIC)
    return start + body + packed + footer


RULE = {"name": "keep_maximum"}
HEADER = {"classes": ["a"], "place": "t", "cell_m": 0.3, "tile_m": 60.0, "rule": RULE}
GOOD = file_of(HEADER, [zlib.compress(bytes(40_000))])


def sources(count, checksum=0):
    """Header of a prior that names its sources."""
    return {**HEADER, "sources": {"count": count, "checksum": checksum}}


def damaged(content, position, value):
    return content[:position] + value + content[position + len(value) :]


HOSTILE = {
    "empty": (b"", "is empty"),
    "text": (b"hello", "is no map prior: give"),
    "pointer": (b"version https://git-lfs.github.com/spec/v1\n" + bytes(99), "git lfs pull"),
    "web page": (b"<!DOCTYPE html>" + bytes(99), "it is a web page"),
    "pickle": (b"\x80\x04cos\nsystem\n", "is no map prior"),
    "magic alone": (GOOD[:8], "is cut off"),
    "cut by one byte": (GOOD[:-1], "is cut off"),
    "cut in the tiles": (GOOD[: len(GOOD) // 2], "is cut off"),
    "longer": (GOOD + b"\0", "is cut off"),
    "version": (file_of(HEADER, version=2), "has version 2 of map priors"),
    "header longer than the file": (damaged(GOOD, 12, struct.pack("<I", 2**31)), "is damaged"),
    "changed header": (damaged(GOOD, 20, b"x"), "a checksum is wrong"),
    "changed index": (damaged(GOOD, len(GOOD) - 30, b"xy"), "a checksum is wrong"),
    "many tiles": (damaged(GOOD, len(GOOD) - 20, struct.pack("<I", 2**32 - 1)), "is cut off"),
    "no json": (file_of(b"{"), "is damaged"),
    "no text": (file_of(b"\xff\xfe"), "is damaged"),
    "deep": (file_of(b"[" * 60_000), "is damaged"),
    "list": (file_of([1]), "must have the fields"),
    "missing field": (file_of({**HEADER, "rule": None} | {"more": 1}), "must have the fields"),
    "class names": (file_of({**HEADER, "classes": [["a"]]}), "is damaged"),
    "classes as text": (file_of({**HEADER, "classes": "abc"}), "classes must be a list"),
    "many classes": (file_of({**HEADER, "classes": [str(i) for i in range(99)]}), "classes must"),
    "place": (file_of({**HEADER, "place": None}), "printable names"),
    "escape in the place": (file_of({**HEADER, "place": "\x1b[2J"}), "printable names"),
    "nan": (file_of({**HEADER, "cell_m": float("nan")}), "cell_m must be in"),
    "huge tile": (file_of({**HEADER, "tile_m": 1e300}), "tile_m must be"),
    "rule": (file_of({**HEADER, "rule": {"name": "eval"}}), "the rule must have a name"),
    "tile outside": (file_of(HEADER, index=[(0, 0, 2**63, 10, 0)]), "outside of the file"),
    "long tile": (file_of(HEADER, index=[(0, 0, 150, 2**31, 0)]), "outside of the file"),
    "tile in the header": (file_of(HEADER, index=[(0, 0, 0, 10, 0)]), "outside of the file"),
    "far tile": (
        file_of(HEADER, [b"x"], [(-(2**31), 0, len(file_of(HEADER)) - _FOOTER.size, 1, 0)]),
        "outside of the file",
    ),
    "sources without an end": (file_of(sources(1)), "a checksum is wrong"),
    "changed sources": (file_of(sources(1, checksum=1), [bytes(8)], []), "a checksum is wrong"),
    "many sources": (file_of(sources(2**40)), r"count of sources must be in \[0"),
    "negative sources": (file_of(sources(-1)), r"count of sources must be in \[0"),
    "sources that are no number": (file_of(sources(True)), "sources must have a count and"),
    "sources as a list": (file_of({**HEADER, "sources": []}), "sources must have a count and"),
    "tile in the sources": (
        file_of(
            sources(1, checksum=zlib.crc32(bytes(8))),
            [bytes(8)],
            [(0, 0, len(file_of(sources(1, checksum=zlib.crc32(bytes(8))))) - _FOOTER.size, 8, 0)],
        ),
        "outside of the file",
    ),
    "twice": (
        file_of(HEADER, [b"x"], 2 * [(1, 1, len(file_of(HEADER)) - _FOOTER.size, 1, 0)]),
        "or twice",
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_in_one_line(name, tmp_path):
    content, message = HOSTILE[name]
    path = tmp_path / "foreign.prior"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as error:
        MapPrior.load(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


TILES = {
    "no zlib": b"hello",
    "short": zlib.compress(bytes(39_999)),
    "long": zlib.compress(bytes(40_001)),
    "bomb": zlib.compress(bytes(1 << 28)),
    "cut": zlib.compress(bytes(range(250)) * 160)[:-5],
}


@pytest.mark.parametrize("name", TILES)
def test_damaged_tiles_are_refused_in_one_line(name, tmp_path):
    path = tmp_path / "foreign.prior"
    path.write_bytes(file_of(HEADER, [TILES[name]]))
    prior = MapPrior.load(path)
    for use in (lambda: prior.read(pose_at(0), GRID), lambda: prior.save(tmp_path / "copy")):
        with pytest.raises(ValueError, match=r"foreign\.prior is damaged: a tile cannot") as error:
            use()
        assert "\n" not in str(error.value)
    assert not (tmp_path / "copy").exists()


def test_a_tile_with_a_wrong_checksum_is_refused(tmp_path):
    path = tmp_path / "foreign.prior"
    tile = zlib.compress(bytes(40_000))
    offset = len(file_of(HEADER)) - _FOOTER.size
    path.write_bytes(file_of(HEADER, [tile], [(0, 0, offset, len(tile), 1)]))
    with pytest.raises(ValueError, match="a tile cannot be read"):
        MapPrior.load(path).read(pose_at(0), GRID)


def test_the_good_file_is_read(tmp_path):
    path = tmp_path / "good.prior"
    path.write_bytes(GOOD)
    assert MapPrior.load(path).read(pose_at(30), GRID).shape == (1, 40, 20)


def test_a_file_may_have_as_many_and_as_long_names_as_its_prior(tmp_path):
    """A letter outside of Unicode's first plane has 12 bytes in the header."""
    names = [f"{number:03d}" + 197 * "\U0001f6e3" for number in range(65)]
    settings = PriorSettings(tuple(names[:64]), names[64])
    MapPrior(settings).save(tmp_path / "long.prior")
    assert MapPrior.load(tmp_path / "long.prior").settings == settings


def test_a_missing_file_is_an_error_of_the_system(tmp_path):
    with pytest.raises(FileNotFoundError):
        MapPrior.load(tmp_path / "none")
