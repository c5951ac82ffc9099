"""What a metric of ``--eval`` is, what it keeps of a sample, and how it is found by its name."""

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

PACKAGE = Path(gsmap.__file__).parent
_CORE = {
    "chamfer": "gsmap.evaluation.core.chamfer_ap",
    "raster": "gsmap.evaluation.core.raster_ap",
}


class _Sides(NamedTuple):
    token: str
    predictions: MapElements
    ground_truth: MapElements


class Sample(_Sides):
    """Token, predictions (N,) and ground truth (K,) of a sample, in metres in its frame."""

    @cached_property
    def shared(self) -> dict[Any, Any]:
        """Intermediate results that several metrics need, by the rules that they follow from."""
        return {}


@dataclass(frozen=True)
class SampleValues:
    """Arrays that a metric keeps of a sample where it ranks no predictions.

    Args:
        token: Name of the sample.
        values: The arrays, by name: of one shape in all samples, or with a first axis that an empty
            sample has none of.
    """

    token: str
    values: Mapping[str, npt.NDArray[Any]]


Matches = FrameMatches | SampleValues
"""What a metric keeps of a sample."""


class ValueTable:
    """The arrays of many samples, in the order of their tokens; a token counts once."""

    def __init__(self) -> None:
        self._records: dict[str, SampleValues] = {}

    def __len__(self) -> int:
        return len(self._records)

    def add(self, record: SampleValues) -> None:
        """Add the arrays of a sample; those of a token that is known are left out."""
        self._records.setdefault(record.token, record)

    @property
    def tokens(self) -> list[str]:
        """The tokens of all samples, in their order. (S,)"""
        return sorted(self._records)

    def column(self, name: str) -> list[npt.NDArray[Any]]:
        """Return the arrays of one name. (S,)"""
        return [self._records[token].values[name] for token in self.tokens]


@dataclass(frozen=True)
class MetricSettings:
    """What a command or a config says of its metrics, from which each takes what it needs.

    Args:
        classes: Names of the classes; a label is an index into them.
        thresholds: Of distances in metres; None for each metric's default.
        dim: Coordinates that distances count: 2 or 3.
        resample_predictions: Whether predictions are resampled.
        resample_ground_truth: Whether ground truth is resampled.
        grid: Extent of the map; None if it is not known.
        polygon_classes: The classes that are areas; names that do not occur are allowed.
        min_score: Least score of a prediction that counts; None for each metric's default.

    Raises:
        ValueError: If there is no class, or a class is no name.
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
        object.__setattr__(self, "classes", checked_classes(self.classes))

    @property
    def canvas(self) -> BEVGrid:
        """The extent of the map; ValueError if it is not known."""
        if self.grid is None:
            raise InputError("metrics of masks or of shrunk maps need the range of the map.")
        return self.grid

    @property
    def areas(self) -> tuple[int, ...]:
        """Labels of the classes that are areas."""
        named = enumerate(self.classes)
        return tuple(label for label, name in named if name in self.polygon_classes)


class Metric(ABC):
    """A metric, found by its name (`register_metric`).

    A class for each metric, with its rules as attributes. Objects are picklable.

    Attributes:
        name: What ``--eval`` calls it, and what the keys of its figures begin with.
        beside: Metrics that are reported together with it.
        ranks: Whether it ranks the predictions of all samples: `match` returns `FrameMatches`, and
            reports have ``detections``, of which intervals, groups and curves are made.
        has_curves: Whether precision-recall curves describe it.
        takes_min_score: Whether it heeds `MetricSettings.min_score`.
        classes: Names of the classes.
    """

    name: ClassVar[str]
    beside: ClassVar[tuple[str, ...]] = ()
    ranks: ClassVar[bool] = False
    has_curves: ClassVar[bool] = False
    takes_min_score: ClassVar[bool] = False
    classes: tuple[str, ...]

    @classmethod
    @abstractmethod
    def of(cls, settings: MetricSettings) -> "Metric":
        """Return the metric by the settings of a command or config."""

    @abstractmethod
    def match(self, sample: Sample) -> Matches:
        """Return what the metric needs of a sample, in few bytes: never masks or points."""

    @abstractmethod
    def reports(self, table: Any) -> list[MetricReport]:
        """Compute the figures of all samples.

        Args:
            table: What `match` has returned: a `MatchTable` of `FrameMatches`, a `ValueTable` of
                `SampleValues`.
        """

    @property
    def counts_heights(self) -> bool:
        """Whether it measures distances in space."""
        return False


MetricClass = TypeVar("MetricClass", bound=type[Metric])
_REGISTERED: dict[str, type[Metric]] = {}


def register_metric(metric: MetricClass) -> MetricClass:
    """Make a metric known by its name; a class decorator.

    Raises:
        ValueError: If another metric has that name.
    """
    known = _REGISTERED.setdefault(metric.name, metric)
    if (known.__module__, known.__qualname__) != (metric.__module__, metric.__qualname__):
        raise InputError(f"{known.__module__} has a metric {metric.name!r}: choose another name.")
    _REGISTERED[metric.name] = metric
    return metric


def metric_class(name: str) -> type[Metric]:
    """Return the metric of a name.

    Of a metric that no module has registered, the file is imported that has its name, or that of
    its first words: ``chamfer_hard`` is in the file of ``chamfer``.

    Raises:
        ValueError: If there is none.
    """
    if name not in _REGISTERED:
        for stem, module in metric_files().items():
            if name == stem or name.startswith(f"{stem}_"):
                import_module(module)
    if name not in _REGISTERED:
        raise InputError(f"there is no metric [{name!r}]; there are {metric_names()}.")
    return _REGISTERED[name]


def metric_files() -> dict[str, str]:
    """Return the modules of the metrics that come with GSMap, by the names of their files.

    Those of a method are in its folder: ``models/<method>/metric.py``.
    """
    own = {path.stem: "metrics" for path in (PACKAGE / "evaluation/metrics").glob("[a-z]*.py")}
    methods = sorted(path.parent.name for path in (PACKAGE / "models").glob("*/metric.py"))
    return {
        **_CORE,
        **{name: f"gsmap.evaluation.{room}.{name}" for name, room in sorted(own.items())},
        **{name: f"gsmap.models.{name}.metric" for name in methods},
    }


def metric_names() -> tuple[str, ...]:
    """Return the names of all metrics, also of those that other modules have registered."""
    for module in metric_files().values():
        import_module(module)
    return tuple(_REGISTERED)


def new_table(matches: Matches) -> MatchTable | ValueTable:
    """Return an empty table for what a metric keeps of samples."""
    return MatchTable() if isinstance(matches, FrameMatches) else ValueTable()


def arrays_of(matches: Matches) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of what a metric keeps of a sample, by name."""
    if isinstance(matches, SampleValues):
        return {name: np.asarray(values) for name, values in matches.values.items()}
    columns = {name: value for name, value in vars(matches).items() if name != "token"}
    return {name: np.asarray(value) for name, value in columns.items() if value is not None}


def matches_of(token: str, arrays: Mapping[str, npt.NDArray[Any]], like: Matches) -> Matches:
    """Make again what a metric keeps of a sample, from its arrays.

    Args:
        token: Name of the sample.
        arrays: The arrays, as `arrays_of` returns them.
        like: What the metric keeps of an empty sample, with the names and shapes.

    Raises:
        ValueError: If names or shapes are others.
    """
    wanted = arrays_of(like)
    shapes = {name: values.shape for name, values in arrays.items()}
    fitting = arrays.keys() == wanted.keys() and all(
        shape[1:] == wanted[name].shape[1:]
        and len(shape) == wanted[name].ndim
        and (wanted[name].shape[:1] in ((), (0,)) or shape == wanted[name].shape)
        for name, shape in shapes.items()
    )
    if isinstance(like, SampleValues) and fitting:
        return SampleValues(token, arrays)
    per_prediction = ("labels", "pred_index", "scores", "matched_gt", "quality")
    if not fitting or len({shapes[name][0] for name in per_prediction}) > 1:
        known = {name: values.shape for name, values in wanted.items()}
        raise InputError(f"shapes {shapes} where an empty sample has {known}")
    return FrameMatches(token, **arrays)
