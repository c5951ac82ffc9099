"""How good a map of a drive is: AP of its elements, completeness and accuracy of its length."""

from collections.abc import Mapping, Sequence

import numpy as np
import shapely

from drivemaps.drive import Drive, DriveFrame
from gsmap.evaluation.core.chamfer_ap import CHAMFER_THRESHOLDS, ChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.report import flat_metrics
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import FloatArray, MapElements
from gsmap.structures.polylines import clip_to_box
from gsmap.utils.words import markdown_table

NUM_POINTS = 1000  # elements are hundreds of metres long


def chamfer_ap(
    pairs: Sequence[tuple[str, MapElements, MapElements]], classes: Sequence[str], num_points: int
) -> dict[str, float]:
    """Return AP_chamfer per class and its mean over the classes that there are.

    Args:
        pairs: Name, predicted and true map of each drive or sample.
        classes: Names of the classes.
        num_points: Points that each line is resampled to.
    """
    config = ChamferConfig(tuple(classes), num_points=num_points)
    evaluator = MapEvaluator(config)
    figures = flat_metrics(evaluator.reports([evaluator.match(*pair) for pair in pairs]))
    there = [name for name in classes if figures[f"chamfer/{name}/num_gts"]]
    found = {name: figures[f"chamfer/{name}/AP"] for name in there}
    return found | {"mean": float(np.mean(list(found.values()))) if there else np.nan}


def near_and_total_m(
    lines: MapElements, other: MapElements, label: int, within_m: float
) -> FloatArray:
    """Return how much of a class's length lies near the other map, and how much there is.

    Args:
        lines: The map whose length counts.
        other: The map that it should lie near.
        label: The class.
        within_m: How near, in metres.

    Returns:
        Both lengths in metres. (2,)
    """
    own, others = (
        np.array([shapely.linestrings(line) for line in of_class.polylines], dtype=object)
        for of_class in (m.select(m.labels == label) for m in (lines, other))
    )
    strip = shapely.union_all(shapely.buffer(others, within_m, quad_segs=32))
    near = shapely.length(shapely.intersection(own, strip)).sum()
    return np.array([near, shapely.length(own).sum()])


def cut_to_frame(elements: MapElements, drive: Drive, frame: DriveFrame) -> MapElements:
    """Cut what a frame sees out of the map of its drive, as ground truth is cut out of a map.

    Args:
        elements: The map in the global frame.
        drive: The drive.
        frame: One of its frames.

    Returns:
        The elements inside the frame's range, in the annotation frame.
    """
    (x0, x1), (y0, y1) = drive.x_range, drive.y_range
    box = shapely.box(x0, y0, x1, y1)
    scores: list[float] = []
    lines, labels = [], []
    for line, label, score in drive.nearby(frame, elements).rows:
        local = frame.to_frame(line)
        if drive.classes[label] in AREA_CLASSES and len(local) > 3:
            areas = shapely.get_parts(shapely.make_valid(shapely.Polygon(local)) & box)
            pieces = [shapely.get_coordinates(a.exterior) for a in areas if a.area > 0.0]
        else:
            pieces = clip_to_box(local, drive.x_range, drive.y_range)
        lines += pieces
        labels += [label] * len(pieces)
        scores += [score] * len(pieces)
    return MapElements.from_polylines(lines, labels, scores)


def map_figures(
    maps: Sequence[MapElements], truths: Sequence[MapElements], drives: Sequence[Drive]
) -> dict[str, dict[str, float]]:
    """Score the maps of drives.

    Args:
        maps: The found maps. (D,)
        truths: The true maps. (D,)
        drives: The drives, of the same classes. (D,)

    Returns:
        By figure, then by class or ``mean``: ``AP`` of whole elements; ``AP per sample`` of what
        each sample sees of the map; ``completeness@T`` and ``accuracy@T`` in T metres, of the
        length of all drives.
    """
    classes = drives[0].classes
    triples = list(zip(drives, maps, truths, strict=True))
    whole = [(drive.scene, found, true) for drive, found, true in triples]
    cut = [
        (f.sample.token, cut_to_frame(found, drive, f), cut_to_frame(true, drive, f))
        for drive, found, true in triples
        for f in drive.frames
    ]
    figures = {
        "AP": chamfer_ap(whole, classes, NUM_POINTS),
        "AP per sample": chamfer_ap(cut, classes, 100),
    }
    sides = {"completeness": (truths, maps), "accuracy": (maps, truths)}
    for name, (first, second) in sides.items():
        for within_m in CHAMFER_THRESHOLDS:
            shares = {}
            for label, class_name in enumerate(classes):
                lengths = [
                    near_and_total_m(*pair, label, within_m)
                    for pair in zip(first, second, strict=True)
                ]
                near, total = np.sum(lengths, axis=0)
                if total:
                    shares[class_name] = float(near / total)
            mean = float(np.mean(list(shares.values()))) if shares else np.nan
            figures[f"{name}@{within_m}"] = shares | {"mean": mean}
    return figures


def figures_table(figures: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Return a Markdown table: a row per figure and way of making the map, a column per class.

    Args:
        figures: What ``map_figures`` returns, by the way of making the map.
    """
    of_first = next(iter(figures.values()))
    columns = [*dict.fromkeys(c for row in of_first.values() for c in row if c != "mean"), "mean"]
    rows = [
        [name, way, *(f"{100 * found[name][c]:.1f}" if c in found[name] else "-" for c in columns)]
        for name in of_first
        for way, found in figures.items()
    ]
    return markdown_table(["figure", "map", *columns], rows)
