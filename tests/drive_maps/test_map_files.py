"""Maps that are read: written by the library, by other programs, or to attack."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drive_cases import CLASSES, drive_of

from drivemaps.geodetic import MapGrid, MapOrigin
from drivemaps.geojson import write_geojson
from drivemaps.lanelet2 import write_lanelet2
from drivemaps.map_files import read_map
from drivemaps.map_reading import ClassRule, describe_unused
from drivemaps.truth import true_map
from gsmap.structures.elements import MapElements

ORIGIN = MapOrigin(48.26, 11.67)
GRID = (
    MapGrid("EPSG:32632") if pytest.importorskip("pyproj", reason="pip install -e .[maps]") else 0
)
LINE = [[0.0, 0.0], [10.0, 0.0]]
TINY_RING = [[0, 0], [0.01, 0], [0, 0.01], [0, 0]]
RING = [[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]]


def assert_equal(found, expected, atol):
    """Same elements in the same order; rings may run the other way."""
    assert found.labels.tolist() == expected.labels.tolist()
    for line, other in zip(found.polylines, expected.polylines, strict=True):
        forward = np.abs(line - other).max()
        assert min(forward, np.abs(line - other[::-1]).max()) < atol


@pytest.mark.parametrize(
    ("suffix", "origin", "atol"),
    [("geojson", None, 1e-3), ("geojson", ORIGIN, 2e-3), ("osm", ORIGIN, 1e-3)],
)
def test_maps_of_the_library_are_read_back(tmp_path, suffix, origin, atol):
    expected = true_map(drive_of())
    path = tmp_path / f"map.{suffix}"
    write = write_geojson if suffix == "geojson" else write_lanelet2
    write(path, expected, CLASSES, origin)
    found, unused = read_map(path, CLASSES, origin)
    assert_equal(found, expected, atol)
    assert not unused
    scored = replace(expected, scores=np.linspace(0, 1, len(expected)))
    write(path, scored, CLASSES, origin)
    found, _ = read_map(path, CLASSES, origin)
    np.testing.assert_allclose(found.scores, scored.scores, atol=1e-4)
    unscored = replace(expected, scores=None)
    write(path, unscored, CLASSES, origin)
    assert (read_map(path, CLASSES, origin).elements.scores == 1).all()


@pytest.mark.parametrize(
    ("suffix", "grid", "zone"),
    [("geojson", "", 39), ("geojson", "EPSG:4527", 39), ("osm", "EPSG:28418", 18)],
)
def test_maps_on_grids_whose_eastings_begin_with_the_zone_are_read_back(
    tmp_path, suffix, grid, zone
):
    place = MapGrid(grid) if grid else None  # without it, metres are written
    line = np.array([[512_000.0, 5.5e6], [512_020.5, 5_500_001.25]]) + np.array([zone * 1e6, 0])
    path = tmp_path / f"map.{suffix}"
    write = write_geojson if suffix == "geojson" else write_lanelet2
    write(path, MapElements.from_polylines([line], [0]), CLASSES, place)
    found, _ = read_map(path, CLASSES, place)
    np.testing.assert_allclose(found.points, line, atol=2e-3)


@pytest.mark.parametrize("place", [ORIGIN, MapOrigin(40.44, -80.0, utm_zone=17), GRID])
def test_degrees_become_the_metres_that_they_came_from(place):
    points = np.random.default_rng(0).uniform(-2000, 2000, (50, 2))
    if place is GRID:
        points += [690_000, 5_340_000]
    back = place.points_of(place.lon_lat(points), "map")
    np.testing.assert_allclose(back, points, atol=1e-5)


def geojson(features, **members):
    return json.dumps({"type": "FeatureCollection", **members, "features": features})


def feature(geometry_type, coordinates, /, **properties):
    geometry = {"type": geometry_type, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def test_a_geojson_of_another_program_is_read_by_its_own_words(tmp_path):
    path = tmp_path / "town.geojson"
    features = [
        feature("LineString", [[1, 2, 99], [3, 4, 99]], kind="lane_line"),
        feature("MultiLineString", [LINE, [[0, 5], [10, 5]]], kind="kerb"),
        feature("MultiPolygon", [[RING, [[1, 1], [2, 1], [2, 2], [1, 1]]]], kind="zebra"),
        feature("Polygon", [np.add(RING, 20).tolist()], kind=7),
        feature("LineString", LINE, kind="zebra"),
        feature("LineString", [[5, 5], [5, 5]], kind="kerb"),
        feature("Point", [0, 0], kind="tree"),
        feature("LineString", LINE, kind="building"),
        feature("LineString", LINE),
        {"type": "Feature", "geometry": None, "properties": None},
    ]
    path.write_text(geojson(features, name="town").replace("{", '{"crs": null, ', 1))
    words = ["kind", "lane_line=divider", "kerb=boundary", "zebra=ped_crossing", "7=ped_crossing"]
    found, unused = read_map(path, CLASSES, rule=ClassRule.parse(words, CLASSES))
    assert found.labels.tolist() == [0, 2, 2, 1, 1]
    assert found.polylines[0].tolist() == [[1, 2], [3, 4]]
    assert found.polylines[3].tolist() == RING
    assert dict(unused) == {
        "holes of polygons": 1,
        "ped_crossing that is an open line": 1,
        "boundary without length": 1,
        "geometry 'Point'": 1,
        "kind 'building'": 1,
        "without 'kind'": 1,
        "without geometry": 1,
    }
    assert describe_unused(unused).startswith("1 x holes of polygons, 1 x ")


@pytest.mark.parametrize("suffix", ["geojson", "osm"])
def test_copies_of_an_element_are_counted(tmp_path, suffix):
    """Lines that run the other way and rings with another start are copies, unlike neighbours."""
    line = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, -1.0]])
    ring = np.array(RING, dtype=float)
    turned = ring[[2, 3, 0, 1, 2]]
    lines = [line, line[::-1], line + 2e-4, line + 0.01, line[:2]]
    rings = [ring, ring[::-1], turned, turned[::-1], ring + 0.01]
    elements = MapElements.from_polylines([*lines, line, *rings], [0] * 5 + [2] + [1] * 5)
    path = tmp_path / f"map.{suffix}"
    write = write_geojson if suffix == "geojson" else write_lanelet2
    write(path, elements, CLASSES, ORIGIN)
    found, unused = read_map(path, CLASSES, ORIGIN)
    assert sorted(found.labels.tolist()) == [0, 0, 0, 1, 1, 2]
    assert dict(unused) == {
        "divider that is a copy of another": 2,
        "ped_crossing that is a copy of another": 3,
    }


def test_degrees_without_a_system_are_longitude_and_latitude(tmp_path):
    path = tmp_path / "town.geojson"
    degrees = ORIGIN.lon_lat(np.array(LINE)).tolist()
    path.write_text(geojson([feature("LineString", degrees, **{"class": "divider"})]))
    found, _ = read_map(path, CLASSES, ORIGIN)
    np.testing.assert_allclose(found.points, LINE, atol=1e-4)
    with pytest.raises(ValueError, match="origin of the global frame is not known: give --origin"):
        read_map(path, CLASSES)


def divider(coordinates):
    return feature("LineString", coordinates, **{"class": "divider"})


def deep(depth):
    return "[" * depth + "]" * depth


HOSTILE_GEOJSON = {
    "nothing": ("", "is empty or holds no complete list"),
    "a list": ("[]", "holds a list and no list under 'features'"),
    "cut": (geojson([divider(LINE)])[:-9], "is empty or holds no complete list"),
    "nested too deep": ('{"features": [' + deep(100_000) + "]}", "is empty or holds no complete"),
    "deep coordinates": (
        geojson([divider([[0, 0]])]).replace("[[0, 0]]", deep(500)), "fewer than two coordinates",
    ),
    "NaN": (geojson([divider([[0, 0], [math.nan, 1]])]), "feature 0: nan is no finite number"),
    "infinity": (geojson([divider([[0, 0], [1, math.inf]])]), "feature 0: inf is no finite"),
    "1e400": (geojson([divider([[0, 0], [1, 1]])]).replace("1]", "1e400]"), "inf is no finite"),
    "a number of 5,000 digits": (
        geojson([divider([[0, 0], [1, 1]])]).replace("1]", "1" * 5000 + "]"), "no complete list",
    ),
    "a number of 400 digits": (
        geojson([divider([[0, 0], [1, 1]])]).replace("1]", "1" * 400 + "]"), "no finite number",
    ),
    "text": (geojson([divider([["0", "0"], [1, 1]])]), "feature 0: '0' is no number"),
    "truth": (geojson([divider([[True, 0], [1, 1]])]), "feature 0: True is no number"),
    "an object for a line": (geojson([divider({"0": [0, 0]})]), "nested differently"),
    "a flat line": (geojson([divider([0, 0, 1, 1])]), "nested differently"),
    "one coordinate": (geojson([divider([[0], [1]])]), "a position has fewer than two coordinates"),
    "no feature": (geojson([3]), "feature 0: it is no object of type Feature"),
    "a geometry without type": (
        geojson([{"type": "Feature", "geometry": {}, "properties": {}}]), "no object with a type",
    ),
    "properties in a list": (
        geojson([{**divider(LINE), "properties": ["class"]}]), "its properties are no object",
    ),
    "an open ring": (
        geojson([feature("Polygon", [RING[:-1]], **{"class": "ped_crossing"})]), "is not closed",
    ),
    "a polygon without rings": (
        geojson([feature("Polygon", [], **{"class": "ped_crossing"})]), "polygon has no ring",
    ),
    "other words": (
        geojson([feature("LineString", LINE, kind="kerb")]),
        r"has no element of .*, but 1 x without 'class': name the property",
    ),
    "only areas without area": (
        geojson([feature("Polygon", [TINY_RING], **{"class": "ped_crossing"})]),
        "has no element of .*, but 1 x ped_crossing without area",
    ),
    "far away": (geojson([divider([[0, 0], [1e9, 0]])]), r"reaches 1e\+09 m"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE_GEOJSON)
def test_hostile_geojson_ends_in_one_line(tmp_path, name):
    content, message = HOSTILE_GEOJSON[name]
    path = tmp_path / "map.geojson"
    path.write_text(content.replace("{", '{"crs": null, ', 1))
    if name == "nothing":
        path.write_text("")
    with pytest.raises(ValueError, match=message) as error:
        read_map(path, CLASSES)
    assert "map.geojson" in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400


@pytest.mark.parametrize(
    ("crs", "coordinates", "message"),
    [
        ({"type": "name", "properties": {"name": "EPSG:3857"}}, LINE, "coordinates of 'EPSG:3857'"),
        ({"type": "name"}, LINE, "coordinates of None"),
        ("EPSG:4326", LINE, "coordinates of None"),
        (None, [[500.0, 0.0], [510.0, 0.0]], 'no longitude and latitude: .* "crs": null'),
        (None, [[0.0, 0.0], [1.0, 0.0]], "km from the origin 48.26 11.67"),
    ],
)
def test_coordinates_of_another_system_are_refused(tmp_path, crs, coordinates, message):
    path = tmp_path / "map.geojson"
    members = {"crs": crs} if crs else {}
    path.write_text(geojson([divider(coordinates)], **members))
    with pytest.raises(ValueError, match=message):
        read_map(path, CLASSES, ORIGIN)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["kind", "kerb"], "must be VALUE=CLASS"),
        (["kind", "kerb=wall"], r"a class of \['divider', 'ped_crossing', 'boundary'\]"),
        (["kind", "=divider"], "must be VALUE=CLASS"),
        (["", "a=divider"], "must have a name"),
        (["kind", "a=divider", "a=boundary"], "'a' has the classes 'divider' and 'boundary'"),
    ],
)
def test_wrong_words_for_classes_are_named(words, message):
    with pytest.raises(ValueError, match=message):
        ClassRule.parse(words, CLASSES)


def test_a_name_that_is_no_map_and_a_missing_file_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"must end in one of \['.geojson', '.json', '.osm'"):
        read_map(tmp_path / "map.shp", CLASSES)
    for name in ("map.geojson", "map.osm"):
        with pytest.raises(FileNotFoundError):
            read_map(tmp_path / name, CLASSES)


NODES = """
<node id='1' lat='48.26' lon='11.67'><tag k='local_x' v='0'/><tag k='local_y' v='0'/></node>
<node id='2' lat='48.2601' lon='11.67'><tag k='local_x' v='0'/><tag k='local_y' v='11'/></node>
<node id='3' lat='48.2601' lon='11.6701'><tag k='local_x' v='7'/><tag k='local_y' v='11'/></node>
<node id='4' lat='48.26' lon='11.6701'><tag k='local_x' v='7'/><tag k='local_y' v='0'/></node>
"""


def way(number, nodes, **tags):
    refs = "".join(f"<nd ref='{node}'/>" for node in nodes)
    tags = "".join(f"<tag k='{key}' v='{value}'/>" for key, value in tags.items())
    return f"<way id='{number}'>{refs}{tags}</way>"


def relation(number, members, **tags):
    members = "".join(f"<member type='way' ref='{r}' role='{k}'/>" for k, r in members.items())
    tags = "".join(f"<tag k='{key}' v='{value}'/>" for key, value in tags.items())
    return f"<relation id='{number}'>{members}{tags}</relation>"


def osm(body, nodes=NODES):
    return f"<?xml version='1.0'?>\n<osm version='0.6'>{nodes}{body}</osm>"


def test_a_lanelet2_map_of_another_program_is_read_by_its_types(tmp_path):
    path = tmp_path / "town.osm"
    body = [
        way(10, [1, 2], type="line_thin", subtype="dashed"),
        way(11, [4, 3], type="curbstone", subtype="high"),
        way(12, [1, 2], type="pedestrian_marking"),
        way(13, [3, 4], type="pedestrian_marking"),
        way(14, [1, 2, 3], type="traffic_light"),
        way(15, [1, 2, 3], type="traffic_sign", subtype="de294"),
        way(16, [2, 3], type="zebra_marking"),
        way(17, [1, 2, 3, 4], type="zebra_marking", area="yes"),
        way(18, [1, 2]),
        relation(20, {"left": 12, "right": 13}, type="lanelet", subtype="crosswalk"),
        relation(21, {"left": 10, "right": 11}, type="lanelet", subtype="road"),
        relation(22, {}, type="regulatory_element"),
        relation(23, {"ref_line": 12}, type="regulatory_element", subtype="crosswalk"),
        relation(24, {"outer": 17}, type="multipolygon", subtype="crosswalk"),
        "<way id='19' action='delete'/><bounds minlat='1'/>",
    ]
    path.write_text(osm("".join(body)))
    found, unused = read_map(path, CLASSES)
    assert found.labels.tolist() == [1, 0, 2]
    ring = [[0, 0], [0, 11], [7, 11], [7, 0], [0, 0]]
    for line, expected in zip(
        found.polylines, [ring, [[0, 0], [0, 11]], [[7, 0], [7, 11]]], strict=True
    ):
        assert line.tolist() == expected
    assert dict(unused) == {
        "class 'traffic_light'": 1,
        "class 'traffic_sign/de294'": 1,
        "class ''": 1,
        "ped_crossing that is a copy of another": 1,  # way 17 has the outline of lanelet 20
        "ped_crossing that is an open line": 1,
        "relation 'lanelet'": 1,
        "relation 'regulatory_element'": 2,
        "relation 'multipolygon'": 1,
        "deleted way": 1,
    }
    rule = ClassRule.parse(["type", "traffic_sign=boundary"], CLASSES)
    found, _ = read_map(path, CLASSES, rule=rule)
    assert found.labels.tolist() == [2]


@pytest.mark.parametrize(
    ("kind", "unused"),
    [
        ("curbstone", {"boundary that is part of a crosswalk": 2}),
        ("line_thin", {"divider that is part of a crosswalk": 2}),
        ("pedestrian_marking", {}),
        ("virtual", {}),
    ],
)
def test_lines_of_other_classes_that_bound_a_crosswalk_are_counted(tmp_path, kind, unused):
    path = tmp_path / "town.osm"
    crosswalk = relation(20, {"left": 10, "right": 11}, type="lanelet", subtype="crosswalk")
    path.write_text(osm(way(10, [1, 2], type=kind) + way(11, [4, 3], type=kind) + crosswalk))
    found, counted = read_map(path, CLASSES)
    assert found.labels.tolist() == [1]
    assert dict(counted) == unused


def test_nodes_without_local_positions_need_an_origin(tmp_path):
    path = tmp_path / "town.osm"
    nodes = "<node id='5' lat='48.26' lon='11.6702'/>"
    path.write_text(osm(way(10, [1, 5], type="line_thin"), NODES + nodes))
    with pytest.raises(ValueError, match=r"without local_x and local_y.*give --origin or --crs"):
        read_map(path, CLASSES)
    found, _ = read_map(path, CLASSES, ORIGIN)
    np.testing.assert_allclose(found.points, [[0, 0], [14.85, 0]], atol=0.01)


@pytest.mark.parametrize("place", [MapOrigin(48.261, 11.67), GRID])
def test_degrees_that_contradict_local_positions_are_counted(tmp_path, place):
    path = tmp_path / "town.osm"
    path.write_text(osm(way(10, [1, 2], type="line_thin")))
    for origin, counted in ((None, 0), (ORIGIN, 0), (place, 1), (MapOrigin(-33.0, 151.0), 1)):
        found, unused = read_map(path, CLASSES, origin)
        assert found.points.tolist() == [[0, 0], [0, 11]]
        assert sum("far from local_x and local_y" in reason for reason in unused) == counted
    for value in ("", "0", "0.0"):  # as programs write a map without a place
        nodes = re.sub("(lat|lon)='.*?'", rf"\1='{value}'", NODES)
        path.write_text(osm(way(10, [1, 2], type="line_thin"), nodes))
        found, unused = read_map(path, CLASSES, place)
        assert found.points.tolist() == [[0, 0], [0, 11]]
        assert not unused


LAUGHS = "".join(f"<!ENTITY l{i} '{f'&l{i - 1};' * 10}'>" for i in range(1, 10))
HOSTILE_OSM = {
    "nothing": ("", "is no valid XML .no element found"),
    "no XML": ("<osm><node id=1/></osm>", "is no valid XML .not well-formed"),
    "cut": (osm("")[:-8], "is no valid XML"),
    "a web page": ("<!DOCTYPE html><html></html>", "it has a document type"),
    "an external entity": (
        "<!DOCTYPE osm [<!ENTITY e SYSTEM 'file:///etc/passwd'>]><osm>&e;</osm>",
        "it has a document type",
    ),
    "a billion laughs": (
        f"<!DOCTYPE osm [<!ENTITY l0 'ha'>{LAUGHS}]><osm>&l9;</osm>", "it has a document type",
    ),
    "an external document type": (
        "<!DOCTYPE osm SYSTEM 'http://localhost/x.dtd'><osm/>", "it has a document type",
    ),
    "an unknown entity": (osm("&e;"), "is no valid XML .undefined entity"),
    "another root": ("<gpx></gpx>", "its root is 'gpx'"),
    "nested too deep": (osm("<way id='9'>" + "<a>" * 99_999), "nested deeper than 20"),
    "an unknown encoding": ("<?xml version='1.0' encoding='x-no'?><osm/>", "is no valid XML"),
    "a missing node": (osm(way(10, [1, 99], type="line_thin")), "needs node '99', which is miss"),
    "NaN": (osm("", NODES.replace("v='7'", "v='nan'")), "node '3' has the coordinate 'nan'"),
    "infinity": (osm("", NODES.replace("v='7'", "v='1e999'")), "has the coordinate '1e999'"),
    "a word": (osm("", NODES.replace("lat='48.26'", "lat='north'")), "the coordinate 'north'"),
    "out of range": (osm("", NODES.replace("lat='48.26'", "lat='91'")), "no latitude and long"),
    "no position": (osm(way(10, [5, 5], type="line_thin"), "<node id='5'/>"), "without local_x"),
    "a node twice": (osm("", NODES * 2), "node '1' twice"),
    "a way twice": (osm(way(1, [1, 2]) * 2), "way '1' twice"),
    "no id": (osm("<node lat='1' lon='1'/>"), "'node' has no 'id'"),
    "no ref": (osm("<way id='10'><nd/></way>"), "'nd' has no 'ref'"),
    "no value": (osm("<way id='10'><tag k='type'/></way>"), "'tag' has no 'v'"),
    "a crosswalk without a bound": (
        osm(relation(20, {"left": 12}, type="lanelet", subtype="crosswalk")),
        "crosswalk '20' has no left bound",
    ),
    "a crosswalk with a bound in two pieces": (
        osm(
            way(12, [1, 2])
            + way(13, [2, 3])
            + way(14, [4, 3])
            + "<relation id='20'><member type='way' ref='12' role='left'/>"
            "<member type='way' ref='13' role='left'/><member type='way' ref='14' role='right'/>"
            "<tag k='subtype' v='crosswalk'/></relation>"
        ),
        "crosswalk '20' has several left bounds",
    ),
    "one bound of many crosswalks": (
        osm(
            way(10, [1, 2] * 50)
            + "".join(
                relation(number, {"left": 10, "right": 10}, type="lanelet", subtype="crosswalk")
                for number in range(100)
            )
        ),
        "its crosswalks share their bounds too often",
    ),
    "nothing of use": (osm(way(10, [1, 2], type="power")), "has no element of .*class 'power'"),
    "far away": (
        osm(way(10, [1, 3], type="line_thin"), NODES.replace("v='7'", "v='1e12'")),
        r"reaches 1e\+12 m",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE_OSM)
def test_hostile_lanelet2_maps_end_in_one_line(tmp_path, name):
    content, message = HOSTILE_OSM[name]
    path = tmp_path / "map.osm"
    path.write_text(content)
    with pytest.raises(ValueError, match=message) as error:
        read_map(path, CLASSES)
    assert "map.osm" in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400


@pytest.mark.parametrize("suffix", ["geojson", "osm"])
def test_maps_with_too_many_vertices_are_refused(tmp_path, monkeypatch, suffix):
    monkeypatch.setattr("drivemaps.map_reading._MOST_VERTICES", 3)
    monkeypatch.setattr("drivemaps.lanelet2_reading._MOST_PARTS", 8)
    path = tmp_path / f"map.{suffix}"
    if suffix == "osm":
        path.write_text(osm(way(10, [1, 2, 3, 4, 1], type="line_thin")))
    else:
        path.write_text(geojson([divider([*LINE, *LINE])], crs=None))
    with pytest.raises(ValueError, match=r"has more than \d (vertices|nodes and references)"):
        read_map(Path(path), CLASSES)


@pytest.mark.parametrize("score", [math.nan, math.inf, -1, 7, True, "high", None, 10**400])
def test_other_scores_of_strangers_are_not_used(tmp_path, score):
    path = tmp_path / "town.geojson"
    path.write_text(geojson([feature("LineString", LINE, **{"class": "divider", "score": score})]))
    path.write_text(path.read_text().replace("{", '{"crs": null, ', 1))
    found, _ = read_map(path, CLASSES)
    assert found.scores.tolist() == [1.0]


@pytest.mark.parametrize(
    ("text", "score"),
    [("0.3", 0.3), ("1", 1.0), ("0", 0.0), ("nan", 1.0), ("7", 1.0), ("high", 1.0), ("", 1.0)],
)
def test_scores_of_lines_and_crosswalks_of_lanelet2_maps_are_read(tmp_path, text, score):
    path = tmp_path / "town.osm"
    body = [
        way(10, [1, 2], type="line_thin", score=text),
        way(11, [4, 3], type="virtual"),
        way(12, [1, 2], type="virtual"),
        relation(20, {"left": 12, "right": 11}, type="lanelet", subtype="crosswalk", score=text),
    ]
    path.write_text(osm("".join(body)))
    assert read_map(path, CLASSES).elements.scores.tolist() == [score, score]
