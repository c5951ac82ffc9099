"""Base class, settings, registry and records of the metrics of ``--eval``."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

import gsmap
from gsmap.evaluation.core.matches import FrameMatches, MatchTable, checked_classes
from gsmap.evaluation.core.report import MetricReport
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError

PACKAGE = Path(gsmap.__file__).parent  # folder of GSMap's code
# Modules in evaluation/core, by the first word of the names of their metrics.
_CORE_MODULES = {
    "chamfer": "gsmap.evaluation.core.chamfer_ap",
    "raster": "gsmap.evaluation.core.raster_ap",
}
# Arrays of FrameMatches with one row per prediction.
_PER_PREDICTION = ("labels", "pred_index", "scores", "matched_gt", "quality")


class _SampleFields(NamedTuple):
    token: str
    predictions: MapElements
    ground_truth: MapElements


# `cached_property` needs a `__dict__`, which a NamedTuple lacks and its subclass has.
class Sample(_SampleFields):
    """Predictions and ground truth of one sample, in metres in the annotation frame.

    Labels are indices of the metric's classes, or -1 for elements that it must leave out.

    Attributes:
        token: Name of the sample.
        predictions: The N predicted elements, with scores.
        ground_truth: The K annotated elements.
    """

    @cached_property
    def cache(self) -> dict[Any, Any]:
        """Intermediate results that several metrics share, by the rules that they depend on.

        The dictionary starts empty, and the metrics fill it.
        """
        return {}


@dataclass(frozen=True)
class SampleValues:
    """Arrays of one sample, for a metric that ranks no predictions.

    Args:
        token: Name of the sample.
        values: Arrays by name. The shape of an array is equal in all samples, except that the
            length of its first axis may vary. A length that varies is 0 in a sample without
            elements.
    """

    token: str
    values: Mapping[str, npt.NDArray[Any]]


_Shape = tuple[int, ...]
Matches = FrameMatches | SampleValues
"""Record of one sample that a metric keeps: matches of predictions, or other arrays."""


class ValueTable:
    """Arrays of S samples, in the order of their tokens."""

    def __init__(self) -> None:
        self._records: dict[str, SampleValues] = {}

    def __len__(self) -> int:
        return len(self._records)

    def add(self, record: SampleValues) -> None:
        """Add the arrays of a sample, unless the table already has its token."""
        self._records.setdefault(record.token, record)

    @property
    def tokens(self) -> list[str]:
        """Tokens of the S samples, sorted."""
        return sorted(self._records)

    def column(self, name: str) -> list[npt.NDArray[Any]]:
        """Return the array ``name`` of each of the S samples, in the order of the tokens."""
        records = [self._records[token] for token in self.tokens]
        return [record.values[name] for record in records]


@dataclass(frozen=True)
class MetricSettings:
    """Settings of a command or a config, from which each metric takes its rules.

    Args:
        classes: Names of the classes; a label is an index into them.
        thresholds: Distances up to which a prediction matches, in metres; None for the default of
            each metric. Metrics without distances ignore them.
        dim: Number of coordinates in distances: 2 (x, y) or 3 (x, y, z).
        resample_predictions: Whether the points of predictions are resampled at equal distances
            before they are compared.
        resample_ground_truth: Whether the points of the ground truth are resampled in this way.
        grid: Extent of the map in metres; None if unknown.
        polygon_classes: Names of the classes that are areas; unknown names are allowed.
        min_score: Smallest score of a prediction that counts; None for each metric's default.

    Raises:
        ValueError: If ``classes`` is empty, is a single text, or contains a value that is no text.
    """

    classes: tuple[str, ...]
    thresholds: tuple[float, ...] | None = None
    dim: int = 2
    resample_predictions: bool = True
    resample_ground_truth: bool = True
    grid: BEVGrid | None = None
    polygon_classes: tuple[str, ...] = AREA_CLASSES
    min_score: float | None = None

    def __post_init__(self) -> None:
        # A frozen dataclass allows no other assignment.
        object.__setattr__(self, "classes", checked_classes(self.classes))

    @property
    def canvas(self) -> BEVGrid:
        """Extent of the map in metres.

        Raises:
            ValueError: If it is unknown.
        """
        if self.grid is None:
            raise InputError("metrics that draw masks or shrink maps need the range of the map.")
        return self.grid

    @property
    def areas(self) -> tuple[int, ...]:
        """Labels of the classes that are areas."""
        labels = []
        for label, name in enumerate(self.classes):
            if name in self.polygon_classes:
                labels.append(label)
        return tuple(labels)


class Metric(ABC):
    """Base class of a metric, which ``register_metric`` makes available by its name.

    Subclasses set the fixed rules of a metric as class attributes, and `from_settings` sets the
    others. Their objects can be pickled, because worker processes match samples.

    Attributes:
        name: Name of the metric in ``--eval`` and prefix of the keys of its figures.
        companions: Names of metrics that are also reported, before this one.
        ranks: Whether the metric ranks predictions over all samples. If so, `match` returns
            `FrameMatches` and reports have ``detections``, for intervals, groups and curves.
        has_curves: Whether precision-recall curves describe the metric.
        takes_min_score: Whether the metric uses `MetricSettings.min_score`.
        takes_thresholds: Whether the metric uses `MetricSettings.thresholds`.
        classes: Names of the classes; a label is an index into them.
    """

    name: ClassVar[str]
    companions: ClassVar[tuple[str, ...]] = ()
    ranks: ClassVar[bool] = False
    has_curves: ClassVar[bool] = False
    takes_min_score: ClassVar[bool] = False
    takes_thresholds: ClassVar[bool] = False
    classes: tuple[str, ...]

    @classmethod
    @abstractmethod
    def from_settings(cls, settings: MetricSettings) -> "Metric":
        """Create the metric from the settings of a command or config."""

    @abstractmethod
    def match(self, sample: Sample) -> Matches:
        """Compare predictions and ground truth, and return a record without masks or points.

        The records of all samples stay in memory, so they must be small.
        """

    @abstractmethod
    def reports(self, table: Any) -> list[MetricReport]:
        """Compute the figures of all samples.

        Args:
            table: Records of `match`: a `MatchTable` of `FrameMatches`, or a `ValueTable` of
                `SampleValues`.
        """

    @property
    def counts_heights(self) -> bool:
        """Whether heights (z) count, as in three-dimensional distances; False by default."""
        return False


MetricClass = TypeVar("MetricClass", bound=type[Metric])
_REGISTERED: dict[str, type[Metric]] = {}


def register_metric(metric: MetricClass) -> MetricClass:
    """Register a metric under its name; a class decorator.

    Raises:
        ValueError: If another metric has this name.
    """
    # The metric itself, unless its name has been registered before.
    registered = _REGISTERED.setdefault(metric.name, metric)
    first_source = (registered.__module__, registered.__qualname__)
    source = (metric.__module__, metric.__qualname__)
    if first_source != source:
        raise InputError(
            f"{registered.__module__} has a metric {metric.name!r}: choose another name."
        )
    _REGISTERED[metric.name] = metric  # a reloaded module replaces its class
    return metric


def metric_class(name: str) -> type[Metric]:
    """Return the class of a metric by its name.

    If the name is not registered yet, each module of `metric_files` is imported whose name is equal
    to the metric's name or to its first words. For ``chamfer_hard``, this is ``chamfer``.

    Raises:
        ValueError: If there is no metric of this name.
    """
    if name not in _REGISTERED:
        for stem, module in metric_files().items():
            if name == stem or name.startswith(f"{stem}_"):
                import_module(module)
    if name not in _REGISTERED:
        raise InputError(f"there is no metric [{name!r}]; there are {metric_names()}.")
    return _REGISTERED[name]


def metric_files() -> dict[str, str]:
    """Return the modules of the metrics of GSMap, by the names of their files.

    The metrics of a method are in ``models/<method>/metric.py``, under the name of the method.
    """
    modules = dict(_CORE_MODULES)
    for path in sorted((PACKAGE / "evaluation/metrics").glob("[a-z]*.py")):
        modules[path.stem] = f"gsmap.evaluation.metrics.{path.stem}"
    for path in sorted((PACKAGE / "models").glob("*/metric.py")):
        method = path.parent.name
        modules[method] = f"gsmap.models.{method}.metric"
    return modules


def metric_names() -> tuple[str, ...]:
    """Return the names of all metrics, including those that other modules have registered."""
    for module in metric_files().values():
        import_module(module)
    return tuple(_REGISTERED)


def new_table(matches: Matches) -> MatchTable | ValueTable:
    """Create an empty table for records of the type of ``matches``."""
    return MatchTable() if isinstance(matches, FrameMatches) else ValueTable()


def arrays_of(matches: Matches) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of the record of a sample, by name; a single number has the shape (1,)."""
    arrays = {}
    if isinstance(matches, SampleValues):
        for name, values in matches.values.items():
            arrays[name] = np.atleast_1d(values)
        return arrays
    for name, values in vars(matches).items():
        if name != "token" and values is not None:  # None: the metric does not have this array
            arrays[name] = np.atleast_1d(values)
    return arrays


def matches_of(token: str, arrays: Mapping[str, npt.NDArray[Any]], like: Matches) -> Matches:
    """Create the record of a sample from its arrays.

    Args:
        token: Name of the sample.
        arrays: Arrays by name, as `arrays_of` returns them.
        like: Record of an empty sample of the metric, with the expected names and shapes.

    Raises:
        ValueError: If names or shapes do not fit ``like``.
    """
    expected = _shapes(arrays_of(like))
    shapes = _shapes(arrays)
    if not _fits_record(shapes, expected):
        raise InputError(f"shapes {shapes} where an empty sample has {expected}")
    if isinstance(like, SampleValues):
        return SampleValues(token, arrays)
    # These arrays must have one row for each prediction, so their lengths are equal.
    lengths = {shapes[name][0] for name in _PER_PREDICTION}
    if len(lengths) > 1:
        raise InputError(f"shapes {shapes} where an empty sample has {expected}")
    return FrameMatches(token, **arrays)


def _shapes(arrays: Mapping[str, npt.NDArray[Any]]) -> dict[str, _Shape]:
    """Shapes of arrays, by name."""
    return {name: values.shape for name, values in arrays.items()}


def _fits_record(shapes: Mapping[str, _Shape], expected: Mapping[str, _Shape]) -> bool:
    """Whether arrays have the names and the shapes of an empty sample."""
    if shapes.keys() != expected.keys():
        return False
    for name, empty_shape in expected.items():
        if not _fits_shape(shapes[name], empty_shape=empty_shape):
            return False
    return True


def _fits_shape(shape: _Shape, empty_shape: _Shape) -> bool:
    """Whether a shape equals the shape of an empty sample; a first axis of length 0 may vary."""
    if shape == empty_shape:
        return True
    varies = len(empty_shape) > 0 and empty_shape[0] == 0
    return varies and len(shape) == len(empty_shape) and shape[1:] == empty_shape[1:]
