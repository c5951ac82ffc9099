"""How straight predicted lines are: what neither metric sees.

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

MIN_SCORE = 0.2
FOLD_DEG = 90.0  # a vertex that turns by more leads back


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("truth", type=Path, help="annotation file of the split")
    parser.add_argument("results", type=Path, nargs="+", help="result files of tools/test.py")


def run(args: argparse.Namespace) -> None:
    """Print a row for each result file and class of lines."""
    rows = []
    for path in args.results:
        for name, figures in line_shapes(path, args.truth).items():
            length = np.median(figures[:, 0]) if len(figures) else np.nan
            _, turn, folds = figures.mean(0) if len(figures) else [np.nan] * 3
            cells = (f"{length:.2f}", f"{turn:.0f}", f"{100 * folds:.0f}")
            rows.append([str(path.parent.name), name, str(len(figures)), *cells])
    header = ["results", "class", "lines", "length / truth", "turn, degrees", "folds, %"]
    print(f"Lines that match within 1.5 m, with a score of {MIN_SCORE} or more: median of lengths,")
    print("means of turns and folds\n")
    print(markdown_table(header, rows))


def line_shapes(results: Path, truth: Path) -> dict[str, FloatArray]:
    """Return the shapes of the predicted lines that match, by class.

    A row is a prediction's length over that of its ground truth, its mean turn at a vertex in
    degrees, and the share of its vertices that turn by more than 90 degrees. C x (n, 3)
    """
    config = ChamferConfig(AnnotationFile(truth).meta.classes)
    predicted, _ = read_samples(results, RESULTS_KEY, config.classes)
    annotated, _ = read_ground_truth(truth, config.classes)
    names = [name for name in config.classes if name not in AREA_CLASSES]
    shapes: dict[str, list[tuple[float, float, float]]] = {name: [] for name in names}
    nothing = MapElements.from_polylines()
    pairs = [
        Sample(token, predicted.get(token, nothing), true) for token, true in annotated.items()
    ]
    for matches in match_samples(pairs, MapEvaluator(config)):
        found = cast(FrameMatches, matches["chamfer"])
        truths = annotated[found.token].polylines
        lines = predicted[found.token].polylines if len(found.labels) else []
        for index, label, score, matched in zip(
            found.pred_index, found.labels, found.scores, found.matched_gt[:, -1], strict=True
        ):
            name = config.classes[label]
            if name in shapes and score >= MIN_SCORE and matched >= 0:
                turn, folds = turns(lines[index])
                shapes[name].append(
                    (length_m(lines[index]) / length_m(truths[matched]), turn, folds)
                )
    return {name: np.reshape(rows, (-1, 3)) for name, rows in shapes.items()}


def length_m(line: FloatArray) -> float:
    """Length of a polyline in metres. (P, 2 or 3)"""
    return float(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum())


def turns(line: FloatArray) -> tuple[float, float]:
    """Return the mean turn of a polyline in degrees, and the share of folds. (P, 2 or 3)"""
    edges = np.diff(line[:, :2], axis=0)
    headings = np.degrees(np.arctan2(edges[:, 1], edges[:, 0]))
    turned = np.abs((np.diff(headings) + 180.0) % 360.0 - 180.0)
    return float(turned.mean()), float((turned > FOLD_DEG).mean())
