"""Data at every usual range: converted and loaded with no vertex lost."""

from pathlib import Path

import numpy as np
import pytest
from argoverse2_road import write_log
from mmdet3d.registry import DATASETS
from mmengine.registry import init_default_scope

import gsmap.registered  # noqa: F401
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import AnnotationMeta
from mapdata.argoverse2.convert import convert_argoverse2
from mapdata.argoverse2.samples import Argoverse2Options
from mapdata.custom import from_records
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes

RANGES = [(30.0, 15.0), (50.0, 25.0), (100.0, 50.0)]  # 60 x 30, 100 x 50 and 200 x 100 m


def targets_of(path: Path, x_m: float, y_m: float):
    """Open a file with the data set and return the first sample's targets."""
    init_default_scope("mmdet3d")
    grid = {"x_range": [-x_m, x_m], "y_range": [-y_m, y_m]}
    pipeline = [{"type": "FormatMapTargets"}, {"type": "PackMapInputs"}]
    dataset = DATASETS.build(
        {
            "type": "VectorizedMapDataset",
            "ann_file": str(path),
            "grid": grid,
            "pipeline": pipeline,
        }
    )
    return dataset[0]["data_samples"].gt_instances_3d


def stored_targets(path: Path, x_m: float, y_m: float):
    """Return the first sample's targets, whose vertices are those of the file."""
    targets = targets_of(path, x_m, y_m)
    for line, instance in zip(targets.polylines, AnnotationFile(path)[0].instances, strict=True):
        np.testing.assert_allclose(line[: len(instance.points)], instance.points, atol=1e-5)
    return targets


@pytest.mark.parametrize(("x_m", "y_m"), RANGES)
def test_own_data_keep_every_vertex_up_to_the_edge(x_m: float, y_m: float, tmp_path: Path):
    line = np.stack([np.linspace(-x_m, x_m, 41), np.linspace(-y_m, y_m, 41)], -1)
    meta = AnnotationMeta("mine", "ego", "train", x_range=(-x_m, x_m), y_range=(-y_m, y_m))
    instances = [{"label": "divider", "points": line}]
    record = {"token": "t", "cameras": [], "instances": instances}
    from_records(tmp_path / "a.arrow", [record], meta, tmp_path)
    targets = targets_of(tmp_path / "a.arrow", x_m, y_m)
    np.testing.assert_allclose(targets.polylines[0], line, atol=1e-5)  # stored as float32
    np.testing.assert_allclose(targets.pts[0, [0, -1]], line[[0, -1]], atol=1e-5)
    np.testing.assert_allclose(targets.boxes[0], [-x_m, -y_m, x_m, y_m], atol=1e-5)


@pytest.mark.parametrize(("x_m", "y_m"), RANGES)
def test_a_log_reaches_as_far_as_its_range(x_m: float, y_m: float, tmp_path: Path):
    write_log(tmp_path / "val" / "log-a")
    ranges = {"x_range": (-x_m, x_m), "y_range": (-y_m, y_m)}
    convert_argoverse2(Argoverse2Options(tmp_path, **ranges))
    targets = stored_targets(tmp_path / "gsmap_av2_val.arrow", x_m, y_m)
    dividers = targets.polylines[targets.labels_3d == 0]
    end_m = min(x_m, 50.0)  # the lanes end 50 m ahead
    assert float(dividers[..., 0].max()) == pytest.approx(end_m)


@pytest.mark.parametrize(("y_m", "x_m"), RANGES)
def test_a_town_reaches_farther_with_its_range(
    x_m: float, y_m: float, minicity_root: Path, tmp_path: Path
):
    ranges = {"x_range": (-x_m, x_m), "y_range": (-y_m, y_m)}
    convert_nuscenes(NuScenesOptions(minicity_root, "v1.0-trainval", out_dir=tmp_path, **ranges))
    targets = stored_targets(tmp_path / "gsmap_nuscenes_train.arrow", x_m, y_m)
    assert float(targets.polylines[..., 1].max()) > y_m - 0.3  # outlines end 0.2 m before


def test_the_usual_range_follows_the_frame():
    assert AnnotationMeta("mine", "ego", "train").x_range == (-30, 30)
    assert AnnotationMeta("mine", "lidar", "train").x_range == (-15, 15)
