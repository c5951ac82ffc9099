"""Annotation files: what is written comes back, and a wrong or half file is refused."""

import errno
import os
import pickle
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from sample_cases import INTRINSICS, META, assert_same, pose, sample

from gsmap.datasets.annotations.file import AnnotationFile, AnnotationWriter, write_annotations
from gsmap.datasets.annotations.record import (
    AnnotationMeta,
    CameraRecord,
    LidarRecord,
    MapInstance,
    SweepRecord,
)
from gsmap.structures.rigid import rigid
from gsmap.utils.faults import user_message


def test_every_field_survives_across_batches_and_with_absent_parts(tmp_path: Path):
    samples = [sample(i) for i in range(300)]
    samples[1] = sample(1, lidar=None, can_bus=None, instances=None)
    samples[2] = sample(2, cameras=[], instances=[])
    samples[299] = sample(299, lidar=None)
    path = tmp_path / "deep" / "val.arrow"
    assert write_annotations(path, META, samples) == 300
    file = AnnotationFile(path)
    assert len(file) == 300
    for found, wanted in zip(file, samples, strict=True):
        assert_same(found, wanted)
    assert file[1].lidar is None
    assert file[1].can_bus is None
    assert file[1].instances is None
    assert file[2].instances == []
    assert file[-1].lidar is None
    last = file[-2]
    assert last.token == "token298"
    np.testing.assert_array_equal(last.can_bus, np.arange(18.0))
    assert [i.label for i in last.instances] == [2, 0]
    np.testing.assert_array_equal(last.instances[0].points, samples[298].instances[0].points)
    assert last.instances[1].points.shape == (2, 2)
    assert last.lidar.path == "lidar/0.bin"
    assert (last.lidar.sweeps[0].path, last.lidar.sweeps[0].timestamp_ns) == ("lidar/-1.bin", 5)
    np.testing.assert_array_equal(last.lidar.sweeps[0].frame_from_lidar, pose(2))
    np.testing.assert_array_equal(last.lidar.frame_from_lidar, pose(1))
    assert file.column("token")[257] == "token257"
    assert file.meta == META


def test_a_file_without_samples_or_cameras_or_truth_opens(tmp_path: Path):
    assert write_annotations(tmp_path / "none.arrow", META, []) == 0
    assert len(AnnotationFile(tmp_path / "none.arrow")) == 0
    write_annotations(
        tmp_path / "bare.arrow",
        META,
        [sample(0, cameras=[], lidar=None, can_bus=None, instances=None)],
    )
    assert AnnotationFile(tmp_path / "bare.arrow")[0].can_bus is None


def test_three_dimensional_points(tmp_path: Path):
    meta = replace(META, dim=3)
    points = np.array([[0, 0, 1], [1, 1, 2]], np.float32)
    write_annotations(tmp_path / "a.arrow", meta, [sample(instances=[MapInstance(0, points)])])
    np.testing.assert_array_equal(
        AnnotationFile(tmp_path / "a.arrow")[0].instances[0].points, points
    )


def test_pickle_hands_on_the_path_and_checksums_alone(tmp_path: Path):
    write_annotations(tmp_path / "a.arrow", META, [sample(i) for i in range(100)])
    data = pickle.dumps(AnnotationFile(tmp_path / "a.arrow"))
    assert len(data) < 500
    assert_same(pickle.loads(data)[42], sample(42))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"instances": [MapInstance(3, np.zeros((2, 2)))]}, "label 3"),
        ({"instances": [MapInstance(0, np.zeros((1, 2)))]}, r"n >= 2, 2"),
        ({"instances": [MapInstance(0, np.full((2, 2), np.nan))]}, "NaN"),
        ({"instances": [MapInstance(-1, np.zeros((2, 2)))]}, "sample 'token0': label -1 is none"),
        (
            {"instances": [MapInstance(0, np.zeros((2, 3)))]},
            r"points must be numbers \(n >= 2, 2\)",
        ),
        ({"instances": [MapInstance(0, [["1", "2"], ["3", "4"]])]}, "points must be numbers"),
        ({"global_from_frame": np.diag([1, 1, -1, 1])}, "'token0': global_from_frame is no rigid"),
        ({"ego_from_frame": np.diag([2, 2, 2, 1])}, "ego_from_frame is no rigid"),
        ({"ego_from_frame": np.full((4, 4), np.inf)}, "ego_from_frame is no rigid"),
        ({"can_bus": np.full(18, np.nan)}, "can_bus holds NaN"),
        ({"lidar": LidarRecord("../a.bin", np.eye(4))}, r"LiDAR path must be .*got '../a.bin'"),
        ({"lidar": LidarRecord("a", np.eye(4), [SweepRecord("/b", 0, np.eye(4))])}, "got '/b'"),
        ({"timestamp_ns": 2**70}, "'token7' to 'token0'"),
        ({"scene": 5}, "sample 'token0': scene must be text, got 5"),
        (
            {"cameras": [CameraRecord("A", "x", 0, 1, INTRINSICS, np.eye(4))]},
            "size is not positive",
        ),
        *(
            ({"cameras": [CameraRecord("A", "x", 1, 1, np.diag(f), np.eye(4))]}, "lengths > 0")
            for f in ([0.0, 9.0, 1.0], [9.0, 0.0, 1.0], [-9.0, 9.0, 1.0], [9.0, -9.0, 1.0])
        ),
        ({"global_from_frame": np.eye(3)}, r"global_from_frame .*\(4, 4\)"),
        ({"can_bus": np.zeros(16)}, r"can_bus .*\(18,\)"),
        (
            {"cameras": [CameraRecord("A", "/etc/x.jpg", 1, 1, INTRINSICS, np.eye(4))]},
            "relative to the data root",
        ),
        (
            {"cameras": [CameraRecord("A", "x.jpg", 1, 1, INTRINSICS, np.eye(4))] * 2},
            "appears twice",
        ),
        ({"token": ""}, "token"),
        (
            {"instances": [MapInstance(0, np.array([[0.0, 0.0], [1e9, 0.0]]))]},
            "nor beyond 100 km",
        ),
        ({"global_from_frame": rigid(np.eye(3), (1e12, 0, 0))}, "translation within 100,000 km"),
        ({"scene": "../x"}, "scene '../x' would lead out of a folder"),
        ({"scene": "/abs/x"}, "scene '/abs/x' would lead out of a folder"),
        ({"map_name": "a\\..\\b"}, "map_name .* would lead out of a folder"),
        ({"scene": "\x1b[2J"}, r"scene '\\x1b\[2J' .*control characters"),
        ({"cameras": [CameraRecord("", "x", 1, 1, INTRINSICS, np.eye(4))]}, "name '' .*is empty"),
        (
            {"cameras": [CameraRecord(n, "x", 1, 1, INTRINSICS, np.eye(4)) for n in ("", "B")]},
            "name '' .*is empty",
        ),
        (
            {"cameras": [CameraRecord(p, p, 1, 1, INTRINSICS, np.eye(4)) for p in ("A", "", "B")]},
            "name '' .*is empty",
        ),
        (
            {
                "cameras": [
                    CameraRecord("A", "", 1, 1, INTRINSICS, np.eye(4)),
                    CameraRecord("B", "b.jpg", 1, 1, INTRINSICS, np.eye(4)),
                ]
            },
            "path must be relative .*got ''",
        ),
        (
            {"cameras": [CameraRecord("a/../../b", "x", 1, 1, INTRINSICS, np.eye(4))]},
            "name 'a/../../b' .*would lead out of a folder",
        ),
    ],
)
def test_a_malformed_sample_is_refused_and_leaves_nothing(
    tmp_path: Path, changes: dict, message: str
):
    with pytest.raises(ValueError, match=message):
        write_annotations(tmp_path / "a.arrow", META, [sample(7), sample(**changes)])
    assert list(tmp_path.iterdir()) == []


def test_a_failed_rewrite_keeps_the_old_file(tmp_path: Path):
    write_annotations(tmp_path / "a.arrow", META, [sample(1)])
    with pytest.raises(ValueError, match="already written"):
        write_annotations(tmp_path / "a.arrow", META, [sample(2), sample(2)])
    assert AnnotationFile(tmp_path / "a.arrow")[0].token == "token1"
    assert [p.name for p in tmp_path.iterdir()] == ["a.arrow"]


def test_leftovers_of_a_killed_writer_are_removed(tmp_path: Path):
    writer = AnnotationWriter(tmp_path / "a.arrow", META)
    if (pid := os.fork()) == 0:
        writer.__enter__()
        os._exit(0)  # without its end, as if it was killed
    os.waitpid(pid, 0)
    assert len(list(tmp_path.iterdir())) == 1
    with AnnotationWriter(tmp_path / "a.arrow", META) as writer:
        writer.write(sample())
    assert [p.name for p in tmp_path.iterdir()] == ["a.arrow"]


def test_mismatch_names_the_field_and_what_to_run(tmp_path: Path):
    write_annotations(tmp_path / "a.arrow", META, [sample()])
    file = AnnotationFile(tmp_path / "a.arrow")
    file.require(
        classes=["divider", "ped_crossing", "boundary"], split="val", x_range=[-15, 15], frame=None
    )
    with pytest.raises(
        ValueError, match=r"classes .*boundary.*config asks for \('divider',\).*`make it`"
    ):
        file.require(classes=("divider",))
    with pytest.raises(ValueError, match="split val, the config asks for train"):
        file.require(split="train")
    with pytest.raises(ValueError, match=r"y_range \(-30.0, 30.0\)"):
        file.require(y_range=(-50, 50))


def test_half_foreign_and_outdated_files_are_refused(tmp_path: Path):
    path = tmp_path / "a.arrow"
    with pytest.raises(FileNotFoundError, match="create_data"):
        AnnotationFile(path)
    write_annotations(path, META, [sample()])
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ValueError, match="not a whole annotation file"):
        AnnotationFile(path)
    table = pa.table({"a": [1]})
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)
    with pytest.raises(ValueError, match="not an annotation file"):
        AnnotationFile(path)
    write_annotations(path, replace(META, format_version=99), [sample()])
    with pytest.raises(ValueError, match=r"format version 99.*`make it`"):
        AnnotationFile(path)


def test_the_usual_range_is_60_m_along_the_road_and_30_m_across():
    lidar, ego = (AnnotationMeta("x", frame, "val") for frame in ("lidar", "ego"))
    assert (lidar.x_range, lidar.y_range) == ((-15.0, 15.0), (-30.0, 30.0))
    assert (ego.x_range, ego.y_range) == ((-30.0, 30.0), (-15.0, 15.0))


def test_meta_refuses_bad_values():
    with pytest.raises(ValueError, match="frame"):
        AnnotationMeta("x", "camera", "val")
    for x_range in ((1, 1), (1, np.inf), (-np.inf, 1)):
        with pytest.raises(ValueError, match="x_range"):
            AnnotationMeta("x", "ego", "val", x_range=x_range)
    with pytest.raises(ValueError, match="classes"):
        AnnotationMeta("x", "ego", "val", classes=("a", "a"))
    with pytest.raises(ValueError, match="classes must be different names"):
        AnnotationMeta("x", "ego", "val", classes="abc")
    with pytest.raises(ValueError, match="at most 1000 classes, not 1001"):
        AnnotationMeta("x", "ego", "val", classes=[f"class {i}" for i in range(1001)])
    with pytest.raises(ValueError, match="dataset must be a text"):
        AnnotationMeta(3, "ego", "val")
    for dim in (4, 2.0, True, "2"):
        with pytest.raises(ValueError, match=f"dim must be 2 or 3, got {dim!r}"):
            AnnotationMeta("x", "ego", "val", dim=dim)


def test_a_full_disk_leaves_the_old_file_alone(tmp_path: Path):
    write_annotations(tmp_path / "a.arrow", META, [sample(1)])
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))  # writing more fails
    try:
        with pytest.raises(OSError, match="File too large"):
            write_annotations(tmp_path / "a.arrow", META, [sample(i) for i in range(300)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert AnnotationFile(tmp_path / "a.arrow")[0].token == "token1"
    assert [p.name for p in tmp_path.iterdir()] == ["a.arrow"]


def test_what_the_machine_lacks_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "a.arrow"
    write_annotations(path, META, [])
    for error in (
        OSError(errno.EMFILE, "Too many open files"),
        OSError(errno.EACCES, "Permission denied"),
        pa.ArrowMemoryError("malloc of size 64 failed"),
    ):

        def failing(*_: object, error: Exception = error) -> None:
            raise error

        with monkeypatch.context() as patch:
            patch.setattr(pa, "memory_map", failing)
            with pytest.raises(type(error)) as raised:
                AnnotationFile(path)
        assert raised.value is error
        assert "delete" not in user_message(raised.value)
    AnnotationFile(path)
