"""Missing and damaged files of a sample are named, or skipped and counted."""

import cv2
import numpy as np
import pytest
from dataset_cases import DEPTH_AND_MASKS, MINICITY, SWEEPS, dataset_config
from PIL import Image

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.errors import BrokenSampleError


def test_missing_truncated_and_foreign_images_are_named(build, copied_root):
    dataset = build(**dataset_config(MINICITY, "val_dataloader", copied_root))
    path = copied_root / dataset.sample(0).cameras[1].path
    name, token = dataset.sample(0).cameras[1].name, dataset.sample(0).token
    path.with_name("whole.jpg").write_bytes(content := path.read_bytes())
    turned = Image.Exif()
    turned[0x0112] = 3  # upside down, of the same size
    for damaged in (content[:-3000], content[:-3000] + b"\xff\xd9", content[:-2]):
        path.write_bytes(damaged)
        with pytest.raises(BrokenSampleError, match=f"{token}.*{name}.*truncated or damaged"):
            dataset[0]
    image = cv2.imread(str(path.with_name("whole.jpg")))
    for damage, message in (
        (cv2.resize(image, (200, 112)), "has 200 x 112 pixels, but its record"),
        (cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE), "has 225 x 400 pixels"),
    ):
        cv2.imwrite(str(path), damage)
        with pytest.raises(BrokenSampleError, match=f"{token}.*{name}.*{message}"):
            dataset[0]
    Image.fromarray(image).save(path, exif=turned)
    with pytest.raises(BrokenSampleError, match=f"{token}.*{name}.*wants it turned, orientation 3"):
        dataset[0]
    path.write_bytes(b"no picture \xff\xd9")
    with pytest.raises(BrokenSampleError, match=f"{token}.*{name}.*not an image"):
        dataset[0]
    path.unlink()
    with pytest.raises(
        BrokenSampleError, match=f"{token}.*{name}.*no image at .*fetch the file again"
    ):
        dataset[0]


def test_missing_and_truncated_points_are_named(build, copied_root):
    dataset = build(**dataset_config(DEPTH_AND_MASKS, "train_dataloader", copied_root))
    path = copied_root / dataset.sample(0).lidar.path
    path.write_bytes(path.read_bytes()[:-6])
    with pytest.raises(BrokenSampleError, match=f"{dataset.sample(0).token}.*copy it again"):
        dataset[0]
    path.unlink()
    with pytest.raises(BrokenSampleError, match="no LiDAR file at"):
        dataset[0]


def test_a_missing_earlier_sweep_is_named_with_the_remedy(build, copied_root):
    dataset = build(**dataset_config(SWEEPS, "val_dataloader", copied_root))
    sample = dataset.sample(1)
    path = copied_root / sample.lidar.sweeps[0].path
    message = f"{sample.token}.*no earlier LiDAR sweep at {path}.*--max-sweeps 0"
    with pytest.raises(BrokenSampleError, match=message):
        dataset[1]


def test_broken_samples_are_skipped_and_counted_on_demand(build, copied_root):
    config = dataset_config(MINICITY, "train_dataloader", copied_root, broken_samples="skip")
    dataset = build(**config)
    token = dataset.sample(0).token
    (copied_root / dataset.sample(0).cameras[0].path).unlink()
    for _ in range(2):
        assert dataset[0]["data_samples"].metainfo["token"] == dataset.sample(1).token
    assert list(dataset.broken_tokens) == [token]
    (copied_root / dataset.sample(1).cameras[0].path).unlink()
    with pytest.raises(RuntimeError, match=r"in a row are broken.*no image"):
        dataset[1]


def test_a_sample_that_a_transform_drops_is_named_or_counted(build, minicity_root):
    config = dataset_config(MINICITY, "train_dataloader", minicity_root)
    token = build(**config).sample(0).token

    def drop(results: dict) -> dict | None:
        return None if results["token"] == token else results

    config = {**config, "pipeline": [drop, *config.pipeline]}
    with pytest.raises(BrokenSampleError, match=f"{token}': a transform .* returned None"):
        build(**config)[0]
    dataset = build(**config, broken_samples="skip")
    assert dataset[0]["data_samples"].metainfo["token"] != token
    assert list(dataset.broken_tokens) == [token]


def test_an_absent_camera_is_named(build, minicity_annotations, minicity_root, tmp_path):
    file = AnnotationFile(minicity_annotations["val"])
    samples = list(file)
    del samples[0].cameras[0]
    write_annotations(tmp_path / "five.arrow", file.meta, samples)
    config = dataset_config(MINICITY, "val_dataloader", minicity_root)
    config.ann_file = str(tmp_path / "five.arrow")
    with pytest.raises(BrokenSampleError, match=f"{samples[0].token}.*no camera 'CAM_FRONT'"):
        build(**config)[0]


def test_nan_in_an_image_is_named(build, minicity_annotations, minicity_root):
    def poison(results: dict) -> dict:
        results["img"][2] = results["img"][2].astype(np.float32)
        results["img"][2][5, 7, 1] = np.nan
        return results

    config = dataset_config(MINICITY, "val_dataloader", minicity_root)
    dataset = build(**{**config, "pipeline": [*config.pipeline[:-1], poison, config.pipeline[-1]]})
    with pytest.raises(BrokenSampleError, match="CAM_FRONT_LEFT: the image holds NaN"):
        dataset[0]


def test_images_of_which_some_are_numbers_with_fractions_keep_their_values(build, minicity_root):
    def brighten(results: dict) -> dict:
        results["img"][2] = results["img"][2].astype(np.float32) + 300.5
        return results

    config = dataset_config(MINICITY, "val_dataloader", minicity_root)
    steps = [*config.pipeline[:-1], brighten, config.pipeline[-1]]
    images = build(**{**config, "pipeline": steps})[0]["inputs"]["img"]
    assert images[2].min() >= 300.5
    assert images[1].max() <= 255
