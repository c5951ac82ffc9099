"""JSON files of FiftyOne: cameras as slices of groups, map elements as polylines in the images."""

import json
from dataclasses import replace

import numpy as np
import pytest

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import AnnotationMeta, CameraRecord
from gsmap.visualization.fiftyone import _visible_parts, write_fiftyone
from mapdata.custom import from_records

META = AnnotationMeta("mine", "ego", "val", ground_z_m=0.0)
INTRINSICS = [[100.0, 0, 100], [0, 100, 50], [0, 0, 1]]
FRONT = [[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0], [0, 0, 0, 1]]  # 1.5 m above the road
REAR = [[0, 1, 0, 0], [0, 0, -1, 1.5], [-1, 0, 0, 0], [0, 0, 0, 1]]


@pytest.fixture
def annotations(tmp_path):
    """A sample with two cameras of 200 x 100, and a line straight ahead from 3 m on."""
    cameras = []
    for name, pose in (("front", FRONT), ("rear", REAR)):
        camera = {"name": name, "path": f"{name}.jpg", "intrinsics": INTRINSICS, "width": 200}
        cameras.append({**camera, "height": 100, "cam_from_frame": pose})
    lines = [{"label": "divider", "points": [[-20.0, 0], [20, 0]]}]
    record = {"token": "a", "scene": "s", "cameras": cameras, "instances": lines}
    path = tmp_path / "val.arrow"
    from_records(path, [record], META, tmp_path)
    return path


def test_elements_are_polylines_in_the_images_of_a_group(annotations, tmp_path):
    vector = {"cls_name": "boundary", "pts": [[5.0, -2], [10, -2]], "confidence_level": 0.5}
    content = {"results": [{"sample_token": "a", "vectors": [vector]}]}
    results = tmp_path / "results.json"
    results.write_text(json.dumps(content))
    assert write_fiftyone(tmp_path / "out.json", annotations, results=results) == (2, [])
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["group_media_types"] == {"front": "image", "rear": "image"}
    front, rear = found["samples"]
    assert front["group"]["_id"] == rear["group"]["_id"]
    assert front["filepath"] == str(tmp_path / "front.jpg")
    for image in (front, rear):
        (divider,) = image["ground_truth"]["polylines"]
        assert (divider["label"], divider["closed"]) == ("divider", False)
        (part,) = divider["points"]  # v = 50 + 150 / x, cut at the lower edge, x = 3 m
        np.testing.assert_allclose(np.array(part)[:, 0], 0.5)
        assert sorted([part[0][1], part[-1][1]]) == pytest.approx([0.5 + 1.5 / 20, 1.0])
    (boundary,) = front["predictions"]["polylines"]
    assert boundary["confidence"] == 0.5
    (part,) = boundary["points"]
    np.testing.assert_allclose(part[0], [(100 + 200 / 5) / 200, (50 + 150 / 5) / 100])
    np.testing.assert_allclose(part[-1], [(100 + 200 / 10) / 200, (50 + 150 / 10) / 100])
    assert rear["predictions"]["polylines"] == []


def test_results_of_other_samples_are_refused(annotations, tmp_path):
    results = tmp_path / "results.json"
    results.write_text(json.dumps({"results": [{"sample_token": "b", "vectors": []}]}))
    with pytest.raises(ValueError, match=r"results.json has no sample of .*val.arrow"):
        write_fiftyone(tmp_path / "out.json", annotations, results=results)
    assert len(AnnotationFile(annotations)) == 1
    assert not (tmp_path / "out.json").exists()


def test_what_is_left_out_is_named(annotations, tmp_path):
    tree = {"cls_name": "tree", "pts": [[0, 0]], "confidence_level": 0.5}
    short = {"cls_name": "divider", "pts": [[5, 0]], "confidence_level": 0.5}
    one = {"sample_token": "a", "vectors": [tree, short]}
    samples = [one, {"sample_token": "b", "vectors": []}]
    results = tmp_path / "results.json"
    results.write_text(json.dumps({"results": samples}))
    _, notes = write_fiftyone(tmp_path / "out.json", annotations, results=results)
    assert notes == [
        "1 result has no ground truth, such as 'b': left out",
        "1 predictions of class 'tree' are left out",
        "1 prediction of fewer than two points left out",
    ]


def test_a_line_that_leaves_the_image_at_a_corner_has_two_parts():
    intrinsics = np.array([[500.0, 0, 400], [0, 500, 300], [0, 0, 1]])
    camera = CameraRecord("front", "a.jpg", 800, 600, intrinsics, np.eye(4))
    corner = np.array([[3.0, 1.5, 3.0], [0.7, 1.5, 2.1], [-3.0, 1.5, 3.0]])
    first, second = _visible_parts(corner, camera)
    assert first[-1][1] == second[0][1] == 1.0  # both end at the lower border
    assert first[-1][0] > second[0][0]


def test_the_ground_is_below_the_sensor_that_the_sample_has(tmp_path):
    """A sensor at a height of 1.2 m: the ground lies at z = -1.2 in its frame."""
    matrix = np.array(FRONT)
    matrix[:3, 3] = matrix[:3, :3] @ [0, 0, -0.3]  # the camera is 0.3 m above the sensor
    mounting = np.eye(4)
    mounting[2, 3] = 1.2
    camera = {"name": "front", "path": "a.jpg", "intrinsics": INTRINSICS, "width": 200}
    cameras = [{**camera, "height": 100, "cam_from_frame": matrix}]
    lines = [{"label": "divider", "points": [[5.0, 0], [20, 0]]}]
    record = {"token": "a", "scene": "s", "cameras": cameras, "instances": lines}
    meta = replace(META, frame="lidar", ground_z_m=None)
    path = tmp_path / "val.arrow"
    from_records(path, [{**record, "ego_from_frame": mounting}], meta, tmp_path)
    write_fiftyone(tmp_path / "out.json", path)
    (image,) = json.loads((tmp_path / "out.json").read_text())["samples"]
    ((part,),) = [line["points"] for line in image["ground_truth"]["polylines"]]
    assert part[0][1] == pytest.approx((50 + 150 / 5) / 100)
