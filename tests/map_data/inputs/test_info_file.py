import pickle
from collections import OrderedDict

import cv2
import numpy as np
import pytest
from fuzz.attacks import Calls

from mapdata.infos.plain_pickle import load_plain_pickle
from mapdata.infos.recordings import read_info_file


def make_info(folder, cameras=("CAM_FRONT", "CAM_BACK"), **changes):
    images = {}
    for i, name in enumerate(cameras):
        cv2.imwrite(str(folder / f"{name}.jpg"), np.zeros((90, 160, 3), np.uint8))
        lidar2cam = np.eye(4)
        lidar2cam[0, 3] = i
        images[name] = {
            "img_path": f"{name}.jpg",
            "cam2img": [[100.0, 0, 80], [0, 100, 45], [0, 0, 1]],
            "lidar2cam": lidar2cam.tolist(),
        }
    lidar2ego, ego2global = np.eye(4), np.eye(4)
    lidar2ego[2, 3], ego2global[:2, 3] = 1.84, (100, 200)
    info = {
        "token": "abc",
        "timestamp": 1532402927.5,
        "images": images,
        "lidar_points": {"lidar2ego": lidar2ego.tolist()},
        "ego2global": ego2global,
        "sample_idx": np.int64(3),
    } | changes
    path = folder / "infos.pkl"
    path.write_bytes(pickle.dumps({"metainfo": {}, "data_list": [info]}))
    return path


def test_plain_containers_and_numpy_values_are_read(tmp_path):
    values = OrderedDict(a=np.float32(1.5), b=[np.arange(3), None, True], c=b"x", d={1, 2})
    path = tmp_path / "plain.pkl"
    for protocol in range(2, pickle.HIGHEST_PROTOCOL + 1):
        path.write_bytes(pickle.dumps(values, protocol=protocol))
        if (
            protocol < 4
        ):  # older protocols write a set and bytes by calling builtins, which is refused
            with pytest.raises(ValueError, match="is not plain data"):
                load_plain_pickle(path)
            continue
        found = load_plain_pickle(path)
        assert found["a"] == np.float32(1.5)
        np.testing.assert_array_equal(found["b"][0], [0, 1, 2])
        assert (found["c"], found["d"]) == (b"x", {1, 2})


def test_pickle_that_would_run_code_is_refused_and_nothing_runs(tmp_path):
    target = tmp_path / "proof"
    path = tmp_path / "attack.pkl"
    path.write_bytes(pickle.dumps({"data_list": [Calls(open, str(target), "w")]}))
    with pytest.raises(ValueError, match=r"attack.pkl .*asks for _?io.open"):
        load_plain_pickle(path)
    assert not target.exists()


@pytest.mark.parametrize("shape", [(1, 10**9), (10**9, 0), (0, 10**9), (10**9,)])
def test_no_array_has_more_values_than_the_file_has_bytes(tmp_path, shape):
    def number(value):
        return b"\x8a\x08" + value.to_bytes(8, "little")

    path = tmp_path / "huge.pkl"
    for code in (b"S0", b"S1"):
        content = pickle.dumps(np.zeros((0, 7), "S1"), 2)
        assert content.count(b"K\x00K\x07\x86") == 1
        written = b"(" + b"".join(map(number, shape)) + b"t"
        content = content.replace(b"K\x00K\x07\x86", written).replace(b"S1", code)
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"huge.pkl cannot be read as a pickle of plain data"):
            load_plain_pickle(path)
    path.write_bytes(pickle.dumps(np.zeros((0, 7)), 4))
    assert load_plain_pickle(path).shape == (0, 7)


@pytest.mark.parametrize("content", [b"", b"\x80\x04garbage", b"not a pickle"])
def test_broken_pickle_is_named(tmp_path, content):
    path = tmp_path / "broken.pkl"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"broken.pkl cannot be read as a pickle"):
        load_plain_pickle(path)


def test_sample_has_the_files_calibration_and_pose(tmp_path):
    (sample,) = read_info_file(make_info(tmp_path))
    assert [camera.name for camera in sample.cameras] == ["CAM_FRONT", "CAM_BACK"]
    back = sample.cameras[1]
    assert (back.path, back.width, back.height) == ("CAM_BACK.jpg", 160, 90)
    assert back.cam_from_frame[0, 3] == 1
    np.testing.assert_allclose(sample.global_from_frame[:3, 3], [100, 200, 1.84])
    np.testing.assert_allclose(sample.ego_from_frame[:3, 3], [0, 0, 1.84])
    assert (sample.token, sample.timestamp_ns) == ("abc", 1532402927500000000)
    assert sample.instances is None


@pytest.mark.parametrize("shape", [(3, 4), (4, 4)])
def test_larger_matrices_of_a_camera_are_read_too(tmp_path, shape):
    """mmdet3d's files have intrinsics of several sizes, and poses without their last row."""
    path = make_info(tmp_path, cameras=("CAM_FRONT",))
    (plain,) = read_info_file(path)
    content = pickle.loads(path.read_bytes())
    camera = content["data_list"][0]["images"]["CAM_FRONT"]
    intrinsics = np.eye(*shape)
    intrinsics[:3, :3] = camera["cam2img"]
    camera |= {"cam2img": intrinsics.tolist(), "lidar2cam": camera["lidar2cam"][:3]}
    path.write_bytes(pickle.dumps(content))
    (found,) = read_info_file(path)
    for name in ("intrinsics", "cam_from_frame"):
        expected, larger = (getattr(s.cameras[0], name) for s in (plain, found))
        np.testing.assert_array_equal(larger, expected)


def test_files_are_found_in_the_folders_of_nuscenes(tmp_path):
    path = make_info(tmp_path, cameras=("CAM_FRONT",))
    folder = tmp_path / "samples" / "CAM_FRONT"
    folder.mkdir(parents=True)
    (tmp_path / "CAM_FRONT.jpg").rename(folder / "CAM_FRONT.jpg")
    assert read_info_file(path)[0].cameras[0].path == "samples/CAM_FRONT/CAM_FRONT.jpg"


def test_real_nuscenes_sample(shared_dir):
    path = next((shared_dir / "nuscenes_sample").glob("*.pkl"))
    (sample,) = read_info_file(path)
    assert sample.token == "ca9a282c9e77460f8360f564131a8af5"
    assert {(c.width, c.height) for c in sample.cameras} == {(1600, 900)}
    assert len(sample.cameras) == 6
    assert sample.lidar is not None
    ahead = {c.name: c.cam_from_frame[2, :3] for c in sample.cameras}  # optical axes
    assert ahead["CAM_FRONT"][1] > 0.99
    assert ahead["CAM_BACK"][1] < -0.99


def test_missing_image_names_sample_camera_and_places(tmp_path):
    path = make_info(tmp_path)
    (tmp_path / "CAM_BACK.jpg").unlink()
    message = r"sample 0, camera CAM_BACK: no file .*CAM_BACK.jpg or .*--data-root"
    with pytest.raises(FileNotFoundError, match=message):
        read_info_file(path)


def test_no_path_leads_out_of_the_data_root(tmp_path):
    (tmp_path / "secret.jpg").write_bytes(b"nothing")
    root = tmp_path / "root"
    (root / "samples").mkdir(parents=True)
    path = make_info(root, cameras=("CAM_FRONT",))
    content = pickle.loads(path.read_bytes())
    camera = content["data_list"][0]["images"]["CAM_FRONT"]
    for name in ("../secret.jpg", "samples/../../secret.jpg", str(tmp_path / "root/../secret.jpg")):
        camera["img_path"] = name
        path.write_bytes(pickle.dumps(content))
        with pytest.raises(FileNotFoundError, match="camera CAM_FRONT: no file"):
            read_info_file(path)


def test_file_that_is_no_image_is_named(tmp_path):
    path = make_info(tmp_path)
    (tmp_path / "CAM_BACK.jpg").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"camera CAM_BACK: .*CAM_BACK.jpg is not an image"):
        read_info_file(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": {}}, "sample 0 has no camera"),
        ({"ego2global": np.eye(3)}, r"sample 0: ego2global must be 4 x 4, got \(3, 3\)"),
        ({"lidar_points": {}}, "sample 0 cannot be used: it has no 'lidar2ego'; GSMap needs"),
    ],
)
def test_incomplete_info_is_named(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        read_info_file(make_info(tmp_path, **changes))


def test_other_pickles_are_refused(tmp_path):
    path = tmp_path / "old.pkl"
    path.write_bytes(pickle.dumps({"infos": []}))
    with pytest.raises(ValueError, match="not an info file of mmdet3d's format v2"):
        read_info_file(path)


@pytest.mark.parametrize("time", [1532402927.5, 1532402927500, 1532402927500000000])
def test_a_time_is_in_seconds_or_in_another_unit_of_unix_time(time, tmp_path):
    (sample,) = read_info_file(make_info(tmp_path, timestamp=time))
    assert sample.timestamp_ns == 1532402927500000000
