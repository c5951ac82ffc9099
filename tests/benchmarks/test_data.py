"""What the data benchmarks compare is comparable: both ways give the same ground truth."""

from pathlib import Path

import numpy as np
import pytest
import shapely

from benchmarks.data import measure_loading, open_maps, per_item_orders, tile_annotations
from benchmarks.images import measure_images
from benchmarks.memory import tile_tables
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapInstance
from gsmap.structures.polylines import PADDING, equivalent_orders
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes


def total_length(instances: list[MapInstance], label: int) -> float:
    return sum(shapely.LineString(i.points).length for i in instances if i.label == label)


def test_ground_truth_made_per_item_equals_the_prepared_one(minicity_root, minicity_annotations):
    prepared, per_item = open_maps(minicity_root, (-15, 15), (-30, 30))
    for sample in AnnotationFile(minicity_annotations["train"]):
        fast = prepared[sample.map_name].instances(sample.global_from_frame)
        slow = per_item[sample.map_name].instances(sample.global_from_frame)
        for label in range(3):
            np.testing.assert_allclose(
                total_length(fast, label), total_length(slow, label), atol=1e-6
            )


@pytest.mark.parametrize(("count", "workers"), [(4, [1]), (10, [2, 0])])
def test_workers_that_measure_no_batch_are_refused(count, workers, tmp_path):
    for number in range(6):
        (tmp_path / f"{number}.jpg").touch()
    with pytest.raises(ValueError, match=r"--workers must be >= 1, with --samples of more than 4"):
        measure_images(tmp_path, count, workers)


def test_orders_made_per_item_equal_the_vectorised_ones():
    square = np.array([[0, 0], [4, 0], [4, 3], [0, 0.0]])
    line = np.array([[0, 0], [1, 0], [1, 5.0]])
    slow = per_item_orders([MapInstance(1, square), MapInstance(0, line)], 20)
    for points, wanted in zip((square, line), slow, strict=True):
        found = equivalent_orders(points, 20)
        found = found[(found != PADDING).all((1, 2))]
        np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_tiled_files_have_the_wanted_size(minicity_annotations, minicity_root, tmp_path: Path):
    tile_annotations(minicity_annotations["train"], tmp_path / "tiled.arrow", 300)
    assert measure_loading(tmp_path / "tiled.arrow", reads=50)["samples"] == 300
    assert tile_tables(minicity_root, "v1.0-trainval", tmp_path / "root", 3) == 12
    summary = convert_nuscenes(NuScenesOptions(tmp_path / "root", "v1.0-trainval"))
    assert dict(summary.samples) == {"train": 12}
    tiled = AnnotationFile(tmp_path / "root/gsmap_nuscenes_train.arrow")
    assert len(tiled[-1].lidar.sweeps) == 10
