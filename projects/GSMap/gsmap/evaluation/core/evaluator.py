"""All metrics over a stream of samples: match each sample once, keep only its matches."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gsmap.evaluation.core.chamfer_ap import (
    CHAMFER_THRESHOLDS,
    HARD_CHAMFER_THRESHOLDS,
    ChamferConfig,
    chamfer_report,
    match_chamfer,
)
from gsmap.evaluation.core.matches import FrameMatches, MatchTable
from gsmap.evaluation.core.raster_ap import RasterConfig, match_raster, raster_report
from gsmap.evaluation.core.report import MetricReport, flat_metrics
from gsmap.evaluation.core.sample_ap import (
    METHODS,
    SampleAPConfig,
    match_sample_ap,
    sample_ap_reports,
)
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import resample_all

METRIC_NAMES = ("chamfer", "raster")
HARD_NAME = "chamfer_hard"
"""AP_chamfer at the hard thresholds besides, of the same matching."""
TWO_SIDED_NAME = "vectormapnet"
"""VectorMapNet's own: AP_chamfer without the samples that lack predictions or ground truth."""
SHRUNK_NAME = "vectormapnet_shrunk"
"""The same in the units of its release, where a map is as much smaller as its canvas is larger."""
SHRUNK_MARGIN_M = 2.0
ALL_NAMES = (*METRIC_NAMES, HARD_NAME, TWO_SIDED_NAME, SHRUNK_NAME, *METHODS)
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
        two_sided: Whether another report, ``vectormapnet``, leaves out samples without predictions
            or without ground truth; by the rules of AP_chamfer, at 0.5, 1.0 and 1.5 m.
        drawn: Rules of AP per sample, a method each.
        shrunk: The map's extent, by which another report, ``vectormapnet_shrunk``, scales both
            sides before it does as ``two_sided``; None leaves it out.

    Raises:
        ValueError: If all are left out, their classes differ, or AP_chamfer has other rules than
            ``two_sided`` and ``shrunk`` need.
    """

    chamfer: ChamferConfig | None
    raster: RasterConfig | None
    ground_truth_points: int | None = None
    hard: bool = False
    two_sided: bool = False
    drawn: tuple[SampleAPConfig, ...] = ()
    shrunk: BEVGrid | None = None

    def __post_init__(self) -> None:
        classes = {config.classes for config in self._configs}
        if len(classes) != 1:
            raise ValueError(f"name at least one of {ALL_NAMES}, with the same classes.")
        if len({config.method for config in self.drawn}) != len(self.drawn):
            raise ValueError("drawn must have one entry for a method.")
        plain = self.chamfer and replace(self.chamfer, thresholds=CHAMFER_THRESHOLDS)
        if (self.two_sided or self.shrunk) and plain != ChamferConfig(next(iter(classes))):
            raise ValueError(
                f"{TWO_SIDED_NAME} is AP_chamfer of lines of 100 points in the plane: leave out "
                "heights (dim 3) and points as they are given."
            )
        if self.ground_truth_points is not None and self.ground_truth_points < 2:
            raise ValueError(f"ground_truth_points must be >= 2, got {self.ground_truth_points}.")

    @classmethod
    def named(
        cls,
        names: Collection[str],
        chamfer: ChamferConfig,
        raster: RasterConfig | None,
        ground_truth_points: int | None = None,
        min_score: float = 0.0,
    ) -> "MapEvaluator":
        """Return the evaluator of some metrics.

        Args:
            names: Of ``ALL_NAMES``. What is made of the matches of AP_chamfer comes besides it.
            chamfer: Rules of AP_chamfer, if it is named.
            raster: Rules of AP_raster, if it is named; its canvas is that of all masks. None is
                enough for metrics without masks.
            ground_truth_points: As of the class.
            min_score: Of ``SampleAPConfig``.

        Raises:
            ValueError: If there is no metric of a name, or as of the class.
        """
        if unknown := set(names) - set(ALL_NAMES):
            raise ValueError(f"there is no metric {sorted(unknown)}; there are {ALL_NAMES}.")
        beside = HARD_NAME in names, TWO_SIDED_NAME in names
        methods = [method for method in METHODS if method in names]
        if raster is None and (methods or {"raster", SHRUNK_NAME} & set(names)):
            raise ValueError("metrics of masks or of shrunk maps need the rules of AP_raster.")
        drawn = [
            SampleAPConfig(raster.classes, method, raster.grid, min_score)
            for method in methods
            if raster
        ]
        shrunk = raster.grid if raster and SHRUNK_NAME in names else None
        return cls(
            chamfer if "chamfer" in names or any(beside) or shrunk else None,
            raster if "raster" in names else None,
            ground_truth_points,
            *beside,
            tuple(drawn),
            shrunk,
        )

    @property
    def _configs(self) -> list[ChamferConfig | RasterConfig | SampleAPConfig]:
        """The rules of all metrics."""
        return [config for config in (self.chamfer, self.raster, *self.drawn) if config]

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
        if self.chamfer is None:
            return None
        thresholds = {*self.chamfer.thresholds}
        thresholds.update(HARD_CHAMFER_THRESHOLDS if self.hard else ())
        thresholds.update(CHAMFER_THRESHOLDS if self.two_sided else ())
        return replace(self.chamfer, thresholds=tuple(thresholds))

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes."""
        return self._configs[0].classes

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
        if self.shrunk:
            found_there = _in_shrunk_units(predictions, self.shrunk)
            true_there = _in_shrunk_units(ground_truth, self.shrunk)
            matches = match_chamfer(found_there, true_there, ChamferConfig(self.classes), token)
            found[SHRUNK_NAME] = matches.if_two_sided()
        for config in self.drawn:
            found[config.method] = match_sample_ap(predictions, ground_truth, config, token)
        return found

    @property
    def _num_thresholds(self) -> dict[str, int]:
        """At how many thresholds each metric matches."""
        found = {config.method: len(METHODS[config.method].thresholds) for config in self.drawn}
        if self._chamfer:
            found["chamfer"] = len(self._chamfer.thresholds)
        if self.raster:
            found["raster"] = len(next(iter(self.raster.thresholds.values())))
        if self.shrunk:
            found[SHRUNK_NAME] = len(CHAMFER_THRESHOLDS)
        return found

    def require_fitting(self, found: SampleMatches) -> None:
        """Raise ValueError unless matches that come from elsewhere fit the rules."""
        wanted = self._num_thresholds
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
        tables = {name: MatchTable() for name in self._num_thresholds}
        two_sided, found = MatchTable(), []
        for sample in samples:
            for name, table in tables.items():
                table.add(sample[name])
            if self.two_sided:
                two_sided.add(sample["chamfer"].if_two_sided())
        if not any(map(len, tables.values())):
            raise ValueError("there is no sample to score.")
        found += self._distance_reports(tables, two_sided)
        if self.raster:
            found.append(raster_report(tables["raster"], self.raster))
        for config in self.drawn:
            found += sample_ap_reports(tables[config.method], config)
        return found

    def _distance_reports(
        self, tables: Mapping[str, MatchTable], two_sided: MatchTable
    ) -> list[MetricReport]:
        """Compute AP_chamfer, and what else is made of distances."""
        found = []
        if self.chamfer and self._chamfer:
            chamfer, rules = tables["chamfer"], self._chamfer
            found.append(chamfer_report(chamfer, rules, self.chamfer.thresholds))
            if self.hard:
                found.append(chamfer_report(chamfer, rules, HARD_CHAMFER_THRESHOLDS, HARD_NAME))
            if self.two_sided:
                found.append(chamfer_report(two_sided, rules, CHAMFER_THRESHOLDS, TWO_SIDED_NAME))
        if self.shrunk:
            rules = ChamferConfig(self.classes)
            found.append(chamfer_report(tables[SHRUNK_NAME], rules, name=SHRUNK_NAME))
        return found


def _in_shrunk_units(elements: MapElements, grid: BEVGrid) -> MapElements:
    """Return elements of a map in the units of VectorMapNet's release.

    There coordinates are a share of the map and 2 m more, and come back as that share of the map
    alone. It matters to distances that they are scaled so, not from which corner.
    """
    size = np.array(grid.extent_m)
    points = elements.with_coordinates(2).points * (size / (size + SHRUNK_MARGIN_M))
    return replace(elements, points=points)
