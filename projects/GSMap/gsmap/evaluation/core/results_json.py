"""Result and ground-truth files in the JSON form of MapTR and MapVR.

Results: ``{"meta": ..., "results": [{"sample_token", "vectors": [{"pts", "pts_num", "cls_name",
"type", "confidence_level"}]}]}``; ground truth: ``{"GTs": [...]}`` without confidence.
"""

import heapq
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.structures.bezier import curve_points
from gsmap.structures.elements import FARTHEST_M, MOST_M, MapElements
from gsmap.utils.errors import InputError
from gsmap.utils.files import atomic_write
from gsmap.utils.json_items import Place, items_of
from gsmap.utils.shards import ShardFile

RESULTS_KEY, GROUND_TRUTH_KEY = "results", "GTs"
BEZIER = "bezier"
"""Curves in place of ``pts``: ``degree`` and ``pts``; `compact_results` writes them."""
THREE_D = "3D"
SHARD_KIND = "results"
_LAST_LINE = "]}\n"


def vectors_of(elements: MapElements, classes: Sequence[str]) -> list[dict[str, Any]]:
    """Convert predictions to a sample's ``vectors``, with their Gaussians if they have any."""
    labels, scores = elements.labels.tolist(), elements.confidence.tolist()
    vectors: list[dict[str, Any]] = [
        {
            "pts": points.tolist(),
            "pts_num": len(points),
            "cls_name": classes[label],
            "type": label,
            "confidence_level": score,
        }
        for points, label, score in zip(elements.polylines, labels, scores, strict=True)
    ]
    for name in ("scales", "rotations"):
        values = getattr(elements, name)
        if values is not None:
            for vector, a, b in zip(vectors, elements.offsets, elements.offsets[1:], strict=False):
                vector[f"gaussian_{name}"] = values[a:b].tolist()
    return vectors


class SampleFile:
    """The samples of a result or ground-truth file, one after another; never all in memory.

    Args:
        path: The file.
        key: ``results`` or ``GTs``.
        classes: Names of the classes; elements of others get the label -1, which no metric counts.
        gaussians: Whether to read the Gaussians of results where all elements have them.

    Attributes:
        ignored: Of the samples so far, how many elements are of which other class, and how many
            samples have points with heights (``THREE_D``).
        about: What the file says of itself, after the last sample; a stranger's words.
    """

    def __init__(
        self, path: str | Path, key: str, classes: Sequence[str], gaussians: bool = False
    ) -> None:
        self.path, self._key, self._classes = Path(path), key, classes
        self._gaussians = gaussians
        self.ignored = Counter[str]()
        self.about: dict[str, Any] = {}

    def __iter__(self) -> Iterator[tuple[str, MapElements, Place]]:
        """Yield token, elements and place of each sample; errors are those of `raw`."""
        for _, token, elements, place in self.raw():
            yield token, elements, place

    def raw(self) -> Iterator[tuple[dict[str, Any], str, MapElements, Place]]:
        """Yield what stands in the file, token, elements and place of each sample.

        Raises:
            FileNotFoundError: If the file does not exist.
            ValueError: If it has no list under the key, a sample is malformed or has no token, or a
                token occurs twice; the message names the file and the sample.
        """
        seen, form = set(), f'{{"{self._key}": [{{"sample_token": ..., "vectors": [...]}}, ...]}}'
        beside: dict[str, Any] = {"meta": None}
        for item, place in items_of(self.path, self._key, f"it must be {form}", beside):
            token, elements = self._convert(item, self.ignored)
            if token in seen:
                raise InputError(f"{self.path} holds sample {token!r} more than once.")
            seen.add(token)
            yield item, token, elements, place
        self.about = beside["meta"] if isinstance(beside["meta"], dict) else {}

    def tokens(self) -> list[str]:
        """Return the tokens of all samples."""
        return [token for token, *_ in SampleFile(self.path, self._key, self._classes)]

    def load(self, token: str, place: Place) -> MapElements:
        """Read the elements of one sample again; ValueError if it is no longer in that place."""
        start, length = place
        with self.path.open("rb") as file, suppress(ValueError):
            file.seek(start)
            found, elements = self._convert(json.loads(file.read(length)), Counter())
            if found == token:
                return elements
        raise InputError(
            f"{self.path} was changed while it was read: end what writes there, and start again."
        )

    def _convert(self, item: Any, ignored: Counter[str]) -> tuple[str, MapElements]:
        """Return token and elements of a sample, and count what is ignored."""
        if not isinstance(item, dict) or not {"sample_token", "vectors"} <= item.keys():
            raise InputError(f"{self.path}: {item!r:.80} has no sample_token or no vectors.")
        token = str(item["sample_token"])
        try:
            scored = self._key == RESULTS_KEY
            elements = read_vectors(
                item["vectors"], self._classes, ignored, scored=scored, gaussians=self._gaussians
            )
            return token, elements
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise InputError(
                f"{self.path}, sample {token!r}: {error!r}; each vector needs pts, "
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
        vectors: Elements as the file has them.
        classes: Names of the classes; elements of others get the label -1.
        ignored: Counts elements of other classes by their class, and samples with heights.
        scored: Whether each element needs a confidence.
        gaussians: Whether to read the Gaussians where all elements have them.

    Raises:
        KeyError: If an entry is missing.
        TypeError: If an entry has another type.
        ValueError: If a value is not allowed.
    """
    label_of = {name: label for label, name in enumerate(classes)}
    if not all(isinstance(v["cls_name"], str) for v in vectors):
        raise TypeError("cls_name is no text")
    ignored.update(v["cls_name"] for v in vectors if v["cls_name"] not in label_of)
    polylines = [_points_of(vector) for vector in vectors]
    if any(len(point) == 3 for points in polylines for point in points[:1]):
        ignored[THREE_D] += 1
    extra = {
        name: [v[f"gaussian_{name}"] for v in vectors]
        for name in ("scales", "rotations")
        if gaussians and vectors and all(f"gaussian_{name}" in v for v in vectors)
    }
    elements = MapElements.from_polylines(
        polylines,
        [label_of.get(v["cls_name"], -1) for v in vectors],
        [v["confidence_level"] for v in vectors] if scored else None,
        **extra,
    )
    _require_near(elements)
    return elements


def _require_near(elements: MapElements) -> None:
    """Refuse lines that no map around a vehicle has; what resamples them would take all memory.

    Raises:
        ValueError: If a point is too far, or a line too long.
    """
    points = elements.points
    if not len(points):
        return
    widest = 2 * float(np.abs(points).max()) * points.shape[1] ** 0.5  # no step is longer
    if widest * len(points) <= FARTHEST_M:
        return
    steps = np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=1)
    starts = elements.offsets[:-1]
    steps[starts[starts < len(steps)]] = 0.0
    total = steps.sum()
    if np.abs(points).max() > FARTHEST_M or total > FARTHEST_M:
        lengths = [steps[a:b].sum() for a, b in pairwise(elements.offsets)]
        if (worst := max(np.abs(points).max(), *lengths)) > FARTHEST_M:
            raise InputError(
                f"a line of {worst:.3g} m, or that far from the vehicle: at most "
                f"{FARTHEST_M / 1000:g} km are read"
            )
    if total > MOST_M:
        raise InputError(
            f"lines of {total:.3g} m in all: at most {MOST_M / 1000:g} km of a sample are read"
        )


def _points_of(vector: Mapping[str, Any]) -> Any:
    """Return the points of a vector, or those of its Bezier curve."""
    if "pts" in vector or BEZIER not in vector:
        return vector["pts"]
    curve = vector[BEZIER]
    if not isinstance(curve["degree"], int):
        raise TypeError(f"the degree {curve['degree']!r:.20} is no whole number")
    return curve_points(curve["pts"], curve["degree"]).tolist()


def read_samples(
    path: str | Path, key: str, classes: Sequence[str], gaussians: bool = False
) -> tuple[dict[str, MapElements], Counter[str]]:
    """Read all samples of a file; errors are those of ``SampleFile``.

    Args:
        path: The file.
        key: ``results`` or ``GTs``.
        classes: Names of the classes; elements of others get the label -1.
        gaussians: Whether to read the Gaussians of results where all elements have them.

    Returns:
        The elements of each sample, by token; and what is ignored.
    """
    file = SampleFile(path, key, classes, gaussians)
    return {token: elements for token, elements, _ in file}, file.ignored


def write_results(
    path: str | Path,
    samples: Iterable[tuple[str, list[dict[str, Any]]]],
    meta: Mapping[str, Any] | None = None,
    key: str = RESULTS_KEY,
) -> None:
    """Write a file of results or ground truth, which appears only when it is whole.

    Args:
        path: File to write.
        samples: Tokens and vectors (``vectors_of``), taken one by one.
        meta: What to say about the file, in JSON's types.
        key: ``results`` or ``GTs``.
    """
    with atomic_write(path) as file:
        file.write(f'{{"meta":{json.dumps(dict(meta or {}))},"{key}":[')
        for number, (token, vectors) in enumerate(samples):
            sample = {"sample_token": token, "vectors": vectors}
            file.write(",\n" if number else "\n")
            file.write(json.dumps(sample, separators=(",", ":")))
        file.write("\n" + _LAST_LINE)


def merge_results(path: Path, shards: Sequence[ShardFile]) -> int:
    """Write a result file from its shards (``find_shards``) and return how many samples it has.

    The samples are in the order of their tokens.

    Raises:
        ValueError: If the shards say other things about themselves, or a sample occurs twice.
    """
    with ExitStack() as stack, atomic_write(path) as out:
        files = [stack.enter_context(s.path.open(encoding="utf-8")) for s in shards]
        head, *others = [file.readline() for file in files]
        if set(others) - {head}:
            raise InputError(f"the shards of {path} have different first lines: make them anew.")
        out.write(head.removesuffix("\n"))
        count, last = 0, None
        for token, line in heapq.merge(*map(_lines_by_token, files)):
            if last is not None and token <= last:
                raise InputError(f"shards of {path} hold sample {token!r} twice or out of order.")
            out.write(",\n" if count else "\n")
            out.write(line)
            count, last = count + 1, token
        out.write("\n" + _LAST_LINE)
    return count


def _lines_by_token(file: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield token and text of the samples in the lines that ``write_results`` writes."""
    decoder, start = json.JSONDecoder(), len('{"sample_token":')
    for line in file:
        if line != _LAST_LINE:
            token, _ = decoder.raw_decode(line, start)
            if not isinstance(token, str):
                raise InputError(f"{token!r:.80} is no token of a sample.")
            yield token, line.rstrip(",\n")
