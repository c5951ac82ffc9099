"""Measurements behind ``results/speed.md``, run by ``python -m benchmarks data``."""

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
    """Write an annotation file of ``count`` samples by repeating another one's."""
    file = AnnotationFile(source)
    known = list(file)

    def samples() -> Iterator[MapSample]:
        for number in range(count):
            sample = known[number % len(known)]
            yield replace(sample, token=f"{sample.token}_{number}")

    write_annotations(target, file.meta, samples())


def _unique_bytes() -> int:
    """Memory of this process that it shares with no other."""
    return psutil.Process().memory_full_info().uss


def _read_in_worker(file: AnnotationFile, reads: int) -> tuple[int, int, int, int]:
    """Read random samples in a fresh process and report the memory that it took."""
    before = _unique_bytes()
    order = np.random.default_rng(0).integers(len(file), size=reads)
    points = sum(len(i.points) for row in order for i in file[int(row)].instances or [])
    return before, _unique_bytes(), psutil.Process().memory_info().rss, points


def measure_loading(path: Path, reads: int = 5000) -> dict[str, float]:
    """Measure opening an annotation file and reading from it in an extra process.

    Args:
        path: The file.
        reads: How many random samples the extra process reads.

    Returns:
        ``open_s`` and ``read_ms`` per sample, both of CPU time; ``worker_mb``, all that the extra
        process holds for itself, the interpreter and its libraries included; ``worker_growth_mb``,
        what reading added to it; ``worker_rss_mb``, with shared pages; ``file_mb``; ``samples``.
    """
    start = time.process_time()
    file = AnnotationFile(path)
    file.instance_counts()
    opened = time.process_time() - start
    start = time.process_time()
    for row in np.random.default_rng(1).integers(len(file), size=1000):
        file[int(row)]
    read = time.process_time() - start
    before, after, rss, _ = in_own_process(_read_in_worker, file, reads)
    return {
        "samples": len(file),
        "file_mb": path.stat().st_size / _MEGABYTE,
        "open_s": opened,
        "read_ms": read,
        "worker_mb": after / _MEGABYTE,
        "worker_growth_mb": (after - before) / _MEGABYTE,
        "worker_rss_mb": rss / _MEGABYTE,
    }


class PerItemGroundTruth:
    """Ground truth made for each item by a walk over all records of the map, with the devkit.

    The way of code that makes it in the data loader: what ``NuScenesLocalMap`` is measured against.

    Args:
        nusc_map: A map of the devkit.
        x_range: Smallest and largest x in metres.
        y_range: Smallest and largest y in metres.
    """

    def __init__(
        self, nusc_map: Any, x_range: tuple[float, float], y_range: tuple[float, float]
    ) -> None:
        self._map = nusc_map
        self._x_range, self._y_range = x_range, y_range

    def instances(self, global_from_frame: np.ndarray) -> list[MapInstance]:
        """Return the elements around a pose."""
        yaw = np.arctan2(global_from_frame[1, 0], global_from_frame[0, 0])
        box = shapely.box(self._x_range[0], self._y_range[0], self._x_range[1], self._y_range[1])
        x, y = global_from_frame[:2, 3]
        turned = affinity.rotate(box, yaw, origin=(0, 0), use_radians=True)
        patch = affinity.translate(turned, x, y)

        def local(geometry: shapely.Geometry) -> shapely.Geometry:
            moved = affinity.translate(geometry, -x, -y)
            return affinity.rotate(moved, -yaw, origin=(0, 0), use_radians=True)

        found = [MapInstance(0, line) for line in self._dividers(patch, local)]
        crossings = shapely.union_all(self._areas("ped_crossing", patch, local))
        found += [MapInstance(1, shapely.get_coordinates(r)) for r in self._rings(crossings)]
        layers = [self._areas(name, patch, local) for name in ("road_segment", "lane")]
        surface = shapely.union_all([shapely.union_all(layer) for layer in layers])
        inner = box.buffer(-0.2, join_style="mitre")
        for ring in self._rings(surface):
            pieces = shapely.get_parts(shapely.line_merge(ring.intersection(inner)))
            found += [MapInstance(2, shapely.get_coordinates(piece)) for piece in pieces]
        return found

    def _dividers(self, patch: shapely.Polygon, local: Callable[..., Any]) -> list[np.ndarray]:
        lines = []
        for layer in ("road_divider", "lane_divider"):
            for record in getattr(self._map, layer):
                if len(self._map.get("line", record["line_token"])["node_tokens"]) < 2:
                    continue
                line = self._map.extract_line(record["line_token"]).intersection(patch)
                if not line.is_empty:
                    parts = shapely.get_parts(local(line))
                    lines += [shapely.get_coordinates(part) for part in parts]
        return lines

    def _areas(
        self, layer: str, patch: shapely.Polygon, local: Callable[..., Any]
    ) -> list[shapely.Geometry]:
        areas = []
        for record in getattr(self._map, layer):
            polygon = self._map.extract_polygon(record["polygon_token"])
            if polygon.is_valid:
                cut = polygon.intersection(patch)
                if not cut.is_empty:
                    areas.append(local(cut))
        return areas

    def _rings(self, area: shapely.Geometry) -> list[shapely.Geometry]:
        polygons = shapely.get_parts(area)
        return list(shapely.get_rings(polygons[shapely.get_type_id(polygons) == 3]))


def per_item_orders(instances: Sequence[MapInstance], num_points: int) -> list[np.ndarray]:
    """Return each element's equivalent orders, one call per point. each (S, P, 2)."""

    def resampled(points: np.ndarray) -> np.ndarray:
        line = shapely.LineString(points)
        distances = np.linspace(0, line.length, num_points)
        return np.array([line.interpolate(distance).coords[0] for distance in distances])

    orders = []
    for instance in instances:
        points = instance.points
        if is_closed(points):
            rolled = (
                np.roll(points[:-1], k, axis=0) for k in range(min(len(points), num_points) - 1)
            )
            orders.append(np.stack([resampled(np.concatenate([r, r[:1]])) for r in rolled]))
        else:
            orders.append(np.stack([resampled(points), resampled(points[::-1])]))
    return orders


def open_maps(root: Path, x_range: tuple[float, float], y_range: tuple[float, float]) -> tuple:
    """Open all maps of a data root both ways.

    Returns:
        ``NuScenesLocalMap`` by name, and ``PerItemGroundTruth`` by name.
    """
    from nuscenes.map_expansion.map_api import NuScenesMap, locations

    prepared, per_item = {}, {}
    for name in locations:
        if (root / f"maps/expansion/{name}.json").is_file():
            layers = open_layers(root, name, CLASSES)
            prepared[name] = NuScenesLocalMap(layers, CLASSES, x_range, y_range)
            per_item[name] = PerItemGroundTruth(NuScenesMap(str(root), name), x_range, y_range)
    return prepared, per_item


def _cpu_ms(work: Callable[[], Any]) -> float:
    start = time.process_time()
    work()
    return 1e3 * (time.process_time() - start)


def measure_ground_truth(root: Path, annotations: Path, repeats: int = 3) -> dict[str, float]:
    """Measure ground truth per frame, prepared once per map and made per item, in turns.

    Args:
        root: Data root with the map expansion.
        annotations: Annotation file whose poses serve.
        repeats: How many times each way runs over all poses; the fastest counts.

    Returns:
        CPU time in milliseconds per frame (``prepared_ms``, ``per_item_ms``) and their ratio.
    """
    file = AnnotationFile(annotations)
    prepared, per_item = open_maps(root, file.meta.x_range, file.meta.y_range)
    poses = [(sample.map_name, sample.global_from_frame) for sample in file]

    def quickly() -> None:
        for name, pose in poses:
            prepared[name].instances(pose)

    def slowly() -> None:
        for name, pose in poses:
            per_item[name].instances(pose)

    spent = np.array([[_cpu_ms(quickly), _cpu_ms(slowly)] for _ in range(repeats)])
    fast, slow = spent.min(0) / len(poses)
    return {"prepared_ms": fast, "per_item_ms": slow, "ratio": slow / fast}


def measure_pipeline(config: Any, root: Path, count: int = 20) -> dict[str, float]:
    """Measure the training pipeline, with ground truth from the file and made per item, in turns.

    Made per item means: elements out of the map by a walk over its records, and their point orders
    by one call per point, as MapTR's data set does. Images are loaded and changed by the same
    transforms.

    Args:
        config: Config of a ``VectorizedMapDataset``.
        root: Data root with the map expansion.
        count: How many samples each way delivers.

    Returns:
        CPU time in milliseconds per sample (``file_ms``, ``per_item_ms``) and the ratio.
    """
    from mmdet3d.registry import DATASETS

    dataset = DATASETS.build(deepcopy(config))
    meta = dataset.metainfo
    _, per_item = open_maps(root, meta["x_range"], meta["y_range"])
    dataset[0]

    def from_file() -> None:
        for number in range(count):
            dataset[number % len(dataset)]

    def by_item() -> None:
        for number in range(count):
            results = dataset.get_data_info(number % len(dataset))
            truth = per_item[results["map_name"]].instances(results["lidar2global"])
            for transform in dataset.pipeline.transforms:
                if type(transform).__name__ == "FormatMapTargets":
                    results["orders"] = per_item_orders(truth, transform.num_points)
                else:
                    results = transform(results)

    spent = np.array([[_cpu_ms(from_file), _cpu_ms(by_item)] for _ in range(3)])
    fast, slow = spent.min(0) / count
    return {"file_ms": fast, "per_item_ms": slow, "ratio": slow / fast}
