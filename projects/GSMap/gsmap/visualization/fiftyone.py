"""Export of camera images with map elements to a JSON file of FiftyOne."""

import argparse
import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import CameraRecord, MapSample
from gsmap.datasets.elements import elements_of_instances
from gsmap.evaluation.core.file_evaluation import mismatch_notes
from gsmap.evaluation.core.results_json import THREE_D, SampleFile
from gsmap.structures.elements import MapElements
from gsmap.structures.frames import FrameView, frame_view
from gsmap.utils.cli import output_file
from gsmap.utils.errors import InputError
from gsmap.utils.files import atomic_write
from gsmap.utils.words import format_count
from gsmap.visualization.camera_projection import project_segments, subdivide

_STEP_M = 2.0  # largest length of a projected segment, in metres
_DECIMALS = 6  # of positions in an image, as shares of its width and height
_ID_DIGITS = 24  # hexadecimal digits of an ID of FiftyOne
# Names of Python classes of FiftyOne, which the JSON file contains as the types of fields.
_FIELDS = "fiftyone.core.fields."
_POLYLINES = f"{_FIELDS}EmbeddedDocumentField(fiftyone.core.labels.Polylines)"


def write_fiftyone(
    path: str | Path,
    annotations: str | Path,
    results: str | Path | None = None,
    data_root: str | Path | None = None,
) -> tuple[int, list[str]]:
    """Write a JSON file that ``fiftyone.Dataset.from_json`` loads as a grouped data set.

    Each sample of this project becomes a FiftyOne group, whose slices are the images of the
    cameras. An image is a sample of FiftyOne. Map elements are polylines in the images, in the
    fields ``ground_truth`` and ``predictions`` (with scores).

    Args:
        path: File to write.
        annotations: Annotation file.
        results: Result file; None for ground truth alone.
        data_root: Folder that image paths are relative to; None for the folder of the annotations.

    Returns:
        Number of images, and notes on samples and elements that are left out.

    Raises:
        ValueError: If a file is malformed, the result file has no sample of the annotation file, or
            no sample has a camera.
    """
    file = AnnotationFile(annotations)
    root = Path(data_root or Path(annotations).parent).resolve()
    predictions = None
    # Place (offset and length in bytes) of each sample in the result file, by token. Elements are
    # loaded sample by sample below, so that a large file does not fill the memory.
    places = {}
    notes: list[str] = []
    if results is not None:
        predictions = SampleFile(results, key="results", classes=file.meta.classes)
        places = {token: place for token, _, place in predictions}  # the elements are not kept
        notes = mismatch_notes(places, file.column("token"), allowed=True)
        for name, number in sorted(predictions.ignored.items()):
            if name != THREE_D:
                notes.append(f"{number} predictions of class {name!r} are left out")
        if predictions.num_short:
            count = format_count(predictions.num_short, "prediction")
            notes.append(f"{count} of fewer than two points left out")
        if not places.keys() & set(file.column("token")):
            raise InputError(f"{results} has no sample of {annotations}.")
    # Orientation of the annotation frame, and the ground, on which lines without z are drawn.
    view = frame_view(file.meta.frame, file.meta.ground_z_m)
    samples: list[dict[str, Any]] = []
    for sample in file:
        layers = {"ground_truth": elements_of_instances(sample.instances or [])}
        if predictions is not None and sample.token in places:
            layers["predictions"] = predictions.load(sample.token, places[sample.token])
        sample_view = view.with_mounting(sample.ego_from_frame)
        samples += _images(sample, layers, view=sample_view, classes=file.meta.classes, root=root)
    if not samples:
        raise InputError(f"{annotations} has no sample with a camera.")
    content = {**_schema(file, samples=samples), "samples": samples}
    with atomic_write(path, "w") as target:
        json.dump(content, target)
    return len(samples), notes


def _schema(file: AnnotationFile, samples: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Name, slices and types of the fields of the data set.

    Args:
        file: Annotation file.
        samples: Images of all samples (`_images`), at least one.
    """
    slices = {image["group"]["name"]: "image" for image in samples}
    fields = {
        "id": f"{_FIELDS}ObjectIdField",
        "filepath": f"{_FIELDS}StringField",
        "tags": f"{_FIELDS}ListField({_FIELDS}StringField)",
        "group": f"{_FIELDS}EmbeddedDocumentField(fiftyone.core.groups.Group)",
        "token": f"{_FIELDS}StringField",
        "scene": f"{_FIELDS}StringField",
        "ground_truth": _POLYLINES,
        "predictions": _POLYLINES,
    }
    return {
        "name": f"{file.meta.dataset}-{file.meta.split}",
        "media_type": "group",
        "group_field": "group",
        "group_media_types": slices,
        "default_group_slice": next(iter(slices)),
        "sample_fields": fields,
        "info": {},
    }


def _images(
    sample: MapSample,
    layers: dict[str, MapElements],
    view: FrameView,
    classes: Sequence[str],
    root: Path,
) -> Iterator[dict[str, Any]]:
    """Yield the images of a sample, each in the form in which FiftyOne stores a sample.

    Args:
        sample: The sample.
        layers: Map elements by the name of their field.
        view: Orientation of the annotation frame, and height of the road.
        classes: Names of the classes.
        root: Data root of the images.
    """
    # The ID of the group follows from the token, so it is equal in each export.
    group = hashlib.sha256(sample.token.encode()).hexdigest()[:_ID_DIGITS]
    for camera in sample.cameras:
        image: dict[str, Any] = {
            "filepath": str(root / camera.path),
            "tags": [],
            "group": {"_id": {"$oid": group}, "_cls": "Group", "name": camera.name},
            "token": sample.token,
            "scene": sample.scene,
        }
        for name, elements in layers.items():
            polylines = list(_polylines(elements, camera=camera, view=view, classes=classes))
            image[name] = {"_cls": "Polylines", "polylines": polylines}
        yield image


def _polylines(
    elements: MapElements, camera: CameraRecord, view: FrameView, classes: Sequence[str]
) -> Iterator[dict[str, Any]]:
    """Yield the elements inside the image of a camera as labels of FiftyOne.

    Elements of unknown classes, which have the label -1, are left out.
    """
    for number, line in enumerate(elements.polylines):
        label = int(elements.labels[number])
        # `lift` puts a line without z on the ground. `shapes` are the visible parts of the line.
        shapes = _visible_parts(view.lift(line), camera)
        if label < 0 or not shapes:
            continue
        polyline = {
            "_cls": "Polyline",
            "attributes": {},
            "tags": [],
            "label": classes[label],
            "points": shapes,
            "closed": False,
            "filled": False,
        }
        if elements.scores is not None:
            polyline["confidence"] = float(elements.scores[number])
        yield polyline


def _visible_parts(line: np.ndarray, camera: CameraRecord) -> list[list[list[float]]]:
    """Parts of a line inside the image of a camera, as shares of its width and height.

    Args:
        line: Vertices in metres. (n, 3)
        camera: The camera.

    Returns:
        Vertices (x, y) of each part, in [0, 1].
    """
    dense = subdivide(line, _STEP_M)
    size_px = (camera.width, camera.height)
    # Visible part of each segment in pixels (m, 2, 2), its depth, and the index of the segment.
    segments, _, index = project_segments(
        dense[:-1], dense[1:], img_from_frame=camera.img_from_frame, size_px=size_px
    )
    if not len(segments):
        return []
    shares = np.clip(segments / size_px, 0.0, 1.0).round(_DECIMALS)  # (m, 2, 2)
    # A part ends where the next visible segment is not the next segment of the line, or where the
    # line is outside of the image between the two.
    are_next = np.diff(index) == 1
    are_joined = np.isclose(segments[:-1, 1], segments[1:, 0]).all(-1)
    breaks = np.flatnonzero(~(are_next & are_joined)) + 1
    parts = []
    for run in np.split(shares, breaks):
        # The points are the start of each segment, and the end of the last one.
        vertices = np.concatenate([run[:, 0], run[-1:, 1]])
        parts.append(vertices.tolist())
    return parts


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py fiftyone``."""
    parser.add_argument("annotations", type=Path, help="annotation file (.arrow)")
    parser.add_argument("target", type=output_file, help="JSON file to write")
    parser.add_argument("--results", type=Path, help="result file, for the field predictions")
    parser.add_argument("--data-root", type=Path, help="root of the image paths")


def run(arguments: argparse.Namespace) -> str:
    """Run the command ``fiftyone`` and return its report."""
    count, notes = write_fiftyone(
        arguments.target,
        arguments.annotations,
        results=arguments.results,
        data_root=arguments.data_root,
    )
    written = f"{format_count(count, 'image')} written to {arguments.target}"
    return "\n".join([written, *(f"note: {note}" for note in notes)])
