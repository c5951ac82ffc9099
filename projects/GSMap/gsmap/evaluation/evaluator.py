"""Both metrics over a stream of samples: match each sample once, keep only its matches."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from gsmap.evaluation.chamfer_ap import ChamferConfig, chamfer_report, match_chamfer
from gsmap.evaluation.matches import FrameMatches
from gsmap.evaluation.raster_ap import RasterConfig, match_raster, raster_report
from gsmap.evaluation.report import MetricReport
from gsmap.structures.elements import MapElements
from gsmap.structures.polylines import resample_all

METRIC_NAMES = ("chamfer", "raster")
SampleMatches = dict[str, FrameMatches]  # by the name of the metric


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


def with_points(elements: MapElements, num_points: int) -> MapElements:
    """Return ground truth with a fixed number of points at equal arc lengths.

    Args:
        elements: Polylines and rings; those of fewer than two points are kept as they are.
        num_points: Number of points of each.
    """
    resampled = resample_all(elements.points, elements.offsets, num_points)
    pairs = zip(elements.polylines, resampled, strict=True)
    polylines = [new if len(old) >= 2 else old for old, new in pairs]
    return MapElements.from_polylines(polylines, elements.labels)


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
    found: SampleMatches = {}
    if config.chamfer:
        found["chamfer"] = match_chamfer(predictions, ground_truth, config.chamfer, token)
    if config.raster:
        found["raster"] = match_raster(predictions, ground_truth, config.raster, token)
    return found


def reports(samples: Iterable[SampleMatches], config: EvaluationConfig) -> list[MetricReport]:
    """Compute the metrics from the matches of all samples.

    Args:
        samples: Matches in any order; repeated tokens count once.
        config: Metrics and their rules.
    """
    records, found = list(samples), []
    if config.chamfer:
        found.append(chamfer_report((r["chamfer"] for r in records), config.chamfer))
    if config.raster:
        found.append(raster_report((r["raster"] for r in records), config.raster))
    return found


def flat_metrics(found: Sequence[MetricReport]) -> dict[str, float]:
    """Join the figures of several metrics under their flat keys."""
    return {key: value for report in found for key, value in report.metrics.items()}


@dataclass
class MapEvaluator:
    """Streaming evaluation: update per sample while a network runs, compute at the end.

    Memory grows by a few kilobytes per sample; masks and points are not kept.

    Args:
        config: Metrics and their rules.
        samples: Matches so far; those of another process may be added.
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

    def compute(self) -> list[MetricReport]:
        """Return one report per metric."""
        return reports(self.samples, self.config)
