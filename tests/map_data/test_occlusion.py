"""What boxes hide of a map, by lines of sight that are worked by hand.

A camera 1.5 m above the ground looks along x at a line 10 m ahead, from y = -5 to 5. Half way, a
box 1.5 m high stands between y = 1 and 3, from x = 4.5 to 5.5: it hides what lies from y = 1.9 on.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from processes import run_tool
from sample_cases import META
from scipy.spatial.transform import Rotation

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import CameraRecord, MapInstance, MapSample
from gsmap.evaluation.analysis.groups import read_groups
from gsmap.structures.polylines import resample
from gsmap.structures.rigid import invert_rigid, rigid
from mapdata.nuscenes.occlusion import (
    Boxes,
    _map_points,
    cuts_sight,
    ground_view,
    hidden_share,
    read_boxes,
    word_for,
)

HEIGHT_M = 1.8  # of the annotation frame above the ground
GLOBAL_FROM_FRAME = rigid(Rotation.from_euler("z", 30, degrees=True).as_matrix(), [100, 50, 1.8])
VIEW = ground_view(META)
FORWARD = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # frame from camera: z looks along x


def camera(y: float) -> CameraRecord:
    frame_from_cam = rigid(FORWARD, [0.0, y, 1.5 - HEIGHT_M])
    intrinsics = np.array([[100.0, 0, 200], [0, 100, 200], [0, 0, 1]])
    return CameraRecord("C", "", 400, 400, intrinsics, invert_rigid(frame_from_cam))


def sample(*cameras: CameraRecord, x: float = 10.0) -> MapSample:
    line = MapInstance(0, np.array([[x, -5.0], [x, 5.0]]))
    above_ground = rigid(np.eye(3), [0, 0, HEIGHT_M])
    views = list(cameras)
    return MapSample(
        "s", "scene", "", 0, views, GLOBAL_FROM_FRAME, None, None, [line], above_ground
    )


def share_of(one: MapSample, boxes: Boxes) -> float:
    return hidden_share(one, boxes, view=VIEW)


def tables(folder: Path, height_m: float = 1.5, **wrong: object) -> Path:
    """Write the box, which stands across: its length of 2 m along the frame's y."""
    centre = GLOBAL_FROM_FRAME @ [5.0, 2.0, height_m / 2 - HEIGHT_M, 1]
    x, y, z, w = Rotation.from_euler("z", 30 + 90, degrees=True).as_quat()
    box = {
        "token": "b", "sample_token": "s", "translation": centre[:3].tolist(),
        "rotation": [w, x, y, z], "size": [1.0, 2.0, height_m],
    }  # fmt: skip
    other = {**box, "token": "c", "sample_token": "another sample"}
    (folder / "sample_annotation.json").write_text(json.dumps([other, {**box, **wrong}]))
    return folder


def test_a_box_hides_what_lies_behind_it(tmp_path):
    boxes = read_boxes(tables(tmp_path), ["s"])["s"]
    assert len(boxes.halves_m) == 1
    assert share_of(sample(camera(0)), boxes) == pytest.approx(4 / 11)  # y = 2, 3, 4, 5
    assert share_of(sample(camera(0), x=4.0), boxes) == 0  # before the box
    with pytest.raises(ValueError, match="sample 's' has no ground truth"):
        share_of(replace(sample(camera(0)), instances=None), boxes)
    low = read_boxes(tables(tmp_path, height_m=0.5), ["s"])["s"]
    assert share_of(sample(camera(0)), low) == 0  # one looks over it


def test_what_another_camera_sees_is_not_hidden_and_what_none_holds_does_not_count(tmp_path):
    boxes = read_boxes(tables(tmp_path), ["s"])["s"]
    assert share_of(sample(camera(0), camera(-5)), boxes) == 0
    narrow = camera(0)
    narrow.width = 205  # up to y = -0.5: six points are left, four of them hidden
    assert share_of(sample(narrow), boxes) == pytest.approx(4 / 6)


def test_sight_is_cut_between_the_eye_and_the_point_alone(tmp_path):
    boxes = read_boxes(tables(tmp_path), ["s"])["s"]
    ahead, behind, short = ([10.0, 4.0, -HEIGHT_M], [-10.0, -4.0, -2.1], [4.0, 1.6, -1.0])
    points = np.array([ahead, behind, short]) @ GLOBAL_FROM_FRAME[:3, :3].T
    points += GLOBAL_FROM_FRAME[:3, 3]
    eye = (GLOBAL_FROM_FRAME @ [0, 0, 1.5 - HEIGHT_M, 1])[:3]
    np.testing.assert_array_equal(cuts_sight(eye, points, boxes)[:, 0], [True, False, False])


def test_a_sample_without_boxes_or_map_has_nothing_hidden(tmp_path):
    found = read_boxes(tables(tmp_path), ["s", "empty"])
    assert share_of(sample(camera(0)), found["empty"]) == 0
    nothing = sample(camera(0))
    nothing.instances = []
    assert share_of(nothing, found["s"]) == 0


# LIDAR_TOP of a nuScenes vehicle: it is tilted by 1.4 degrees.
EGO_FROM_LIDAR = rigid(
    [
        [0.00203327, 0.99970406, 0.02424172],
        [-0.99998051, 0.00217566, -0.00584864],
        [-0.00589965, -0.02422936, 0.99968904],
    ],
    [0.94, 0, 1.84],
)


@pytest.mark.parametrize(
    ("frame", "ego_from_frame", "ground_z_m", "expected"),
    [
        ("lidar", EGO_FROM_LIDAR, None, 0.0),
        ("lidar", EGO_FROM_LIDAR, -1.7, 0.0),  # the mounting is more exact
        ("ego", np.eye(4), None, 0.0),  # of nuScenes, whose origin is on the road
        ("ego", np.eye(4), -0.31, -0.31),
        ("ego", None, None, 0.0),
    ],
)
def test_the_map_is_on_the_road_below_a_tilted_lidar(frame, ego_from_frame, ground_z_m, expected):
    """Of a line from 30 m behind to 30 m ahead, a level plane would be 0.7 m off at the ends."""
    view = ground_view(replace(META, frame=frame, ground_z_m=ground_z_m))
    line = MapInstance(0, np.array([[0.0, -30.0], [0.0, 30.0]]))
    one = replace(sample(), instances=[line], ego_from_frame=ego_from_frame)
    points = _map_points(one, view)
    assert points.shape == (61, 3)
    np.testing.assert_allclose(points[:, :2], resample(line.points, 61))
    ego_from_frame = np.eye(4) if ego_from_frame is None else ego_from_frame
    heights_m = points @ ego_from_frame[2, :3] + ego_from_frame[2, 3]
    np.testing.assert_allclose(heights_m, expected, atol=1e-6)


def test_a_sensor_of_unknown_mounting_is_at_the_given_or_usual_height():
    one = replace(sample(), ego_from_frame=None)
    for ground_z_m, expected in ((None, -1.84), (-1.2, -1.2)):
        points = _map_points(one, ground_view(replace(META, ground_z_m=ground_z_m)))
        np.testing.assert_allclose(points[:, 2], expected)


def test_map_points_with_heights_keep_them():
    raised = MapInstance(0, np.array([[10.0, -5, -1.5], [10, 5, -1.5]]))
    points = _map_points(replace(sample(), instances=[raised]), VIEW)
    np.testing.assert_allclose(points[:, 2], -1.5)


def test_shares_have_words_that_sort():
    words = [word_for(share, (5, 20)) for share in (0, 0.0499, 0.05, 0.2, 1.0)]
    assert words == ["00-05 % hidden"] * 2 + ["05-20 % hidden"] + ["20-100 % hidden"] * 2


def test_damaged_and_foreign_tables_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="no table at"):
        read_boxes(tmp_path, ["s"])
    with pytest.raises(ValueError, match="has no box of these samples"):
        read_boxes(tables(tmp_path), ["x"])
    with pytest.raises(ValueError, match="record 'b': size must be 3 finite numbers"):
        read_boxes(tables(tmp_path, size=[1, 2]), ["s"])


def test_the_command_writes_a_group_for_each_sample(
    minicity_root: Path, minicity_annotations: dict[str, Path], tmp_path: Path
):
    tool, truth = ("tools/create_data.py", "occlusion"), minicity_annotations["val"]
    words = *tool, truth, minicity_root / "v1.0-trainval", tmp_path / "o.json"
    done = run_tool(*words, "--limits", 1, 50)
    assert "% hidden: " in done.stdout
    groups = read_groups(truth, str(tmp_path / "o.json")).group_of
    assert set(groups) == set(AnnotationFile(truth).column("token"))
    refused = run_tool(*words, "--limits", 50, 1)
    assert refused.stderr.startswith("error: --limits must rise")
