"""Records with a calibration file hold what `infer FOLDER` reads with that file."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.datasets.source import Mount, change_frame
from gsmap.utils.shards import Shard, find_shards
from mapdata.custom import from_records
from mapdata.folders.images import read_image_folder

META = AnnotationMeta("mine", "ego", "train", x_range=(-30, 30), y_range=(-15, 15), ground_z_m=0.2)
START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
EAST_M, NORTH_M = 690_000.0, 5_330_000.0
CALIBRATION = """
cameras:
  front:
    intrinsics: [100, 100, 80, 45]
    position_m: [1.7, 0, 1.5]
    yaw_pitch_roll_deg: [0, 5, 0]
    distortion: [-0.3, 0.1, 0, 0]
  left:
    intrinsics: [90, 90, 80, 45]
    position_m: [1.2, 0.4, 1.4]
    yaw_pitch_roll_deg: [90, 0, 0]
ground_z_m: -0.3
poses: poses.csv
"""


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A folder with two cameras of two images; the left one 20 ms late; the car drives north."""
    folder = tmp_path / "drive"
    board = (np.indices((90, 160)).sum(0) // 10 % 2 * 255).astype(np.uint8)
    for camera, late_ns in (("front", 0), ("left", 20_000_000)):
        (folder / camera).mkdir(parents=True)
        for number in range(2):
            time_ns = START_NS + number * STEP_NS + late_ns
            cv2.imwrite(str(folder / camera / f"{time_ns}.jpg"), cv2.merge([board] * 3))
    (folder / "calibration.yaml").write_text(CALIBRATION)
    half = np.sqrt(0.5)
    rows = ["timestamp_ns,x,y,z,qw,qx,qy,qz"]
    for number in range(4):
        time_ns = START_NS + number * STEP_NS
        rows.append(f"{time_ns},{EAST_M},{NORTH_M + number},30,{half},0,0,{half}")
    (folder / "poses.csv").write_text("\n".join(rows))
    return folder


def records_of(folder: Path, **more: object) -> list[dict]:
    records = []
    for number in range(2):
        time_ns = START_NS + number * STEP_NS
        late_ns = time_ns + 20_000_000
        left = {"name": "left", "path": f"left/{late_ns}.jpg", "timestamp_ns": late_ns}
        front = {"name": "front", "path": f"front/{time_ns}.jpg"}
        record = {"token": f"t{number}", "timestamp_ns": time_ns, "cameras": [front, left]}
        records.append({**record, **more})
    return records


@pytest.mark.parametrize("frame", ["ego", "lidar"])
def test_cameras_poses_and_images_are_those_of_infer(drive: Path, frame: str, caplog) -> None:
    meta = replace(META, frame=frame, ground_z_m=0.2 if frame == "ego" else None)
    file = drive / "calibration.yaml"
    from_records(drive / "a.arrow", records_of(drive), meta, drive, calibration=file)
    assert "has no ego_from_frame" not in caplog.text
    source = read_image_folder(file, drive / "frames")
    mount = Mount(frame, meta.ground_z_m)
    expected = [change_frame(sample, "ego", mount) for sample in source.samples]
    found = list(AnnotationFile(drive / "a.arrow"))
    assert len(found) == len(expected) == 2
    for sample, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(sample.global_from_frame, wanted.global_from_frame, atol=1e-6)
        for camera, other in zip(sample.cameras, wanted.cameras, strict=True):
            assert camera.name == other.name
            np.testing.assert_allclose(camera.cam_from_frame, other.cam_from_frame, atol=1e-9)
            np.testing.assert_array_equal(camera.intrinsics, other.intrinsics)
            image = cv2.imread(str(drive / camera.path)).astype(int)
            seen = cv2.imread(str(source.data_root / other.path))
            # the left image is encoded once more by `infer`, which changes JPEG's values a little
            np.testing.assert_allclose(image, seen, atol=0 if camera.name == "front" else 3)
    # the left camera's image is 20 ms late: the car has driven 0.2 m towards its own front
    moving_m = found[0].cameras[1].cam_from_frame[0, 3]
    standing_m = mount.matrix[0, 3] - 1.2  # right of a camera that looks left is ahead of the car
    np.testing.assert_allclose(moving_m - standing_m, -0.2, atol=1e-6)


def test_the_sizes_and_poses_of_a_shard_are_those_of_all_records(drive: Path) -> None:
    """Poses at the first images of both cameras; the last shard has no image with a pose."""
    cv2.imwrite(str(drive / f"left/{START_NS + STEP_NS + 20_000_000}.jpg"), np.zeros((9, 16, 3)))
    rows = ["frame,x,y,z,qw,qx,qy,qz"]
    for name, north_m in ((START_NS, 0), (START_NS + 20_000_000, 3)):
        rows.append(f"{name},{EAST_M},{NORTH_M + north_m},30,1,0,0,0")
    (drive / "poses.csv").write_text("\n".join(rows))
    file = drive / "calibration.yaml"
    from_records(drive / "a.arrow", records_of(drive), META, drive, calibration=file)
    whole = list(AnnotationFile(drive / "a.arrow"))
    for index in range(3):  # the first of three shards has no record
        shard = Shard(index, 3)
        from_records(drive / "b.arrow", records_of(drive), META, drive, shard, calibration=file)
        part = list(AnnotationFile(shard.path_of(drive / "b.arrow")))
        for sample, wanted in zip(part, shard.part(whole), strict=True):
            np.testing.assert_array_equal(sample.global_from_frame, wanted.global_from_frame)
            for camera, other in zip(sample.cameras, wanted.cameras, strict=True):
                np.testing.assert_array_equal(camera.cam_from_frame, other.cam_from_frame)
                assert (camera.width, camera.height) == (other.width, other.height) == (160, 90)


@pytest.mark.parametrize("name", ["calibration.yaml", "poses.csv"])
def test_shards_of_other_calibrations_are_not_joined(name: str, drive: Path) -> None:
    file = drive / "calibration.yaml"
    for index in range(2):
        shard = Shard(index, 2)
        from_records(drive / "a.arrow", records_of(drive), META, drive, shard, calibration=file)
        (drive / name).write_text((drive / name).read_text() + "\n")
    with pytest.raises(ValueError, match="differs in input"):
        find_shards(drive / "a.arrow")


def test_a_map_in_grid_coordinates_comes_into_the_frame(drive: Path) -> None:
    """The car heads north: a line 2 m west of it is 2 m to its left, the road 0.2 m up."""
    west = EAST_M - 2
    line = {"label": "divider", "points": [[west, NORTH_M - 90], [west, NORTH_M + 90]]}
    records = records_of(drive, global_instances=[line])
    file = drive / "calibration.yaml"
    from_records(drive / "a.arrow", records, META, drive, calibration=file)
    for sample in AnnotationFile(drive / "a.arrow"):
        (found,) = sample.instances
        np.testing.assert_allclose(sorted(found.points.tolist()), [[-30, 2], [30, 2]], atol=1e-6)
        np.testing.assert_allclose(sample.global_from_frame[2, 3], 30 - 0.3 - 0.2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": [{"name": "rear", "path": "r.jpg"}]}, "'rear' is not in .*'front', 'left'"),
        ({"timestamp_ns": 5}, "has no pose near timestamp_ns 5"),
        ({"global_from_frame": np.eye(4)}, "has poses, too: leave out one"),
        (
            {"cameras": [{"name": "left", "path": "l.jpg", "intrinsics": np.eye(3)}]},
            r"camera 'left' has \['intrinsics'\], which .* defines: leave them out",
        ),
        ({"cameras": [{"name": "left"}]}, "it has no 'path'"),
        ({"ego_from_frame": np.diag([-1, -1, 1, 1])}, "leave it out in the frame 'ego'"),
    ],
)
def test_records_that_do_not_fit_the_file_are_named(drive: Path, change: dict, message: str):
    bad = {**records_of(drive)[1], **change}
    bad["cameras"] = change.get("cameras", bad["cameras"][:1])
    records = [records_of(drive)[0], bad]
    file = drive / "calibration.yaml"
    with pytest.raises(ValueError, match=rf"record 't1'.*{message}"):
        from_records(drive / "a.arrow", records, META, drive, calibration=file)
    assert not (drive / "a.arrow").exists()


def test_images_whose_motion_is_unknown_are_counted(drive: Path, caplog) -> None:
    file = drive / "calibration.yaml"
    records = records_of(drive)
    from_records(drive / "a.arrow", records, META, drive, calibration=file)
    assert "neglected" not in caplog.text
    records[1]["cameras"][1]["timestamp_ns"] += 10**9
    from_records(drive / "a.arrow", records, META, drive, calibration=file)
    assert "camera 'left': no pose is near the time of its image at 1 of 2 samples" in caplog.text
    file.write_text(CALIBRATION.replace("poses: poses.csv", ""))
    records = records_of(drive, global_from_frame=np.eye(4))
    from_records(drive / "a.arrow", records, META, drive, calibration=file)
    assert "camera 'left': no pose is near the time of its image at 2 of 2 samples" in caplog.text
    assert "'front'" not in caplog.text


def test_a_missing_or_malformed_calibration_file_is_named(drive: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.yaml"):
        from_records(drive / "a", records_of(drive), META, drive, calibration=drive / "none.yaml")
    (drive / "calibration.yaml").write_text("cameras: {front: {intrinsic: 3}}")
    file = drive / "calibration.yaml"
    with pytest.raises(ValueError, match=r"camera 'front'.*unknown keys \['intrinsic'\]"):
        from_records(drive / "a", records_of(drive), META, drive, calibration=file)


@pytest.mark.parametrize("named", [False, True])
def test_a_name_of_images_of_different_times_is_refused_as_the_time_of_a_pose(
    drive: Path, named: bool
) -> None:
    """Both cameras call their images 0 and 1, which the left one took 20 ms later."""
    records = records_of(drive)
    for number, record in enumerate(records):
        for camera in record["cameras"]:
            path = f"{camera['name']}/{number}.jpg"
            (drive / camera["path"]).rename(drive / path)
            camera["path"] = path
    file = drive / "calibration.yaml"
    if named:
        poses = drive / "poses.csv"
        poses.write_text(f"frame,x,y,z,qw,qx,qy,qz\n0,{EAST_M},{NORTH_M},30,1,0,0,0")
        with pytest.raises(ValueError, match=r"line 2: frame '0' names images of different times"):
            from_records(drive / "a.arrow", records, META, drive, calibration=file)
    else:  # the names do not matter
        from_records(drive / "a.arrow", records, META, drive, calibration=file)
        assert len(AnnotationFile(drive / "a.arrow")) == 2


def test_a_camera_twice_and_a_record_without_time_are_refused(drive: Path) -> None:
    file = drive / "calibration.yaml"
    records = records_of(drive)
    records[1]["cameras"] *= 2
    with pytest.raises(ValueError, match=r"record 't1'.*camera 'front' appears twice"):
        from_records(drive / "a.arrow", records, META, drive, calibration=file)
    records = records_of(drive)
    del records[1]["timestamp_ns"]
    with pytest.raises(ValueError, match=r"record 't1'.*names poses: give timestamp_ns"):
        from_records(drive / "a.arrow", records, META, drive, calibration=file)
