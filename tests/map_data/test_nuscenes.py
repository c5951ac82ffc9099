"""The nuScenes converter: the reference's vectors, splits, clear errors, counted omissions."""

import argparse
import json
import tarfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
import shapely.affinity
from processes import run_tool

from gsmap.datasets.annotations.file import AnnotationFile, AnnotationWriter
from gsmap.datasets.annotations.record import MapSample
from mapdata.lane_graph import link_lanes
from mapdata.nuscenes import convert as nuscenes
from mapdata.nuscenes.convert import NuScenesOptions, add_arguments, convert_nuscenes, run
from mapdata.nuscenes.map import MapLayers, NuScenesLocalMap
from mapdata.vectors_json import write_vectors

REPO = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def reference_root(golden_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("reference")
    with tarfile.open(golden_dir / "data/E6_mini_root_A.tar.gz") as archive:
        archive.extractall(target)
    return target / "root_A"


def square(x: float, y: float, size: float) -> shapely.Polygon:
    return shapely.box(x, y, x + size, y + size)


def local_map(
    classes: tuple[str, ...], crossings: str = "united", **layers: list
) -> NuScenesLocalMap:
    lines = layers.pop("road_divider", [])
    polygons = {name: np.array(geometries, object) for name, geometries in layers.items()}
    for name in classes:
        if name not in ("divider", "boundary"):
            polygons.setdefault(name, np.empty(0, object))
    return NuScenesLocalMap(MapLayers(lines, polygons, Counter()), classes, crossings=crossings)


def pose(x: float, y: float, yaw_deg: float) -> np.ndarray:
    cos, sin = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, 2], [0, 0, 0, 1.0]])


def test_a_divider_is_cut_and_turned_into_the_frame():
    """The frame's x axis points along the map's +y; the line runs along the map's y."""
    line = shapely.LineString([[100, -50], [100, 50]])
    town = local_map(("divider",), road_divider=[line])
    (found,) = town.instances(pose(105, 0, 90))
    np.testing.assert_allclose(found.points, [[-15, 5], [15, 5]], atol=1e-9)


def test_overlapping_crossings_unite_and_close_at_the_patch():
    town = local_map(("ped_crossing",), ped_crossing=[square(10, 0, 4), square(12, 0, 10)])
    (found,) = town.instances(pose(0, 0, 0))
    np.testing.assert_array_equal(found.points[0], found.points[-1])
    assert shapely.Polygon(found.points).area == pytest.approx(4 * 2 + 3 * 10)
    assert found.points[:, 0].max() == pytest.approx(15)
    assert not shapely.is_ccw(shapely.LinearRing(found.points))


def crossing_lines(rule: str, crossings: list[shapely.Polygon], *at: float) -> list[np.ndarray]:
    """Return the lines of crossings by a rule, at a pose (x, y, degrees)."""
    town = local_map(("ped_crossing",), crossings=rule, ped_crossing=crossings)
    return [instance.points for instance in town.instances(pose(*at))]


def test_edges_are_the_two_longest_of_each_crossing_and_never_united():
    """Two crossings overlap; the second is cut by the patch at x = 15.

    ::

        y = 3   +-----------+   +----|--+      the edges of 8 m and of 9 m,
        y = 0   +-----------+---+----|--+      each cut at x = 15
                2          10   9   15  18
    """
    lines = crossing_lines("edges", [shapely.box(2, 0, 10, 3), shapely.box(9, 0, 18, 3)], 0, 0, 0)
    found = {tuple(sorted(map(tuple, line.round(6).tolist()))) for line in lines}
    assert found == {
        ((2, 0), (10, 0)), ((2, 3), (10, 3)), ((9, 0), (15, 0)), ((9, 3), (15, 3)),
    }  # fmt: skip
    assert all(len(line) == 2 for line in lines)


def test_edges_turn_with_the_frame_and_the_longer_one_comes_second():
    slanted = shapely.Polygon([(0, 0), (6, 0), (5, 2), (0, 2)])
    first, second = crossing_lines("edges", [slanted], 0, 0, 90)
    np.testing.assert_allclose(sorted(first.round(6).tolist()), [[2, -5], [2, 0]])
    np.testing.assert_allclose(sorted(second.round(6).tolist()), [[0, -6], [0, 0]])


def test_parallel_crossings_unite_and_stay_open_where_the_patch_cuts_them():
    """Two halves of one crossing become one ring; one across the edge ends 0.2 m inside.

    ::

        y = 2   +-----+-----+      +---|--+
                |     |     |      |   |         open at x = 14.8
        y = 0   +-----+-----+      +---|--+
                0     3     6     12  15  20
    """
    halves = [shapely.box(0, 0, 3, 2), shapely.box(3, 0, 6, 2), shapely.box(12, 0, 20, 2)]
    whole, cut = sorted(crossing_lines("parallel", halves, 0, 0, 0), key=lambda p: p[:, 0].min())
    np.testing.assert_array_equal(whole[0], whole[-1])
    assert shapely.Polygon(whole).area == pytest.approx(12)
    assert shapely.is_ccw(shapely.LinearRing(whole))
    np.testing.assert_allclose(sorted(cut[[0, -1]].round(6).tolist()), [[14.8, 0], [14.8, 2]])
    assert len(cut) == 4


def test_crossings_at_right_angles_stay_two_by_the_rule_of_parallel_ones():
    two = [shapely.box(0, 0, 8, 2), shapely.box(3, -6, 5, 1)]
    assert len(crossing_lines("parallel", two, 0, 0, 0)) == 2
    assert len(crossing_lines("united", two, 0, 0, 0)) == 1
    turned = [shapely.box(0, 0, 8, 2), shapely.affinity.rotate(shapely.box(6, 0, 14, 2), 9)]
    assert len(crossing_lines("parallel", turned, 0, 0, 0)) == 2  # beyond 8 degrees


def test_no_crossing_near_gives_no_line_and_an_unknown_rule_is_refused():
    for rule in ("united", "edges", "parallel"):
        assert crossing_lines(rule, [square(90, 90, 4)], 0, 0, 0) == []
        assert crossing_lines(rule, [], 0, 0, 0) == []
    with pytest.raises(ValueError, match=r"crossings must be one of .*got 'round'"):
        crossing_lines("round", [], 0, 0, 0)


def test_a_boundary_is_the_outline_of_road_and_lanes_without_the_patch_s_edges():
    """Two road cells side by side: their common edge is no boundary; both long sides are.

    ::

        y = 5   +------+------+
                |      |      |     the patch ends at x = -14.8 and 14.8
        y = -5  +------+------+
               -50     0      50
    """
    road = [shapely.box(-50, -5, 0, 5), shapely.box(0, -5, 50, 5)]
    town = local_map(("boundary",), road_segment=road, lane=[])
    lines = sorted(instance.points[:, 1].mean() for instance in town.instances(pose(0, 0, 0)))
    np.testing.assert_allclose(lines, [-5, 5])
    for instance in town.instances(pose(0, 0, 0)):
        assert sorted(instance.points[[0, -1], 0]) == pytest.approx([-14.8, 14.8])
        # the road lies to the right of its outline
        heading = np.sign(instance.points[-1, 0] - instance.points[0, 0])
        assert heading == np.sign(instance.points[0, 1])


def test_an_island_inside_stays_a_ring_however_its_chunks_fall():
    angles = np.linspace(0, 2 * np.pi, 101)[:-1]
    island = np.stack([4 * np.cos(angles), 4 * np.sin(angles)], -1)
    road = shapely.Polygon(shapely.box(-80, -80, 80, 80).exterior, [island])
    town = local_map(("boundary",), road_segment=[road], lane=[])
    (ring,) = town.instances(pose(0, 0, 30))
    np.testing.assert_array_equal(ring.points[0], ring.points[-1])
    np.testing.assert_allclose(np.linalg.norm(ring.points, axis=1), 4, atol=1e-9)
    (arc,) = town.instances(pose(14.8, 0, 0))
    assert len(arc.points) > 20
    assert np.abs(arc.points[[0, -1], 0]).max() == pytest.approx(14.8)
    assert town.instances(pose(40, 0, 0)) == []


def test_centre_lines_follow_each_way_through_a_fork():
    """One lane splits into two connectors: two paths, both cut at the patch's upper edge."""
    layers = MapLayers([], {}, Counter())
    layers.centerlines = [
        np.array([[0, -40, 0], [0, 0, 0.0]]),
        np.array([[0, 0, 0], [0, 40, 0.0]]),
        np.array([[0, 0, 0], [10, 40, 0.0]]),
    ]
    layers.links = link_lanes([(0, [], [1, 2]), (1, [0], []), (2, [0], [])])
    town = NuScenesLocalMap(layers, ("centerline",))
    found = sorted((i.points for i in town.instances(pose(0, 0, 0))), key=lambda p: p[-1, 0])
    np.testing.assert_allclose([line[0] for line in found], [[0, -30], [0, -30]], atol=1e-9)
    np.testing.assert_allclose([line[-1] for line in found], [[0, 30], [7.5, 30]], atol=1e-9)


def test_an_unknown_class_is_refused():
    with pytest.raises(ValueError, match="tree"):
        local_map(("tree",))


def vector_set(frames: list[dict]) -> dict[str, list[tuple[int, shapely.LineString]]]:
    return {
        frame["sample_token"]: [
            (v["label"], shapely.LineString(v["pts"])) for v in frame["vectors"]
        ]
        for frame in frames
    }


def apart(a: shapely.LineString, b: shapely.LineString) -> float:
    """Largest distance from a vertex of either line to the other line."""
    return max(
        shapely.distance(shapely.points(shapely.get_coordinates(one)), other).max()
        for one, other in ((a, b), (b, a))
    )


def test_vectors_equal_the_reference(
    reference_root: Path, golden_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(nuscenes, "_FRAMES_PER_WORKER", 1)
    options = NuScenesOptions(reference_root, "v1.0-mini", out_dir=tmp_path, workers=2)
    summary = convert_nuscenes(options)
    assert dict(summary.samples) == {"mini_train": 32, "mini_val": 32}
    files = [tmp_path / f"gsmap_nuscenes_{split}.arrow" for split in ("mini_train", "mini_val")]
    assert write_vectors(files, tmp_path / "out.json") == 64
    frames = json.loads((tmp_path / "out.json").read_text())["GTs"]
    wanted = vector_set(json.loads((golden_dir / "data/E6_A.json").read_text())["frames"])
    found = vector_set(frames)
    assert found.keys() == wanted.keys()
    for token, lines in wanted.items():
        assert len(found[token]) == len(lines)
        free = list(found[token])
        for label, line in lines:
            near = [i for i, (other, _) in enumerate(free) if other == label]
            # both are rounded to 1e-6 m, and ours is stored as float32
            match = min(near, key=lambda i: apart(line, free[i][1]))
            assert apart(line, free.pop(match)[1]) < 1e-5


def test_what_is_left_out_is_counted(reference_root: Path, tmp_path: Path):
    summary = convert_nuscenes(NuScenesOptions(reference_root, "v1.0-mini", out_dir=tmp_path))
    assert summary.problems["invalid ped_crossing polygon left out"] == 2
    assert summary.problems["road_divider without two nodes left out"] == 2
    assert summary.problems["CAM_BACK image file missing"] == 64
    text = summary.text()
    assert "divider 983, ped_crossing 152, boundary 305" in text
    assert "2 of the 10 scenes of the splits are in " in text


def test_minicity_converts_and_names_itself(minicity_root: Path, minicity_annotations: dict):
    file = AnnotationFile(minicity_annotations["train"])
    assert (file.meta.dataset, file.meta.split, file.meta.frame) == ("minicity", "train", "lidar")
    assert file.meta.versions["shapely"] == shapely.__version__
    sample = file[0]
    assert len(sample.cameras) == 6
    assert all((minicity_root / camera.path).is_file() for camera in sample.cameras)
    assert sample.lidar is not None
    assert len(file[1].lidar.sweeps) >= 1
    # the road ahead of the first camera is drawn where the calibration says: forward is +y
    forward = np.linalg.inv(sample.cameras[0].cam_from_frame)[:3, 2]
    assert forward[1] > 0.9
    yaw = np.arctan2(sample.global_from_frame[1, 1], sample.global_from_frame[0, 1])
    assert sample.can_bus[16] % (2 * np.pi) == pytest.approx(yaw % (2 * np.pi), abs=0.05)


def test_the_vehicle_s_frame_holds_the_same_world(
    minicity_root: Path, minicity_annotations: dict, tmp_path: Path
):
    """What the command writes with ``--frame ego``, against the file in LIDAR_TOP's frame."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    words = f"--root {minicity_root} --out-dir {tmp_path} --frame ego --tag _ego --workers 1"
    ranges = "--x-range -30 30 --y-range -15 15"
    run(parser.parse_args([*words.split(), *ranges.split()], argparse.Namespace(command="make it")))
    found = AnnotationFile(tmp_path / "gsmap_minicity_train_ego.arrow")
    found.require(frame="ego", x_range=(-30.0, 30.0), y_range=(-15.0, 15.0))
    assert found.meta.ground_z_m == 0.0  # the road, in the vehicle's frame of nuScenes
    assert AnnotationFile(minicity_annotations["train"]).meta.ground_z_m is None
    for ego, lidar in zip(found, AnnotationFile(minicity_annotations["train"]), strict=True):
        ego_from_lidar = lidar.ego_from_frame
        assert ego_from_lidar[2, 3] > 1  # on the roof
        np.testing.assert_array_equal(ego.ego_from_frame, np.eye(4))
        at = ego.global_from_frame @ ego_from_lidar
        np.testing.assert_allclose(at, lidar.global_from_frame, atol=1e-9)
        for camera, other in zip(ego.cameras, lidar.cameras, strict=True):
            cam_from_lidar = camera.cam_from_frame @ ego_from_lidar
            np.testing.assert_allclose(cam_from_lidar, other.cam_from_frame, atol=1e-9)
        np.testing.assert_allclose(ego.lidar.frame_from_lidar, ego_from_lidar)
        for sweep, other in zip(ego.lidar.sweeps, lidar.lidar.sweeps, strict=True):
            expected = ego_from_lidar @ other.frame_from_lidar
            np.testing.assert_allclose(sweep.frame_from_lidar, expected, atol=1e-9)
        np.testing.assert_array_equal(ego.can_bus, lidar.can_bus)
        both = shapely.box(-25, -14, 25, 14)  # which the two ranges share
        for label in range(3):
            own, other = of_label(ego, label, np.eye(4)), of_label(lidar, label, ego_from_lidar)
            # pitch and roll of the roof shorten the plane by less than 5 cm
            assert own.intersection(both).difference(other.buffer(0.05)).is_empty
            assert other.intersection(both).difference(own.buffer(0.05)).is_empty


def test_the_rule_of_the_crossings_is_an_option_that_the_file_names(
    minicity_root: Path, minicity_annotations: dict, tmp_path: Path
):
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    words = f"--root {minicity_root} --out-dir {tmp_path} --crossings edges --tag _edges"
    run(parser.parse_args([*words.split(), "--workers", "1"]))
    file = AnnotationFile(tmp_path / "gsmap_minicity_train_edges.arrow")
    assert file.meta.crossings == "edges"
    united = AnnotationFile(minicity_annotations["train"])
    assert united.meta.crossings == "united"
    assert "crossings" not in united.meta.options
    for edges, rings in zip(file, united, strict=True):
        lines = [i.points for i in edges.instances if i.label == 1]
        assert lines
        assert {len(line) for line in lines} == {2}
        for label in (0, 2):
            own, other = (
                [i.points for i in s.instances if i.label == label] for s in (edges, rings)
            )
            assert all(map(np.array_equal, own, other))


def of_label(sample: MapSample, label: int, ego_from_frame: np.ndarray) -> shapely.MultiLineString:
    """Return a sample's elements of one class as the vehicle sees them from above."""
    lines = [i.points[:, :2] for i in sample.instances if i.label == label]
    rotation, shift = ego_from_frame[:2, :2], ego_from_frame[:2, 3]
    return shapely.MultiLineString([line @ rotation.T + shift for line in lines])


def test_own_splits_by_name_and_token(options: NuScenesOptions, tmp_path: Path):
    tables = json.loads((options.root / options.version / "scene.json").read_text())
    splits = {"near": [tables[0]["token"]], "far": [tables[1]["name"]]}
    (tmp_path / "own.json").write_text(json.dumps(splits))
    convert_nuscenes(replace(options, split_file=tmp_path / "own.json"))
    near = AnnotationFile(tmp_path / "out/gsmap_nuscenes_near.arrow")
    assert {sample.scene for sample in near} == {tables[0]["name"]}
    assert near.meta.split == "near"


def test_a_scene_both_sides_is_warned_of_or_refused(options: NuScenesOptions, tmp_path: Path):
    tables = json.loads((options.root / options.version / "scene.json").read_text())
    own = tmp_path / "own.json"
    own.write_text(json.dumps({"train": [tables[0]["name"]], "val": [tables[0]["token"]]}))
    with pytest.raises(ValueError, match=r"own\.json cannot.* is in both train and val; list"):
        convert_nuscenes(replace(options, split_file=own))
    own.write_text(json.dumps({"train": ["scene-9999"]}))
    with pytest.raises(ValueError, match=r"none of the split's scenes"):
        convert_nuscenes(replace(options, split_file=own))


def test_missing_parts_are_named(options: NuScenesOptions, tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"no data set at .*nuscenes.org"):
        convert_nuscenes(replace(options, root=tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError, match=r"no version 'v1.0-mini' .* it has v1.0-trainval"):
        convert_nuscenes(replace(options, version="v1.0-mini"))
    (tmp_path / "bare/v1.0-mini").mkdir(parents=True)
    (tmp_path / "bare/v1.0-mini/scene.json").write_text("[]")
    with pytest.raises(FileNotFoundError, match="Map expansion pack"):
        convert_nuscenes(replace(options, root=tmp_path / "bare", version="v1.0-mini"))
    with pytest.raises(ValueError, match="classes must be among"):
        convert_nuscenes(replace(options, classes=("divider", "tree")))


def test_a_sample_without_lidar_is_left_out_and_one_without_a_camera_kept(
    options: NuScenesOptions, damaged_root: Path
):
    table = damaged_root / "v1.0-trainval/sample_data.json"
    records = json.loads(table.read_text())
    keys = [r for r in records if r["is_key_frame"]]
    lidar = next(r for r in keys if "LIDAR_TOP" in r["filename"])
    camera = next(
        r
        for r in keys
        if "CAM_BACK/" in r["filename"] and r["sample_token"] != lidar["sample_token"]
    )
    table.write_text(json.dumps([r for r in records if r not in (lidar, camera)]))
    summary = convert_nuscenes(replace(options, root=damaged_root, max_sweeps=0))
    assert sum(summary.samples.values()) == 3
    assert summary.problems["sample left out: no LIDAR_TOP key frame"] == 1
    assert summary.problems["CAM_BACK absent (sample kept without it)"] == 1


def test_missing_sweeps_are_counted_once(options: NuScenesOptions, damaged_root: Path):
    """Neighbouring samples share sweeps; the copy has no file of any."""
    sweeps = len(list((options.root / "sweeps/LIDAR_TOP").iterdir()))
    summary = convert_nuscenes(replace(options, root=damaged_root, max_sweeps=10))
    assert summary.problems["LIDAR_TOP sweep file missing"] == sweeps > 0
    with pytest.raises(ValueError, match="max_sweeps must be >= 0, got -1"):
        replace(options, max_sweeps=-1)


def test_a_truncated_table_is_named_and_nothing_stays_behind(options, damaged_root: Path):
    table = damaged_root / "v1.0-trainval/ego_pose.json"
    table.write_text(table.read_text()[:-40])
    with pytest.raises(ValueError, match=r"ego_pose.json is empty or holds no complete list"):
        convert_nuscenes(replace(options, root=damaged_root))
    assert not options.out_dir.exists()


def test_extended_classes_are_closed_rings(options: NuScenesOptions, tmp_path: Path):
    extended = ("stop_line", "intersection", "carpark_area", "centerline")
    classes = ("divider", "ped_crossing", "boundary", *extended)
    summary = convert_nuscenes(replace(options, classes=classes, tag="_extended"))
    assert summary.instances["intersection"] + summary.instances["stop_line"] > 0
    assert summary.instances["centerline"] > 0
    for sample in AnnotationFile(tmp_path / "out/gsmap_nuscenes_train_extended.arrow"):
        for instance in sample.instances:
            if 3 <= instance.label < 6:
                np.testing.assert_array_equal(instance.points[0], instance.points[-1])


def test_the_command_reports_and_fails_in_words(minicity_root: Path, tmp_path: Path):
    tool = "tools/create_data.py", "nuscenes", "--root"
    done = run_tool(*tool, minicity_root, "--out-dir", tmp_path, "--workers", 1)
    assert "samples: " in done.stdout
    assert AnnotationFile(tmp_path / "gsmap_minicity_val.arrow").meta.command.startswith("python ")
    failed = run_tool(*tool, tmp_path)
    assert failed.returncode != 0
    assert failed.stderr.startswith("error: no version")
    assert "Traceback" not in failed.stderr


def test_a_disk_that_fills_between_two_splits_leaves_neither(
    options: NuScenesOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    finish, finished = AnnotationWriter.finish, []

    def fill(writer: AnnotationWriter) -> None:
        if writer not in finished and len(finished) == 1:
            raise OSError("No space left on device")
        finished.append(writer)
        finish(writer)

    monkeypatch.setattr(AnnotationWriter, "finish", fill)
    with pytest.raises(OSError, match="No space left"):
        convert_nuscenes(options)
    assert list((tmp_path / "out").iterdir()) == []
