"""The deep check of annotation files and of the files that they name."""

import shutil
from pathlib import Path

import pytest

from gsmap.datasets.annotations.file import AnnotationFile
from mapdata.check import check_files


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
