"""Info pickles in the formats of MapTR's repository, synthesised from known samples."""

import json
import os
import pickle
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fuzz.attacks import Calls
from pyquaternion import Quaternion

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from mapdata.infos.convert import convert_infos


def split_pose(matrix: np.ndarray) -> tuple[list[float], list[float]]:
    rotation = Quaternion(matrix=matrix[:3, :3], atol=1e-6, rtol=1e-6)
    return matrix[:3, 3].tolist(), rotation.elements.tolist()


def sensor_info(path: str, frame_from_sensor: np.ndarray, timestamp_us: int) -> dict:
    return {
        "data_path": f"./data/nuscenes/{path}",
        "sensor2lidar_rotation": frame_from_sensor[:3, :3],
        "sensor2lidar_translation": frame_from_sensor[:3, 3],
        "timestamp": timestamp_us,
    }


def nuscenes_info(sample: MapSample) -> dict:
    """One entry of ``nuscenes_infos_temporal_*.pkl``."""
    lidar_pose = split_pose(sample.ego_from_frame)
    ego_pose = split_pose(sample.global_from_frame @ np.linalg.inv(sample.ego_from_frame))
    return {
        "lidar_path": f"./data/nuscenes/{sample.lidar.path}",
        "token": sample.token,
        "prev": "",
        "can_bus": np.array([*sample.can_bus[:16], 0, 0]),
        "sweeps": [
            sensor_info(s.path, s.frame_from_lidar, s.timestamp_ns // 1000)
            for s in sample.lidar.sweeps
        ],
        "cams": {
            c.name: {
                **sensor_info(c.path, np.linalg.inv(c.cam_from_frame), 0),
                "cam_intrinsic": c.intrinsics,
            }
            for c in sample.cameras
        },
        "map_location": sample.map_name,
        "scene_token": "s",
        "lidar2ego_translation": lidar_pose[0],
        "lidar2ego_rotation": lidar_pose[1],
        "ego2global_translation": ego_pose[0],
        "ego2global_rotation": ego_pose[1],
        "timestamp": sample.timestamp_ns // 1000,
        "gt_names": np.array(["car", "truck"]),
    }


def annotation(sample: MapSample, classes: tuple[str, ...]) -> dict[str, list[np.ndarray]]:
    lines = {name: [] for name in (*classes, "centerline")}
    for instance in sample.instances:
        lines[classes[instance.label]].append(instance.points.astype(np.float64))
    lines["divider"].append(np.zeros((1, 2)))  # upstream's files hold such
    lines["centerline"].append(np.zeros((2, 2)))
    return lines


@pytest.fixture
def known(minicity_annotations: dict[str, Path]) -> AnnotationFile:
    return AnnotationFile(minicity_annotations["train"])


def convert(tmp_path: Path, name: str, content: object, root: Path) -> AnnotationFile:
    (tmp_path / name).write_bytes(pickle.dumps(content, protocol=4))
    target = tmp_path / "out.arrow"
    convert_infos(tmp_path / name, target, root, "train", command="make it")
    return AnnotationFile(target)


def assert_same_elements(found: MapSample, wanted: MapSample) -> None:
    assert [i.label for i in found.instances] == [i.label for i in wanted.instances]
    for one, other in zip(found.instances, wanted.instances, strict=True):
        np.testing.assert_allclose(one.points, other.points, atol=1e-5)


def test_maptr_infos_get_their_truth_from_the_maps(known, minicity_root, tmp_path):
    infos = {"infos": [nuscenes_info(s) for s in known], "metadata": {"version": "v1.0-trainval"}}
    last = infos["infos"][-1]
    last["ego2global_rotation"] = Quaternion(last["ego2global_rotation"]).rotation_matrix
    file = convert(tmp_path, "nuscenes_infos_temporal_train.pkl", infos, minicity_root)
    assert file.meta == replace(
        file.meta, dataset="nuscenes", frame="lidar", split="train", command="make it"
    )
    for found, wanted in zip(file, known, strict=True):
        assert found.token == wanted.token
        assert found.lidar.path == wanted.lidar.path
        for one, other in zip(found.cameras, wanted.cameras, strict=True):
            assert (one.name, one.path) == (other.name, other.path)
            np.testing.assert_allclose(one.cam_from_frame, other.cam_from_frame, atol=1e-6)
        for one, other in zip(found.lidar.sweeps, wanted.lidar.sweeps, strict=True):
            np.testing.assert_allclose(one.frame_from_lidar, other.frame_from_lidar, atol=1e-6)
            assert one.timestamp_ns == other.timestamp_ns
        np.testing.assert_allclose(found.global_from_frame, wanted.global_from_frame, atol=1e-6)
        np.testing.assert_allclose(found.can_bus[3:], wanted.can_bus[3:], atol=1e-5)
        assert_same_elements(found, wanted)


def test_maptr_infos_without_maps_have_no_truth(known, tmp_path):
    infos = {"infos": [nuscenes_info(known[0])]}
    file = convert(tmp_path, "nuscenes_infos_temporal_train.pkl", infos, tmp_path)
    assert file[0].instances is None
    assert file[0].cameras[0].path.startswith("samples/CAM_FRONT/")


def test_infos_with_maps_bring_their_truth(known, tmp_path):
    infos = []
    for sample in known:
        info = nuscenes_info(sample)
        infos.append({**info, "annotation": annotation(sample, known.meta.classes)})
    name = "nuscenes_map_infos_temporal_train.pkl"
    for found, wanted in zip(
        convert(tmp_path, name, {"infos": infos}, tmp_path), known, strict=True
    ):
        assert_same_elements(found, wanted)


def test_elements_that_cannot_be_used_are_counted(known, damaged_root, tmp_path):
    """A line of one node in the map; lines of a point, with heights, of other classes in a file."""
    sample = known[0]
    file = damaged_root / f"maps/expansion/{sample.map_name}.json"
    content = json.loads(file.read_text())
    token = content["lane_divider"][0]["line_token"]
    (line,) = [line for line in content["line"] if line["token"] == token]
    del line["node_tokens"][1:]
    file.write_text(json.dumps(content))
    lines = annotation(sample, known.meta.classes)
    lines["divider"].append(np.ones((2, 3)))  # a line with heights
    for more, reason in (
        ({}, "lane_divider without two nodes left out"),
        ({"annotation": lines}, "line of fewer than two points left out"),
        ({"annotation": lines}, "line of 3 coordinates cut to 2"),
        ({"annotation": lines}, "class 'centerline' left out, which --classes does not list"),
    ):
        infos = tmp_path / "infos_train.pkl"
        infos.write_bytes(pickle.dumps({"infos": [{**nuscenes_info(sample), **more}]}, protocol=4))
        summary = convert_infos(infos, tmp_path / "out.arrow", damaged_root, "train")
        assert summary.problems[reason] == 1


def test_argoverse_infos_keep_three_coordinates(tmp_path):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    lines = [[], [[1.0, 2]], np.array([[0.0, 0, 1], [5, 0, 2]])]
    camera = {
        "img_fpath": "data/argoverse2/sensor/val/log/sensors/cameras/ring_front_center/7.jpg",
        "intrinsics": np.diag([100.0, 100, 1]),
        "extrinsics": np.eye(4),
        "e2g_translation": np.array([1.0, 0, 0]),
        "e2g_rotation": turn,
    }
    info = {
        "e2g_translation": np.zeros(3),
        "e2g_rotation": turn,
        "cams": {"ring_front_center": camera},
        "lidar_path": "data/argoverse2/sensor/val/log/sensors/lidar/7.feather",
        "timestamp": "7",
        "log_id": "log",
        "token": "log_7",
        "annotation": {"divider": lines, "ped_crossing": [], "boundary": [], "centerline": lines},
    }
    unknown = info | {"token": "log_8", "annotation": None}
    (tmp_path / "av2_val.pkl").write_bytes(pickle.dumps({"samples": [info, unknown]}))
    summary = convert_infos(tmp_path / "av2_val.pkl", tmp_path / "a.arrow", tmp_path, "val")
    size = "assumed to have 1550 x 2048 pixels"
    assert summary.problems[f"ring_front_center: image not there ({size})"] == 2
    assert summary.problems["no ground truth in the info file (sample kept without it)"] == 1
    file = AnnotationFile(tmp_path / "a.arrow")
    sample = file[0]
    assert (file.meta.dataset, file.meta.frame, file.meta.dim) == ("av2", "ego", 3)
    assert (file.meta.x_range, file.meta.y_range) == ((-30, 30), (-15, 15))
    assert len(sample.instances) == 1
    np.testing.assert_allclose(sample.instances[0].points, lines[-1])
    assert sample.cameras[0].path == "val/log/sensors/cameras/ring_front_center/7.jpg"
    assert (sample.cameras[0].width, sample.cameras[0].height) == (1550, 2048)
    # the vehicle has moved 1 m along the city's x, which is -y of the vehicle, when the image is
    # taken
    np.testing.assert_allclose(sample.cameras[0].cam_from_frame[:3, 3], [0, 1, 0], atol=1e-12)


def test_truth_beyond_the_range_is_refused_until_the_range_is_given(known, tmp_path):
    info = nuscenes_info(known[0])
    far = {"divider": [np.array([[0.0, -45], [0, 45]])], "ped_crossing": [], "boundary": []}
    content = {"infos": [{**info, "annotation": far}]}
    name = "nuscenes_map_infos_temporal_train.pkl"
    with pytest.raises(ValueError, match=r"vertex at \(0.0, -45.0\), outside .* --y-range"):
        convert(tmp_path, name, content, tmp_path)
    ranges = {"x_range": (-25.0, 25.0), "y_range": (-50.0, 50.0)}
    convert_infos(tmp_path / name, tmp_path / "far.arrow", tmp_path, "train", **ranges)
    file = AnnotationFile(tmp_path / "far.arrow")
    assert (file.meta.x_range, file.meta.y_range) == ((-25, 25), (-50, 50))
    np.testing.assert_allclose(file[0].instances[0].points, far["divider"][0])


@pytest.mark.parametrize(
    "content", [{"infos": [Calls(os.system, "touch was_here")]}, {"infos": [Path("/")]}]
)
def test_a_pickle_that_runs_code_is_refused_unrun(content, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="not plain data"):
        convert(tmp_path, "nuscenes_infos_temporal_train.pkl", content, tmp_path)
    assert not (tmp_path / "was_here").exists()
    assert not (tmp_path / "out.arrow").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "neither a list `infos`"),
        ({"infos": []}, "no sample"),
        (
            {"infos": [{"token": "a"}]},
            "sample 0 cannot be used: it has no 'lidar2ego",
        ),
    ],
)
def test_other_pickles_are_refused(content, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        convert(tmp_path, "nuscenes_infos_temporal_train.pkl", content, tmp_path)
    assert not (tmp_path / "out.arrow").exists()


def own_info(root: Path, size: tuple[int, int] | None, **more: object) -> Path:
    """An info file of MapTR's form with one camera, whose image is in place."""
    pose = {"translation": [0.0] * 3, "rotation": [1.0, 0, 0, 0]}
    camera = {"data_path": "samples/FRONT/0.jpg", "cam_intrinsic": np.eye(3)}
    camera |= {f"sensor2lidar_{name}": value for name, value in pose.items()}
    info = {
        "token": "a",
        "lidar_path": "0.bin",
        "cams": {"FRONT": camera},
        "timestamp": 17 * 10**14,
    }
    info |= {f"{way}_{n}": v for way in ("lidar2ego", "ego2global") for n, v in pose.items()}
    if size is not None:
        (root / "samples/FRONT").mkdir(parents=True)
        cv2.imwrite(str(root / "samples/FRONT/0.jpg"), np.zeros((size[1], size[0], 3), np.uint8))
    path = root / "own_val.pkl"
    path.write_bytes(pickle.dumps({"infos": [info | more]}))
    return path


@pytest.mark.parametrize(("size", "recorded"), [((320, 180), (320, 180)), (None, (1600, 900))])
def test_images_have_their_own_size_if_they_are_there(size, recorded, tmp_path):
    path = own_info(tmp_path, size)
    summary = convert_infos(path, tmp_path / "a.arrow", tmp_path, "val").text()
    (camera,) = AnnotationFile(tmp_path / "a.arrow")[0].cameras
    assert (camera.width, camera.height) == recorded
    assert ("FRONT: image not there (assumed to have 1600 x 900 pixels)" in summary) == (
        size is None
    )


def test_no_image_outside_of_the_data_root_is_opened(tmp_path):
    root = tmp_path / "root"
    root.mkdir()
    (tmp_path / "secret.jpg").write_bytes(b"nothing")
    camera = pickle.loads(own_info(root, None).read_bytes())["infos"][0]["cams"]["FRONT"]
    for name in ("../secret.jpg", "samples/../../secret.jpg"):
        path = own_info(root, None, cams={"FRONT": {**camera, "data_path": name}})
        with pytest.raises(ValueError, match=r"path '.*secret.jpg' does not lie under .*root"):
            convert_infos(path, root / "a.arrow", root, "val")


@pytest.mark.parametrize("unit", [1, 10**3, 10**6, 10**9])
def test_times_of_info_files_may_have_any_unit(unit, tmp_path):
    path = own_info(tmp_path, None, timestamp=17 * 10**17 // unit)
    convert_infos(path, tmp_path / "a.arrow", tmp_path, "val")
    assert AnnotationFile(tmp_path / "a.arrow")[0].timestamp_ns == 17 * 10**17


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"ego2global_translation": None}, "ego2global_translation must be 3 numbers, got nan"),
        ({"cams": {"FRONT": {}}}, "it has no 'data_path'"),
    ],
)
def test_a_field_that_is_missing_is_named_with_those_that_are_needed(more, message, tmp_path):
    path = own_info(tmp_path, None, **more)
    with pytest.raises(
        ValueError, match=f"sample 0 cannot be used: {message}; a sample .* has token"
    ):
        convert_infos(path, tmp_path / "a.arrow", tmp_path, "val")


@pytest.mark.parametrize("in_samples", [True, False], ids=["Argoverse 2", "nuScenes"])
def test_info_files_of_another_form_are_named_with_what_they_lack(in_samples, tmp_path):
    info = {"token": "a", "e2g_translation": [0, 0, 0], "e2g_rotation": np.eye(3), "cams": {}}
    path = tmp_path / "av2_map_infos_val.pkl"
    path.write_bytes(pickle.dumps({"samples": [info], "id2map": {}} if in_samples else [info]))
    message = ".* or MapTracker, .* lack lidar_path, log_id, timestamp. Convert the data"
    with pytest.raises(ValueError, match=message):
        convert_infos(path, tmp_path / "a.arrow", tmp_path, "val")
