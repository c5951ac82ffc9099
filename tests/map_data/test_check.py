"""The deep check of annotation files and of the files that they name."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import AnnotationMeta
from mapdata.check import check_files
from mapdata.custom import from_records


def test_a_whole_data_set_is_right_and_damage_is_named(
    minicity_root: Path, minicity_annotations: dict[str, Path], tmp_path: Path
):
    root = shutil.copytree(minicity_root, tmp_path / "root")
    path = root / minicity_annotations["val"].name
    text = check_files([path], root, workers=1)
    assert text.endswith("2 samples, values right, checksum right, images and LiDAR files whole")
    sample = AnnotationFile(path)[1]
    image, sweep = root / sample.cameras[2].path, root / sample.lidar.path
    image.write_bytes(image.read_bytes()[:-100])
    sweep.unlink()
    wrong = rf"{sample.token}.*{image} is truncated.*no LiDAR file at {sweep}"
    with pytest.raises(ValueError, match=wrong):
        check_files([path], root, workers=1)
    assert "images" not in check_files([path], None, workers=1)


def test_a_damaged_footer_is_found(minicity_annotations: dict[str, Path], tmp_path: Path):
    path = tmp_path / "a.arrow"
    content = bytearray(minicity_annotations["val"].read_bytes())
    content[-60:-20] = bytes(40)
    path.write_bytes(content)
    assert len(AnnotationFile(path)) == 2
    with pytest.raises(ValueError, match="the footer, by which other programs read"):
        check_files([path], None, workers=1)


def test_the_check_counts_elements_and_doubts_truth_and_cameras(tmp_path: Path, caplog):
    """Truth in millimetres, and matrices the wrong way round."""
    looking = [[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, -1.2], [0, 0, 0, 1]]
    here = {"label": "divider", "points": [[0, 1], [9, 1]]}
    beside = {"label": "divider", "points": [[0, -2], [9, -2]]}
    there = {"label": "divider", "points": [[0, 1_750], [9_000, 1_750]]}

    def record(token, cam_from_frame, *instances):
        camera = {
            "name": "front", "path": "x.jpg", "width": 640, "height": 360,
            "intrinsics": [[400, 0, 320], [0, 400, 180], [0, 0, 1]],
            "cam_from_frame": cam_from_frame,
        }  # fmt: skip
        return {"token": token, "scene": token, "cameras": [camera], "instances": list(instances)}

    meta = AnnotationMeta("mine", "ego", "train", ground_z_m=0.0)
    right, wrong = tmp_path / "right.arrow", tmp_path / "wrong.arrow"
    from_records(right, [record("a", looking, here, beside)], meta, tmp_path)
    assert caplog.text == ""
    assert check_files([right], None, workers=1).splitlines()[0] == (
        f"{right}: 2 map elements, up to 2 in a sample (a model needs at least as many queries)"
    )
    upside = np.linalg.inv(looking).tolist()
    from_records(wrong, [record("b", looking, there), record("c", upside, here)], meta, tmp_path)
    assert "1 of 2 records lose all of their elements (the first is 'b')" in caplog.text
    text = check_files([wrong], None, workers=1)
    assert "warning: 1 of 2 samples have no element in the range" in text
    assert "warning: calibration: camera 'front' " in text
    equal = [record("a", looking, here), record("b", looking, here)]
    for number, values in enumerate(equal):
        time_ns = number * 500_000_000
        values.update(scene="drive", timestamp_ns=time_ns, global_from_frame=np.eye(4))
    from_records(wrong, equal, meta, tmp_path)
    text = check_files([wrong], None, workers=1)
    assert "warning: poses: the poses of all 2 samples are the identity in drive 'drive'" in text
    caplog.clear()
    from_records(wrong, [record("a", looking, here)], AnnotationMeta("x", "ego", "v"), tmp_path)
    assert "does not contain the height of the road in the frame 'ego'" in caplog.text


def test_scenes_of_two_places_are_named_when_a_file_is_written_and_checked(tmp_path: Path, caplog):
    looking = [[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, -1.2], [0, 0, 0, 1]]
    camera = {
        "name": "front", "path": "x.jpg", "width": 640, "height": 360,
        "intrinsics": [[400, 0, 320], [0, 400, 180], [0, 0, 1]], "cam_from_frame": looking,
    }  # fmt: skip
    meta = AnnotationMeta("mine", "ego", "train", ground_z_m=0.0)

    def warnings(*places: tuple[str, str]) -> tuple[str, str]:
        """Warnings of writing and of checking a file; each record has a scene and a place."""
        caplog.clear()
        records = [
            {"token": str(number), "scene": scene, "map_name": place, "cameras": [camera]}
            for number, (scene, place) in enumerate(places)
        ]
        from_records(tmp_path / "a.arrow", records, meta, tmp_path)
        return caplog.text, check_files([tmp_path / "a.arrow"], None, workers=1)

    munich, vienna = ("drive_001", "munich"), ("drive_001", "vienna")
    expected = "scene 'drive_001' has samples of several places, ['munich', 'vienna'] (map_name)"
    for text in warnings(munich, vienna, munich):
        assert expected in text
    for text in warnings(vienna, munich, ("x", "a"), ("x", "b"), ("y", "a")):
        assert "scene 'drive_001' (and 1 more) has samples of several places" in text
    # Scenes of one place, unknown places, and single frames without a scene.
    for text in warnings(munich, ("drive_002", "vienna"), ("drive_001", ""), ("", "a"), ("", "b")):
        assert "several places" not in text
