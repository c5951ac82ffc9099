"""Scores of result files for the report page, with the matches of each sample."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.evaluation.analysis.distances import cut_by_distance
from gsmap.evaluation.core.chamfer_ap import CHAMFER_THRESHOLDS, ChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.file_evaluation import mismatch_notes
from gsmap.evaluation.core.matches import FrameMatches
from gsmap.evaluation.core.metric import Sample
from gsmap.evaluation.core.raster_ap import RasterConfig
from gsmap.evaluation.core.report import MetricReport
from gsmap.evaluation.core.results_json import RESULTS_KEY, THREE_D, SampleFile
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import IntArray, MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.model_facts import law_of
from gsmap.utils.split_lists import require_results_of
from gsmap.utils.words import format_count

MATCH_M = 1.0
"""Largest Chamfer distance in metres of a hit on the page."""
# Column of this distance in `FrameMatches.matched_gt`, which has one column for each threshold.
_HIT_COLUMN = CHAMFER_THRESHOLDS.index(MATCH_M)


@dataclass(frozen=True)
class ScoredResult:
    """Predictions and scores of one result file.

    Args:
        name: Name of the result on the page.
        predictions: Elements of each sample, by token.
        matches: Matches of each sample by token; matches are pairs with a small Chamfer distance.
        reports: Report of each metric.
        notes: Remarks on the samples for the reader.
        law: Distribution of the errors of vertices with Gaussians, ``normal`` or ``laplace``.
    """

    name: str
    predictions: Mapping[str, MapElements]
    matches: Mapping[str, FrameMatches]
    reports: list[MetricReport]
    notes: list[str]
    law: str

    def hits(self, token: str) -> IntArray:
        """Index of the ground truth that each prediction hits within 1 m, or -1. (N,)

        The N predictions are in the order of ``matches[token]``.
        """
        return self.matches[token].matched_gt[:, _HIT_COLUMN]

    def f1(self, token: str, score_thr: float) -> float:
        """Compute F1 of a sample.

        Args:
            token: Token of the sample.
            score_thr: Smallest score of a prediction that counts.

        Returns:
            F1 in [0, 1], which is 1 if there are neither predictions nor ground truth.
        """
        matches = self.matches[token]
        is_counted = matches.scores >= score_thr
        total = int(is_counted.sum()) + int(matches.num_gts.sum())
        if total == 0:
            return 1.0
        num_hits = int((self.hits(token)[is_counted] >= 0).sum())
        return 2 * num_hits / total  # total: predictions and ground truths together


def score_result(
    name: str,
    path: str | Path,
    truth: Mapping[str, MapElements],
    meta: AnnotationMeta,
    allow_mismatch: bool = False,
    allow_other_split: bool = False,
    law: str | None = None,
) -> ScoredResult:
    """Score a result file with the rules of ``tools/evaluate.py``.

    Args:
        name: Name of the result on the page.
        path: Results in MapTR's JSON form, with or without Gaussians.
        truth: Ground truth of each sample, by token.
        meta: Metadata of the annotation file.
        allow_mismatch: Whether the samples of the results and of the ground truth may differ. A
            sample without results then counts as a sample without predictions, and results without
            ground truth are ignored.
        allow_other_split: Whether to accept results of a model that was trained on another list of
            scenes than the list of the ground truth, and results for such other data.
        law: Distribution of the errors, ``normal`` or ``laplace``; by default the distribution of
            the model's calibration in the file, or ``normal`` without a calibration.

    Returns:
        Predictions, matches and reports.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is malformed, or its samples or its split disagree with the ground
            truth.
    """
    file = SampleFile(path, RESULTS_KEY, meta.classes, gaussians=True)
    predictions = {}
    # After the last sample, `file` has the metadata (`about`) and the numbers of ignored elements.
    for token, elements, _ in file:
        predictions[token] = elements
    if not allow_other_split:
        # Refuse results for other data, or of a model that was trained on another list of scenes.
        require_results_of(meta.split_list, about=file.about, path=path)
    try:
        # Notes on samples without results and on results without ground truth.
        notes = mismatch_notes(predictions, truth, allowed=allow_mismatch)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    # `file.ignored` has the number of predictions of each unknown class, by the name of the class.
    # Its entry `THREE_D` is no class: it is the number of samples whose predictions have heights.
    num_ignored = dict(file.ignored)
    num_samples_with_heights = num_ignored.pop(THREE_D, 0)
    if num_samples_with_heights:
        notes.append("some predictions have heights, which no figure here counts")
    if file.num_short:
        few = "of fewer than two points"
        notes.append(f"{format_count(file.num_short, 'prediction')} {few} left out")
    for class_name, count in sorted(num_ignored.items()):
        notes.append(f"{count} predictions of class {class_name!r} are not scored")
    evaluator = _create_evaluator(meta)
    no_elements = MapElements.from_polylines()
    samples = []
    matches = {}
    for token, true_elements in truth.items():
        # Matches of the sample under each metric, by the name of the metric.
        matches_of_metrics = evaluator.match(
            token, predictions=predictions.get(token, no_elements), ground_truth=true_elements
        )
        samples.append(matches_of_metrics)
        matches[token] = cast(FrameMatches, matches_of_metrics["chamfer"])
    return ScoredResult(
        name,
        predictions=predictions,
        matches=matches,
        reports=evaluator.reports(samples),
        notes=notes,
        law=law or law_of(file.about),
    )


def score_by_distance(
    result: ScoredResult, truth: Mapping[str, MapElements], meta: AnnotationMeta
) -> ScoredResult:
    """Score a result in bands of the distance from the vehicle.

    Args:
        result: Scored result file.
        truth: Ground truth of each sample, by token.
        meta: Metadata of the annotation file.

    Returns:
        The result with new reports, in which each band of a sample counts as a separate sample.
    """
    evaluator = _create_evaluator(meta)
    no_elements = MapElements.from_polylines()
    samples = []
    for token, true_elements in truth.items():
        predictions = result.predictions.get(token, no_elements)
        sample = Sample(token, predictions=predictions, ground_truth=true_elements)
        samples.append(sample)
    area_labels = [label for label, name in enumerate(meta.classes) if name in AREA_CLASSES]
    # One new sample for each band of a sample, with the parts of the elements in the band.
    bands = cut_by_distance(samples, areas=area_labels)
    return replace(result, reports=evaluator.reports(evaluator.match_all(bands)))


def _create_evaluator(meta: AnnotationMeta) -> MapEvaluator:
    """Evaluator with the metrics of the page."""
    grid = BEVGrid(meta.x_range, meta.y_range)
    return MapEvaluator(ChamferConfig(meta.classes), RasterConfig(meta.classes, grid))
