"""Logs of py123d become annotation files: cameras, poses and maps, and what is wrong is named."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest

from gsmap.datasets.annotations.file import AnnotationFile, merge_annotations
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.utils.errors import WorkError
from gsmap.utils.shards import Shard, find_shards
from mapdata.folders.rig import rotation_of
from mapdata.py123d.convert import Py123dOptions, convert_py123d
from mapdata.py123d.packed import unpack

msgpack = pytest.importorskip("msgpack", reason="msgpack is not installed: .[py123d]")

import py123d_log as cases  # noqa: E402 - needs msgpack

CLASSES = ("divider", "ped_crossing", "boundary", "centerline")


def convert(root: Path, **changes) -> tuple[str, AnnotationFile]:
    """Convert the log; the summary and the file."""
    options = {"split": "test_val", "rate_hz": None, "classes": CLASSES, **changes}
    text = convert_py123d(Py123dOptions(root, **options)).text()
    return text, AnnotationFile(root / "gsmap_py123d_test_val.arrow")


def check_first_sample(root: Path, file: AnnotationFile) -> None:
    """Compare the first sample, at x = 19.5 in the map, with the values of the case."""
    assert file.meta.frame == "ego"
    # centre 0.35 m above the axle, box of 1.5 m
    assert file.meta.ground_z_m == pytest.approx(0.35 - 0.75)
    sample = file[0]
    pose = cases.global_from_axle(0)
    np.testing.assert_allclose(sample.global_from_frame, pose)
    assert (sample.scene, sample.map_name) == ("log1", "town")
    assert sample.timestamp_ns == 1000 * cases.TIMES_US[0]
    back, front = sample.cameras
    assert (back.name, front.name) == ("pcam_b0", "pcam_f0")
    assert front.path == "front/0.jpg"
    np.testing.assert_allclose(front.intrinsics, [[200, 0, 160], [0, 210, 90], [0, 0, 1]])
    values = cases.global_pose_of_camera(0)
    global_from_camera = rigid(rotation_of(values[3:]), values[:3])
    for camera in (back, front):  # one has a pose in the table, the other of the IMU
        expected = invert_rigid(global_from_camera) @ pose
        np.testing.assert_allclose(camera.cam_from_frame, expected, atol=1e-9)
    # a point 10 m ahead of the camera on its axis lies in the middle of the image
    ahead = front.img_from_frame @ [12.0, 0.0, 1.1, 1.0]
    np.testing.assert_allclose(ahead[:2] / ahead[2], [160, 90], atol=1e-6)
    assert back.path.startswith("rectified/")
    assert cv2.imread(str(root / back.path)).shape == (180, 320, 3)
    elements = {name: [] for name in CLASSES}
    for instance in sample.instances:
        elements[CLASSES[instance.label]].append(instance.points)
    (divider,) = elements["divider"]
    np.testing.assert_allclose(divider, [[-19.5, 2], [30, 2]], atol=1e-6)
    (boundary,) = elements["boundary"]  # of two pieces
    np.testing.assert_allclose(boundary[[0, -1]], [[-19.5, -6], [30, -6]], atol=1e-6)
    (crossing,) = elements["ped_crossing"]
    np.testing.assert_array_equal(crossing[0], crossing[-1])
    assert crossing.min(axis=0) == pytest.approx([20.5, -6])
    (centre,) = elements["centerline"]
    np.testing.assert_allclose(centre, [[-19.5, 0], [30, 0]], atol=1e-6)


def test_a_log_becomes_an_annotation_file(tmp_path):
    cases.write_log(tmp_path)
    text, file = convert(tmp_path)
    check_first_sample(tmp_path, file)
    assert len(file) == 4
    assert "1 x frame left out: no image of pcam_b0, for example log1_1700000001000000" in text


def test_the_library_writes_the_format_that_is_read(tmp_path):
    pytest.importorskip("py123d.api", reason="py123d is not installed")
    root = tmp_path / "library"
    folder = cases.write_log_by_the_library(root)
    _, file = convert(root)
    check_first_sample(root, file)
    own = cases.write_log(tmp_path / "own")
    for path in own.glob("*.arrow"):
        ours = pa.ipc.open_file(str(path)).read_all()
        theirs = pa.ipc.open_file(str(folder / path.name)).read_all()
        for field in ours.schema:
            assert theirs.schema.field(field.name).type == field.type
        metadata = msgpack.unpackb(theirs.schema.metadata[b"metadata"])
        assert metadata == json.loads(json.dumps(unpack(ours.schema.metadata[b"metadata"])))


def test_a_rate_and_names_select_samples(tmp_path):
    cases.write_log(tmp_path)
    _, file = convert(tmp_path, rate_hz=2.0)
    assert [s.timestamp_ns // 1000 for s in file] == cases.TIMES_US[:4:2]
    with pytest.raises(FileNotFoundError, match=r"no log .* in .*test_val; there are test_val"):
        convert(tmp_path, logs=("other",))


def test_a_log_without_a_map_has_no_ground_truth(tmp_path):
    folder = cases.write_log(tmp_path)
    replace_metadata(folder / "sync.arrow", {**cases.log_metadata(), "map_metadata": None})
    _, file = convert(tmp_path)
    assert file[0].instances is None


def replace_metadata(path: Path, metadata: dict) -> None:
    """Replace the metadata of a table."""
    table = pa.ipc.open_file(str(path)).read_all()
    cases.write_table(path, dict(zip(table.column_names, table, strict=True)), metadata)


@pytest.mark.parametrize("key", ["location", "dataset"])
def test_a_map_without_a_place_is_found_by_the_log_s_or_named(key, tmp_path):
    folder = cases.write_log(tmp_path)
    (tmp_path / "maps/test").mkdir(parents=True)
    (folder / "map.arrow").rename(tmp_path / "maps/test/test_town.arrow")
    metadata = cases.log_metadata()
    metadata["map_metadata"] |= {"map_is_per_log": False}
    del metadata["map_metadata"][key]
    replace_metadata(folder / "sync.arrow", metadata)
    check_first_sample(tmp_path, convert(tmp_path)[1])
    for value in ({key: None}, {key: ""}):
        metadata["map_metadata"] |= value
        replace_metadata(folder / "sync.arrow", metadata)
        check_first_sample(tmp_path, convert(tmp_path)[1])
    del metadata[key]
    replace_metadata(folder / "sync.arrow", metadata)
    message = rf"log left out: its map cannot be found, since .*sync\.arrow has no {key}: convert"
    with pytest.raises(WorkError, match=message):
        convert(tmp_path)


def replace_column(path: Path, name: str, values: pa.Array) -> None:
    """Replace a column of a table."""
    table = pa.ipc.open_file(str(path)).read_all()
    metadata = unpack(table.schema.metadata[b"metadata"])
    columns = dict(zip(table.column_names, table, strict=True))
    cases.write_table(path, {**columns, name: values}, metadata)


def test_what_cannot_be_used_is_left_out_by_name(tmp_path):
    folder = cases.write_log(tmp_path)
    second = folder.with_name("log2")
    shutil.copytree(folder, second)
    (second / "map.arrow").write_bytes(b"nothing")
    third = folder.with_name("log3")
    shutil.copytree(folder, third)
    (third / "ego_state_se3.arrow").unlink()
    contents = [b"\x7fELF", cases.jpeg(1), cases.jpeg(2), cases.jpeg(3), cases.jpeg(4)]
    values = pa.array(contents, pa.binary())
    replace_column(folder / "camera.pcam_b0.arrow", "camera.pcam_b0.data", values)
    text, file = convert(tmp_path)
    assert {sample.scene for sample in file} == {"log1"}
    assert "frame left out: camera 'pcam_b0': row 0 is not an image" in text
    assert "log left out: " + str(second / "map.arrow") in text
    assert "log left out: no table at " + str(third / "ego_state_se3.arrow") in text
    assert not list(tmp_path.rglob("images/log1/pcam_b0/1700000000000000.*"))


def test_crosswalks_that_cross_themselves_are_counted(monkeypatch, tmp_path):
    crossed = [[20.0, -6.0], [70.0, 6.0], [70.0, -6.0], [20.0, 6.0], [20.0, -6.0]]
    monkeypatch.setattr(cases, "CROSSWALK", crossed)
    cases.write_log(tmp_path)
    text, file = convert(tmp_path)
    assert "1 x map element without a valid geometry left out" in text
    assert {item.label for item in file[0].instances} == {0, 2, 3}


@pytest.mark.parametrize(
    ("table", "column", "values", "message"),
    [
        ("camera.pcam_f0", "data", pa.array(["../a.jpg"] * 5), "the path must lie below"),
        ("sync", "camera.pcam_f0", pa.array([9, -1, 9, 9, 9]), "has 5 images, so no row 9"),
        (
            "sync",
            "sync.timestamp_us",
            pa.array([None] * 5, pa.int64()),
            "sync.arrow cannot be used",
        ),
        (
            "ego_state_se3",
            "imu_se3",
            pa.array([[0.0] * 7] * 5, pa.list_(pa.float64(), 7)),
            "a quaternion must have length 1",
        ),
    ],
)
def test_foreign_values_are_refused(table, column, values, message, tmp_path):
    folder = cases.write_log(tmp_path)
    name = column if table == "sync" else f"{table}.{column}"
    replace_column(folder / f"{table}.arrow", name, values)
    with pytest.raises(WorkError, match=f"no sample is left of test_val:(.|\n)*{message}"):
        convert(tmp_path)


def add_camera(folder: Path, name: str, **changes) -> None:
    """Add a camera to the log, with the images and rows of ``pcam_f0`` and changed metadata."""
    table = pa.ipc.open_file(str(folder / "camera.pcam_f0.arrow")).read_all()
    key = f"camera.{name}"
    columns = {}
    for column in table.column_names:
        columns[column.replace("camera.pcam_f0", key)] = table[column]
    metadata = {**cases.camera_metadata(name, number=9, distorted=False), **changes}
    cases.write_table(folder / f"{key}.arrow", columns, metadata)
    sync = pa.ipc.open_file(str(folder / "sync.arrow")).read_all()
    replace_column(folder / "sync.arrow", key, sync["camera.pcam_f0"])


def test_cameras_of_other_models_are_left_out_by_name(tmp_path):
    folder = cases.write_log(tmp_path)
    add_camera(folder, "fmcam_l", camera_model="fisheye_mei", mirror_parameter=2.2)
    add_camera(folder, "ftcam_f0", camera_model="ftheta", intrinsics=[1.0] * 14)
    add_camera(folder, "pcam_l0", intrinsics=None)
    add_camera(folder, "pcam_r0")
    sync = pa.ipc.open_file(str(folder / "sync.arrow")).read_all().drop_columns("camera.pcam_r0")
    columns = dict(zip(sync.column_names, sync, strict=True))
    cases.write_table(folder / "sync.arrow", columns, cases.log_metadata())
    text, file = convert(tmp_path)
    check_first_sample(tmp_path, file)
    for line in (
        "left out: its model is 'fisheye_mei', not 'pinhole', for example fmcam_l of log1",
        "left out: its model is 'ftheta', not 'pinhole', for example ftcam_f0 of log1",
        "left out: it has no intrinsics, for example pcam_l0 of log1",
        "left out: sync.arrow has no column for it, for example pcam_r0 of log1",
    ):
        assert f"1 x camera {line}" in text


def test_cameras_in_films_are_left_out_by_name(tmp_path):
    folder = cases.write_log(tmp_path)
    numbers = pa.array(range(5), pa.int32())  # of the frames in camera.pcam_b0.mp4
    replace_column(folder / "camera.pcam_b0.arrow", "camera.pcam_b0.data", numbers)
    text, file = convert(tmp_path)
    assert [camera.name for camera in file[0].cameras] == ["pcam_f0"]
    reason = "camera left out: its images are in a film; py123d must store them as JPEG or PNG"
    assert f"1 x {reason}, for example pcam_b0 of log1" in text
    replace_column(folder / "camera.pcam_f0.arrow", "camera.pcam_f0.data", numbers)
    with pytest.raises(WorkError, match="no camera that can be used") as caught:
        convert(tmp_path)
    assert f"2 x {reason}" in str(caught.value)


def test_other_tables_are_named(tmp_path):
    folder = cases.write_log(tmp_path)
    assert "not read" not in convert(tmp_path)[0]
    for key in ("lidar.lidar_merged", "camera_semantic.pcam_f0", "box_detections_se3"):
        columns = {f"{key}.timestamp_us": pa.array(cases.TIMES_US, pa.int64())}
        cases.write_table(folder / f"{key}.arrow", columns, {})
    text, file = convert(tmp_path)
    tables = "box_detections_se3, camera_semantic.pcam_f0, lidar.lidar_merged"
    assert f"only cameras, poses and maps are read, but not the tables {tables}" in text
    check_first_sample(tmp_path, file)


def test_joined_shards_are_the_whole_file(tmp_path):
    """Three logs in four shards, of which one is empty."""
    folder = cases.write_log(tmp_path)
    for number in (2, 3):
        shutil.copytree(folder, folder.with_name(f"log{number}"))
    _, whole = convert(tmp_path)
    path = tmp_path / "gsmap_py123d_test_val.arrow"
    content = path.read_bytes()
    path.unlink()
    scenes = []
    for index in range(4):
        options = Py123dOptions(
            tmp_path, split="test_val", rate_hz=None, classes=CLASSES, shard=Shard(index, 4)
        )
        convert_py123d(options)
        scenes += [sample.scene for sample in AnnotationFile(options.shard.path_of(path))]
    assert scenes == [sample.scene for sample in whole]
    merge_annotations(path, find_shards(path))
    assert path.read_bytes() == content


@pytest.mark.parametrize("name", ["logs/test_val/log1/map.arrow", "logs/test_val/log3"])
def test_shards_of_other_logs_are_not_joined(name, tmp_path):
    folder = cases.write_log(tmp_path)
    for number in (2, 3):
        shutil.copytree(folder, folder.with_name(f"log{number}"))
    convert_py123d(Py123dOptions(tmp_path, split="test_val", shard=Shard(0, 2)))
    (tmp_path / name).rename(tmp_path / "elsewhere")
    convert_py123d(Py123dOptions(tmp_path, split="test_val", shard=Shard(1, 2)))
    with pytest.raises(ValueError, match="differs in input"):
        find_shards(tmp_path / "gsmap_py123d_test_val.arrow")


def test_vehicles_of_other_heights_are_not_mixed(tmp_path):
    folder = cases.write_log(tmp_path)
    second = folder.with_name("log2")
    shutil.copytree(folder, second)
    ego = pa.ipc.open_file(str(second / "ego_state_se3.arrow")).read_all()
    columns = dict(zip(ego.column_names, ego, strict=True))
    cases.write_table(second / "ego_state_se3.arrow", columns, {**cases.EGO, "height": 3.0})
    with pytest.raises(ValueError, match=r"the road lies -0.40 m above the axle in log1 and -1.15"):
        convert(tmp_path)
    _, file = convert(tmp_path, ground_z_m=-0.4)
    assert {sample.scene for sample in file} == {"log1", "log2"}


@pytest.mark.parametrize(
    ("dtype", "shape"), [("|O", (1,)), ("<f8", (10**9,)), ("<f8", (2, 2)), ("<i8", (1,))]
)
def test_arrays_of_other_types_or_sizes_are_refused(dtype, shape):
    item = {b"__ndarray__": True, b"dtype": dtype, b"shape": shape, b"data": bytes(8)}
    with pytest.raises(ValueError, match="an array"):
        unpack(msgpack.packb({"a": item}))
