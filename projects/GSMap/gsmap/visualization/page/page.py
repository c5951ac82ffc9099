"""Report page: its data as plain values, and the HTML file that displays them."""

import base64
import hashlib
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import AnnotationMeta, MapSample
from gsmap.evaluation.analysis import DISTANCE
from gsmap.evaluation.analysis.bootstrap import Resamples
from gsmap.evaluation.analysis.distances import distance_groups
from gsmap.evaluation.analysis.groups import read_groups
from gsmap.evaluation.core.file_evaluation import read_ground_truth
from gsmap.evaluation.core.raster_ap import MIN_SCORE
from gsmap.structures.elements import MapElements
from gsmap.structures.frames import FrameView, frame_view
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_text
from gsmap.utils.inputs import has_mark
from gsmap.utils.words import format_count
from gsmap.visualization.bev_view import display_extent
from gsmap.visualization.page.changes import ChangeLayer
from gsmap.visualization.page.frames import cameras_of, choose_frames, predictions_of, truth_of
from gsmap.visualization.page.scores import MATCH_M, ScoredResult, score_by_distance, score_result
from gsmap.visualization.page.tables import (
    Table,
    class_tables,
    curves,
    difference_table,
    group_tables,
    reliability_curves,
    summary_table,
)
from gsmap.visualization.style import MATCH_COLOURS, MapStyle

# Line in ``page.html`` by which pages of this module are recognised.
_GENERATOR = b'<meta name="generator" content="gsmap">'


@dataclass(frozen=True)
class PageOptions:
    """Options of the report page.

    Args:
        data_root: Folder that image paths are relative to; by default the folder of the annotation
            file.
        max_frames: Largest number of frames.
        score_thr: Initial value of the slider of the score, in [0, 1].
        image_width: Largest width of the images in pixels. The image of the front camera is drawn
            large, with up to twice this width. 0 leaves images out.
        allow_mismatch: Whether samples without results count as samples without predictions, and
            results without ground truth are ignored; otherwise both are errors.
        by: Groups of samples with separate AP: ``scene``, ``map``, ``distance``, or a JSON file
            with the group of each scene or sample.
        allow_other_split: Whether models may be of another split than the annotation file.
        law: Distribution of the errors of vertices, ``normal`` or ``laplace``, for results with
            Gaussians; by default the distribution of their calibration, or ``normal`` without one.
        changes: File of changes of the map (``build_map.py --changes``), shown in the frames and
            in a table.

    Raises:
        ValueError: If a value is out of its range.
    """

    data_root: Path | None = None
    max_frames: int = 200
    score_thr: float = 0.4
    image_width: int = 320
    allow_mismatch: bool = False
    by: str | None = None
    allow_other_split: bool = False
    law: str | None = None
    changes: Path | None = None

    def __post_init__(self) -> None:
        if self.max_frames < 1 or self.image_width < 0 or not 0 <= self.score_thr <= 1:
            raise InputError(
                "max_frames must be >= 1, image_width >= 0 and score_thr in [0, 1], got "
                f"{self.max_frames}, {self.image_width}, {self.score_thr}."
            )


def page_data(
    annotations: str | Path, results: Mapping[str, str | Path], options: PageOptions
) -> dict[str, Any]:
    """Collect the data of the page.

    Args:
        annotations: Annotation file.
        results: At most two result files, by their names on the page. If there is none, the page
            has only ground truth and cameras.
        options: Options of the page.

    Returns:
        Dictionary of plain values, the input of ``page.js``.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file is malformed, or does not fit the others.
    """
    file = AnnotationFile(annotations)
    meta = file.meta
    style = MapStyle(meta.classes)  # title and colour of each class
    # Orientation of the annotation frame: the page shows maps with the vehicle's front at the top.
    view = frame_view(meta.frame, meta.ground_z_m)
    truth: Mapping[str, MapElements] = {}
    if results:
        truth, _ = read_ground_truth(annotations, meta.classes)
    scored = _score_results(results, truth=truth, meta=meta, options=options)
    tokens = file.column("token")
    seconds = file.seconds_into_scene
    # Indices of the samples that are shown, at most `max_frames`, ascending.
    chosen = choose_frames(
        tokens, max_frames=options.max_frames, results=scored, score_thr=options.score_thr
    )
    root = Path(annotations).parent if options.data_root is None else options.data_root
    layer = ChangeLayer(options.changes, file)  # changes of the map; empty without a file of them
    frames = []
    for index in chosen:
        sample = file[index]
        # The mounting contains the slope of the ground, which is visible in the images.
        sample_view = view.with_mounting(sample.ego_from_frame)
        cameras = cameras_of(sample, view=sample_view, data_root=root, width_px=options.image_width)
        frame = _frame_entry(
            sample,
            title=_frame_title(sample.scene, seconds[index]),
            cameras=cameras,
            scored=scored,
            layer=layer,
            view=view,
        )
        frames.append(frame)
    notes = _collect_notes(
        scored, num_chosen=len(chosen), num_samples=len(tokens), max_frames=options.max_frames
    )
    tables: list[Table] = []
    if scored:
        tables = _tables(scored, truth=truth, style=style, file=file, options=options)
    notes += layer.notes()  # only after the loop over the frames, which counts their changes
    tables += layer.tables()
    return {
        "title": f"{meta.dataset} {meta.split}: {' and '.join(results) or 'ground truth'}",
        "notes": notes,
        "samples": len(tokens),
        "classes": _class_entries(style),
        "match_colours": MATCH_COLOURS,
        "extent": display_extent(BEVGrid(meta.x_range, meta.y_range), view),
        "vehicle": view.vehicle_m,
        "match_m": MATCH_M,
        "min_score": MIN_SCORE,
        "score": options.score_thr,
        "results": [result.name for result in scored],
        "tables": tables,
        "curves": curves(scored, style) if scored else [],
        "reliability": reliability_curves(scored, truth, style),
        "frames": frames,
    }


def _score_results(
    results: Mapping[str, str | Path],
    truth: Mapping[str, MapElements],
    meta: AnnotationMeta,
    options: PageOptions,
) -> list[ScoredResult]:
    """Score the result files in their order.

    Args:
        results: Result files by their names on the page.
        truth: Ground truth of each sample, by token.
        meta: Metadata of the annotation file.
        options: Options of the page.
    """
    scored = []
    for name, path in results.items():
        result = score_result(
            name,
            path,
            truth=truth,
            meta=meta,
            allow_mismatch=options.allow_mismatch,
            allow_other_split=options.allow_other_split,
            law=options.law,
        )
        scored.append(result)
    return scored


def _collect_notes(
    scored: Sequence[ScoredResult], num_chosen: int, num_samples: int, max_frames: int
) -> list[str]:
    """Collect the notes of the results, and a note on the choice of frames if some are left out.

    Args:
        scored: Results, with their notes.
        num_chosen: Number of frames on the page.
        num_samples: Number of samples of the annotation file.
        max_frames: Largest number of frames.
    """
    notes = []
    for result in scored:
        for note in result.notes:
            notes.append(f"{result.name}: {note}")
    if num_chosen < num_samples:
        choice = _describe_choice(scored, num_chosen=num_chosen, max_frames=max_frames)
        notes.append(f"The page shows {num_chosen} of {num_samples} frames: {choice}.")
    return notes


def _frame_entry(
    sample: MapSample,
    title: str,
    cameras: list[list[dict[str, Any]]],
    scored: Sequence[ScoredResult],
    layer: ChangeLayer,
    view: FrameView,
) -> dict[str, Any]:
    """Plain values of one frame.

    Args:
        sample: Sample of the annotation file.
        title: Title of the frame.
        cameras: Plain values of the cameras, in the rows in which they are drawn (`cameras_of`).
        scored: Results, whose predictions are added.
        layer: Changes of the map.
        view: Orientation of the annotation frame.
    """
    predictions = []
    for result in scored:
        predictions.append(predictions_of(sample.token, result=result, view=view))
    return {
        "token": sample.token,
        "title": title,
        "scene": sample.scene,
        "place": sample.map_name,
        "truth": truth_of(sample, view),
        "found": predictions,
        "cameras": cameras,
        "changes": layer.entries(sample, view),
    }


def _class_entries(style: MapStyle) -> list[dict[str, Any]]:
    """Plain values of the classes, in label order."""
    entries = []
    for label in range(len(style.classes)):
        colour = style.colour(label)
        is_area = style.is_closed(label)
        entries.append({"title": style.title(label), "colour": colour, "area": is_area})
    return entries


def _describe_choice(scored: Sequence[ScoredResult], num_chosen: int, max_frames: int) -> str:
    """Describe the rule by which frames were chosen (``choose_frames``)."""
    if not scored:
        return "evenly spread"
    num_worst = max_frames // 4  # as in `choose_frames`
    if not num_worst:
        return "evenly spread"
    worst = f"the {num_worst} worst of {scored[0].name}"
    if len(scored) == 2:
        worst = f"{num_worst} in which both results differ most"
    return f"{num_chosen - num_worst} evenly spread and {worst}"


def _frame_title(scene: str, seconds: float) -> str:
    """Title of a frame on the page."""
    return f"{scene}, {seconds:.1f} s"


def _tables(
    scored: Sequence[ScoredResult],
    truth: Mapping[str, MapElements],
    style: MapStyle,
    file: AnnotationFile,
    options: PageOptions,
) -> list[Table]:
    """Tables of one or two results, with intervals if there are several scenes.

    Args:
        scored: One or two results.
        truth: Ground truth of each sample, by token.
        style: Titles and colours of the classes.
        file: Annotation file.
        options: Options of the page.
    """
    scene_of = dict(zip(file.column("token"), file.column("scene"), strict=True))
    has_scenes = len(set(scene_of.values())) > 1
    # Confidence intervals come from random resamples of the scenes.
    resamples = Resamples(scene_of) if has_scenes else None
    tables = [summary_table(scored, resamples), *class_tables(scored, style)]
    if options.by == DISTANCE:  # the word "distance": bands of the distance from the vehicle
        in_bands = [score_by_distance(result, truth=truth, meta=file.meta) for result in scored]
        # In these results, each band of a sample counts as a separate sample with its token.
        band_tokens = in_bands[0].reports[0].tokens
        groups = distance_groups(band_tokens)
        tables += group_tables(in_bands, groups=groups, by=DISTANCE)
    elif options.by:
        groups = read_groups(file.path, options.by)
        tables += group_tables(scored, groups=groups, by=Path(options.by).name)
    if len(scored) == 2:
        titles = {}
        for (token, scene), seconds in zip(scene_of.items(), file.seconds_into_scene, strict=True):
            titles[token] = _frame_title(scene, seconds)
        # Samples with the largest differences between both results in F1.
        tables.append(difference_table(scored, titles=titles, score_thr=options.score_thr))
    return tables


def page_html(data: Mapping[str, Any]) -> str:
    """Create the page: one HTML file that loads no other file and runs only the script in it.

    Args:
        data: Data from ``page_data``. Its texts are untrusted. The page contains them in a block of
            JSON without ``<``, and the script displays them as text, not as HTML.

    Returns:
        HTML.
    """
    folder = files("gsmap.visualization.page")
    template = Template(folder.joinpath("page.html").read_text("utf-8"))
    style = folder.joinpath("page.css").read_text("utf-8")
    script = folder.joinpath("page.js").read_text("utf-8")
    # The images of each frame are in a separate block, which is parsed when the frame is opened. In
    # the block, they are listed in the order of the cameras, row by row.
    frames = []
    image_blocks = []
    for frame in data["frames"]:
        rows = []
        sources = []
        for row in frame["cameras"]:
            cameras = []
            for camera in row:
                camera_without_image = dict(camera)
                sources.append(camera_without_image.pop("src"))
                cameras.append(camera_without_image)
            rows.append(cameras)
        frames.append({**frame, "cameras": rows})
        block = _json_block(sources)
        image_blocks.append(f'<script type="application/json" class="images">{block}</script>')
    # Content security policy of the page. Only a style and a script with these digests are used.
    rules = [
        "default-src 'none'",
        "img-src data:",
        f"style-src 'sha256-{_digest(style)}'",
        f"script-src 'sha256-{_digest(script)}'",
        "base-uri 'none'",  # this rule and the next one are not covered by default-src
        "form-action 'none'",
    ]
    return template.substitute(
        policy="; ".join(rules),
        title=html.escape(str(data["title"])),
        style=style,
        script=script,
        data=_json_block({**data, "frames": frames}),
        images="".join(image_blocks),
    )


def _json_block(value: Any) -> str:
    """Encode a value as JSON that cannot close the HTML element around it."""
    # Browsers cannot parse NaN, so it is an error here.
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")


def _digest(text: str) -> str:
    """SHA-256 of a text in base64, as in content security policies."""
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def is_own_page(path: Path) -> bool:
    """Whether a file was written by `write_page`."""
    return has_mark(path, _GENERATOR)


def write_page(path: str | Path, data: Mapping[str, Any]) -> str:
    """Write the page.

    Args:
        path: HTML file to write; parent folders are created.
        data: Data from ``page_data``.

    Returns:
        Summary of the page in words, with its size.
    """
    text = page_html(data)
    write_text(path, text)
    return f"{format_count(len(data['frames']), 'frame')}, {len(text) / 1e6:.1f} MB: {path}"
