"""Precision and recall of changes, worked by hand, and files of changes of strangers."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_files import command, results_of

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta, MapInstance, MapSample
from gsmap.evaluation.analysis.change_files import MapChange, read_changes
from gsmap.evaluation.analysis.changes import change_figures, with_map_names
from gsmap.evaluation.analysis.groups import read_groups
from gsmap.evaluation.core.results_json import write_results

RING = [[0.0, 0.0], [8.0, 0.0], [8.0, 3.0], [0.0, 3.0], [0.0, 0.0]]


def feature(change: str, name: str, points: list, **properties: object) -> dict:
    """Feature of a file of changes; closed points are a polygon."""
    geometry = {"type": "LineString", "coordinates": points}
    if points[0] == points[-1]:
        geometry = {"type": "Polygon", "coordinates": [points]}
    values = {"change": change, "class": name, "map": "town", **properties}
    return {"type": "Feature", "properties": values, "geometry": geometry}


def written(path: Path, *features: dict, **members: object) -> Path:
    content = {"type": "FeatureCollection", "crs": None, **members, "features": list(features)}
    path.write_text(json.dumps(content))
    return path


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Six samples one metre apart at x = 0 to 5, heading along +y; they see y = -30 to 30."""
    samples = []
    for i in range(6):
        pose = np.eye(4)
        pose[0, 3] = i
        line = np.array([[0.0, -20.0], [0.0, 20.0]], np.float32)
        samples.append(
            MapSample(f"t{i}", "s0", "town", i, [], pose, instances=[MapInstance(0, line)])
        )
    write_annotations(tmp_path / "val.arrow", AnnotationMeta("own", "lidar", "val"), samples)
    return tmp_path / "val.arrow"


def figures_of(tmp_path: Path, drive: Path, found: list[dict], truth: list[dict]) -> dict:
    changes = read_changes(written(tmp_path / "found.geojson", *found))
    true_changes = read_changes(written(tmp_path / "truth.geojson", *truth))
    return change_figures(changes, true_changes, AnnotationFile(drive))


def line_at(x: float, low: float = -20.0, high: float = 20.0) -> list:
    return [[x, low], [x, high]]


def test_a_file_without_poses_is_refused(tmp_path, drive):
    file = AnnotationFile(drive)
    meta = replace(file.meta, options={"poses": False})
    write_annotations(tmp_path / "val.arrow", meta, list(file))
    with pytest.raises(ValueError, match="knows no poses, which changes need"):
        figures_of(tmp_path, drive, [], [])


def test_precision_and_recall_of_a_street(tmp_path, drive):
    """A removed line at x = 0, an added crossing; one is found, one is invented."""
    truth = [feature("removed", "divider", line_at(0.0)), feature("added", "ped_crossing", RING)]
    found = [
        feature("removed", "divider", line_at(1.2), confidence=0.9),
        feature("removed", "divider", line_at(6.0), confidence=0.5),
    ]
    figures = figures_of(tmp_path, drive, found, truth)
    assert figures["removed/precision"] == 0.5
    assert figures["removed/recall"] == 1.0
    assert figures["added/precision"] == -1.0  # nothing is said to be added
    assert figures["added/recall"] == 0.0
    assert figures["all/precision"] == 0.5
    assert figures["all/recall"] == 0.5
    assert (figures["all/num_found"], figures["all/num_true"]) == (2, 2)
    assert figures["all/precision_at_recall_0.6"] == -1.0
    found.append(feature("added", "ped_crossing", RING, confidence=0.7))
    figures = figures_of(tmp_path, drive, found, truth)
    assert figures["all/precision"] == pytest.approx(2 / 3)
    assert figures["all/recall"] == 1.0
    assert figures["all/precision_at_recall_0.6"] == 1.0  # at a confidence of 0.7


def test_pieces_of_a_line_find_it_together(tmp_path, drive):
    truth = [feature("removed", "divider", line_at(0.0))]
    pieces = [
        feature("removed", "divider", line_at(0.0, -20, -9), confidence=0.8),
        feature("removed", "divider", line_at(0.0, 9, 20), confidence=0.3),
    ]
    assert figures_of(tmp_path, drive, pieces[:1], truth)["all/recall"] == 0.0  # 12.5 of 40 m
    figures = figures_of(tmp_path, drive, pieces, truth)
    assert figures["all/recall"] == 1.0
    assert figures["all/precision"] == 1.0
    assert figures["all/precision_at_recall_0.6"] == 1.0


def test_a_moved_line_is_no_removed_line_except_for_any_kind(tmp_path, drive):
    moved = feature("moved", "divider", line_at(4.0), moved_m=4.0, old=line_at(0.0))
    found = [feature("removed", "divider", line_at(0.0)), feature("added", "divider", line_at(4.0))]
    figures = figures_of(tmp_path, drive, found, [moved])
    assert figures["all/precision"] == 0.0
    assert figures["all/recall"] == 0.0
    assert figures["any_kind/precision"] == 1.0
    assert figures["any_kind/recall"] == 1.0
    assert figures_of(tmp_path, drive, [moved], [moved])["moved/recall"] == 1.0


def test_changes_out_of_view_short_or_on_other_maps_need_not_be_found(tmp_path, drive):
    truth = [
        feature("removed", "divider", line_at(200.0)),
        feature("removed", "divider", line_at(0.0, 26, 70)),  # 4 m of it are in range
        feature("removed", "divider", line_at(0.0, 0, 4)),
        feature("added", "divider", line_at(-12.0)),  # in range of four samples
        feature("removed", "divider", line_at(0.0), map="other town"),
        feature("added", "ped_crossing", [[x, y + 29] for x, y in RING]),  # a part of its outline
    ]
    figures = figures_of(
        tmp_path, drive, [feature("removed", "divider", line_at(0.0, 0, 4))], truth
    )
    assert figures["all/num_true"] == 0
    assert figures["all/recall"] == -1.0
    assert figures["all/precision"] == 1.0  # a short change may be found


def test_a_class_is_compared(tmp_path, drive):
    truth = [feature("removed", "divider", line_at(0.0))]
    figures = figures_of(tmp_path, drive, [feature("removed", "boundary", line_at(0.0))], truth)
    assert figures["any_kind/precision"] == figures["any_kind/recall"] == 0.0


def test_nothing_found_and_nothing_true(tmp_path, drive):
    figures = figures_of(tmp_path, drive, [], [])
    assert set(figures.values()) == {-1.0, 0.0}


def test_the_only_map_needs_no_name(tmp_path, drive):
    nameless = feature("removed", "divider", line_at(0.0))
    del nameless["properties"]["map"]
    truth = [feature("removed", "divider", line_at(0.0))]
    assert figures_of(tmp_path, drive, [nameless], truth)["all/precision"] == 1.0
    elsewhere = feature("removed", "divider", line_at(0.0), map="another")
    with pytest.raises(
        ValueError, match=r"on the map 'another', and the samples are on \['town'\]"
    ):
        figures_of(tmp_path, drive, [elsewhere], truth)


def test_the_only_map_must_be_the_only_one(tmp_path):
    samples = [MapSample(f"t{i}", "s", f"m{i}", i, [], np.eye(4), instances=[]) for i in range(2)]
    write_annotations(tmp_path / "val.arrow", AnnotationMeta("own", "lidar", "val"), samples)
    nameless = feature("removed", "divider", line_at(0.0))
    del nameless["properties"]["map"]
    with pytest.raises(ValueError, match="found changes has changes without the property `map`"):
        figures_of(tmp_path, tmp_path / "val.arrow", [nameless], [])


def test_samples_are_grouped_by_a_change_in_their_range(tmp_path, drive):
    changes = written(tmp_path / "c.geojson", feature("added", "divider", line_at(-12.5)))
    groups = read_groups(drive, str(changes)).group_of
    assert [groups[f"t{i}"] for i in range(6)] == ["changed"] * 3 + ["unchanged"] * 3
    moved = feature("moved", "divider", line_at(99.0), old=line_at(18.5), moved_m=1.0)
    written(changes, moved)
    groups = read_groups(drive, str(changes)).group_of
    assert [groups[f"t{i}"] for i in range(6)] == ["unchanged"] * 4 + ["changed"] * 2
    written(changes, feature("added", "divider", line_at(0.0), map="other"))
    assert set(read_groups(drive, str(changes)).group_of.values()) == {"unchanged"}


def test_the_command_scores_changes_and_groups(tmp_path, drive, capsys):
    truth = written(tmp_path / "truth.geojson", feature("added", "divider", line_at(-12.5)))
    found = written(tmp_path / "f.geojson", feature("added", "divider", line_at(-12.0)))
    out = tmp_path / "figures.json"
    command()([str(found), str(drive), "--changes", str(truth), "--out", str(out)])
    assert "| added | 100.0 | - | 1 | 0 |" in capsys.readouterr().out
    assert json.loads(out.read_text())["changes/all/precision"] == 1.0
    write_results(tmp_path / "r.json", results_of(6))
    words = [str(tmp_path / "r.json"), str(drive), "--eval", "chamfer", "--by", str(truth)]
    command()(words)
    text = capsys.readouterr().out
    assert "| changed | 3 |" in text
    assert "| unchanged | 3 |" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["f.geojson", "val.arrow"], "give the true ones as --changes"),
        (["r.json", "val.arrow", "--changes", "t.geojson"], "scores a file of changes"),
        (["f.geojson", "val.arrow", "--changes", "t", "--by", "map"], "--by applies to elements"),
        (["f.geojson", "val.arrow", "--changes", "t", "--shard", "0/2", "--out", "o"], "--shard"),
    ],
)
def test_options_that_do_not_fit_are_refused(words, message, capsys):
    with pytest.raises(SystemExit):
        command()(words)
    assert message in capsys.readouterr().err


def test_changes_on_a_grid_whose_eastings_begin_with_the_zone_are_read(tmp_path):
    points = [[39_512_000.0, 4_400_000.0], [39_512_009.0, 4_400_000.0]]
    (change,) = read_changes(written(tmp_path / "f.geojson", feature("added", "divider", points)))
    assert change.points.tolist() == points


LINE = {"type": "LineString", "coordinates": [[0, 0], [0, 9]]}
GOOD = {"type": "Feature", "properties": {"change": "added", "class": "divider"}, "geometry": LINE}


def altered(geometry: object = LINE, **properties: object) -> dict:
    return {**GOOD, "properties": {**GOOD["properties"], **properties}, "geometry": geometry}


def line_of(*points: object) -> dict:
    return {"type": "LineString", "coordinates": list(points)}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (7, "feature 0: it is no object with properties"),
        ({"type": "Feature", "geometry": LINE}, "it is no object with properties"),
        (altered(change="painted"), "`change` must be one of removed, added, moved, got 'painted'"),
        (altered(change=["added"]), "`change` must be one of"),
        (
            altered(**{"class": "a\x1b[2J"}),
            "`class` must be a printable name of at most 80",
        ),
        (altered(**{"class": "a" * 81}), "`class` must be a printable name"),
        (altered(**{"map": 3}), "`map` must be a printable name"),
        (altered(confidence=float("nan")), r"`confidence` must be a number in \[0, 1\], got nan"),
        (altered(confidence=True), "`confidence` must be a number"),
        (altered(confidence="high"), "`confidence` must be a number"),
        (altered(None), "its geometry must be a LineString or a Polygon, got None"),
        (altered({"type": "Point", "coordinates": [0, 0]}), "got 'Point'"),
        (altered({"type": "LineString"}), "no list of two or more positions"),
        (altered(line_of([0, 0])), "no list of two or more positions"),
        (altered(line_of([0, 0], 3)), "a position has fewer than two coordinates"),
        (altered(line_of([0, 0], [1])), "a position has fewer than two coordinates"),
        (altered(line_of([0, 0], [1, float("inf")])), "coordinates must be metres within 1e[+]08"),
        (altered(line_of([0, 0], [1, 10**400])), "coordinates must be metres"),
        (altered(line_of([0, 0], [1, "2"])), "coordinates must be metres"),
        (altered(line_of([0, 0], [1, 5e6])), "the changes are longer than 1000 km"),
        (altered({"type": "Polygon", "coordinates": []}), "its polygon has no ring"),
        (altered({"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1]]]}), "is not closed"),
        (altered(change="moved", old=[[0, 0]]), "no list of two or more positions"),
        (altered(change="moved", old=[[0, 0], [0, 9e6]]), "the changes are longer than"),
    ],
)
def test_a_damaged_feature_is_named(content, message, tmp_path):
    path = written(tmp_path / "c.geojson", content)
    with pytest.raises(ValueError, match=message) as error:
        read_changes(path)
    assert "feature 0" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty or holds no complete list"),
        ('{"type": "FeatureCollection", "crs": null}', "holds .* no list under 'features'"),
        ('{"crs": null, "features": [' + "[" * 100_000, "holds no complete list"),
        ('{"features": []}', "no coordinates in metres"),
        ('{"features": [], "crs": {"type": "name"}}', "no coordinates in metres"),
        ('{"crs": null, "features": [', "holds no complete list"),
    ],
)
def test_a_file_of_another_form_is_refused(text, message, tmp_path):
    path = tmp_path / "c.geojson"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        read_changes(path)
    assert "\n" not in str(error.value)


def test_a_change_without_a_map_needs_exactly_one_map():
    points = np.array([[0.0, 0.0], [0.0, 5.0]])
    change = MapChange("added", "divider", "", points, old_points=None, confidence=1.0)
    assert [c.map_name for c in with_map_names([change], ["town"], "f")] == ["town"]
    for names in ([], ["town", "other"]):
        with pytest.raises(ValueError, match=f"has {len(names)} maps: name one for each change"):
            with_map_names([change], names, "f")
