"""Evaluation of several metrics over a stream of samples.

Only the matches of a sample are kept in memory. Its masks and points are not.
"""

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
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import resample_all
from gsmap.utils.errors import InputError

METRIC_NAMES = ("chamfer", "raster")
"""Default metrics, the metrics of published tables."""
SampleMatches = dict[str, Matches]
"""Matches of one sample, by the name of the metric.

The matches of one sample under one metric are also called a record. A metric that matches nothing,
such as a count of folds, stores its values for the sample in its record.
"""


@dataclass(frozen=True, init=False)
class MapEvaluator:
    """Evaluator of one or more metrics.

    Call ``update`` with each sample, then ``compute``. To evaluate in several processes, collect
    the records that ``match`` returns and pass all of them to ``reports``.

    Args:
        *metrics: Metrics, such as ``ChamferConfig(classes)`` and ``RasterConfig(classes)``.
        ground_truth_points: Number of points to which ground truth is resampled first, >= 2.
            Training targets have 20 points, for example. None keeps the full resolution.

    Raises:
        ValueError: If there is no metric, two metrics have equal names, or their classes differ.
    """

    metrics: tuple[Metric, ...]
    ground_truth_points: int | None

    def __init__(self, *metrics: Metric, ground_truth_points: int | None = None) -> None:
        object.__setattr__(self, "metrics", metrics)
        object.__setattr__(self, "ground_truth_points", ground_truth_points)
        names = [metric.name for metric in metrics]
        class_lists = {metric.classes for metric in metrics}
        if len(class_lists) != 1:
            raise InputError("give at least one metric; all metrics must have equal classes.")
        if len(set(names)) != len(names):
            raise InputError(f"the metrics must have different names, got {names}.")
        if ground_truth_points is not None and ground_truth_points < 2:
            raise InputError(f"ground_truth_points must be >= 2, got {ground_truth_points}.")

    @classmethod
    def from_names(
        cls,
        names: Collection[str],
        settings: MetricSettings,
        ground_truth_points: int | None = None,
    ) -> "MapEvaluator":
        """Create an evaluator from the names of metrics.

        Args:
            names: Names of metrics (`metric_class`). Metrics that are reported together with one
                of them (`Metric.companions`) are inserted before it.
            settings: Settings from which each metric takes its rules.
            ground_truth_points: Number of points to which ground truth is resampled first, >= 2.
                None keeps the full resolution.

        Raises:
            ValueError: If there is no name, no metric of a name, or ``ground_truth_points`` is less
                than 2, or if the settings do not suit a metric.
        """
        metric_types: dict[str, type[Metric]] = {}  # a repeated name is one entry
        for name in names:
            metric_type = metric_class(name)
            for companion in metric_type.companions:
                metric_types.setdefault(companion, metric_class(companion))
            metric_types[name] = metric_type
        metrics = [metric_type.from_settings(settings) for metric_type in metric_types.values()]
        return cls(*metrics, ground_truth_points=ground_truth_points)

    @cached_property
    def _matches(self) -> list[SampleMatches]:
        """Records of the samples so far. The list is created on first use."""
        return []

    @cached_property
    def _are_named(self) -> set[bool]:
        """Whether the samples so far have names of the user, with one entry. Created on first use.

        The numbers that stand for missing names could equal names of the user.
        """
        return set()

    def update(
        self, predictions: MapElements, ground_truth: MapElements, token: str | None = None
    ) -> None:
        """Add a sample.

        Args:
            predictions: Predicted elements, in metres in the annotation frame. N in number.
            ground_truth: Annotated elements at full resolution. K in number.
            token: Name of the sample; repeated names count once. Default: the number of the sample.

        Raises:
            ValueError: If the elements do not suit a metric, as in `match`, or only some samples
                have a name.
        """
        self._are_named.add(token is not None)
        if len(self._are_named) > 1:
            raise InputError("give a token for every sample, or for none.")
        if token is None:
            token = f"{len(self._matches):09d}"
        self._matches.append(self.match(token, predictions, ground_truth=ground_truth))

    def compute(self) -> dict[str, float]:
        """Compute the figures of all samples so far.

        Returns:
            Figures by keys such as ``chamfer/divider/AP@0.5`` (docs/evaluation.md).

        Raises:
            ValueError: If there is no sample.
        """
        return flat_metrics(self.reports(self._matches))

    def reset(self) -> None:
        """Remove all samples."""
        self._matches.clear()
        self._are_named.clear()

    @property
    def canvas(self) -> BEVGrid | None:
        """Raster on which the first metric that draws elements draws them; None if none draws."""
        for metric in self.metrics:
            grid = getattr(metric, "grid", None)
            if isinstance(grid, BEVGrid):
                return grid
        return None

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes."""
        return self.metrics[0].classes

    @property
    def counts_heights(self) -> bool:
        """Whether a metric uses heights (z), for example in distances in space."""
        return any(metric.counts_heights for metric in self.metrics)

    def match(
        self, token: str, predictions: MapElements, ground_truth: MapElements
    ) -> SampleMatches:
        """Match one sample under every metric.

        Args:
            token: Name of the sample.
            predictions: Predicted elements, in metres in the annotation frame. N in number.
            ground_truth: Annotated elements at full resolution. K in number.

        Returns:
            Record of each metric, by the name of the metric.

        Raises:
            ValueError: If a label does not fit the classes, predictions have no scores, or a metric
                in space gets elements without heights.
        """
        if self.ground_truth_points is not None:
            ground_truth = _resample_elements(ground_truth, self.ground_truth_points)
        return self._match_sample(Sample(token, predictions, ground_truth))

    def match_empty(self) -> SampleMatches:
        """Match a sample without elements, to get the names and shapes of arrays in the records.

        Records that are read from a file are checked against them.
        """
        points = np.empty((0, 3))  # with heights, which metrics in space require
        truth = replace(MapElements.from_polylines(), points=points)
        predictions = replace(MapElements.from_polylines(scores=()), points=points)
        sample = Sample(token="", predictions=predictions, ground_truth=truth)
        return self._match_sample(sample)

    def _match_sample(self, sample: Sample) -> SampleMatches:
        """Match one sample, whose ground truth is resampled already, under every metric."""
        return {metric.name: metric.match(sample) for metric in self.metrics}

    def match_all(self, samples: Iterable[Sample]) -> list[SampleMatches]:
        """Match several samples under every metric. The records are in the order of the samples."""
        matches = []
        for sample in samples:
            matches.append(
                self.match(sample.token, sample.predictions, ground_truth=sample.ground_truth)
            )
        return matches

    def reports(self, samples: Iterable[SampleMatches]) -> list[MetricReport]:
        """Compute the metrics from the records of all samples; repeated tokens count once.

        Args:
            samples: Records of each sample, as ``match`` returns them.

        Returns:
            Reports of all metrics, in the order of the metrics. A metric may have several reports.

        Raises:
            ValueError: If there is no sample.
        """
        # Records of all samples, by the name of the metric. The kind of record selects the table.
        tables: dict[str, MatchTable | ValueTable] = {}
        for sample in samples:
            for name, record in sample.items():
                if name not in tables:
                    tables[name] = new_table(record)
                tables[name].add(record)  # type: ignore[arg-type]
        if not tables:
            raise InputError("there is no sample to score.")
        reports: list[MetricReport] = []
        for metric in self.metrics:
            reports += metric.reports(tables[metric.name])
        return reports


def _resample_elements(elements: MapElements, num_points: int) -> MapElements:
    """Resample each element of two points or more. Other elements are kept unchanged."""
    resampled = resample_all(elements.points, elements.offsets, num_points=num_points)
    polylines = []
    for line, resampled_line in zip(elements.polylines, resampled, strict=True):
        polylines.append(resampled_line if len(line) >= 2 else line)
    return MapElements.from_polylines(polylines, labels=elements.labels)
