"""Rules that all readers of map files share.

They find the class of an element, refuse files that are too large or have impossible coordinates,
and count the elements that are not used. A reader creates an `ElementCollector`. For each element
of the file it calls `class_of` and, if there is a class, `add`. At the end it calls `finish`.
"""

import hashlib
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely

from drivemaps.geodetic import MapGrid, MapOrigin
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import FARTHEST_M, FloatArray, MapElements
from gsmap.utils.errors import InputError

CLASS_KEY = "class"
"""Property with the class of an element in the files of `write_geojson` and `write_lanelet2`."""
SCORE_KEY = "score"
"""Property with the confidence of an element in the files of both."""
_MOST_VERTICES = 5_000_000  # limits the memory that an untrusted file can take
_SMALLEST_M2 = 0.01  # a ring with a smaller area is a point or a line and is not used
_COPY_DECIMALS = 3  # copies have equal coordinates when they are rounded to millimetres
_LONGEST_NAME = 60  # largest number of characters of a value in a message
_LISTED_REASONS = 8  # largest number of reasons in a message


class MapFile(NamedTuple):
    """Map that was read from a file.

    Attributes:
        elements: Elements in metres in the global frame, labelled by the requested classes. Scores
            are 1 if the file has none.
        unused: Number of elements of the file that are not used, by the reason, a text such as
            ``divider without length``.
    """

    elements: MapElements
    unused: Counter[str]


@dataclass(frozen=True)
class ClassRule:
    """Rule that finds the class of an element of a file from one of its properties.

    Args:
        key: Name of the property, or of the tag in a Lanelet2 file.
        class_of: Class of each value of the property. Elements with other values have no class.
            None if the values are names of classes.

    Raises:
        ValueError: If ``key`` is empty.
    """

    key: str
    class_of: Mapping[str, str] | None = None

    def __post_init__(self) -> None:
        if not self.key:
            raise InputError("the property that names the class must have a name.")

    @classmethod
    def parse(cls, words: Sequence[str], classes: Sequence[str]) -> "ClassRule":
        """Parse ``KEY VALUE=CLASS ...``.

        Args:
            words: Name of the property, then values with their classes. If no value is listed, the
                values of the property are names of classes.
            classes: Names of the classes.

        Raises:
            ValueError: If the first word is empty, a word after it is not ``VALUE=CLASS``, or a
                class does not exist, or if a value has two classes.
        """
        key, *pairs = words
        class_of: dict[str, str] = {}
        for pair in pairs:
            # The last "=" separates the class, because a value may contain this character.
            value, separator, name = pair.rpartition("=")
            if not separator or not value or name not in classes:
                raise InputError(
                    f"a value of {key!r} and its class must be VALUE=CLASS with a class of "
                    f"{list(classes)}, got {pair!r}."
                )
            if class_of.setdefault(value, name) != name:
                raise InputError(
                    f"the value {value!r} has the classes {class_of[value]!r} and {name!r}: give "
                    "one of them."
                )
        return cls(key, class_of or None)


class ElementCollector:
    """Collects the lines of a file that have a class, and counts the unused lines by the reason.

    Args:
        path: Path of the file, for messages.
        classes: Class names in label order.
        rule: Rule that finds the class of an element.

    Attributes:
        unused: Number of unused elements by the reason. Readers add further reasons.
    """

    def __init__(self, path: Path, classes: Sequence[str], rule: ClassRule) -> None:
        self.unused: Counter[str] = Counter()
        self._path = path
        self._classes = tuple(classes)
        self._rule = rule
        self._lines: list[FloatArray] = []
        self._labels: list[int] = []
        self._scores: list[float] = []
        self._num_vertices = 0

    def class_of(self, values: Mapping[str, Any]) -> str | None:
        """Find the class of an element.

        Args:
            values: Untrusted properties of the element.

        Returns:
            Name of the class. If the rule finds no class, None; the element then counts as unused.
        """
        value = values.get(self._rule.key)
        # The values of a rule are texts, and JSON files may have numbers.
        if isinstance(value, (int, float)):
            value = str(value)
        if not isinstance(value, str):
            self.unused[f"without {self._rule.key!r}"] += 1
            return None
        name = value if self._rule.class_of is None else self._rule.class_of.get(value)
        if name not in self._classes:
            self.unused[f"{self._rule.key} {value[:_LONGEST_NAME]!r}"] += 1
            return None
        return name

    def add(self, name: str, line: FloatArray, score: float = 1.0) -> None:
        """Add an element, or count it as unused if it has no length or is an unclosed area.

        Args:
            name: Class of the element.
            line: Finite vertices, in degrees for all elements of the file or in metres for all of
                them. The last vertex of an area must be equal to its first vertex. (n, 2)
            score: Confidence in [0, 1].

        Raises:
            ValueError: If the file has too many vertices.
        """
        self._num_vertices += len(line)
        if self._num_vertices > _MOST_VERTICES:
            raise InputError(
                f"{self._path} has more than {_MOST_VERTICES:,} vertices: cut out the part of the "
                "map that you need."
            )
        # A line has a length if the range (largest minus smallest) of x or of y is not zero.
        has_length = len(line) > 1 and bool(np.ptp(line, axis=0).any())
        if not has_length:
            self.unused[f"{name} without length"] += 1
            return
        is_area = name in AREA_CLASSES
        if is_area and not np.array_equal(line[0], line[-1]):
            self.unused[f"{name} that is an open line"] += 1
            return
        self._lines.append(line)
        self._labels.append(self._classes.index(name))
        self._scores.append(score)

    def finish(self, origin: MapOrigin | MapGrid | None) -> MapFile:
        """Convert the lines to the global frame, check them, and create the map.

        Areas of less than 0.01 square metres are counted as unused, and so are copies of a line or
        an area: some maps store the line between two lanes with each of them.

        Args:
            origin: Position of the global frame on the Earth for lines in degrees; None for lines
                in metres.

        Returns:
            The map. It is empty if the file has no elements.

        Raises:
            ValueError: If a coordinate is out of range, or the file has elements but none of them
                is used.
            RuntimeError: If lines are in degrees and ``pyproj`` is missing.
        """
        lines = []
        labels = []
        scores = []
        seen: set[tuple[int, bytes]] = set()  # labels and digests of the lines so far
        rows = zip(self._lines, self._labels, self._scores, strict=True)
        for line, label, score in rows:
            # Metres in the global frame. (n, 2)
            points = line if origin is None else origin.points_of(line, where=str(self._path))
            farthest_m = np.abs(points).max()
            if not farthest_m <= FARTHEST_M:  # `not <=` is also true of NaN
                raise InputError(
                    f"{self._path} reaches {farthest_m:.3g} m from the origin of the global frame: "
                    f"at most {FARTHEST_M:g} m are read."
                )
            name = self._classes[label]
            if name in AREA_CLASSES and _area_m2(points) < _SMALLEST_M2:
                self.unused[f"{name} without area"] += 1
                continue
            key = (label, _digest(points))
            if key in seen:
                self.unused[f"{name} that is a copy of another"] += 1
                continue
            seen.add(key)
            lines.append(points)
            labels.append(label)
            scores.append(score)
        if not lines and self.unused:
            raise InputError(
                f"{self._path} has no element of {list(self._classes)}, but {self.describe()}: "
                "name the property of the class and its values with --map-classes."
            )
        return MapFile(MapElements.from_polylines(lines, labels, scores), unused=self.unused)

    def describe(self) -> str:
        """Describe the unused elements, the most frequent reasons first (`describe_unused`)."""
        return describe_unused(self.unused)


def _area_m2(ring: FloatArray) -> float:
    """Area of a closed ring in square metres. (n, 2)"""
    if len(ring) < 4:  # fewer than three different vertices, which shapely refuses
        return 0.0
    area: float = shapely.Polygon(ring).area
    return area


def _digest(line: FloatArray) -> bytes:
    """Digest of a line that does not depend on its direction, or on the start of a ring. (n, 2)"""
    vertices = np.round(line, _COPY_DECIMALS) + 0.0  # the sum makes 0.0 of -0.0
    digests = []
    for path in (vertices, vertices[::-1]):
        if np.array_equal(path[0], path[-1]):
            ring = path[:-1]
            start = np.lexsort(ring.T)[0]  # first of the vertices by y, then by x
            path = np.roll(ring, -start, axis=0)
        digests.append(hashlib.blake2b(path.tobytes(), digest_size=16).digest())
    return min(digests)


def describe_unused(unused: Counter[str]) -> str:
    """Describe elements of a map file that are not used.

    Args:
        unused: Number of elements by the reason.

    Returns:
        Numbers and reasons, the most frequent ones first, such as
        ``7 x without 'class', 2 x divider without length``. At most eight reasons are listed.
    """
    listed_reasons = unused.most_common(_LISTED_REASONS)
    parts = []
    for reason, count in listed_reasons:
        parts.append(f"{count} x {reason}")
    num_others = unused.total() - sum(count for _, count in listed_reasons)
    if num_others:
        parts.append(f"{num_others} x other reasons")
    return ", ".join(parts)


def score_of(values: Mapping[str, Any]) -> float:
    """Confidence of an element of a file.

    Args:
        values: Untrusted properties of the element. Tags of Lanelet2 files are texts.

    Returns:
        The property ``score`` if it is a number in [0, 1], also as a text, and 1 otherwise.
    """
    score = values.get(SCORE_KEY)
    if isinstance(score, str):
        try:
            score = float(score)
        except ValueError:
            return 1.0
    # True and False are integers in Python.
    if isinstance(score, bool) or not isinstance(score, (int, float)):
        return 1.0
    return float(score) if 0 <= score <= 1 else 1.0


def finite_number(value: Any) -> float:
    """Convert a JSON number to a finite number.

    Raises:
        ValueError: If the value is not a finite number. ``True`` and ``False`` are not numbers.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{value!r:.40} is no number")
    try:
        number = float(value)
    except OverflowError:  # an integer beyond the range of a float
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{value!r:.40} is no finite number")
    return number
