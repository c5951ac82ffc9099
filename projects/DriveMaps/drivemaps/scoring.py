"""Scores of the maps of drives: AP of elements, and completeness and accuracy by length."""

from collections.abc import Mapping, Sequence

import numpy as np
import shapely

from drivemaps.drive import Drive, DriveFrame
from gsmap.evaluation.core.chamfer_ap import CHAMFER_THRESHOLDS, ChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.report import flat_metrics
from gsmap.structures.cutting import cut_to_range
from gsmap.structures.elements import FloatArray, MapElements
from gsmap.utils.words import markdown_table

NUM_POINTS = 1000
"""Number of points of a resampled element of a drive, which may be hundreds of metres long."""
_NUM_POINTS_OF_SAMPLES = 100  # number of points for elements within the range of one sample


def chamfer_ap(
    pairs: Sequence[tuple[str, MapElements, MapElements]], classes: Sequence[str], num_points: int
) -> dict[str, float]:
    """Compute the AP with the Chamfer distance for each class.

    Args:
        pairs: Name, predicted map and true map of each drive or sample.
        classes: Class names in label order.
        num_points: Number of points that each line is resampled to.

    Returns:
        AP in [0, 1] of each class that has ground truth, and their ``mean``; empty if no class
        has ground truth.
    """
    evaluator = MapEvaluator(ChamferConfig(tuple(classes), num_points=num_points))
    matches = []
    for name, predicted, true in pairs:
        matches.append(evaluator.match(name, predicted, true))
    # Figures by names such as ``chamfer/divider/AP``. ``num_gts`` is the number of true elements.
    metrics = flat_metrics(evaluator.reports(matches))
    ap_of_class = {}
    for name in classes:
        if metrics[f"chamfer/{name}/num_gts"]:
            ap_of_class[name] = metrics[f"chamfer/{name}/AP"]
    return _with_mean(ap_of_class)


def _with_mean(value_of_class: dict[str, float]) -> dict[str, float]:
    """Add the mean of all classes. Without classes, there is none."""
    if not value_of_class:
        return {}
    return value_of_class | {"mean": float(np.mean(list(value_of_class.values())))}


def near_and_total_m(
    lines: MapElements, other: MapElements, label: int, within_m: float
) -> FloatArray:
    """Measure the length of the lines of a class: the part near another map, and the total.

    Args:
        lines: Map whose lines are measured.
        other: Map that the lines are compared with.
        label: Index of the class.
        within_m: Largest distance from a line of the other map, in metres.

    Returns:
        Length near the other map and total length, in metres. (2,)
    """
    measured = _linestrings(lines, label)
    # The strip around a line has round ends, and each quarter of a circle has 32 segments.
    strips = shapely.buffer(_linestrings(other, label), within_m, quad_segs=32)
    near = shapely.intersection(measured, shapely.union_all(strips))
    return np.array([shapely.length(near).sum(), shapely.length(measured).sum()])


def _linestrings(elements: MapElements, label: int) -> np.ndarray:
    """Convert the elements of one class to shapely geometries. (N,)"""
    polylines = elements.select(elements.labels == label).polylines
    # Without elements, only an array of objects is accepted as an array of geometries.
    return np.array([shapely.linestrings(line) for line in polylines], dtype=object)


def cut_to_frame(elements: MapElements, drive: Drive, frame: DriveFrame) -> MapElements:
    """Cut the range of a frame out of the map of a drive, as it is done for ground truth.

    Args:
        elements: Map in the global frame.
        drive: Drive of the frame.
        frame: Frame whose range is cut out.

    Returns:
        Elements inside the range, in the annotation frame.
    """
    nearby = drive.nearby(frame, elements)  # a fast preselection by bounding boxes
    local = MapElements(
        points=frame.to_frame(nearby.points),  # from the global frame to the annotation frame
        offsets=nearby.offsets,
        labels=nearby.labels,
        scores=nearby.scores,
    )
    return cut_to_range(local, drive.classes, x_range=drive.x_range, y_range=drive.y_range)


def map_figures(
    maps: Sequence[MapElements], truths: Sequence[MapElements], drives: Sequence[Drive]
) -> dict[str, dict[str, float]]:
    """Score the maps of drives.

    Args:
        maps: Predicted maps. (D,)
        truths: True maps. (D,)
        drives: Drives with equal classes. (D,)

    Returns:
        Values in [0, 1] by figure, then by class or ``mean``; a class without a value is left out,
        and without classes there is no mean. ``AP`` is the AP of whole elements.
        ``AP per sample`` is the AP of the maps cut to the range of each sample.
        ``completeness@T`` is the share of the true length within T metres of the predicted map.
        ``accuracy@T`` is the share of the predicted length within T metres of the true map. Both
        shares are over all drives.
    """
    classes = drives[0].classes
    whole_pairs = []
    sample_pairs = []
    for drive, predicted, true in zip(drives, maps, truths, strict=True):
        whole_pairs.append((drive.name, predicted, true))
        for frame in drive.frames:
            predicted_part = cut_to_frame(predicted, drive, frame)
            true_part = cut_to_frame(true, drive, frame)
            sample_pairs.append((frame.sample.token, predicted_part, true_part))
    figures = {
        "AP": chamfer_ap(whole_pairs, classes, num_points=NUM_POINTS),
        "AP per sample": chamfer_ap(sample_pairs, classes, num_points=_NUM_POINTS_OF_SAMPLES),
    }
    for within_m in CHAMFER_THRESHOLDS:
        completeness = _near_shares(truths, others=maps, classes=classes, within_m=within_m)
        figures[f"completeness@{within_m}"] = completeness
    # A second loop, because figures are printed in this order: first all values of completeness.
    for within_m in CHAMFER_THRESHOLDS:
        accuracy = _near_shares(maps, others=truths, classes=classes, within_m=within_m)
        figures[f"accuracy@{within_m}"] = accuracy
    return figures


def _near_shares(
    measured: Sequence[MapElements],
    others: Sequence[MapElements],
    classes: Sequence[str],
    within_m: float,
) -> dict[str, float]:
    """Share of the length of each class within a distance of the other maps, and their mean."""
    share_of_class = {}
    for label, name in enumerate(classes):
        lengths_m = []
        for lines, other in zip(measured, others, strict=True):
            lengths_m.append(near_and_total_m(lines, other, label=label, within_m=within_m))
        near_m, total_m = np.sum(lengths_m, axis=0)
        if total_m:  # a class without lines has no share
            share_of_class[name] = float(near_m / total_m)
    return _with_mean(share_of_class)


def figures_table(figures: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Format scores of maps as a Markdown table.

    Args:
        figures: Results of ``map_figures`` by the name of each map.

    Returns:
        A table with a row per figure and map, and a column per class, in percent; ``-`` for a class
        without a value.
    """
    first_figures = next(iter(figures.values()))  # all maps have equal names of figures
    # The columns are the classes of all figures, in the order in which they first occur.
    columns: list[str] = []
    for class_values in first_figures.values():
        for key in class_values:
            if key != "mean" and key not in columns:
                columns.append(key)
    columns.append("mean")
    rows = []
    for figure in first_figures:
        for name, figures_of_map in figures.items():
            class_values = figures_of_map[figure]
            cells = []
            for key in columns:
                cells.append(f"{100 * class_values[key]:.1f}" if key in class_values else "-")
            rows.append([figure, name, *cells])
    return markdown_table(["figure", "map", *columns], rows)
