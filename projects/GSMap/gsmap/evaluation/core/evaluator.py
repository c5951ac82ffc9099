"""All metrics over a stream of samples: match each sample once, keep only its matches."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gsmap.evaluation.core.matches import MatchTable
from gsmap.evaluation.core.metric import (
    Matches,
    Metric,
    MetricSettings,
    Sample,
    ValueTable,
    metric_class,
    new_table,
)
from gsmap.evaluation.core.report import MetricReport, flat_metrics
from gsmap.structures.elements import MapElements
from gsmap.structures.polylines import resample_all
from gsmap.utils.errors import InputError

METRIC_NAMES = ("chamfer", "raster")
"""The metrics of published tables, which are the default."""
SampleMatches = dict[str, Matches]  # by the name of the metric


@dataclass(frozen=True, init=False)
class MapEvaluator:
    """A list of metrics.

    ``update`` with each sample, then ``compute``. Or keep what ``match`` returns for each sample,
    such as of several processes, and make ``reports`` of all.

    Args:
        *metrics: The metrics, such as ``ChamferConfig(classes)`` and ``RasterConfig(classes)``.
        ground_truth_points: To how many points ground truth is first resampled, such as the 20 of
            the training targets; None keeps its full resolution.

    Raises:
        ValueError: If there is no metric, two have one name, or their classes differ.
    """

    metrics: tuple[Metric, ...]
    ground_truth_points: int | None

    def __init__(self, *metrics: Metric, ground_truth_points: int | None = None) -> None:
        object.__setattr__(self, "metrics", metrics)
        object.__setattr__(self, "ground_truth_points", ground_truth_points)
        names = [metric.name for metric in metrics]
        if len({metric.classes for metric in metrics}) != 1:
            raise InputError("name at least one metric; all have the same classes.")
        if len(set(names)) != len(names):
            raise InputError(f"the metrics must have different names, got {names}.")
        if ground_truth_points is not None and ground_truth_points < 2:
            raise InputError(f"ground_truth_points must be >= 2, got {ground_truth_points}.")

    @classmethod
    def named(
        cls,
        names: Collection[str],
        settings: MetricSettings,
        ground_truth_points: int | None = None,
    ) -> "MapEvaluator":
        """Return the evaluator of some metrics.

        Args:
            names: Names of metrics (`metric_class`); others that belong to one come before it.
            settings: What each takes its rules from.
            ground_truth_points: As of the class.

        Raises:
            ValueError: If there is no metric of a name, or settings do not suit it.
        """
        kinds: dict[str, type[Metric]] = {}
        for name in names:
            kind = metric_class(name)
            kinds |= {other: metric_class(other) for other in kind.beside if other not in kinds}
            kinds[name] = kind
        metrics = [kind.of(settings) for kind in kinds.values()]
        return cls(*metrics, ground_truth_points=ground_truth_points)

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

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes."""
        return self.metrics[0].classes

    @property
    def counts_heights(self) -> bool:
        """Whether a metric measures distances in space."""
        return any(metric.counts_heights for metric in self.metrics)

    def match(
        self, token: str, predictions: MapElements, ground_truth: MapElements
    ) -> SampleMatches:
        """Match one sample under every metric.

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
        sample = Sample(token, predictions, ground_truth)
        return {metric.name: metric.match(sample) for metric in self.metrics}

    def match_empty(self) -> SampleMatches:
        """Match a sample without elements, for the names and shapes of what is kept."""
        points = np.empty((0, 3))
        truth = replace(MapElements.from_polylines(), points=points)
        found = replace(MapElements.from_polylines((), (), ()), points=points)
        return {metric.name: metric.match(Sample("", found, truth)) for metric in self.metrics}

    def match_all(self, samples: Iterable[Sample]) -> list[SampleMatches]:
        """Match several samples."""
        return [self.match(*sample) for sample in samples]

    def reports(self, samples: Iterable[SampleMatches]) -> list[MetricReport]:
        """Compute the metrics from the matches of all samples; repeated tokens count once.

        Raises:
            ValueError: If there is no sample.
        """
        tables: dict[str, MatchTable | ValueTable] = {}
        for sample in samples:
            tables = tables or {name: new_table(found) for name, found in sample.items()}
            for name, table in tables.items():
                table.add(sample[name])  # type: ignore[arg-type]
        if not tables:
            raise InputError("there is no sample to score.")
        return [report for metric in self.metrics for report in metric.reports(tables[metric.name])]
