"""Elements of earlier drives: what a frame reads of them, their cells, and hostile files."""

import os
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
import shapely
import torch

from gsmap.prior import ElementPrior, ElementRule, MapPrior, PriorSettings, open_prior
from gsmap.prior.element_prior import _COUNTS, _STORED, _pack
from gsmap.prior.file_format import _FOOTER, _INDEX, ELEMENT_MAGIC, read_header, write_tiles
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.structures.rigid import invert_rigid, rigid

SETTINGS = PriorSettings(("divider", "ped_crossing", "boundary"), "town")
GRID = BEVGrid((-15, 15), (-30, 30), 200, 100)
SQUARE = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0], [0.0, 0.0]])


def pose_at(x=0.0, y=0.0, yaw_rad=0.0):
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return rigid([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], [x, y, 0])


def street():
    """A long line, a crossing and a line elsewhere, in tiles on both sides of the origin."""
    lines = [
        np.array([[2.0, -500.0], [2.0, 0.0], [2.0, 700.0]]),
        SQUARE,
        np.array([[-900.0, 3.0], [-880.0, 3.0]]),
    ]
    return MapElements.from_polylines(lines, labels=[0, 1, 2], scores=[0.75, 0.5, 1.0])


def test_a_frame_reads_the_parts_in_its_range():
    """Against shapely's intersection with the range as a polygon of the global frame."""
    rng = np.random.default_rng(0)
    walks = rng.normal(size=(20, 30, 2)).cumsum(axis=1) * 4 + rng.uniform(-60, 60, (20, 1, 2))
    elements = MapElements.from_polylines(list(walks), [0, 2] * 10, scores=np.full(20, 0.25))
    prior = ElementPrior(SETTINGS, elements)
    read_some = 0
    for yaw_rad in (0.0, 0.7, 2.5):
        pose = pose_at(10.0, -20.0, yaw_rad)
        found = prior.read_elements(pose, GRID)
        corners = np.array([[-15, -30, 0], [15, -30, 0], [15, 30, 0], [-15, 30, 0]])
        box = shapely.Polygon((corners @ pose[:3, :3].T + pose[:3, 3])[:, :2])
        wanted = shapely.MultiLineString(list(walks)).intersection(box)
        lines = [shapely.LineString(line) for line in found.to_frame(pose).polylines]
        assert sum(line.length for line in lines) == pytest.approx(wanted.length)
        assert wanted.buffer(1e-6).covers(shapely.union_all(lines))
        assert set(found.confidence) == {0.25}
        read_some += len(found)
    assert read_some > 5


def test_areas_stay_rings():
    found = ElementPrior(SETTINGS, street()).read_elements(pose_at(), GRID)
    assert found.labels.tolist() == [0, 1]
    assert found.confidence.tolist() == [0.75, 0.5]
    assert shapely.Polygon(found.polylines[1]).equals(shapely.Polygon(SQUARE))
    cut = ElementPrior(SETTINGS, street()).read_elements(pose_at(x=18.0), GRID).polylines[0]
    assert shapely.Polygon(cut).equals(shapely.box(-15.0, 0.0, -12.0, 4.0))  # x of 3 to 6 m


def test_cells_have_the_confidence_of_their_element():
    """As `MapPrior.write_map` draws the map, times the confidences."""
    prior = ElementPrior(SETTINGS, street(), ElementRule(line_width_m=1.2))
    grid = BEVGrid((-15, 15), (-30, 30), 400, 200)
    values = prior.read(torch.from_numpy(pose_at()), grid)
    cells = MapPrior(PriorSettings(SETTINGS.classes, "town", cell_m=0.15))
    cells.write_map(street(), width_m=1.2)
    is_covered = cells.read(pose_at(), grid) > 0
    for label, confidence in ((0, 0.75), (1, 0.5)):
        assert values[label].max() == confidence
        agreement = (values[label] >= confidence / 2) == is_covered[label]
        assert agreement.float().mean() > 0.999
    assert not values[2].any()
    assert not prior.read(pose_at(x=5000.0), grid).any()


def test_a_file_holds_everything(tmp_path):
    path = tmp_path / "town.elements"
    prior = ElementPrior(SETTINGS, street(), ElementRule(sigma_m=0.3))
    prior.save(path)
    found = open_prior(path)
    assert isinstance(found, ElementPrior)
    assert (found.settings, found.rule) == (SETTINGS, ElementRule(sigma_m=0.3))
    rows = {row[1]: row for row in found.elements.rows}
    for line, label, score in street().rows:
        assert np.array_equal(rows[label][0], line)
        assert rows[label][2] == score
    assert sorted(os.listdir(tmp_path)) == [".town.elements.lock", "town.elements"]
    with pytest.raises(ValueError, match="has place 'town', and 'oslo' is needed"):
        ElementPrior.load(path, PriorSettings(SETTINGS.classes, "oslo"))
    empty = ElementPrior(SETTINGS, MapElements.from_polylines())
    empty.save(path)
    found = ElementPrior.load(path)
    assert len(found.elements) == len(found.read_elements(pose_at(), GRID)) == 0


def crossed_ring(num_vertices):
    points = np.random.default_rng(0).uniform(-14, 14, (num_vertices, 2))
    return np.concatenate([points, points[:1]])


def scored(score):
    elements = MapElements.from_polylines([SQUARE], [0], scores=[0.5])
    return replace(elements, scores=np.array([score]))


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        (MapElements.from_polylines([SQUARE], [3]), r"labels of elements must be in \[0, 3\)"),
        (MapElements.from_polylines([SQUARE[:1]], [0]), "need two vertices or more"),
        (MapElements.from_polylines([SQUARE * 1e8], [0]), "must be within 1e"),
        (replace(scored(0.5), points=SQUARE * np.nan), "must be within 1e"),
        (scored(7.0), r"scores of elements must be in \[0, 1\]"),
        (scored(np.nan), r"scores of elements must be in \[0, 1\]"),
        (MapElements.from_polylines([SQUARE[[0, 0]]], [0]), "need a length"),
        (MapElements.from_polylines([crossed_ring(250)], [1]), "251 vertices crosses itself"),
    ],
)
def test_elements_out_of_range_are_refused(elements, message):
    with pytest.raises(ValueError, match=message):
        ElementPrior(SETTINGS, elements)


def test_long_rings_and_short_crossed_ones_are_areas():
    angles = np.linspace(0, 2 * np.pi, 500)
    circle = 5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    circle[-1] = circle[0]
    rings = [circle, crossed_ring(10), SQUARE[[0, 2, 0]]]
    prior = ElementPrior(SETTINGS, MapElements.from_polylines(rings, [1, 1, 1]))
    found = prior.read_elements(pose_at(), GRID)
    assert len(found) >= 3
    assert shapely.Polygon(found.polylines[0]).area == pytest.approx(np.pi * 25, rel=1e-3)
    flat = ElementPrior(SETTINGS, MapElements.from_polylines(rings[2:], [1]))
    assert flat.read(pose_at(), GRID).max() > 0.5  # a line, as for `read_elements`


def test_settings_and_poses_out_of_range_are_refused():
    with pytest.raises(ValueError, match="sigma_m must be in"):
        ElementRule(sigma_m=0.0)
    with pytest.raises(ValueError, match="line_width_m must be in"):
        ElementRule(line_width_m=6.0)
    prior = ElementPrior(SETTINGS, street())
    with pytest.raises(ValueError, match="pose must be a rigid transform"):
        prior.read_elements(2 * pose_at(), GRID)
    back = prior.read_elements(invert_rigid(pose_at(x=3.0)), GRID)
    assert back.polylines[0][0, 0] == pytest.approx(5.0)


def rewritten(content, path, change=lambda stored, vertices: None, pack=None):
    """Write the file again, its first tile changed."""
    settings, rule, places, _ = read_header(content, path, magic=ELEMENT_MAGIC)
    tiles = []
    for number, (key, (offset, length, _)) in enumerate(places.items()):
        packed = content[offset : offset + length]
        if number == 0:
            counts = np.frombuffer(packed[:8], _COUNTS)[0]
            states = bytearray(zlib.decompress(packed[8:]))
            cut = int(counts["elements"]) * _STORED.itemsize
            stored = np.frombuffer(states, _STORED, count=counts["elements"])
            vertices = np.frombuffer(states, "<f8", offset=cut)
            change(stored, vertices)
            packed = packed[:8] + zlib.compress(bytes(states)) if pack is None else pack(packed)
        tiles.append((key, packed))
    with path.open("wb") as file:
        write_tiles(file, settings, rule=rule, tiles=tiles, magic=ELEMENT_MAGIC)


def set_stored(name, value):
    return lambda stored, vertices: stored[name].__setitem__(0, value)


def set_vertex(value):
    return lambda stored, vertices: vertices.__setitem__(0, value)


def flipped(content, at):
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


def shared(content):
    """Let the second tile of a file begin with the first one; checksums fit."""
    offset, count, _, header_crc, magic = _FOOTER.unpack(content[-_FOOTER.size :])
    rows = np.frombuffer(content[offset : -_FOOTER.size], _INDEX).copy()
    rows["offset"][1] = rows["offset"][0]
    index = rows.tobytes()
    footer = _FOOTER.pack(offset, count, zlib.crc32(index), header_crc, magic)
    return content[:offset] + index + footer


HOSTILE = {
    "nothing": (lambda c, p: p.write_bytes(b""), "is empty"),
    "text": (lambda c, p: p.write_bytes(b"<!doctype html>" * 20), "it is a web page"),
    "cut": (lambda c, p: p.write_bytes(c[:-5]), "is cut off"),
    "another version": (
        lambda c, p: p.write_bytes(c[:8] + struct.pack("<I", 9) + c[12:]), "has version 9",
    ),
    "a changed index": (
        lambda c, p: p.write_bytes(flipped(c, len(c) - _FOOTER.size - 9)), "a checksum is wrong",
    ),
    "tiles that share bytes": (lambda c, p: p.write_bytes(shared(c)), "tiles outside of the file"),
    "another class": (lambda c, p: rewritten(c, p, set_stored("label", 3)), "labels of elements"),
    "a score above 1": (lambda c, p: rewritten(c, p, set_stored("score", 1.5)), "the score 1.5"),
    "no score": (lambda c, p: rewritten(c, p, set_stored("score", np.nan)), "the score nan"),
    "other lengths": (
        lambda c, p: rewritten(c, p, set_stored("num_vertices", 2**32 - 1)), "cannot be read",
    ),
    "a NaN": (lambda c, p: rewritten(c, p, set_vertex(np.nan)), "point that is not finite"),
    "a far vertex": (lambda c, p: rewritten(c, p, set_vertex(1e9)), "must be within"),
    "a large number": (
        lambda c, p: rewritten(c, p, pack=lambda t: b"\xff" * 8 + t[8:]), "cannot be read",
    ),
    "a bomb": (
        lambda c, p: rewritten(c, p, pack=lambda t: t[:8] + zlib.compress(bytes(10**8))),
        "cannot be read",
    ),
    "a short tile": (lambda c, p: rewritten(c, p, pack=lambda t: b"ab"), "cannot be read"),
    "an element without vertices": (
        lambda c, p: rewritten(c, p, pack=lambda t: _pack(MapElements.from_polylines([[]], [0]))),
        "need two vertices or more",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_end_in_one_line(tmp_path, name):
    make, message = HOSTILE[name]
    path = tmp_path / "town.elements"
    ElementPrior(SETTINGS, street()).save(path)
    make(path.read_bytes(), path)
    with pytest.raises(ValueError, match=message) as error:
        ElementPrior.load(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
