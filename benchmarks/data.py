"""Measurements of data sets for ``results/speed.md``: ``python -m benchmarks data``."""

import time
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import shapely
from shapely import affinity

from benchmarks.measure import in_own_process
from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import CLASSES, MapInstance, MapSample
from gsmap.structures.polylines import is_closed
from mapdata.nuscenes.map import NuScenesLocalMap, open_layers

_MEGABYTE = 2**20


def tile_annotations(source: Path, target: Path, count: int) -> None:
    """Write an annotation file that repeats the samples of another one.

    Args:
        source: Annotation file to repeat.
        target: Annotation file to write.
        count: Number of samples.
    """
    file = AnnotationFile(source)
    source_samples = list(file)

    def samples() -> Iterator[MapSample]:
        for number in range(count):
            sample = source_samples[number % len(source_samples)]
            yield replace(sample, token=f"{sample.token}_{number}")

    write_annotations(target, file.meta, samples())


def _unique_bytes() -> int:
    """Memory of this process that no other process shares, in bytes."""
    return psutil.Process().memory_full_info().uss


def _read_in_worker(file: AnnotationFile, reads: int) -> tuple[int, int, int, int]:
    """Read random samples and measure the memory of this process, which has read nothing before.

    The points are counted, so that every element that is read is also used.

    Args:
        file: Annotation file.
        reads: Number of samples to read.

    Returns:
        Unique memory (`_unique_bytes`) before reading, unique memory after reading, resident memory
        after reading, all in bytes, and the number of points read.
    """
    before = _unique_bytes()
    order = np.random.default_rng(0).integers(len(file), size=reads)
    num_points = 0
    for row in order:
        for instance in file[int(row)].instances or []:  # None without ground truth
            num_points += len(instance.points)
    return before, _unique_bytes(), psutil.Process().memory_info().rss, num_points


def measure_loading(path: Path, reads: int = 5000) -> dict[str, float]:
    """Measure the time to open an annotation file, and the memory of a process that reads it.

    Args:
        path: Annotation file.
        reads: Number of random samples that the extra process reads.

    Returns:
        Figures by name. ``samples`` is the number of samples, and ``file_mb`` is the size of the
        file. ``open_s`` is the processor time to open the file, and ``read_ms`` the processor time
        to read one sample. ``worker_mb`` is the memory of the extra process after reading, without
        pages shared with other processes; it includes the interpreter and its libraries.
        ``worker_growth_mb`` is the growth of this memory by reading. ``worker_rss_mb`` is the
        resident memory after reading, with shared pages.
    """
    start = time.process_time()
    file = AnnotationFile(path)
    file.instance_counts()  # reads the number of elements of each sample, as training does first
    open_s = time.process_time() - start
    start = time.process_time()
    for row in np.random.default_rng(1).integers(len(file), size=1000):
        file[int(row)]
    read_ms = time.process_time() - start  # seconds of 1000 reads = milliseconds of one read
    # A fresh process, as a worker of a data loader is: it has read nothing before.
    before, after, rss, _ = in_own_process(_read_in_worker, file, reads)
    return {
        "samples": len(file),
        "file_mb": path.stat().st_size / _MEGABYTE,
        "open_s": open_s,
        "read_ms": read_ms,
        "worker_mb": after / _MEGABYTE,
        "worker_growth_mb": (after - before) / _MEGABYTE,
        "worker_rss_mb": rss / _MEGABYTE,
    }


class PerItemGroundTruth:
    """Ground truth that is computed for each item by a walk over all records of the map.

    It is computed with the nuScenes devkit, as in data loaders that compute ground truth while
    loading. The classes are divider (0), crossing (1) and boundary (2). The benchmark compares it
    with ``NuScenesLocalMap``, which is prepared once for each map.

    Args:
        nusc_map: Map of the devkit (``NuScenesMap``). A layer such as ``nusc_map.lane`` is a list
            of records, and `extract_line` and `extract_polygon` make their shapely geometries.
        x_range: Smallest and largest x in metres.
        y_range: Smallest and largest y in metres.
    """

    def __init__(
        self, nusc_map: Any, x_range: tuple[float, float], y_range: tuple[float, float]
    ) -> None:
        self._map = nusc_map
        self._x_range = x_range
        self._y_range = y_range

    def instances(self, global_from_frame: np.ndarray) -> list[MapInstance]:
        """Compute the elements around a pose.

        Args:
            global_from_frame: Transform from the annotation frame to the map, in metres. (4, 4)

        Returns:
            Elements in the annotation frame, in metres.
        """
        x, y = global_from_frame[:2, 3]
        yaw = np.arctan2(global_from_frame[1, 0], global_from_frame[0, 0])
        x_min, x_max = self._x_range
        y_min, y_max = self._y_range
        box = shapely.box(x_min, y_min, x_max, y_max)
        rotated = affinity.rotate(box, yaw, origin=(0, 0), use_radians=True)
        patch = affinity.translate(rotated, xoff=x, yoff=y)

        def to_frame(geometry: shapely.Geometry) -> shapely.Geometry:
            """Transform a geometry from the map to the frame."""
            shifted = affinity.translate(geometry, xoff=-x, yoff=-y)
            return affinity.rotate(shifted, -yaw, origin=(0, 0), use_radians=True)

        instances = []
        for line in self._dividers(patch, to_frame):
            instances.append(MapInstance(0, line))
        # Areas of one layer that touch or overlap are joined before their outlines are taken.
        crossings = shapely.union_all(self._areas("ped_crossing", patch, to_frame=to_frame))
        for ring in _rings(crossings):
            instances.append(MapInstance(1, shapely.get_coordinates(ring)))
        segments = shapely.union_all(self._areas("road_segment", patch, to_frame=to_frame))
        lanes = shapely.union_all(self._areas("lane", patch, to_frame=to_frame))
        surface = shapely.union_all([segments, lanes])
        # Outlines are cut 0.2 m inside the range, so that the edge of the range is not a boundary.
        inner = box.buffer(-0.2, join_style="mitre")
        for ring in _rings(surface):
            # A ring is also cut at its start. `line_merge` joins the two pieces there.
            for piece in shapely.get_parts(shapely.line_merge(ring.intersection(inner))):
                instances.append(MapInstance(2, shapely.get_coordinates(piece)))
        return instances

    def _dividers(self, patch: shapely.Polygon, to_frame: Callable[..., Any]) -> list[np.ndarray]:
        """Dividers inside a patch of the map, in the frame by ``to_frame``. Each (n, 2)"""
        lines = []
        for layer in ("road_divider", "lane_divider"):
            for record in getattr(self._map, layer):
                token = record["line_token"]
                if len(self._map.get("line", token)["node_tokens"]) < 2:
                    continue  # not a line
                line = self._map.extract_line(token).intersection(patch)
                if not line.is_empty:
                    for part in shapely.get_parts(to_frame(line)):
                        lines.append(shapely.get_coordinates(part))
        return lines

    def _areas(
        self, layer: str, patch: shapely.Polygon, to_frame: Callable[..., Any]
    ) -> list[shapely.Geometry]:
        """Valid areas of a layer inside a patch of the map, in the frame by ``to_frame``."""
        areas = []
        for record in getattr(self._map, layer):
            polygon = self._map.extract_polygon(record["polygon_token"])
            if polygon.is_valid:
                part = polygon.intersection(patch)
                if not part.is_empty:
                    areas.append(to_frame(part))
        return areas


def _rings(area: shapely.Geometry) -> list[shapely.Geometry]:
    """Outer and inner rings of the polygons of an area; points and lines in it are left out."""
    parts = shapely.get_parts(area)
    polygons = parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON]
    return list(shapely.get_rings(polygons))


def per_item_orders(instances: Sequence[MapInstance], num_points: int) -> list[np.ndarray]:
    """Resample the points of each element in all equivalent orders, with one call per point.

    Args:
        instances: Elements.
        num_points: Number of points P of each order.

    Returns:
        The S equivalent orders of each element: both directions of a line, or at most P - 1
        rotations of a ring, in metres. Each (S, P, 2)
    """

    def resample(points: np.ndarray) -> np.ndarray:
        """Resample to P points at equal distances. (n, 2) -> (P, 2)"""
        line = shapely.LineString(points)
        distances = np.linspace(0, line.length, num=num_points)
        return np.array([line.interpolate(distance).coords[0] for distance in distances])

    orders = []
    for instance in instances:
        points = instance.points
        if is_closed(points):
            rings = []
            # A closed ring repeats its first point, so it has one start fewer than it has points.
            # At most P - 1 starts are used, as in MapTR's data set.
            for k in range(min(len(points), num_points) - 1):
                ring = np.roll(points[:-1], k, axis=0)
                rings.append(resample(np.concatenate([ring, ring[:1]])))
            orders.append(np.stack(rings))
        else:
            orders.append(np.stack([resample(points), resample(points[::-1])]))
    return orders


def open_maps(
    root: Path, x_range: tuple[float, float], y_range: tuple[float, float]
) -> tuple[dict[str, NuScenesLocalMap], dict[str, PerItemGroundTruth]]:
    """Open the maps that a data root has, for both ways to compute ground truth.

    Args:
        root: Data root with the map expansion.
        x_range: Smallest and largest x of the ground truth in metres.
        y_range: Smallest and largest y of the ground truth in metres.

    Returns:
        ``NuScenesLocalMap`` by name, and ``PerItemGroundTruth`` by name.
    """
    # The devkit is optional. `locations` are the names of all nuScenes maps.
    from nuscenes.map_expansion.map_api import NuScenesMap, locations

    prepared = {}
    per_item = {}
    for name in locations:
        if (root / f"maps/expansion/{name}.json").is_file():
            layers = open_layers(root, name, CLASSES)
            prepared[name] = NuScenesLocalMap(layers, CLASSES, x_range, y_range)
            nusc_map = NuScenesMap(str(root), name)
            per_item[name] = PerItemGroundTruth(nusc_map, x_range, y_range=y_range)
    return prepared, per_item


def _cpu_ms(work: Callable[[], Any]) -> float:
    """Processor time of a call in milliseconds."""
    start = time.process_time()
    work()
    return 1e3 * (time.process_time() - start)


def measure_ground_truth(root: Path, annotations: Path, repeats: int = 3) -> dict[str, float]:
    """Measure two ways to compute the ground truth of a frame.

    The first one takes it from a map that is prepared once (`NuScenesLocalMap`). The second one
    walks over all records of the map for each frame (`PerItemGroundTruth`). Passes over all poses
    alternate between the two, so that a slow phase of the machine affects both.

    Args:
        root: Data root with the map expansion.
        annotations: Annotation file with the poses.
        repeats: Number of passes of each way over all poses; the fastest pass counts.

    Returns:
        CPU time in milliseconds per frame (``prepared_ms``, ``per_item_ms``) and their ratio.
    """
    file = AnnotationFile(annotations)
    prepared, per_item = open_maps(root, file.meta.x_range, y_range=file.meta.y_range)
    poses = [(sample.map_name, sample.global_from_frame) for sample in file]

    def run_prepared() -> None:
        for name, pose in poses:
            prepared[name].instances(pose)

    def run_per_item() -> None:
        for name, pose in poses:
            per_item[name].instances(pose)

    prepared_times = []
    per_item_times = []
    for _ in range(repeats):
        prepared_times.append(_cpu_ms(run_prepared))
        per_item_times.append(_cpu_ms(run_per_item))
    prepared_ms = min(prepared_times) / len(poses)
    per_item_ms = min(per_item_times) / len(poses)
    return {
        "prepared_ms": prepared_ms,
        "per_item_ms": per_item_ms,
        "ratio": per_item_ms / prepared_ms,
    }


def measure_pipeline(config: Any, root: Path, count: int = 20) -> dict[str, float]:
    """Measure the training pipeline with two sources of ground truth.

    The first pipeline reads it from the annotation file. The second one computes it for each item
    by a walk over the records of the map, and resamples the orders of points with one call per
    point, as in MapTR's data set. Both apply equal image transforms. Each has three passes, which
    alternate, and the fastest one counts.

    Args:
        config: Config of a ``VectorizedMapDataset``.
        root: Data root with the map expansion.
        count: Number of samples of each pass, >= 1.

    Returns:
        CPU time in milliseconds per sample (``file_ms``, ``per_item_ms``) and their ratio.
    """
    from mmdet3d.registry import DATASETS

    dataset = DATASETS.build(deepcopy(config))  # a copy, which building may change
    meta = dataset.metainfo
    _, per_item = open_maps(root, meta["x_range"], y_range=meta["y_range"])
    dataset[0]  # opens the files, outside of the measured time

    def run_from_file() -> None:
        for number in range(count):
            dataset[number % len(dataset)]

    def run_per_item() -> None:
        for number in range(count):
            results = dataset.get_data_info(number % len(dataset))  # before all transforms
            truth = per_item[results["map_name"]].instances(results["lidar2global"])
            for transform in dataset.pipeline.transforms:
                # `FormatMapTargets` makes the orders of points from the annotation file.
                if type(transform).__name__ == "FormatMapTargets":
                    results["orders"] = per_item_orders(truth, transform.num_points)
                else:
                    results = transform(results)

    file_times = []
    per_item_times = []
    for _ in range(3):
        file_times.append(_cpu_ms(run_from_file))
        per_item_times.append(_cpu_ms(run_per_item))
    file_ms = min(file_times) / count
    per_item_ms = min(per_item_times) / count
    return {"file_ms": file_ms, "per_item_ms": per_item_ms, "ratio": per_item_ms / file_ms}
