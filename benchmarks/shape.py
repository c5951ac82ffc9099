"""Straightness of predicted lines, to which AP_chamfer and AP_raster are not sensitive.

AP_chamfer and AP_raster compare sets of points and pixels. A line whose points run back and forth
along its ground truth scores as well as one that follows it.
"""

import argparse
from pathlib import Path
from typing import cast

import numpy as np

from benchmarks.measure import markdown_table
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.file_evaluation import match_samples, read_ground_truth
from gsmap.evaluation.core.matches import FrameMatches
from gsmap.evaluation.core.metric import Sample
from gsmap.evaluation.core.results_json import RESULTS_KEY, read_samples
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import FloatArray, MapElements

MIN_SCORE = 0.2  # smallest score of a predicted line that counts
FOLD_DEG = 90.0  # a vertex with a larger turn is a fold: the line runs back from there


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks shape`` to a parser."""
    parser.add_argument("truth", type=Path, help="annotation file of the split")
    parser.add_argument("results", type=Path, nargs="+", help="result files of tools/test.py")


def run(args: argparse.Namespace) -> None:
    """Print a row for each result file and class of lines.

    Args:
        args: Parsed options of ``add_arguments``.
    """
    rows = []
    for path in args.results:
        for name, shapes in line_shapes(path, args.truth).items():
            length_ratio = np.nan  # NaN in the row of a class without lines
            turn = np.nan
            folds = np.nan
            if len(shapes):
                length_ratio = np.median(shapes[:, 0])
                _, turn, folds = shapes.mean(axis=0)
            row = [
                str(path.parent.name),
                name,
                str(len(shapes)),
                f"{length_ratio:.2f}",
                f"{turn:.0f}",
                f"{100 * folds:.0f}",
            ]
            rows.append(row)
    header = ["results", "class", "lines", "length / truth", "turn, degrees", "folds, %"]
    print(f"Lines that match within 1.5 m, with a score of {MIN_SCORE} or more: median of lengths,")
    print("means of turns and folds\n")
    print(markdown_table(header, rows))


def line_shapes(results: Path, truth: Path) -> dict[str, FloatArray]:
    """Measure the shapes of the predicted lines that match a ground truth.

    Args:
        results: Result file.
        truth: Annotation file of the split.

    Returns:
        For each class of lines, by name, an array with one row per matched line: its length
        relative to its ground truth, its mean turn at a vertex in degrees, and the share of
        vertices with a turn of more than 90 degrees. Areas are left out. (n, 3)
    """
    config = ChamferConfig(AnnotationFile(truth).meta.classes)  # rules of AP_chamfer, the defaults
    predictions, _ = read_samples(results, RESULTS_KEY, config.classes)
    truths, _ = read_ground_truth(truth, config.classes)
    # Both readers return the elements of each sample by token, and counts of ignored elements.
    shapes: dict[str, list[tuple[float, float, float]]] = {}
    for name in config.classes:
        if name not in AREA_CLASSES:
            shapes[name] = []
    no_elements = MapElements.from_polylines()  # for samples without results
    samples = []
    for token, elements in truths.items():
        samples.append(Sample(token, predictions.get(token, no_elements), elements))
    for sample_matches in match_samples(samples, MapEvaluator(config)):
        # `FrameMatches` has one entry for each prediction that counts. Its indices refer to the
        # elements of the sample.
        matches = cast(FrameMatches, sample_matches["chamfer"])
        if not len(matches.labels):
            continue
        truth_lines = truths[matches.token].polylines
        pred_lines = predictions[matches.token].polylines
        # The last column belongs to the largest threshold, 1.5 m: index of the ground truth that
        # the prediction matches, or -1.
        truth_indices = matches.matched_gt[:, -1]
        for index, label, score, truth_index in zip(
            matches.pred_index, matches.labels, matches.scores, truth_indices, strict=True
        ):
            name = config.classes[label]
            if name in shapes and score >= MIN_SCORE and truth_index >= 0:
                line = pred_lines[index]
                length_ratio = length_m(line) / length_m(truth_lines[truth_index])
                turn, folds = turns(line)
                shapes[name].append((length_ratio, turn, folds))
    return {name: np.reshape(rows, (-1, 3)) for name, rows in shapes.items()}


def length_m(line: FloatArray) -> float:
    """Length in metres of a polyline (P, 2) or (P, 3), projected to the plane."""
    steps = np.diff(line[:, :2], axis=0)
    return float(np.linalg.norm(steps, axis=1).sum())


def turns(line: FloatArray) -> tuple[float, float]:
    """Mean turn of a polyline in degrees, and the share of its vertices that are folds.

    Args:
        line: Vertices in metres. (P, 2) or (P, 3)

    Returns:
        The mean in [0, 180] and the share in [0, 1]. Both are 0 for a line of two vertices.
    """
    if len(line) < 3:
        return 0.0, 0.0
    edges = np.diff(line[:, :2], axis=0)
    headings = np.degrees(np.arctan2(edges[:, 1], edges[:, 0]))
    # A turn across the heading of 180 degrees would differ by 360 degrees.
    differences = (np.diff(headings) + 180.0) % 360.0 - 180.0  # in [-180, 180)
    angles = np.abs(differences)
    return float(angles.mean()), float((angles > FOLD_DEG).mean())
