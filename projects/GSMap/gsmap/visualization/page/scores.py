"""A result file scored for the page, with the matches of each sample."""

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

MATCH_M = 1.0
"""Chamfer distance in metres within which the page calls a prediction a hit."""
_COLUMN = CHAMFER_THRESHOLDS.index(MATCH_M)


@dataclass(frozen=True)
class ScoredResult:
    """One result file.

    Args:
        name: What the page calls it.
        predictions: Elements of each sample, by token.
        matches: Their matches by Chamfer distance, by token.
        reports: One report per metric.
        notes: What the reader should know of the samples.
        law: Distribution of the errors that its Gaussians tell of.
    """

    name: str
    predictions: Mapping[str, MapElements]
    matches: Mapping[str, FrameMatches]
    reports: list[MetricReport]
    notes: list[str]
    law: str

    def hits(self, token: str) -> IntArray:
        """Return the ground truth that each counted prediction hits within 1 m, or -1. (N,)"""
        return self.matches[token].matched_gt[:, _COLUMN]

    def f1(self, token: str, score_thr: float) -> float:
        """Return F1 of a sample's predictions of at least ``score_thr``; 1 if there is nothing."""
        matches = self.matches[token]
        kept = matches.scores >= score_thr
        total = int(kept.sum()) + int(matches.num_gts.sum())
        return 2 * int((self.hits(token)[kept] >= 0).sum()) / total if total else 1.0


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
        name: What the page calls it.
        path: Results in MapTR's JSON form, with or without Gaussians.
        truth: Ground truth of each sample, by token.
        meta: Classes and range.
        allow_mismatch: As in ``mismatch_notes``.
        allow_other_split: Whether the model may be of another split than the ground truth.
        law: Distribution of the errors; None for that of the model's calibration, or the normal.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If it is malformed, or its samples or its split are not the ground truth's.
    """
    file = SampleFile(path, RESULTS_KEY, meta.classes, gaussians=True)
    predictions, others = {token: found for token, found, _ in file}, file.ignored
    if not allow_other_split:
        require_results_of(meta.split_list, file.about, path)
    try:
        notes = mismatch_notes(predictions, truth, allow_mismatch)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    if others.pop(THREE_D, 0):
        notes.append("some predictions have heights, which no figure here counts")
    notes += [f"{n} predictions of class {c!r} are not scored" for c, n in sorted(others.items())]
    evaluator, nothing = _evaluator(meta), MapElements.from_polylines()
    found = [evaluator.match(t, predictions.get(t, nothing), gt) for t, gt in truth.items()]
    chamfer = [cast(FrameMatches, sample["chamfer"]) for sample in found]
    matches = {frame.token: frame for frame in chamfer}
    reports, law = evaluator.reports(found), law or law_of(file.about)
    return ScoredResult(name, predictions, matches, reports, notes, law)


def scored_by_distance(
    result: ScoredResult, truth: Mapping[str, MapElements], meta: AnnotationMeta
) -> ScoredResult:
    """Return a result whose reports are of the map in bands of distances from the vehicle.

    Args:
        result: A scored result file.
        truth: Ground truth of each sample, by token.
        meta: Classes and range.
    """
    evaluator, nothing = _evaluator(meta), MapElements.from_polylines()
    samples = (
        Sample(token, result.predictions.get(token, nothing), gt) for token, gt in truth.items()
    )
    areas = [label for label, name in enumerate(meta.classes) if name in AREA_CLASSES]
    found = (evaluator.match(*pieces) for pieces in cut_by_distance(samples, areas))
    return replace(result, reports=evaluator.reports(found))


def _evaluator(meta: AnnotationMeta) -> MapEvaluator:
    """Return the metrics of the page."""
    grid = BEVGrid(meta.x_range, meta.y_range)
    return MapEvaluator(ChamferConfig(meta.classes), RasterConfig(meta.classes, grid))
