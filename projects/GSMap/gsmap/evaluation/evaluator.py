"""Both metrics over a stream of samples: match each sample once, keep only its matches."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

from gsmap.evaluation.chamfer_ap import (
    HARD_CHAMFER_THRESHOLDS,
    ChamferConfig,
    chamfer_report,
    match_chamfer,
)
from gsmap.evaluation.matches import FrameMatches, MatchTable
from gsmap.evaluation.raster_ap import RasterConfig, match_raster, raster_report
from gsmap.evaluation.report import MetricReport, flat_metrics
from gsmap.structures.elements import MapElements
from gsmap.structures.polylines import resample_all

METRIC_NAMES = ("chamfer", "raster")
HARD_NAME = "chamfer_hard"
"""AP_chamfer at the hard thresholds besides, of the same matching."""
Sample = tuple[str, MapElements, MapElements]  # token, predictions, ground truth
SampleMatches = dict[str, FrameMatches]  # by the name of the metric


@dataclass(frozen=True)
class MapEvaluator:
    """Which metrics to compute, and how.

    ``update`` with each sample, then ``compute``. Or keep what ``match`` returns for each sample,
    such as of several processes, and make ``reports`` of all.

    Args:
        chamfer: Rules of AP_chamfer, or None to leave it out.
        raster: Rules of AP_raster, or None to leave it out.
        ground_truth_points: To how many points ground truth is first resampled, such as the 20 of
            the training targets; None keeps its full resolution.
        hard: Whether a second report has AP_chamfer at 0.2, 0.5 and 1.0 m.

    Raises:
        ValueError: If both are left out, or their classes differ.
    """

    chamfer: ChamferConfig | None
    raster: RasterConfig | None
    ground_truth_points: int | None = None
    hard: bool = False

    def __post_init__(self) -> None:
        classes = {config.classes for config in (self.chamfer, self.raster) if config}
        if len(classes) != 1:
            raise ValueError(f"name at least one of {METRIC_NAMES}, with the same classes.")
        if self.ground_truth_points is not None and self.ground_truth_points < 2:
            raise ValueError(f"ground_truth_points must be >= 2, got {self.ground_truth_points}.")

    @cached_property
    def _matches(self) -> list[SampleMatches]:
        """Matches of the samples so far."""
        return []

    def update(
        self, predictions: MapElements, ground_truth: MapElements, token: str | None = None
    ) -> None:
        """Add a sample; one whose token was there before counts once. Its place is the default."""
        token = f"{len(self._matches):09d}" if token is None else token
        self._matches.append(self.match(token, predictions, ground_truth))

    def compute(self) -> dict[str, float]:
        """Return the figures of all samples so far, as docs/evaluation.md lists them.

        Raises:
            ValueError: If there is no sample.
        """
        return flat_metrics(self.reports(self._matches))

    def reset(self) -> None:
        """Forget all samples."""
        self._matches.clear()

    @cached_property
    def _chamfer(self) -> ChamferConfig | None:
        """Rules of the matching by distance, at the thresholds of all reports."""
        if self.chamfer is None or not self.hard:
            return self.chamfer
        thresholds = {*self.chamfer.thresholds, *HARD_CHAMFER_THRESHOLDS}
        return replace(self.chamfer, thresholds=tuple(thresholds))

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes."""
        config = self.chamfer or self.raster
        assert config is not None
        return config.classes

    @property
    def counts_heights(self) -> bool:
        """Whether a metric measures distances in space."""
        return self.chamfer is not None and self.chamfer.dim == 3

    def match(
        self, token: str, predictions: MapElements, ground_truth: MapElements
    ) -> SampleMatches:
        """Match one sample under every metric that is asked for.

        Args:
            token: Name of the sample.
            predictions: Its predictions, in metres in the annotation frame. (N,)
            ground_truth: Its ground truth at full resolution, likewise. (K,)
        """
        if self.ground_truth_points is not None:
            points, offsets = ground_truth.points, ground_truth.offsets
            resampled = resample_all(points, offsets, self.ground_truth_points)
            pairs = zip(ground_truth.polylines, resampled, strict=True)
            polylines = [new if len(old) >= 2 else old for old, new in pairs]
            ground_truth = MapElements.from_polylines(polylines, ground_truth.labels)
        found: SampleMatches = {}
        if self._chamfer:
            found["chamfer"] = match_chamfer(predictions, ground_truth, self._chamfer, token)
        if self.raster:
            found["raster"] = match_raster(predictions, ground_truth, self.raster, token)
        return found

    def require_fitting(self, found: SampleMatches) -> None:
        """Raise ValueError unless matches that come from elsewhere fit the rules."""
        wanted = {}
        if self._chamfer:
            wanted["chamfer"] = len(self._chamfer.thresholds)
        if self.raster:
            wanted["raster"] = len(next(iter(self.raster.thresholds.values())))
        for name in wanted.keys() | found.keys():
            shapes = (found[name].matched_gt.shape[1:], found[name].num_gts.shape)
            if shapes != ((wanted[name],), (len(self.classes),)):
                raise ValueError(f"{name}: shapes {shapes} for {self.classes}")

    def match_all(self, samples: Iterable[Sample]) -> list[SampleMatches]:
        """Match several samples."""
        return [self.match(*sample) for sample in samples]

    def reports(self, samples: Iterable[SampleMatches]) -> list[MetricReport]:
        """Compute the metrics from the matches of all samples; repeated tokens count once.

        Raises:
            ValueError: If there is no sample.
        """
        chamfer, raster, found = MatchTable(), MatchTable(), []
        for sample in samples:
            if self.chamfer:
                chamfer.add(sample["chamfer"])
            if self.raster:
                raster.add(sample["raster"])
        if not (len(chamfer) or len(raster)):
            raise ValueError("there is no sample to score.")
        if self.chamfer and self._chamfer:
            found.append(chamfer_report(chamfer, self._chamfer, self.chamfer.thresholds))
            if self.hard:
                hard = HARD_CHAMFER_THRESHOLDS
                found.append(chamfer_report(chamfer, self._chamfer, hard, HARD_NAME))
        if self.raster:
            found.append(raster_report(raster, self.raster))
        return found
