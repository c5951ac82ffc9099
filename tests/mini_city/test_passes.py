"""Several passes of the same streets, of which some are repainted before the last one."""

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from nuscenes.map_expansion.map_api import NuScenesMap
from nuscenes.nuscenes import NuScenes

from gsmap.datasets.annotations.file import AnnotationFile
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes
from mapdata.nuscenes.map import open_map
from minicity import devkit_plots
from minicity.config import MiniCityConfig
from minicity.generate import _splits, generate, plan_scenes
from minicity.map_expansion import town_to_map
from minicity.repaint import Change, list_changes, repaint_town
from minicity.roads import CrossSection, Road, RoadStyle
from minicity.town import Town, make_town

TINY = {"image_size": (128, 72), "samples_per_scene": 1, "sweeps_per_sample": 0, "progress": False}
PASSES = {"scenes": 4, "seed": 5, "passes": 3, "repainted": 0.5}
VAL_TOWN = "boston-seaport"


def digests(root: Path) -> dict[str, str]:
    """Digest of each file in a folder, by its path."""
    found = {}
    for path in sorted(root.rglob("*")):
        if path.is_file():
            found[str(path.relative_to(root))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def nodes_of(content: dict) -> dict[str, tuple[float, float]]:
    """Coordinates of the nodes of a map, by token."""
    return {node["token"]: (node["x"], node["y"]) for node in content["node"]}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("passes") / "root"
    assert generate(root, workers=0, **PASSES, **TINY)
    options = NuScenesOptions(root=root, version="v1.0-trainval", dataset="minicity")
    convert_nuscenes(options)
    return root


@pytest.fixture(scope="module", params=range(4))
def towns(request: pytest.FixtureRequest) -> tuple[Town, Town, list[Change]]:
    before = make_town(VAL_TOWN, request.param, 6)
    after, changes = repaint_town(before, request.param, share=0.6)
    return before, after, changes


def shapes(town: Town, layer: str, link: str) -> dict[bytes, shapely.Geometry]:
    """Geometries of a layer of a town's map, by their coordinates."""
    content = town_to_map(town, 0)
    nodes = nodes_of(content)
    linked_records = {record["token"]: record for record in content[link]}
    key = "node_tokens" if link == "line" else "exterior_node_tokens"
    found = {}
    for record in content[layer]:
        linked_record = linked_records[record[f"{link}_token"]]
        points = np.array([nodes[token] for token in linked_record[key]])
        shape = shapely.LineString(points) if link == "line" else shapely.Polygon(points)
        found[points.tobytes()] = shape
    return found


def lengths(changes: list[Change], kind: str, class_name: str) -> float:
    """Total length of the changed lines or outlines of a kind and class."""
    total = 0.0
    for change in changes:
        if (change.kind, change.class_name) == (kind, class_name):
            points = change.before if change.after is None else change.after
            total += shapely.LineString(points).length
    return total


def test_the_map_of_a_town_without_passes_has_not_changed() -> None:
    nodes = town_to_map(make_town(VAL_TOWN, 3, 6), 3)["node"]
    digest = hashlib.sha256(json.dumps(nodes).encode()).hexdigest()
    # Of the towns before there were passes; coordinates are rounded to 0.1 mm.
    assert digest[:16] == "90dd690230b22496"


def test_one_pass_is_the_data_set_without_passes(tmp_path: Path, root: Path) -> None:
    arguments = {"scenes": PASSES["scenes"], "seed": PASSES["seed"]}
    generate(tmp_path / "plain", workers=0, **arguments, **TINY)
    generate(tmp_path / "one", workers=0, passes=1, **arguments, **TINY)
    plain = digests(tmp_path / "plain")
    assert plain == digests(tmp_path / "one")
    for name in plain:
        assert "passes" not in name
        assert "splits" not in name
    first_pass = digests(root)
    names = []
    for name in plain:
        if name.startswith("samples/LIDAR") and "scene-0003" not in name:
            names.append(name)
    assert len(names) == 3
    for name in names:  # training scenes; those of validation are later than in one pass
        assert first_pass[name] == plain[name]


def test_passes_have_equal_bytes_in_one_process_and_in_two(tmp_path: Path, root: Path) -> None:
    generate(tmp_path / "two", workers=2, **PASSES, **TINY)
    other = digests(tmp_path / "two")
    own = digests(root)
    for name in list(own):
        if name.endswith(".arrow"):  # converted annotations, which only one of them has
            del own[name]
    assert own == other


def test_passes_follow_one_street_in_other_light_and_traffic(root: Path) -> None:
    nusc = NuScenes("v1.0-trainval", str(root), verbose=False)
    table = json.loads((root / "v1.0-trainval/passes.json").read_text())
    assert len(table) == len(nusc.scene) == 12
    by_street: dict[str, list[dict]] = {}
    for record in table:
        by_street.setdefault(record["first_scene"], []).append(record)
    assert len(by_street) == 4
    for records in by_street.values():
        assert [record["pass"] for record in records] == [1, 2, 3]
        assert len({record["location"] for record in records}) == 1
        times = []
        places = []
        traffic = []
        for record in records:
            scene = nusc.get("scene", record["scene_token"])
            assert scene["name"] == record["scene"]
            sample = nusc.get("sample", scene["first_sample_token"])
            data = nusc.get("sample_data", sample["data"]["LIDAR_TOP"])
            pose = nusc.get("ego_pose", data["ego_pose_token"])
            boxes = [nusc.get("sample_annotation", token) for token in sample["anns"]]
            times.append(sample["timestamp"])
            places.append(np.array(pose["translation"][:2]))
            traffic.append([box["translation"] for box in boxes])
        assert times == sorted(set(times))
        for place in places[1:]:
            assert 0 < np.linalg.norm(place - places[0]) < 6.0
        assert traffic[0] != traffic[1]
        assert traffic[1] != traffic[2]


def test_last_passes_of_validation_are_a_split_in_the_frame_of_the_earlier_ones(
    root: Path,
) -> None:
    val = AnnotationFile(root / "gsmap_minicity_val.arrow")
    earlier = AnnotationFile(root / "gsmap_minicity_val_earlier.arrow")
    train = AnnotationFile(root / "gsmap_minicity_train.arrow")
    assert (len(val), len(earlier), len(train)) == (1, 2, 9)
    assert {sample.map_name for sample in (*val, *earlier)} == {VAL_TOWN}
    last_ns = max(sample.timestamp_ns for sample in earlier)
    assert all(sample.timestamp_ns > last_ns for sample in val)
    expansions = []
    for log in json.loads((root / "v1.0-trainval/log.json").read_text()):
        if log["location"] == VAL_TOWN:
            expansions.append(log.get("map_expansion"))
    assert expansions == [f"{VAL_TOWN}.before", f"{VAL_TOWN}.before", None]


def test_annotations_of_each_pass_follow_the_paint_of_its_time(root: Path) -> None:
    train = AnnotationFile(root / "gsmap_minicity_train.arrow")
    logs = json.loads((root / "v1.0-trainval/log.json").read_text())
    log_by_token = {log["token"]: log for log in logs}
    scenes = json.loads((root / "v1.0-trainval/scene.json").read_text())
    log_of = {scene["name"]: log_by_token[scene["log_token"]] for scene in scenes}
    checked = 0
    for sample in train:
        log = log_of[sample.scene]
        name = log.get("map_expansion", log["location"])
        content = json.loads((root / f"maps/expansion/{name}.json").read_text())
        nodes = nodes_of(content)
        lines = []
        for record in content["line"]:
            points = [nodes[token] for token in record["node_tokens"]]
            lines.append(shapely.LineString(points))
        dividers = shapely.union_all(lines)
        for instance in sample.instances:
            if instance.label == 0:
                flat = np.pad(instance.points[:, :2], ((0, 0), (0, 1)))
                flat = np.pad(flat, ((0, 0), (0, 1)), constant_values=1.0)
                points = (flat @ sample.global_from_frame.T)[:, :2]
                assert shapely.distance(dividers, shapely.points(points)).max() < 0.15  # tilt
                checked += 1
    assert checked > 10


@pytest.mark.skipif(
    np.lib.NumpyVersion(np.__version__) >= "2.4.0",
    reason="nuscenes-devkit 1.2.0 draws maps with numpy < 2.4 alone (docs/install.md)",
)
def test_a_drawn_map_has_the_paint_of_its_time(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = []

    def open_named(folder: Path, name: str) -> NuScenesMap:
        opened.append(name)
        return open_map(folder, name)

    monkeypatch.setattr(devkit_plots, "open_map", open_named)
    nusc = NuScenes("v1.0-trainval", str(root), verbose=False)
    of_town = []  # numbers of the town's samples
    for number, sample in enumerate(nusc.sample):
        scene = nusc.get("scene", sample["scene_token"])
        log = nusc.get("log", scene["log_token"])
        if log["location"] == VAL_TOWN:
            of_town.append(number)
    for number in (of_town[0], of_town[-1]):
        devkit_plots.run(argparse.Namespace(root=str(root), out=tmp_path, sample=number))
    assert opened == [f"{VAL_TOWN}.before", VAL_TOWN]


def test_a_share_of_the_streets_is_repainted(towns: tuple[Town, Town, list[Change]]) -> None:
    before, after, changes = towns
    pairs = zip(before.roads, after.roads, strict=True)
    repainted = {old.index for old, new in pairs if old is not new}
    assert len(repainted) == round(0.6 * len(before.roads))
    assert {change.street for change in changes} == repainted
    assert repaint_town(before, 9, share=0.0)[1] == []


def test_changes_are_the_difference_of_both_maps(towns: tuple[Town, Town, list[Change]]) -> None:
    before, after, changes = towns
    old = shapes(before, "ped_crossing", "polygon")
    new = shapes(after, "ped_crossing", "polygon")
    removed = sum(old[key].length for key in old.keys() - new.keys())
    added = sum(new[key].length for key in new.keys() - old.keys())
    assert lengths(changes, "removed", "ped_crossing") == pytest.approx(removed, abs=1e-2)
    assert lengths(changes, "added", "ped_crossing") == pytest.approx(added, abs=1e-2)
    for layer in ("road_divider", "lane_divider"):
        old = shapes(before, layer, "line")
        new = shapes(after, layer, "line")
        lost = shapely.union_all([old[key] for key in old.keys() - new.keys()])
        # Every lost piece of a divider is in the list, or still painted (a longer or shorter line).
        explained = [shapely.union_all(list(new.values())).buffer(0.01)]
        for change in changes:
            if change.class_name == "divider" and change.before is not None:
                explained.append(shapely.LineString(change.before).buffer(0.01))
        assert lost.difference(shapely.union_all(explained)).length < 0.05
    for layer in ("walkway", "carpark_area"):
        assert shapes(before, layer, "polygon").keys() == shapes(after, layer, "polygon").keys()


def straight_road(**values: object) -> Road:
    """Two lanes each way from (0, 0) to (80, 0), with a parking strip on the left."""
    section = CrossSection(
        forward=2, backward=2, lane_m=3.5, median_m=0.0, right_shoulder_m=0.3, left_shoulder_m=2.3
    )
    style = RoadStyle("white", (3.0, 3.0), 0.15, False, "zebra", 0.0, 80.0, 2.0)
    center = np.column_stack([np.linspace(0, 80, num=17), np.zeros(17)])
    return Road(0, 0, 1, center=center, section=section, style=style, **values)


def test_moved_dividers_keep_kerbs_and_outer_edges() -> None:
    before = straight_road()
    after = straight_road(shift_m=1.0)
    assert after.forward_edges == [1.0, -2.5, -7.0]
    assert after.backward_edges == [1.0, 4.5, 7.0]
    changes = list_changes(before, after)
    assert [change.kind for change in changes] == ["moved"] * 3
    for change, offset in zip(changes, (0.0, -3.5, 3.5), strict=True):
        np.testing.assert_allclose(change.before[:, 1], offset)
        np.testing.assert_allclose(change.after[:, 1], offset + 1)
    lanes = [lane.center[0, 1] for lane in after.lanes()]
    np.testing.assert_allclose(lanes, [-0.75, -4.75, 2.75, 5.75])


def test_a_crossing_in_the_middle_cuts_the_dividers() -> None:
    changes = list_changes(straight_road(), straight_road(crossings=[(38.0, 42.0)]))
    kinds = [(change.kind, change.class_name) for change in changes]
    assert kinds == [("added", "ped_crossing"), *[("removed", "divider")] * 3]
    outline = changes[0].after
    np.testing.assert_allclose(outline[0], outline[-1])
    assert shapely.Polygon(outline).bounds == pytest.approx((38.0, -7.3, 42.0, 9.3))
    np.testing.assert_allclose(changes[1].before[[0, -1], 0], [37.6, 42.4])
    feature = changes[1].feature("town")
    assert feature["properties"] == {
        "change": "removed",
        "class": "divider",
        "map": "town",
        "street": 0,
    }
    assert feature["geometry"]["type"] == "LineString"


def test_a_removed_crossing_in_the_middle_joins_the_dividers() -> None:
    changes = list_changes(straight_road(crossings=[(38.0, 42.0)]), straight_road())
    kinds = [(change.kind, change.class_name) for change in changes]
    assert kinds == [("removed", "ped_crossing"), *[("added", "divider")] * 3]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"passes": 0}, "passes must be in 1..20, got 0"),
        ({"passes": 2, "repainted": 1.5}, "share in 0..1, got 1.5"),
        ({"passes": 2, "repainted": float("nan")}, "share in 0..1, got nan"),
        ({"repainted": 0.5}, "passes >= 2"),
        ({"scenes": 400, "passes": 4}, "got 1280 and 320"),
        ({"passes": 3, "new_passes": 3}, "new_passes must be in 1..2, as one pass is driven"),
        ({"passes": 3, "new_passes": 0}, "new_passes must be in 1..2"),
        ({"new_passes": 2}, "new_passes must be in 1..1"),
    ],
)
def test_values_out_of_range_are_refused(values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MiniCityConfig(**{"scenes": 4, **values})


def test_new_passes_have_the_new_paint_and_are_for_validation() -> None:
    config = MiniCityConfig(scenes=2, passes=5, new_passes=2, repainted=0.1)
    tasks = plan_scenes(config)
    val = [task for task in tasks if task.location == VAL_TOWN]
    new = [task.expansion == VAL_TOWN for task in val]
    assert new == [False, False, False, True, True]
    splits = _splits(config, tasks)
    assert splits["val"] == [task.name for task in val[3:]]
    assert splits["val_earlier"] == [task.name for task in val[:3]]
    assert len(splits["train"]) == 5
    assert config.as_dict()["new_passes"] == 2
    assert "new_passes" not in MiniCityConfig(scenes=2, passes=5).as_dict()


def test_another_number_of_passes_is_another_data_set(root: Path) -> None:
    arguments = {**PASSES, "passes": 1, "repainted": 0.0}
    with pytest.raises(ValueError, match=r"passes is 3, asked for 1, repainted is 0.5, asked"):
        generate(root, workers=0, **arguments, **TINY)


@pytest.mark.parametrize("name", [7, ["boston-seaport"], None])
def test_a_map_file_without_a_name_is_refused(root: Path, tmp_path: Path, name: object) -> None:
    copy = tmp_path / "copy"
    (copy / "v1.0-trainval").mkdir(parents=True)
    for path in (root / "v1.0-trainval").iterdir():
        (copy / "v1.0-trainval" / path.name).write_bytes(path.read_bytes())
    (copy / "maps").symlink_to(root / "maps")
    logs = json.loads((root / "v1.0-trainval/log.json").read_text())
    logs[0]["map_expansion"] = name
    (copy / "v1.0-trainval/log.json").write_text(json.dumps(logs))
    options = NuScenesOptions(root=copy, version="v1.0-trainval", dataset="minicity")
    with pytest.raises(ValueError, match=r"log.json, record .*: map_expansion must be a str, got"):
        convert_nuscenes(options)
