"""Both metrics over a stream of samples: match each sample once, keep only its matches."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from gsmap.evaluation.chamfer_ap import (
    ChamferConfig,
    chamfer_report,
    match_chamfer,
    resample_polylines,
)
from gsmap.evaluation.matches import FrameMatches, MatchTable, as_table
from gsmap.evaluation.raster_ap import RasterConfig, match_raster, raster_report
from gsmap.evaluation.report import MetricReport
from gsmap.structures.elements import MapElements

METRIC_NAMES = ("chamfer", "raster")


@dataclass(frozen=True)
class EvaluationConfig:
    """Which metrics to compute and their rules.

    Args:
        chamfer: Rules of AP_chamfer, or None to leave it out.
        raster: Rules of AP_raster, or None to leave it out.
        ground_truth_points: If set, ground truth is first resampled to that many points, such as
            the 20 of the training targets; by default it keeps its full resolution.

    Raises:
        ValueError: If both are left out, or their classes differ.
    """

    chamfer: ChamferConfig | None
    raster: RasterConfig | None
    ground_truth_points: int | None = None

    def __post_init__(self) -> None:
        if self.chamfer is None and self.raster is None:
            raise ValueError(f"name at least one metric of {METRIC_NAMES}.")
        if self.ground_truth_points is not None and self.ground_truth_points < 2:
            raise ValueError(f"ground_truth_points must be >= 2, got {self.ground_truth_points}.")
        if self.chamfer and self.raster and self.chamfer.classes != self.raster.classes:
            raise ValueError(
                "both metrics must have the same classes, got "
                f"{self.chamfer.classes} and {self.raster.classes}."
            )

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes."""
        config = self.chamfer or self.raster
        assert config is not None
        return config.classes


@dataclass(frozen=True)
class SampleMatches:
    """What is kept of one sample; small, and picklable between processes.

    Args:
        token: Name of the sample.
        by_metric: Matches by the name of the metric.
    """

    token: str
    by_metric: dict[str, FrameMatches]


def with_points(elements: MapElements, num_points: int) -> MapElements:
    """Return elements with a fixed number of points at equal arc lengths.

    Args:
        elements: Polylines and rings; those of fewer than two points are kept as they are.
        num_points: Number of points of each.
    """
    points = resample_polylines(elements, num_points)
    polylines = [
        points[i] if count >= 2 else elements.polylines[i]
        for i, count in enumerate(elements.num_points)
    ]
    return MapElements.from_polylines(polylines, elements.labels, elements.scores)


def match_sample(
    token: str, predictions: MapElements, ground_truth: MapElements, config: EvaluationConfig
) -> SampleMatches:
    """Match one sample under every metric that is asked for.

    Args:
        token: Name of the sample.
        predictions: Its predictions.
        ground_truth: Its ground truth.
        config: Metrics and their rules.
    """
    if config.ground_truth_points is not None:
        ground_truth = with_points(ground_truth, config.ground_truth_points)
    found: dict[str, FrameMatches] = {}
    if config.chamfer:
        found["chamfer"] = match_chamfer(predictions, ground_truth, config.chamfer, token)
    if config.raster:
        found["raster"] = match_raster(predictions, ground_truth, config.raster, token)
    return SampleMatches(token, found)


def reports(samples: Iterable[SampleMatches], config: EvaluationConfig) -> list[MetricReport]:
    """Compute the metrics from the matches of all samples.

    Args:
        samples: Matches in any order; repeated tokens count once.
        config: Metrics and their rules.
    """
    return table_reports(tables_of(samples, config), config)


def tables_of(samples: Iterable[SampleMatches], config: EvaluationConfig) -> dict[str, MatchTable]:
    """Join the matches of samples to a table of each metric.

    Args:
        samples: Matches of each sample.
        config: Metrics and their rules.
    """
    records = list(samples)
    names = [name for name in METRIC_NAMES if getattr(config, name)]
    return {name: as_table(record.by_metric[name] for record in records) for name in names}


def table_reports(tables: Mapping[str, MatchTable], config: EvaluationConfig) -> list[MetricReport]:
    """Compute the metrics from tables of all samples.

    Args:
        tables: The table of each metric.
        config: Metrics and their rules.
    """
    found = []
    if config.chamfer:
        found.append(chamfer_report(tables["chamfer"], config.chamfer))
    if config.raster:
        found.append(raster_report(tables["raster"], config.raster))
    return found


def load_kernels(config: EvaluationConfig) -> None:
    """Load the compiled code that matching needs, by matching a small sample.

    Args:
        config: Metrics and their rules.
    """
    line = MapElements.from_polylines([[[0.0, 0.0], [1.0, 1.0]]], [0])
    match_sample("", line, line, config)


def flat_metrics(found: Sequence[MetricReport]) -> dict[str, float]:
    """Join the figures of several metrics under their flat keys."""
    return {key: value for report in found for key, value in report.metrics.items()}


@dataclass
class MapEvaluator:
    """Streaming evaluation: update per sample while a network runs, compute at the end.

    Memory grows by a few kilobytes per sample; masks and points are not kept.

    Args:
        config: Metrics and their rules.
    """

    config: EvaluationConfig
    samples: list[SampleMatches] = field(default_factory=list)

    def update(self, token: str, predictions: MapElements, ground_truth: MapElements) -> None:
        """Match one sample and keep its matches.

        Args:
            token: Name of the sample; a repeated one counts once.
            predictions: Its predictions.
            ground_truth: Its ground truth.
        """
        self.samples.append(match_sample(token, predictions, ground_truth, self.config))

    def merge(self, other: "MapEvaluator") -> None:
        """Add the samples that another evaluator has seen.

        Args:
            other: An evaluator with the same rules.

        Raises:
            ValueError: If its rules differ.
        """
        if other.config != self.config:
            raise ValueError(f"evaluators differ: {self.config} and {other.config}.")
        self.samples.extend(other.samples)

    def compute(self) -> list[MetricReport]:
        """Return one report per metric."""
        return reports(self.samples, self.config)
