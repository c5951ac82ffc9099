"""Images on their way into the model: sizes and matrices worked by hand."""

import cv2
import numpy as np
import pytest

from gsmap.datasets.transforms import images
from gsmap.datasets.transforms.images import ScaleImages


def test_matrices_take_the_exact_ratio_of_each_axis():
    """Half of 101 x 51 pixels is 50 x 25: a little less than half, by another ratio each way."""
    image = np.zeros((51, 101, 3), np.uint8)
    matrices = {"lidar2img": [np.eye(4)], "img_aug_matrix": [np.diag([2.0, 2.0, 1.0, 1.0])]}
    results = ScaleImages(0.5).transform({"img": [image], "raw_shapes": [(51, 101)], **matrices})
    assert results["raw_shapes"] == [(25, 50)]
    assert results["img"][0].shape == (25, 50, 3)
    assert results["img_shape"] == results["pad_shape"] == (25, 50)
    np.testing.assert_allclose(results["lidar2img"][0], np.diag([50 / 101, 25 / 51, 1, 1]))
    np.testing.assert_allclose(results["img_aug_matrix"][0], np.diag([100 / 101, 50 / 51, 1, 1]))


def test_sizes_are_not_one_pixel_short():
    """0.58 * 100 is 57.99999999999999 in floating-point numbers."""
    matrices = {"lidar2img": [np.eye(4)], "img_aug_matrix": [np.eye(4)]}
    for size in ((100, 200, 3), (200, 100, 3)):
        images_of_size = {"img": [np.zeros(size, np.uint8)], "raw_shapes": [size[:2]]}
        results = ScaleImages(0.58).transform({**images_of_size, **matrices})
        assert sorted(results["img_shape"]) == [58, 116]


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((400, 225), (160, 90)),  # as in training: 0.4 of them
        ((1600, 900), (160, 90)),
        ((640, 480), (160, 120)),  # of another shape: as long as in training
        ((480, 640), (120, 160)),
        ((80, 45), (160, 90)),
    ],
)
def test_images_of_another_size_become_as_long_as_those_of_the_training(
    size, expected, monkeypatch
):
    said = []
    monkeypatch.setattr(images, "print_log", lambda text, logger: said.append(text))
    images._log_other_scale.cache_clear()
    matrices = {"lidar2img": [np.eye(4)], "img_aug_matrix": [np.eye(4)]}
    image = np.zeros((*size[::-1], 3), np.uint8)
    step = ScaleImages(0.4, trained_size=(160, 90))
    results = step.transform({"img": [image], "raw_shapes": [size[::-1]], **matrices})
    assert results["img"][0].shape[1::-1] == expected
    assert results["raw_shapes"] == [expected[::-1]]
    ratio = np.divide(expected, size)
    np.testing.assert_allclose(results["lidar2img"][0], np.diag([*ratio, 1, 1]))
    start = "images of {} x {} are scaled to {} x {}, without".format(*size, *expected)
    assert [text.startswith(start) for text in said] == [True] * (size != (400, 225))


def test_a_scale_that_leaves_no_image_is_refused():
    with pytest.raises(ValueError, match="scale or size must be > 0, got 0"):
        ScaleImages(0)
    with pytest.raises(ValueError, match=r"scale 0\.1 leaves nothing of a 9 x 20 image"):
        ScaleImages(0.1).transform({"img": [np.zeros((20, 9, 3), np.uint8)]})


def test_a_size_takes_each_image_without_its_padding():
    """Two images of 40 x 20 and 20 x 40, padded to 40 x 40, become 10 x 10 each."""
    images = [np.zeros((40, 40, 3), np.uint8) for _ in range(2)]
    images[0][:20] = images[1][:, :20] = 9
    matrices = {key: [np.eye(4), np.eye(4)] for key in ("lidar2img", "img_aug_matrix")}
    shapes = [(20, 40), (40, 20)]
    results = ScaleImages(size=(10, 10)).transform(
        {"img": images, "raw_shapes": shapes, **matrices}
    )
    assert [image.min() for image in results["img"]] == [9, 9]
    assert results["img_shape"] == (10, 10)
    assert results["raw_shapes"] == [(10, 10), (10, 10)]  # nothing of them is padding now
    np.testing.assert_allclose(results["lidar2img"][0], np.diag([10 / 40, 10 / 20, 1, 1]))
    np.testing.assert_allclose(results["img_aug_matrix"][1], np.diag([10 / 20, 10 / 40, 1, 1]))
    with pytest.raises(ValueError, match="give scale or size"):
        ScaleImages()


@pytest.mark.parametrize(("width", "by_area"), [(288, False), (640, True), (1920, True)])
def test_images_that_are_far_larger_than_the_trained_ones_shrink_by_area(width, by_area):
    """A chessboard of single pixels is grey from afar; four of its pixels are not."""
    image = np.indices((width * 9 // 16, width)).sum(0) % 2 * np.float32(255)
    image = np.ascontiguousarray(np.repeat(image[..., None], 3, 2))
    image[:, : width // 2] *= np.arange(width // 2)[None, :, None] % 3 == 0  # no regular pattern
    matrices = {key: [np.eye(4)] for key in ("lidar2img", "img_aug_matrix")}
    step = ScaleImages(0.4, trained_size=(160, 90))
    inputs = {"img": [image], "raw_shapes": [image.shape[:2]], **matrices}
    (found,) = step.transform(dict(inputs))["img"]
    exact = cv2.resize(image, (160, 90), interpolation=cv2.INTER_AREA)
    assert (abs(found - exact).max() < 1e-3) == by_area
    (same,) = ScaleImages(160 / width).transform(dict(inputs))["img"]
    bilinear = cv2.resize(image, (160, 90), interpolation=cv2.INTER_LINEAR)
    np.testing.assert_allclose(same, bilinear, atol=1e-3)  # as in the training
