"""Corruptions of cameras: what is drawn, how strong it is, and which matrices change."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from sample_cases import META, sample

from gsmap.datasets.annotations.file import write_annotations
from gsmap.datasets.annotations.record import MapSample
from gsmap.datasets.transforms.corruptions import (
    KINDS,
    SEVERITIES,
    CorruptImages,
    DelayCameras,
    DropCameras,
)
from gsmap.structures.calibration import OUT_OF_SIGHT

INNER = np.array([[80.0, 0, 80, 0], [0, 80, 45, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
# camera: x right, y down, z forward; annotation frame: x right, y forward, z up, 2 m above ground
LOOK = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
IMAGES = KINDS[KINDS.index("fog") :]


def results(views: int = 6, token: str = "a") -> dict:
    rng = np.random.default_rng(1)
    image = cv2.resize(rng.integers(0, 255, (9, 16, 3), dtype=np.uint8), (160, 90))
    lidar2ground = np.eye(4)
    lidar2ground[2, 3] = 2.0
    return {
        "token": token,
        "img": [image.copy() for _ in range(views)],
        "raw_shapes": [(90, 160)] * views,
        "cam2img": [INNER] * views,
        "img_aug_matrix": [np.eye(4)] * views,
        "lidar2cam": [LOOK] * views,
        "lidar2img": [INNER @ LOOK] * views,
        "lidar2ground": lidar2ground,
    }


def num_black(found: dict) -> int:
    return sum(not image.any() for image in found["img"])


def images_of(frame: MapSample, root: Path, **values: object) -> dict[str, dict]:
    """What a pipeline starts from: the path of the image of each camera, and further values."""
    images = {}
    for camera in frame.cameras:
        images[camera.name] = {"img_path": str(root / camera.path), **values}
    return images


def error_of(kind: str, severity: int, seed: int = 0) -> float:
    found = CorruptImages(kind, severity, seed).transform(results(1))
    return float(np.abs(found["img"][0].astype(float) - results(1)["img"][0]).mean())


@pytest.mark.parametrize("kind", IMAGES)
def test_a_severer_corruption_changes_the_image_more(kind):
    errors = [error_of(kind, severity) for severity in SEVERITIES]
    assert errors[0] > 0.2
    assert errors == sorted(errors)
    assert errors[-1] > 1.5 * errors[0]


@pytest.mark.parametrize("kind", KINDS)
def test_seed_and_token_decide_what_is_drawn(kind):
    def of(seed: int, token: str) -> dict:
        return CorruptImages(kind, 3, seed).transform(results(token=token))

    def same(first: dict, second: dict) -> bool:
        for key in ("img", "lidar2cam", "lidar2img"):
            if not np.array_equal(first[key], second[key]):
                return False
        return True

    assert same(of(0, "a"), of(0, "a"))
    drawn = kind not in ("fog", "motion_blur", "jpeg")
    assert same(of(0, "a"), of(1, "a")) != drawn
    assert same(of(0, "a"), of(0, "b")) != drawn


def test_lost_cameras_are_black_look_nowhere_and_add_up():
    lost = []
    for severity in SEVERITIES:
        found = CorruptImages("camera_lost", severity).transform(results())
        black = {view for view, image in enumerate(found["img"]) if not image.any()}
        assert len(black) == severity
        for view in range(6):
            expected = OUT_OF_SIGHT if view in black else LOOK
            np.testing.assert_array_equal(found["lidar2cam"][view], expected)
            np.testing.assert_allclose(found["lidar2img"][view], INNER @ expected)
        lost.append(black)
    for fewer, more in pairwise(lost):
        assert fewer < more
    pair = CorruptImages("camera_lost", 5).transform(results(2))
    assert num_black(pair) == 1  # the last camera stays


def test_calibration_is_off_by_the_degrees_and_centimetres_that_are_said():
    turned = CorruptImages("rotation", 4).transform(results())
    shifted = CorruptImages("translation", 3).transform(results())
    for view in range(6):
        turn = turned["lidar2cam"][view] @ np.linalg.inv(LOOK)
        angle = np.degrees(np.arccos((np.trace(turn[:3, :3]) - 1) / 2))
        assert angle == pytest.approx(2.0)
        np.testing.assert_allclose(turned["lidar2img"][view], INNER @ turned["lidar2cam"][view])
        shift = shifted["lidar2cam"][view] - LOOK
        assert np.linalg.norm(shift[:3, 3]) == pytest.approx(0.1)
    assert not np.allclose(turned["lidar2cam"][0], turned["lidar2cam"][1])


def test_fog_leaves_five_percent_of_the_contrast_at_the_end_of_sight():
    """A camera 2 m above the ground with a focal length of 80 pixels: 4 rows below the horizon the
    ground is 40 m away, 40 rows below it 4.5 m.
    """
    black = results(1)
    black["img"] = [np.zeros((90, 160, 3), np.float32)]
    image = CorruptImages("fog", 4).transform(black)["img"][0]  # one sees 40 m
    centre = image[:, 80, 0] / 200
    assert 1 - centre[49] == pytest.approx(0.05, abs=0.002)
    assert 1 - centre[85] == pytest.approx(0.05 ** (np.hypot(80, 40) / 40 * 2 / 40), abs=0.002)
    assert 1 - centre[10] == pytest.approx(0.05 ** (60 / 40), abs=0.002)  # a house: 60 m


def test_fog_needs_the_height_of_the_cameras():
    message = "sample 'a' has no ego_from_frame and its file no ground_z_m, one of which fog needs"
    with pytest.raises(ValueError, match=message):
        CorruptImages("fog", 1).transform({**results(), "lidar2ground": None})


@pytest.mark.parametrize("to_float32", [True, False])
@pytest.mark.parametrize("kind", IMAGES)
def test_padding_does_not_change_and_does_not_change_the_picture(kind, to_float32):
    """Of three cameras, two have smaller images, padded at the bottom and right."""
    shapes = [(60, 160), (90, 100), (90, 160)]
    padded = results(3)
    padded["raw_shapes"] = shapes
    if to_float32:
        padded["img"] = [image.astype(np.float32) for image in padded["img"]]
    for image, (height, width) in zip(padded["img"], shapes, strict=True):
        image[height:] = 0
        image[:, width:] = 0
    before = [image.copy() for image in padded["img"]]
    cut = {**padded, "img": [padded["img"][0][:60]], "raw_shapes": shapes[:1]}
    found = CorruptImages(kind, 5).transform(dict(padded))["img"]
    for image, clean, (height, width) in zip(found, before, shapes, strict=True):
        assert image.shape == clean.shape
        assert image.dtype == clean.dtype
        assert not image[height:].any()
        assert not image[:, width:].any()
        assert not np.array_equal(image[:height, :width], clean[:height, :width])
    for image, clean in zip(padded["img"], before, strict=True):  # of the caller
        np.testing.assert_array_equal(image, clean)
    (alone,) = CorruptImages(kind, 5).transform(cut)["img"]  # without padding
    np.testing.assert_array_equal(found[0][:60], alone)


@pytest.mark.parametrize(("kind", "severity"), [("snow", 1), ("fog", 0), ("fog", 6)])
def test_unknown_corruptions_are_refused(kind, severity):
    with pytest.raises(ValueError, match="kind must be one of"):
        CorruptImages(kind, severity)


def test_delayed_cameras_show_the_sample_before(tmp_path):
    """The second sample of a scene shows some images of the first; the first one stays."""
    second = sample(0, timestamp_ns=10)
    first = sample(1, timestamp_ns=9)
    other = replace(sample(2), scene="another")
    write_annotations(tmp_path / "a.arrow", META, [second, first, other])
    step = DelayCameras("a.arrow", severity=5, data_root=str(tmp_path))
    cases = [(second, {"0.jpg", "1.jpg"}), (first, {"1.jpg"}), (other, {"2.jpg"})]
    for row, expected in cases:
        images = images_of(row, tmp_path, size=1)
        found = step.transform({"token": row.token, "images": images})["images"]
        assert {Path(image["img_path"]).name for image in found.values()} == expected
        assert images == images_of(row, tmp_path, size=1)  # the input has not changed
        for name, image in found.items():
            assert name in image["img_path"]
            assert image["size"] == 1


def test_a_camera_that_the_sample_before_lacks_is_not_delayed(tmp_path):
    complete = sample(0, timestamp_ns=1)
    before = replace(complete, cameras=complete.cameras[:1])
    now = sample(1, timestamp_ns=2)
    write_annotations(tmp_path / "a.arrow", META, [before, now])
    step = DelayCameras("a.arrow", severity=5, data_root=str(tmp_path))
    expected = images_of(now, tmp_path)
    expected[now.cameras[0].name]["img_path"] = str(tmp_path / before.cameras[0].path)
    found = step.transform({"token": now.token, "images": images_of(now, tmp_path)})["images"]
    assert found == expected


def test_training_drops_some_cameras_of_some_samples():
    np.random.seed(0)  # noqa: NPY002 - as mmengine does
    step = DropCameras(prob=0.5, max_num=3)
    counts = []
    for _ in range(200):
        found = step.transform(results())
        counts.append(num_black(found))
        away = sum(np.array_equal(matrix, OUT_OF_SIGHT) for matrix in found["lidar2cam"])
        assert away == counts[-1]
    shares = np.bincount(counts, minlength=4) / 200
    np.testing.assert_allclose(shares, [0.5, 1 / 6, 1 / 6, 1 / 6], atol=0.09)
    assert num_black(DropCameras(1.0, 9).transform(results(2))) == 1
