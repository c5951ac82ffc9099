"""Own data: the documented example runs, and mistakes are named."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.evaluation import ChamferConfig, MapEvaluator
from gsmap.evaluation.core.file_evaluation import evaluate_files
from gsmap.structures.frames import FRAME_VIEWS
from mapdata.custom import from_records
from mapdata.vectors_json import write_vectors

REPO = Path(__file__).resolve().parents[2]
DOC = REPO / "docs/custom_data.md"
META = AnnotationMeta("mine", "ego", "train", x_range=(-30, 30), y_range=(-15, 15))


def record(**changes) -> dict:
    camera = {
        "name": "front",
        "path": "a.jpg",
        "intrinsics": np.eye(3),
        "cam_from_frame": np.eye(4),
        "width": 8,
        "height": 6,
    }
    return {"token": "t", "cameras": [camera], **changes}


def elements(tmp_path: Path, *instances: dict, meta: AnnotationMeta = META) -> list:
    from_records(tmp_path / "a.arrow", [record(instances=list(instances))], meta, tmp_path)
    return AnnotationFile(tmp_path / "a.arrow")[0].instances


def test_the_documented_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", DOC.read_text(), re.DOTALL)
    assert len(blocks) == 2
    scope: dict = {}
    for block in blocks:
        exec(block, scope)
    labels = [i.label for i in AnnotationFile("my_data/train.arrow")[0].instances]
    assert labels == [0, 1, 2]
    divider = AnnotationFile("my_data/train.arrow")[0].instances[0].points
    np.testing.assert_allclose(divider[[0, -1], 0], [-30, 30])
    assert AnnotationFile("my_data/all.arrow")[1].instances is None
    assert scope["data"]["inputs"]["img"].shape == (2, 3, 180, 320)
    meta = scope["data"]["data_samples"].metainfo
    # the crossing's near right corner, 8 m ahead and 4 m to the right, seen by the front camera
    u, v, depth, _ = meta["lidar2img"][0] @ np.array([8, -4, 0, 1])
    assert depth == pytest.approx(8)
    assert (u / depth, v / depth) == pytest.approx((160 + 200 * 4 / 8, 90 + 200 * 1.5 / 8))


def test_a_ring_that_leaves_the_range_stays_a_ring(tmp_path: Path):
    square = [[25, 0], [35, 0], [35, 5], [25, 5], [25, 0]]
    (ring,) = elements(tmp_path, {"label": 1, "points": square})
    np.testing.assert_array_equal(ring.points[0], ring.points[-1])
    assert ring.points[:, 0].max() == 30
    assert elements(tmp_path, {"label": 0, "points": [[40, 0], [50, 0]]}) == []
    assert elements(tmp_path, {"label": 1, "points": [[40, 0], [50, 0], [50, 5], [40, 0]]}) == []


@pytest.mark.parametrize("label", [0, 2])
def test_a_closed_line_is_open_where_it_leaves_the_range(label: int, tmp_path: Path):
    island = [[25, 6], [35, 6], [35, 24], [25, 24], [25, 6]]
    (line,) = elements(tmp_path, {"label": label, "points": island})
    np.testing.assert_allclose(line.points, [[25, 15], [25, 6], [30, 6]])
    inside = [[20, 6], [28, 6], [28, 12], [20, 6]]
    (ring,) = elements(tmp_path, {"label": label, "points": inside})
    np.testing.assert_array_equal(ring.points, inside)


def test_height_is_interpolated_where_a_line_is_cut(tmp_path: Path):
    meta = AnnotationMeta("mine", "ego", "train", x_range=(-30, 30), y_range=(-15, 15), dim=3)
    (line,) = elements(tmp_path, {"label": 0, "points": [[20, 0, 0], [40, 0, 2]]}, meta=meta)
    np.testing.assert_allclose(line.points, [[20, 0, 0], [30, 0, 1]])


@pytest.mark.parametrize(
    "xy",
    [
        [[29, -20], [60, -20], [60, 20], [29, 20]],  # two corners
        [[20, 10], [50, 10], [50, 40], [20, 40]],  # one corner
        [[-90, -70], [90, -50], [70, 90], [-80, 60]],  # the whole range
        [[-40, 10], [40, 10], [40, 40], [35, 40], [35, 14], [-35, 14], [-35, 40], [-40, 40]],
    ],
)
def test_corners_of_the_range_lie_on_the_plane_of_a_ring(xy: list, tmp_path: Path):
    points = [[x, y, 2 + 0.1 * x - 0.05 * y] for x, y in [*xy, xy[0]]]
    rings = elements(tmp_path, {"label": 1, "points": points}, meta=replace(META, dim=3))
    for ring in rings:
        x, y, z = ring.points.T
        np.testing.assert_allclose(z, 2 + 0.1 * x - 0.05 * y, atol=1e-5)
        assert np.abs(x).max() <= 30
        assert np.abs(y).max() <= 15


def test_a_corner_inside_of_a_ring_that_is_no_plane_fits_the_cuts_beside_it(tmp_path: Path):
    """The range cuts off the right and the upper part, with the corner at z = 4.

    (20, 21) 0 ---------- 4 (36, 21)    The best plane is
             |            |             z = 1 + (x - 28) / 8 + (y - 13) / 8.
    (20, 15) x- - - + (30, 15)          It is 0.25 m above both cuts, x, whose height is 0,
             |      |     |             and 1.5 m high at the corner, +, which gets 1.25 m.
    (20, 5)  0 -----x---- 0 (36, 5)
    """
    points = [[20, 5, 0], [36, 5, 0], [36, 21, 4], [20, 21, 0], [20, 5, 0]]
    (ring,) = elements(tmp_path, {"label": 1, "points": points}, meta=replace(META, dim=3))
    heights = {(x, y): z for x, y, z in ring.points.tolist()}
    expected = {(20, 5): 0, (20, 15): 0, (30, 15): 1.25, (30, 5): 0}
    assert heights == pytest.approx(expected)


def test_no_image_outside_of_the_data_root_is_opened(tmp_path: Path):
    root = tmp_path / "root"
    root.mkdir()
    cv2.imwrite(str(tmp_path / "secret.png"), np.zeros((6, 8, 3), np.uint8))
    camera = record()["cameras"][0] | {"path": "../secret.png"}
    unsized = {key: value for key, value in camera.items() if key not in ("width", "height")}
    distorted = camera | {"distortion": [0.1, 0, 0, 0]}
    for changed in (unsized, distorted):
        with pytest.raises(
            ValueError, match=r"record 't' .* camera 'front': the path must lie below .*root"
        ):
            from_records(root / "a.arrow", [record(cameras=[changed])], META, root)
    assert list(root.iterdir()) == []


@pytest.mark.parametrize("frame", ["ego", "lidar"])
def test_an_unknown_mounting_is_not_the_identity(frame: str, tmp_path: Path, caplog):
    """Lines must lie on the road: 1.84 m below a LiDAR by default, not at its own height."""
    meta = AnnotationMeta("mine", frame, "train")
    mounted = np.eye(4)
    mounted[2, 3] = 1.5
    records = [
        record(),
        {**record(ego_from_frame=mounted), "token": "u"},
        {**record(), "token": "v"},
    ]
    from_records(tmp_path / "a.arrow", records, meta, tmp_path)
    file = AnnotationFile(tmp_path / "a.arrow")
    heights = [FRAME_VIEWS[frame].with_mounting(sample.ego_from_frame).ground for sample in file]
    usual = FRAME_VIEWS[frame].ground
    assert heights == [usual, (0, 0, FRAME_VIEWS[frame].ego_ground_z_m - 1.5), usual]
    unknown = [sample.ego_from_frame is None for sample in file]
    assert unknown == ([True, False, True] if frame == "lidar" else [False] * 3)
    assert caplog.text.count("has no ego_from_frame") == (frame == "lidar")


def test_lidar_and_signals_are_kept(tmp_path: Path):
    sweep = {"path": "s.bin", "timestamp_ns": 3, "frame_from_lidar": np.diag([-1.0, -1, 1, 1])}
    lidar = {"path": "l.bin", "frame_from_lidar": np.eye(4), "sweeps": [sweep]}
    from_records(tmp_path / "a.arrow", [record(lidar=lidar, can_bus=range(18))], META, tmp_path)
    sample = AnnotationFile(tmp_path / "a.arrow")[0]
    assert (sample.lidar.path, sample.lidar.sweeps[0].path) == ("l.bin", "s.bin")
    assert sample.can_bus[17] == 17


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (record(gt=[]), r"unknown keys \['gt'\]"),
        (
            record(cameras=[{**record()["cameras"][0], "distortions": [-0.3, 0.1, 0, 0]}]),
            r"camera 'front': unknown keys \['distortions'\]; known are \['cam_from_frame'",
        ),
        (record(lidar={"path": "l.bin", "sweep": []}), r"lidar: unknown keys \['sweep'\]"),
        (record(lidar="l.bin"), r"lidar: expected a mapping with \['frame_from_lidar', .*'l.bin'"),
        (record(cameras=["front.jpg"]), "a mapping for each camera, got 'front.jpg'"),
        ("front.jpg", r"record 0 cannot be used: expected a mapping with \['cameras', .*front.jpg"),
        ({"token": "t"}, "record 't' cannot be used: it has no 'cameras'"),
        (record(instances=[{"label": "tree", "points": [[0, 0], [1, 1]]}]), "'tree' is not among"),
        (record(instances=[{"label": 0, "points": [[0, 0, 0], [1, 1, 1]]}]), r"\(n >= 2, 2\)"),
        (record(instances=[{"label": 0, "points": [[0, np.nan], [1, 1]]}]), "NaN"),
        ({**record(), "token": 5}, "sample 5: token must be text, got 5"),
        (record(scene=7), "sample 't': scene must be text, got 7"),
        ({**record(), "timestamp_ns": 0.5}, "sample 't': timestamp_ns must be a whole number"),
        (
            record(instances=[{"label": 1.7, "points": [[0, 0], [1, 1]]}]),
            "record 't' cannot be used: label must be a whole number, got 1.7",
        ),
        (record(lidar={"path": Path("l.bin")}), "sample 't': path must be text, got PosixPath"),
        (
            record(instances=[{"label": 1, "points": [[0, 0], [40, 9], [40, 0], [0, 9], [0, 0]]}]),
            "crosses itself",
        ),
    ],
)
def test_mistakes_are_named_and_leave_nothing(tmp_path: Path, bad: dict, message: str):
    with pytest.raises(ValueError, match=message):
        from_records(tmp_path / "a.arrow", [bad], META, tmp_path)
    assert not list(tmp_path.iterdir())


def test_areas_that_are_open_lines_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    ring = [[8, -4], [11, -4], [11, 4], [8, 4]]
    elements(tmp_path, {"label": 1, "points": [*ring, ring[0]]}, {"label": 0, "points": ring})
    assert "open lines" not in caplog.text
    elements(tmp_path, {"label": 1, "points": ring})
    assert (
        "1 of 1 records have crossings or other areas that are open lines (the first is 't')"
        in (caplog.text)
    )


def test_a_missing_or_broken_image_is_named(tmp_path: Path):
    bare = record()
    del bare["cameras"][0]["width"]
    with pytest.raises(FileNotFoundError, match=r"'t', camera 'front': no image"):
        from_records(tmp_path / "a.arrow", [bare], META, tmp_path)
    (tmp_path / "a.jpg").write_text("no picture")
    with pytest.raises(ValueError, match="not an image"):
        from_records(tmp_path / "a.arrow", [bare], META, tmp_path)


def test_a_map_in_pieces_is_joined_on_request(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """Two tiles meet at x = 0, 5 cm apart; the second line of the east runs west.

    .. code-block:: text

        y = 2:  -20 ---- 0 | 0 ---- 20     one line
        y = -2: -20 ---- 0, then a fork to (20, -2) and (20, -6): three lines stay
        two halves of a crossing are one ring, a boundary is no divider
    """
    ring = [[8, -4], [11, -4], [11, 4], [8, 4], [8, -4]]
    pieces = [
        {"label": 0, "points": [[-20, 2], [0, 2]]},
        {"label": 0, "points": [[20, 2], [0.04, 2.03]]},
        {"label": 0, "points": [[-20, -2], [0, -2]]},
        {"label": 0, "points": [[0, -2], [20, -2]]},
        {"label": 0, "points": [[0, -2], [20, -6]]},
        {"label": 1, "points": ring[:3]},
        {"label": 1, "points": ring[2:]},
        {"label": 2, "points": [[0, 2], [0, 10]]},
    ]
    assert len(elements(tmp_path, *pieces)) == 8
    assert "open lines" in caplog.text
    caplog.clear()
    from_records(tmp_path / "j.arrow", [record(instances=pieces)], META, tmp_path, join=True)
    found = AnnotationFile(tmp_path / "j.arrow")[0].instances
    assert "open lines" not in caplog.text
    assert sorted(item.label for item in found) == [0, 0, 0, 0, 1, 2]
    (whole,) = [item.points for item in found if np.ptp(item.points[:, 0]) > 30]
    assert sorted(whole[:, 0].tolist()) == [-20, 0, 20]
    (crossing,) = [item.points for item in found if item.label == 1]
    np.testing.assert_array_equal(crossing, ring)


def test_lines_through_the_same_corners_in_another_order_are_no_copies(tmp_path: Path, caplog):
    corners = np.array([[0, 0], [0, 5], [8, 5], [8, 0.0]])
    pieces = [{"label": 2, "points": corners}, {"label": 2, "points": corners[[1, 0, 3, 2]]}]
    from_records(tmp_path / "j.arrow", [record(instances=pieces)], META, tmp_path)
    assert "copies" not in caplog.text
    from_records(tmp_path / "j.arrow", [record(instances=pieces)], META, tmp_path, join=True)
    assert len(AnnotationFile(tmp_path / "j.arrow")[0].instances) == 2


def test_a_line_of_two_lanes_is_one_line(tmp_path: Path):
    line = np.array([[0, 0], [10, 0], [20, 1.0]])
    onward = np.array([[20, 1], [25, 1], [28, 2.0]])
    ring = np.array([[8, -4], [11, -4], [11, 4], [8, -4.0]])
    turned = ring[[1, 2, 0, 1]]
    dense = np.array([[0, 0], [5, 0], [10, 0], [20, 1.0]])
    copies = [line, line[::-1], line + 1e-9, line + np.array([4e-4, -3e-4]), dense[::-1]]
    copies += [onward, onward, ring, ring[::-1], turned]
    pieces = []
    for points in copies:
        pieces.append({"label": 0, "points": points})
    pieces.append({"label": 2, "points": line})  # another class
    from_records(tmp_path / "j.arrow", [record(instances=pieces)], META, tmp_path, join=True)
    found = AnnotationFile(tmp_path / "j.arrow")[0].instances
    assert [item.label for item in found] == [0, 0, 2]
    np.testing.assert_array_equal(found[0].points, ring)
    assert sorted(found[1].points[:, 0].tolist()) == [0, 10, 20, 25, 28]
    np.testing.assert_array_equal(found[2].points, line)


@pytest.mark.parametrize(
    ("change", "is_copy"),
    [
        ({"points": [[56, 2.0], [0, 0]]}, True),
        ({"points": [[0, 0.005], [14, 0.5], [84, 3.0]]}, True),  # equal where they are in range
        ({"points": [[0, 0.05], [56, 2.05]]}, False),  # two painted lines
        ({"points": [[0, 0], [14, 0.5]]}, False),
        ({"label": 2}, False),
    ],
)
def test_copies_of_a_line_are_counted(tmp_path: Path, caplog, change: dict, is_copy: bool):
    line = {"label": 0, "points": [[0, 0], [56, 2.0]]}
    other = {"label": 2, "points": [[-5, -3], [5, -3]]}
    records = [
        record(token="plain", instances=[line, other]),
        record(token="copied", instances=[line, other, {**line, **change}]),
        record(token="unknown"),
    ]
    from_records(tmp_path / "a.arrow", records, META, tmp_path)
    text = "1 of 3 records have elements that are copies of others (the first is 'copied')"
    assert (text in caplog.text) == is_copy
    assert ("copies of others" in caplog.text) == is_copy
    caplog.clear()
    from_records(tmp_path / "a.arrow", records, META, tmp_path, join=True)
    assert "copies of others" not in caplog.text


def test_joined_pieces_keep_their_heights(tmp_path: Path):
    pieces = [
        {"label": 0, "points": [[-5, 0, 1.0], [0, 0, 2.0]]},
        {"label": 0, "points": [[0, 0.05, 2.5], [5, 0, 3.0]]},
    ]
    meta = replace(META, dim=3)
    from_records(tmp_path / "j.arrow", [record(instances=pieces)], meta, tmp_path, join=True)
    (line,) = AnnotationFile(tmp_path / "j.arrow")[0].instances
    assert sorted(line.points[:, 2].tolist()) == [1.0, 2.0, 3.0]
    short = [{"label": 0, "points": [[0, 0], [0.03, 0]]}]
    from_records(tmp_path / "s.arrow", [record(instances=short)], META, tmp_path, join=True)
    assert len(AnnotationFile(tmp_path / "s.arrow")[0].instances) == 1


WITH_CENTERLINE = replace(META, classes=(*META.classes, "centerline"))


def joined_lines(tmp_path: Path, label: str, lines: list, dim: int = 2) -> list:
    """Vertices of the elements of a class after joining, in order."""
    instances = [{"label": label, "points": points} for points in lines]
    meta = replace(WITH_CENTERLINE, dim=dim)
    path = tmp_path / "j.arrow"
    from_records(path, [record(instances=instances)], meta, tmp_path, join=True)
    found = AnnotationFile(path)[0].instances
    assert {meta.classes[item.label] for item in found} == {label}
    return sorted(item.points.round(3).tolist() for item in found)


A, B, C, D = [-20, 0], [0, 0], [20, 0], [20, 9]
RING = [[0, 0], [5, 0], [5, 5], [0, 0]]


@pytest.mark.parametrize(
    ("lines", "centerlines", "dividers"),
    [
        ([[A, B], [B, C]], [[A, B, C]], 1),
        ([[C, B], [B, A]], [[C, B, A]], 1),
        ([[A, B], [C, B]], [[A, B], [C, B]], 1),  # head-on
        ([[B, A], [B, C]], [[B, A], [B, C]], 1),  # both start here
        ([[A, C], [C, A]], [[A, C], [C, A]], 1),  # both directions on one line
        ([[A, B, C], [C, A], [[0, 0.004], A], [A, C]], [[A, B, C], [B, A], [C, A]], 1),
        # Both directions, in tiles
        ([[A, B], [B, A], [B, C], [C, B]], [[A, B, C], [C, B, A]], 1),
        ([[A, B], [B, C], [B, D]], [[A, B], [B, C], [B, D]], 3),  # a fork
        ([[A, B], [C, B], [B, D]], [[A, B], [B, D], [C, B]], 3),
        ([[A, B, C], [C, D], [D, C], [C, [10, 0]]], [[A, B, C, D], [D, C, [10, 0]]], 3),
        ([RING, RING[::-1], RING], sorted([RING, RING[::-1]]), 1),  # a roundabout
        ([RING[:3], RING[2:]], [RING], 1),
    ],
)
def test_centre_lines_are_joined_in_their_direction(
    tmp_path: Path, lines: list, centerlines: list, dividers: int
):
    found = joined_lines(tmp_path, "centerline", lines)
    assert len(found) == len(centerlines)
    for points, expected in zip(found, centerlines, strict=True):
        np.testing.assert_allclose(points, expected, atol=0.005)
    assert len(joined_lines(tmp_path, "divider", lines)) == dividers


@pytest.mark.parametrize("label", ["divider", "centerline"])
def test_lines_of_a_bridge_are_neither_joined_nor_copies(tmp_path: Path, label: str):
    def high(line: list, z_m: float) -> list:
        return [[x, y, z_m] for x, y in line]

    for lines, count in (
        ([high([A, B], 0), high([[0.05, 0], C], 6)], 2),
        ([high([A, B], 0), high([B, C], 6)], 2),
        ([high([A, B], 0), high([B, C], 0.4), high([A, B], 6), high([B, C], 6.2)], 2),
        ([high([A, C], 0), high([A, C], 6)], 2),
        ([high([A, C], 0), high([A, C], 0.5)], 1),
        ([high(RING, 0), high(RING, 6)], 2),
    ):
        found = joined_lines(tmp_path, label, lines, dim=3)
        assert len(found) == count
        heights = {round(points[0][2]) for points in found}
        assert heights == ({0, 6} if count == 2 else {0})


def test_an_exported_file_is_ground_truth_for_the_evaluation(tmp_path: Path):
    line = {"label": "boundary", "points": [[-20, 2], [0, 2], [20, 3]]}
    from_records(tmp_path / "a.arrow", [record(instances=[line])], META, tmp_path)
    assert write_vectors([tmp_path / "a.arrow"], tmp_path / "a.json") == 1
    found = {"pts": line["points"], "cls_name": "boundary", "confidence_level": 0.9}
    results = {"results": [{"sample_token": "t", "vectors": [found]}]}
    (tmp_path / "r.json").write_text(json.dumps(results))
    evaluator = MapEvaluator(ChamferConfig(META.classes))
    (report,), _ = evaluate_files(tmp_path / "r.json", tmp_path / "a.json", evaluator)
    assert report.metrics["chamfer/boundary/AP"] == 1.0


def test_the_reader_and_the_writer_are_names_of_the_package():
    import mapdata

    assert mapdata.from_records is from_records
    assert {"from_records", "open_input"} <= set(dir(mapdata))


def test_a_map_in_global_coordinates_is_moved_into_each_frame(tmp_path: Path):
    """The vehicle stands at (500000, 4000000) and looks north: north is ahead, west is left."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = 500_000, 4_000_000, 30
    line = {"label": "divider", "points": [[499_998, 3_999_000], [499_998, 4_001_000]]}
    whole = {"global_instances": [line], "global_from_frame": pose}
    from_records(tmp_path / "g.arrow", [record(**whole)], META, tmp_path)
    (found,) = AnnotationFile(tmp_path / "g.arrow")[0].instances
    np.testing.assert_allclose(sorted(found.points.tolist()), [[-30, 2], [30, 2]], atol=1e-6)
    with_height = {"label": 0, "points": [[499_998, 4_000_000, 29], [499_998, 4_000_010, 28.5]]}
    meta = replace(META, dim=3)
    record_3d = record(global_instances=[with_height], global_from_frame=pose)
    from_records(tmp_path / "h.arrow", [record_3d], meta, tmp_path)
    (found,) = AnnotationFile(tmp_path / "h.arrow")[0].instances
    np.testing.assert_allclose(found.points, [[0, 2, -1], [10, 2, -1.5]], atol=1e-6)
    for points in (line["points"], [], np.zeros((2, 5, 3))):
        bad = {"global_instances": [{"label": 0, "points": points}], "global_from_frame": pose}
        with pytest.raises(ValueError, match=r"global_instances must be \(n >= 2, 3\)"):
            from_records(tmp_path / "w.arrow", [record(**bad)], meta, tmp_path)
    for changes, message in (
        ({"global_instances": [line]}, "need global_from_frame"),
        ({**whole, "instances": []}, "not both"),
    ):
        with pytest.raises(ValueError, match=f"record 't'.*{message}"):
            from_records(tmp_path / "w.arrow", [record(**changes)], META, tmp_path)


def test_global_coordinates_that_were_rounded_to_float32_are_counted(tmp_path: Path, caplog):
    """At a northing of 5,300 km, steps of float32 are 0.5 m."""
    records = []
    for number in range(10):
        pose = np.eye(4)
        pose[:3, 3] = 691_000.3 + 5.1 * number, 5_336_000.7 + 1.3 * number, 520.0
        points = pose[:2, 3] + np.array([[-9.0, 2.03], [8, 2.07]])
        line = {"label": 0, "points": points.tolist()}
        records.append(record(token=str(number), global_from_frame=pose, global_instances=[line]))

    def warnings_of(records: list) -> str:
        caplog.clear()
        from_records(tmp_path / "a.arrow", records, META, tmp_path)
        return caplog.text

    def rounded(item: dict, kind: type) -> dict:
        pose = item["global_from_frame"].copy()
        pose[:3, 3] = pose[:3, 3].astype(np.float32)  # still an array of float64
        return {**item, "global_from_frame": kind(pose)}

    assert "float32" not in warnings_of(records)
    for kind in (np.asarray, np.float32, np.ndarray.tolist):
        text = warnings_of([rounded(item, kind) for item in records])
        assert "10 of 10 records have positions in global_from_frame that are rounded" in text
        assert "global_instances" not in text
    assert "float32" not in warnings_of([rounded(records[0], np.asarray), *records[1:]])
    origin = np.eye(4)
    origin[:3, 3] = 690_000, 5_334_000, 0  # of single frames
    single = [{**item, "global_from_frame": origin, "global_instances": []} for item in records]
    assert "float32" not in warnings_of(single)
    coarse = []
    for item in records:
        line = {"label": 0, "points": np.float32(item["global_instances"][0]["points"])}
        coarse.append({**item, "global_instances": [line]})
    text = warnings_of(coarse)
    assert "10 of 10 records have points of global_instances that are rounded" in text
    assert "positions in" not in text


def test_poses_are_known_of_all_records_or_of_none(tmp_path: Path):
    path = tmp_path / "poses.arrow"
    posed = record(token="a", global_from_frame=np.eye(4))
    plain = record(token="b")
    from_records(path, iter([posed, {**posed, "token": "c"}]), META, tmp_path)
    assert AnnotationFile(path).meta.has_poses
    from_records(path, [plain, {**plain, "token": "c", "global_from_frame": None}], META, tmp_path)
    assert not AnnotationFile(path).meta.has_poses
    for records, text in (
        ([posed, plain], "record 'b'.*it has no global_from_frame, unlike the first"),
        ([plain, posed], "record 'a'.*it has a global_from_frame, unlike the first"),
    ):
        with pytest.raises(ValueError, match=text):
            from_records(tmp_path / "refused.arrow", records, META, tmp_path)
        assert not (tmp_path / "refused.arrow").exists()


def test_an_ideal_fisheye_is_rectified(tmp_path: Path):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((90, 160, 3), 90, np.uint8))
    matrix = np.array([[100.0, 0, 80], [0, 100, 45], [0, 0, 1]])
    camera = {"name": "front", "path": "a.png", "intrinsics": matrix, "cam_from_frame": np.eye(4)}
    for model, numbers, is_rectified in (
        ("equidistant", [0, 0, 0, 0], True), ("plumb_bob", [0, 0, 0, 0], False),
        ("plumb_bob", None, False), (None, [], False),
    ):  # fmt: skip
        lens = {"distortion_model": model, "distortion": numbers}
        from_records(tmp_path / "d.arrow", [{"token": "t", "cameras": [camera | lens]}], META,
                     tmp_path)  # fmt: skip
        (seen,) = AnnotationFile(tmp_path / "d.arrow")[0].cameras
        assert (seen.path != "a.png") == is_rectified
    for model, numbers, message in (
        ("equidistant", None, "give its four coefficients"),
        ("omni", [1, 0, 0, 0], "distortion model 'omni'"),
    ):
        lens = {"distortion_model": model, "distortion": numbers}
        with pytest.raises(ValueError, match=message):
            from_records(tmp_path / "d.arrow", [{"token": "t", "cameras": [camera | lens]}], META,
                         tmp_path)  # fmt: skip


def test_rings_of_own_classes_that_are_cut_along_the_range_are_named(tmp_path: Path, caplog):
    meta = replace(META, classes=("boundary", "curb", "ped_crossing"))
    block = [[-50, 5], [50, 5], [50, 105], [-50, 105], [-50, 5]]
    small = [[5, 5], [9, 5], [9, 8], [5, 5]]
    far = [[50, 50], [90, 50], [90, 80], [50, 50]]
    path = tmp_path / "rings.arrow"
    for label, points, is_named in (
        ("boundary", block, False), ("ped_crossing", block, False), ("curb", small, False),
        ("curb", block[:3], False), ("curb", block, True),
    ):  # fmt: skip
        caplog.clear()
        others = [
            {"label": "curb", "points": far},
            {"label": "boundary", "points": [[0, 0], [1, 0]]},
        ]
        instances = [{"label": label, "points": points}, *others]
        from_records(path, [record(instances=instances)], meta, tmp_path)
        text = "1 of 1 records have rings of your own classes that leave the range (the first"
        assert (text in caplog.text) == is_named


def test_images_of_a_distorted_camera_are_rectified_once(tmp_path: Path):
    board = (np.indices((90, 160)).sum(0) // 10 % 2 * 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), cv2.merge([board] * 3))
    matrix = np.array([[100.0, 0, 80], [0, 100, 45], [0, 0, 1]])
    camera = {"name": "front", "path": "a.png", "intrinsics": matrix, "cam_from_frame": np.eye(4)}
    camera["distortion"] = [-0.3, 0.1, 0, 0]
    distorted = {"token": "t", "cameras": [camera]}
    from_records(tmp_path / "d.arrow", [distorted], META, tmp_path)
    (seen,) = AnnotationFile(tmp_path / "d.arrow")[0].cameras
    expected = cv2.undistort(cv2.merge([board] * 3), matrix, np.array([-0.3, 0.1, 0, 0]))
    written = cv2.imread(str(tmp_path / seen.path))
    assert np.abs(written.astype(int) - expected).mean() < 3  # JPEG's loss
    np.testing.assert_array_equal(seen.intrinsics, matrix)
    first = (tmp_path / seen.path).stat().st_mtime_ns
    from_records(tmp_path / "d.arrow", [distorted], META, tmp_path)
    assert (tmp_path / seen.path).stat().st_mtime_ns == first
    camera["distortion"] = [-0.2, 0.1, 0, 0]  # another calibration, another file
    from_records(tmp_path / "d.arrow", [distorted], META, tmp_path)
    assert AnnotationFile(tmp_path / "d.arrow")[0].cameras[0].path != seen.path
    camera["distortion"] = [-0.2, 0.1]
    with pytest.raises(ValueError, match="takes 4 or 5 or 8 or 12 or 14 numbers"):
        from_records(tmp_path / "d.arrow", [distorted], META, tmp_path)


def test_a_replaced_image_of_a_distorted_camera_is_rectified_again(tmp_path: Path):
    """Also by an older file; and a missing one is no reason to keep what is there."""
    size = {"width": 160, "height": 90, "intrinsics": [[100, 0, 80], [0, 100, 45], [0, 0, 1]]}
    camera = {**record()["cameras"][0], **size, "distortion": [-0.3, 0.1, 0, 0]}
    image = tmp_path / "a.jpg"
    for seconds, grey in enumerate((100, 200, 30)):
        cv2.imwrite(str(image), np.full((90, 160, 3), grey, np.uint8))
        os.utime(image, (1000 - seconds, 1000 - seconds))
        from_records(tmp_path / "d.arrow", [record(cameras=[camera])], META, tmp_path)
        (seen,) = AnnotationFile(tmp_path / "d.arrow")[0].cameras
        assert cv2.imread(str(tmp_path / seen.path))[45, 80, 0] == pytest.approx(grey, abs=3)
    image.unlink()
    with pytest.raises(ValueError, match=r"record 't'.*camera 'front': no image at .*a\.jpg"):
        from_records(tmp_path / "d.arrow", [record(cameras=[camera])], META, tmp_path)
