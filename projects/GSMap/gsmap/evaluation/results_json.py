"""Result and ground-truth files in the JSON form of MapTR and MapVR.

Results: ``{"meta": ..., "results": [{"sample_token", "vectors": [{"pts", "pts_num", "cls_name",
"type", "confidence_level"}]}]}``; ground truth: ``{"GTs": [...]}`` without confidence.
"""

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsmap.structures.elements import MapElements

RESULTS_KEY, GROUND_TRUTH_KEY = "results", "GTs"


def elements_from_vectors(
    vectors: Sequence[Mapping[str, Any]], classes: Mapping[str, int], scored: bool
) -> MapElements:
    """Convert the ``vectors`` of one sample.

    Args:
        vectors: Entries with ``pts``, ``cls_name`` and, if scored, ``confidence_level``.
        classes: Label of each class name; vectors of other classes get the label -1, which no
            metric counts.
        scored: Whether to read the confidence.

    Returns:
        The elements.

    Raises:
        ValueError: If a key is missing or a value is not finite.
    """
    try:
        points = [v["pts"] for v in vectors]
        labels = [classes.get(v["cls_name"], -1) for v in vectors]
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
    vectors: list[dict[str, Any]] = [
        {
            "pts": points.tolist(),
            "pts_num": len(points),
            "cls_name": classes[label],
            "type": label,
            "confidence_level": score,
        }
        for points, label, score in zip(
            elements.polylines, elements.labels.tolist(), elements.confidence.tolist(), strict=True
        )
    ]
    for name in ("scales", "rotations"):
        values = getattr(elements, name)
        if values is not None:
            for i, vector in enumerate(vectors):
                part = slice(elements.offsets[i], elements.offsets[i + 1])
                vector[f"gaussian_{name}"] = values[part].tolist()
    return vectors


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
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("w", encoding="utf-8") as file:
            file.write(f'{{"meta":{json.dumps(dict(meta or {}))},"{key}":[')
            for number, (token, vectors) in enumerate(samples):
                file.write(",\n" if number else "\n")
                sample = {"sample_token": token, "vectors": vectors}
                file.write(json.dumps(sample, separators=(",", ":")))
            file.write("\n]}\n")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
