"""Reading and writing of results and ground truth in the JSON form of MapTR's evaluator.

A file of results is ``{"meta": ..., "results": [{"sample_token", "vectors": [{"pts", "pts_num",
"cls_name", "type", "confidence_level"}]}]}``. A vector is a map element: its points in metres,
their number, the name and the label of its class, and its score. A file of ground truth is
``{"GTs": [...]}``, without confidence.
"""

import heapq
import json
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.structures.bezier import curve_points
from gsmap.structures.elements import MAX_LENGTH_M, MAX_TOTAL_LENGTH_M, MapElements
from gsmap.utils.errors import InputError
from gsmap.utils.files import atomic_write
from gsmap.utils.json_items import Place, items_of
from gsmap.utils.shards import ShardFile

RESULTS_KEY = "results"
GROUND_TRUTH_KEY = "GTs"
BEZIER = "bezier"
"""Key of a Bezier curve, ``degree`` and ``pts``, that replaces points (`compact_results`)."""
THREE_D = "3D"
"""Key of the number of samples with heights in `SampleFile.ignored`."""
SHARD_KIND = "results"
_LAST_LINE = "]}\n"  # closes the list of samples and the object of the file
_GAUSSIAN_FIELDS = ("scales", "rotations")  # of `MapElements`; ``gaussian_<field>`` in a vector


def vectors_of(elements: MapElements, classes: Sequence[str]) -> list[dict[str, Any]]:
    """Convert predictions to the ``vectors`` of a sample, with their Gaussians if they have any.

    Args:
        elements: Predicted elements, in metres in the annotation frame.
        classes: Names of the classes; a label is an index into them.
    """
    labels = elements.labels.tolist()
    scores = elements.confidence.tolist()
    vectors: list[dict[str, Any]] = []
    for points, label, score in zip(elements.polylines, labels, scores, strict=True):
        vector = {
            "pts": points.tolist(),
            "pts_num": len(points),
            "cls_name": classes[label],
            "type": label,
            "confidence_level": score,
        }
        vectors.append(vector)
    for name in _GAUSSIAN_FIELDS:
        vertex_values = getattr(elements, name)  # one row for each vertex of all elements
        if vertex_values is None:
            continue
        for vector, (start, end) in zip(vectors, pairwise(elements.offsets), strict=True):
            vector[f"gaussian_{name}"] = vertex_values[start:end].tolist()
    return vectors


class SampleFile:
    """Result or ground-truth file whose samples are read one by one by iteration.

    Args:
        path: Path of the file.
        key: Key of the samples: ``results`` or ``GTs``.
        classes: Names of the classes; elements of other classes get the label -1, which no metric
            counts.
        gaussians: Whether to read the Gaussians of a sample if all of its elements have them.

    Attributes:
        left_out: Tokens of samples that iterating leaves out, such as those of other shards.
        ignored: Number of elements of each other class, and number of samples with heights
            (``THREE_D``), in the samples yielded so far.
        num_short: Number of elements of the classes with fewer than two points in these samples.
        about: Metadata of the file. It is set after the last sample was read, and not validated.
    """

    def __init__(
        self, path: str | Path, key: str, classes: Sequence[str], gaussians: bool = False
    ) -> None:
        self.path = Path(path)
        self._key = key
        self._classes = classes
        self._gaussians = gaussians
        self.left_out: Collection[str] = frozenset()
        self.ignored = Counter[str]()
        self.num_short = 0
        self.about: dict[str, Any] = {}

    def __iter__(self) -> Iterator[tuple[str, MapElements, Place]]:
        """Yield token, elements and place of each sample; raises the errors of `raw`.

        The place is the start and the length of the sample in the file, in bytes.
        """
        for _, token, elements, place in self.raw():
            yield token, elements, place

    def raw(self) -> Iterator[tuple[dict[str, Any], str, MapElements, Place]]:
        """Yield the JSON object, token, elements and place of each sample.

        Raises:
            FileNotFoundError: If the file does not exist.
            ValueError: If the file has no list under the key, a sample is malformed or has no
                token, or a token occurs twice; the message names the file and the sample.
        """
        tokens = set()
        form = f'{{"{self._key}": [{{"sample_token": ..., "vectors": [...]}}, ...]}}'
        # `items_of` sets the value of this key when it reaches the entry, which may come last.
        other_entries: dict[str, Any] = {"meta": None}
        for item, place in items_of(self.path, self._key, f"it must be {form}", other_entries):
            token = self._token_of(item)
            if token in tokens:
                raise InputError(f"{self.path} holds sample {token!r} more than once.")
            tokens.add(token)
            if token not in self.left_out:
                elements = self._elements_of(item, self.ignored)
                is_short = (elements.num_points < 2) & (elements.labels >= 0)
                self.num_short += int(is_short.sum())
                yield item, token, elements, place
        meta = other_entries["meta"]
        self.about = meta if isinstance(meta, dict) else {}

    def tokens(self) -> list[str]:
        """Return the tokens of all samples."""
        # Another object, so that the counts in `ignored` do not change.
        file = SampleFile(self.path, key=self._key, classes=self._classes)
        return [token for token, _, _ in file]

    def load(self, token: str, place: Place) -> MapElements:
        """Read the elements of one sample without reading the samples before it.

        Args:
            token: Name of the sample.
            place: Place of the sample, as iterating yields it: start and length in bytes.

        Raises:
            FileNotFoundError: If the file does not exist.
            ValueError: If the sample is not in this place.
        """
        start, length = place
        # If the file was changed, this place may not contain the JSON of a sample. The resulting
        # ValueError is suppressed, and the error below is raised.
        with self.path.open("rb") as file, suppress(ValueError):
            file.seek(start)
            item = json.loads(file.read(length))
            if self._token_of(item) == token:
                return self._elements_of(item, ignored=Counter())
        raise InputError(
            f"{self.path} was changed while it was read: stop the program that writes to it, and "
            "start again."
        )

    def _token_of(self, item: Any) -> str:
        """Return the token of the JSON object of a sample."""
        if not isinstance(item, dict) or not {"sample_token", "vectors"} <= item.keys():
            raise InputError(f"{self.path}: {item!r:.80} has no sample_token or no vectors.")
        return str(item["sample_token"])

    def _elements_of(self, item: dict[str, Any], ignored: Counter[str]) -> MapElements:
        """Convert the JSON object of a sample to elements, and count ignored elements."""
        try:
            return read_vectors(
                item["vectors"],
                classes=self._classes,
                ignored=ignored,
                scored=self._key == RESULTS_KEY,
                gaussians=self._gaussians,
            )
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise InputError(
                f"{self.path}, sample {self._token_of(item)!r}: {error!r}; each vector needs pts, "
                "cls_name and, in results, confidence_level."
            ) from error


def read_vectors(
    vectors: Sequence[Mapping[str, Any]],
    classes: Sequence[str],
    ignored: Counter[str],
    scored: bool = True,
    gaussians: bool = False,
) -> MapElements:
    """Convert the ``vectors`` of one sample of a file.

    Args:
        vectors: JSON objects of the elements.
        classes: Names of the classes; elements of other classes get the label -1.
        ignored: Number of elements of each other class, and of samples with heights; updated in
            place.
        scored: Whether each element must have a confidence.
        gaussians: Whether to read the Gaussians if all elements have them.

    Raises:
        KeyError: If an entry is missing.
        TypeError: If an entry has a wrong type.
        ValueError: If a value is not allowed.
    """
    label_of = {name: label for label, name in enumerate(classes)}
    polylines = []
    labels = []
    scores = []
    has_heights = False
    for vector in vectors:
        name = vector["cls_name"]
        if not isinstance(name, str):
            raise TypeError("cls_name is no text")
        if name not in label_of:
            ignored[name] += 1
        labels.append(label_of.get(name, -1))
        points = _points_of(vector)
        polylines.append(points)
        # One element with heights (x, y, z) is enough.
        has_heights |= len(points) > 0 and len(points[0]) == 3
        if scored:
            scores.append(vector["confidence_level"])
    if has_heights:
        ignored[THREE_D] += 1
    gaussian_fields = {}
    if gaussians and vectors:
        for name in _GAUSSIAN_FIELDS:
            key = f"gaussian_{name}"
            if all(key in vector for vector in vectors):
                gaussian_fields[name] = [vector[key] for vector in vectors]
    elements = MapElements.from_polylines(
        polylines,
        labels=labels,
        scores=scores if scored else None,
        **gaussian_fields,
    )
    _check_lengths(elements)
    return elements


def _check_lengths(elements: MapElements) -> None:
    """Check that lines are not far longer than a map around a vehicle.

    Long lines in a malformed file would be resampled to more points than fit in memory.

    Raises:
        ValueError: If a point is too far from the vehicle, or a line too long.
    """
    points = elements.points
    if not len(points):
        return
    # Fast check: all points lie in a cube around the origin, so no two points are farther apart
    # than its diagonal. All lines together are at most as long as the diagonal times the number of
    # points.
    max_coordinate = np.abs(points).max()
    max_step = 2 * float(max_coordinate) * points.shape[1] ** 0.5
    if max_step * len(points) <= MAX_LENGTH_M:
        return
    # Distance of each vertex from the vertex before it; 0 for the first vertex of a line.
    steps = np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=1)
    starts = elements.offsets[:-1]
    first_vertices = starts[starts < len(steps)]  # lines without vertices may be at the end
    steps[first_vertices] = 0.0
    total = steps.sum()
    # No single line is too long if all lines together are not.
    if max_coordinate > MAX_LENGTH_M or total > MAX_LENGTH_M:
        lengths = [steps[start:end].sum() for start, end in pairwise(elements.offsets)]
        worst = max([max_coordinate, *lengths])
        if worst > MAX_LENGTH_M:
            raise InputError(
                f"a line is {worst:.3g} m long, or a point is that far from the vehicle: at most "
                f"{MAX_LENGTH_M / 1000:g} km are read"
            )
    if total > MAX_TOTAL_LENGTH_M:
        raise InputError(
            f"all lines together are {total:.3g} m long: at most {MAX_TOTAL_LENGTH_M / 1000:g} km "
            "of a sample are read"
        )


def _points_of(vector: Mapping[str, Any]) -> Any:
    """Return the points of a vector, or points on its Bezier curve."""
    if "pts" in vector or BEZIER not in vector:
        return vector["pts"]  # KeyError if the vector has neither
    curve = vector[BEZIER]
    if not isinstance(curve["degree"], int):
        raise TypeError(f"the degree {curve['degree']!r:.20} is no whole number")
    return curve_points(curve["pts"], degree=curve["degree"]).tolist()


def read_leading_meta(path: Path, key: str) -> dict[str, Any]:
    """Read the metadata before the samples of a file. It is not validated.

    Args:
        path: Path of the file.
        key: Key of the samples: ``results`` or ``GTs``.

    Returns:
        Metadata, empty if there is none before the samples.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file has no list under the key.
    """
    # `items_of` sets the value of this key if the entry precedes the first sample. Then the file is
    # closed, and no further sample is read.
    other_entries: dict[str, Any] = {"meta": None}
    advice = f'it must be {{"{key}": [...]}}'
    with closing(items_of(path, key, advice, other_entries)) as items:
        next(items, None)
    meta = other_entries["meta"]
    return meta if isinstance(meta, dict) else {}


def read_samples(
    path: str | Path, key: str, classes: Sequence[str], gaussians: bool = False
) -> tuple[dict[str, MapElements], Counter[str]]:
    """Read all samples of a file; raises the errors of ``SampleFile``.

    Args:
        path: Path of the file.
        key: Key of the samples: ``results`` or ``GTs``.
        classes: Names of the classes; elements of other classes get the label -1.
        gaussians: Whether to read the Gaussians of a sample if all of its elements have them.

    Returns:
        Elements of each sample by token, and the numbers in `SampleFile.ignored`.
    """
    file = SampleFile(path, key=key, classes=classes, gaussians=gaussians)
    samples = {token: elements for token, elements, _ in file}
    return samples, file.ignored


def write_results(
    path: str | Path,
    samples: Iterable[tuple[str, list[dict[str, Any]]]],
    meta: Mapping[str, Any] | None = None,
    key: str = RESULTS_KEY,
) -> None:
    """Write a file of results or ground truth; the file appears when it is complete.

    Args:
        path: Path of the file.
        samples: Token and vectors (``vectors_of``) of each sample; may be a generator.
        meta: Metadata of the file, in types of JSON.
        key: Key of the samples: ``results`` or ``GTs``.
    """
    meta_text = json.dumps(dict(meta or {}))
    # `merge_results` relies on these lines: first the metadata and the key, then one line per
    # sample, and `_LAST_LINE`.
    with atomic_write(path) as file:
        file.write(f'{{"meta":{meta_text},"{key}":[')
        for number, (token, vectors) in enumerate(samples):
            sample = {"sample_token": token, "vectors": vectors}
            file.write(",\n" if number else "\n")
            file.write(json.dumps(sample, separators=(",", ":")))
        file.write("\n" + _LAST_LINE)


def merge_results(path: Path, shards: Sequence[ShardFile]) -> int:
    """Write a result file from its shards, with the samples in the order of their tokens.

    A shard is the result file of a part of the samples. The lines of the samples are copied as
    text.

    Args:
        path: Path of the result file.
        shards: Shards, as ``find_shards`` returns them.

    Returns:
        Number of samples.

    Raises:
        ValueError: If the metadata of the shards differs, a sample occurs twice, or the samples of
            a shard are not in the order of their tokens.
    """
    with ExitStack() as stack, atomic_write(path) as out:  # the stack closes the shards at the end
        files = []
        for shard in shards:
            file = shard.path.open(encoding="utf-8")
            files.append(stack.enter_context(file))
        heads = [file.readline() for file in files]  # the metadata and the key of the samples
        head = heads[0]
        if len(set(heads)) > 1:
            raise InputError(f"the shards of {path} have different first lines: create them again.")
        out.write(head.removesuffix("\n"))
        count = 0
        last_token = None
        sorted_lines = [_lines_by_token(file) for file in files]  # each in the order of tokens
        for token, line in heapq.merge(*sorted_lines):  # keeps this order over all files
            if last_token is not None and token <= last_token:
                raise InputError(f"shards of {path} hold sample {token!r} twice or out of order.")
            out.write(",\n" if count else "\n")
            out.write(line)
            count += 1
            last_token = token
        out.write("\n" + _LAST_LINE)
    return count


def _lines_by_token(file: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield token and text of each sample, from the lines that ``write_results`` writes.

    The text is one JSON object, without the comma and the line break at its end.
    """
    decoder = json.JSONDecoder()
    start = len('{"sample_token":')
    for line in file:
        if line == _LAST_LINE:
            continue
        token, _ = decoder.raw_decode(line, start)  # the value at this position of the line
        if not isinstance(token, str):
            raise InputError(f"{token!r:.80} is no token of a sample.")
        yield token, line.rstrip(",\n")
