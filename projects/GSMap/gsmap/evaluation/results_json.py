"""Result and ground-truth files in the JSON form of MapTR and MapVR.

Results: ``{"meta": ..., "results": [{"sample_token", "vectors": [{"pts", "pts_num", "cls_name",
"type", "confidence_level"}]}]}``; ground truth: ``{"GTs": [...]}`` without confidence.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from gsmap.structures.elements import MapElements
from gsmap.utils.files import atomic_write

RESULTS_KEY, GROUND_TRUTH_KEY = "results", "GTs"
THREE_D = "3D"


def elements_from_vectors(
    vectors: Sequence[Mapping[str, Any]], classes: Sequence[str], scored: bool
) -> MapElements:
    """Convert the ``vectors`` of one sample.

    Args:
        vectors: Entries with ``pts``, ``cls_name`` and, if scored, ``confidence_level``.
        classes: Names of the classes; vectors of other classes get the label -1, which no metric
            counts.
        scored: Whether to read the confidence.

    Returns:
        The elements.

    Raises:
        ValueError: If a key is missing or a value is not finite.
    """
    label_of = {name: label for label, name in enumerate(classes)}
    try:
        points = [v["pts"] for v in vectors]
        labels = [label_of.get(v["cls_name"], -1) for v in vectors]
        scores = [v["confidence_level"] for v in vectors] if scored else None
    except KeyError as error:
        raise ValueError(
            f"a vector lacks {error}: each needs pts and cls_name, and in results confidence_level."
        ) from error
    except TypeError as error:
        raise ValueError(f"vectors must be a list of objects, got {vectors!r:.80}.") from error
    return MapElements.from_polylines(points, labels, scores)


def vectors_of(elements: MapElements, classes: Sequence[str]) -> list[dict[str, Any]]:
    """Convert predictions to the ``vectors`` of one sample, with their Gaussians if they have any.

    Args:
        elements: Predictions. (N,)
        classes: Names of the classes.
    """
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


def read_samples(
    path: str | Path, key: str, classes: Sequence[str]
) -> tuple[dict[str, MapElements], Counter[str]]:
    """Read a result or ground-truth file.

    Samples become arrays while the file is parsed, so that no more than one is ever held as lists.

    Args:
        path: The file.
        key: ``results`` or ``GTs``.
        classes: Names of the classes.

    Returns:
        The elements of each sample, by token; how many elements are of which other class, and how
        many samples have 3D points (``THREE_D``).

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If it has no list under the key, a sample is malformed or has no token, or a
            token occurs twice; the message names the file and the sample.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"no file at {path}.")
    ignored = Counter[str]()
    convert = partial(_converted, path, classes, key == RESULTS_KEY, ignored)
    try:
        items = json.loads(Path(path).read_text(encoding="utf-8"), object_hook=convert)[key]
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        items = error
    if not isinstance(items, list):
        empty = not Path(path).stat().st_size
        what = "is empty" if empty else f"holds no complete list under {key!r}"
        raise ValueError(
            f"{path} {what}: expected "
            f'{{"{key}": [{{"sample_token": ..., "vectors": [...]}}, ...]}}, got {items!r:.80}.'
        )
    samples: dict[str, MapElements] = {}
    for item in items:
        if not isinstance(item, tuple):
            token = item.get("sample_token") if isinstance(item, dict) else None
            what = "a sample has no sample_token" if token is None else f"sample {token!r}"
            raise ValueError(f"{path}: {what}: expected sample_token and a list of vectors.")
        if item[0] in samples:
            raise ValueError(f"{path} holds sample {item[0]!r} more than once.")
        samples[item[0]] = item[1]
    return samples, ignored


def _converted(
    path: str | Path,
    classes: Sequence[str],
    scored: bool,
    ignored: Counter[str],
    item: dict[str, Any],
) -> Any:
    """Return a sample as its token and elements, and count what is ignored; others as they are."""
    token, vectors = item.get("sample_token"), item.get("vectors")
    if token is None or not isinstance(vectors, list):
        return item
    try:
        elements = elements_from_vectors(vectors, classes, scored)
    except ValueError as error:
        raise ValueError(f"{path}, sample {token!r}: {error}") from error
    if (elements.labels < 0).any():
        ignored.update(v["cls_name"] for v in vectors if v["cls_name"] not in classes)
    if any(len(point) == 3 for v in vectors for point in v["pts"][:1]):
        ignored[THREE_D] += 1
    return str(token), elements


def write_results(
    path: str | Path,
    samples: Iterable[tuple[str, list[dict[str, Any]]]],
    meta: Mapping[str, Any] | None = None,
    key: str = RESULTS_KEY,
) -> None:
    """Write a result (or ground-truth) file, sample by sample; it appears only when it is whole.

    Args:
        path: File to write; parent folders are made.
        samples: Token and vectors of each sample.
        meta: What to say about the file.
        key: ``results``, or ``GTs`` for ground truth.
    """
    with atomic_write(path) as file:
        file.write(f'{{"meta":{json.dumps(dict(meta or {}))},"{key}":[')
        for number, (token, vectors) in enumerate(samples):
            file.write(",\n" if number else "\n")
            sample = {"sample_token": token, "vectors": vectors}
            file.write(json.dumps(sample, separators=(",", ":")))
        file.write("\n]}\n")
