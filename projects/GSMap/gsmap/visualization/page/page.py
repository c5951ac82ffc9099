"""The report page: everything that it shows as one value, and the HTML file that shows it."""

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
from gsmap.evaluation.analysis import DISTANCE
from gsmap.evaluation.analysis.bootstrap import Resamples
from gsmap.evaluation.analysis.distances import distance_groups
from gsmap.evaluation.analysis.groups import read_groups
from gsmap.evaluation.core.file_evaluation import read_ground_truth
from gsmap.evaluation.core.raster_ap import MIN_SCORE
from gsmap.structures.elements import MapElements
from gsmap.structures.frames import frame_view
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_text
from gsmap.utils.words import counted
from gsmap.visualization.bev_view import display_extent
from gsmap.visualization.page.frames import cameras_of, choose_frames, found_of, truth_of
from gsmap.visualization.page.scores import MATCH_M, ScoredResult, score_result, scored_by_distance
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

_GENERATOR = b'<meta name="generator" content="gsmap">'
_HEAD_BYTES = 4096  # of a page, within which it names its generator


@dataclass(frozen=True)
class PageOptions:
    """What goes onto the page.

    Args:
        data_root: Folder that image paths start from; the annotation file's by default.
        max_frames: Largest number of frames.
        score_thr: Where the slider of the score starts, in [0, 1].
        image_width: Largest width of the images in pixels, twice that of the camera ahead, which is
            drawn large; 0 leaves them out.
        allow_mismatch: Samples without results count as without predictions, results without
            ground truth are left out; otherwise both are errors.
        by: Parts of the samples that have their AP in a table, as `read_groups` takes them.
        allow_other_split: Whether models may be of another split than the annotation file.
        law: Distribution of the errors that Gaussians tell of; by default that of each result's
            calibration, or the normal one.

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

    def __post_init__(self) -> None:
        if self.max_frames < 1 or self.image_width < 0 or not 0 <= self.score_thr <= 1:
            raise InputError(
                "max_frames must be >= 1, image_width >= 0 and score_thr in [0, 1], got "
                f"{self.max_frames}, {self.image_width}, {self.score_thr}."
            )


def page_data(
    annotations: str | Path, results: Mapping[str, str | Path], options: PageOptions
) -> dict[str, Any]:
    """Gather all that the page shows.

    Args:
        annotations: Annotation file.
        results: None, one or two result files by the names that the page gives them; without any
            the page shows ground truth and cameras alone.
        options: What goes onto the page.

    Returns:
        Plain values, as ``page.js`` reads them.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file is malformed, or does not fit the others.
    """
    file = AnnotationFile(annotations)
    meta, style = file.meta, MapStyle(file.meta.classes)
    view = frame_view(meta.frame, meta.ground_z_m)
    truth = read_ground_truth(annotations, meta.classes)[0] if results else {}
    rules = options.allow_mismatch, options.allow_other_split, options.law
    scored = [score_result(name, path, truth, meta, *rules) for name, path in results.items()]
    tokens, seconds = file.column("token"), file.seconds_into_scene
    chosen = choose_frames(tokens, options.max_frames, scored, options.score_thr)
    root = Path(annotations).parent if options.data_root is None else options.data_root
    frames = []
    for index in chosen:
        sample = file[index]
        tilted = view.with_mounting(sample.ego_from_frame)
        frames.append(
            {
                "token": sample.token,
                "title": _title(sample.scene, seconds[index]),
                "scene": sample.scene,
                "place": sample.map_name,
                "truth": truth_of(sample, view),
                "found": [found_of(sample.token, result, view) for result in scored],
                "cameras": cameras_of(sample, tilted, root, options.image_width),
            }
        )
    notes = [f"{result.name}: {note}" for result in scored for note in result.notes]
    if len(chosen) < len(tokens):
        how = "evenly spread"
        if scored:
            rest = options.max_frames // 4
            which = f"the {rest} worst of {scored[0].name}"
            if len(scored) == 2:
                which = f"{rest} in which both results differ most"
            how = f"{len(chosen) - rest} evenly spread and {which}"
        notes.append(f"The page shows {len(chosen)} of {len(tokens)} frames: {how}.")
    return {
        "title": f"{meta.dataset} {meta.split}: {' and '.join(results) or 'ground truth'}",
        "notes": notes,
        "samples": len(tokens),
        "classes": [
            {"title": style.title(i), "colour": style.colour(i), "area": style.is_closed(i)}
            for i in range(len(meta.classes))
        ],
        "match_colours": MATCH_COLOURS,
        "extent": display_extent(BEVGrid(meta.x_range, meta.y_range), view),
        "vehicle": view.vehicle_m,
        "match_m": MATCH_M,
        "min_score": MIN_SCORE,
        "score": options.score_thr,
        "results": [result.name for result in scored],
        "tables": _tables(scored, truth, style, file, options) if scored else [],
        "curves": curves(scored, style) if scored else [],
        "reliability": reliability_curves(scored, truth, style),
        "frames": frames,
    }


def _title(scene: str, seconds: float) -> str:
    """Return what the page calls a sample."""
    return f"{scene}, {seconds:.1f} s"


def _tables(
    scored: Sequence[ScoredResult],
    truth: Mapping[str, MapElements],
    style: MapStyle,
    file: AnnotationFile,
    options: PageOptions,
) -> list[Table]:
    """Return the tables of one or two results, with intervals where there are several scenes."""
    scene_of = dict(zip(file.column("token"), file.column("scene"), strict=True))
    resamples = Resamples(scene_of) if len(set(scene_of.values())) > 1 else None
    tables = [summary_table(scored, resamples), *class_tables(scored, style)]
    if options.by == DISTANCE:
        near_and_far = [scored_by_distance(result, truth, file.meta) for result in scored]
        groups = distance_groups(near_and_far[0].reports[0].tokens)
        tables += group_tables(near_and_far, groups, DISTANCE)
    elif options.by:
        groups = read_groups(file.path, options.by)
        tables += group_tables(scored, groups, Path(options.by).name)
    if len(scored) == 2:
        pairs = zip(scene_of.items(), file.seconds_into_scene, strict=True)
        titles = {token: _title(scene, seconds) for (token, scene), seconds in pairs}
        tables.append(difference_table(scored, titles, options.score_thr))
    return tables


def page_html(data: Mapping[str, Any]) -> str:
    """Return the page: one file that fetches nothing and runs no script but its own.

    Args:
        data: From ``page_data``. Its texts are strangers' input: they stand in a block of JSON
            without a single ``<``, and the script shows them as text.
    """
    parts = {
        name: files("gsmap.visualization.page").joinpath(f"page.{name}").read_text("utf-8")
        for name in ("html", "css", "js")
    }
    frames, images = [], []
    for frame in data["frames"]:  # its images stand apart and are read when it is opened
        rows = [
            [{k: v for k, v in each.items() if k != "src"} for each in row]
            for row in frame["cameras"]
        ]
        frames.append({**frame, "cameras": rows})
        images.append([each["src"] for row in frame["cameras"] for each in row])
    style, script = (f"'sha256-{_digest(parts[name])}'" for name in ("css", "js"))
    return Template(parts["html"]).substitute(
        policy=f"default-src 'none'; img-src data:; style-src {style}; script-src {script}; "
        "base-uri 'none'; form-action 'none'",  # which default-src does not cover
        title=html.escape(str(data["title"])),
        style=parts["css"],
        script=parts["js"],
        data=_block({**data, "frames": frames}),
        images="".join(
            f'<script type="application/json" class="images">{_block(i)}</script>' for i in images
        ),
    )


def _block(value: Any) -> str:
    """Return JSON that cannot end the element it stands in."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def is_own_page(path: Path) -> bool:
    """Whether a file is a page that `write_page` has written."""
    with path.open("rb") as file:
        return _GENERATOR in file.read(_HEAD_BYTES)


def write_page(path: str | Path, data: Mapping[str, Any]) -> str:
    """Write the page.

    Args:
        path: The HTML file; parent folders are made.
        data: From ``page_data``.

    Returns:
        What was written, in words, with its size.
    """
    text = page_html(data)
    write_text(path, text)
    return f"{counted(len(data['frames']), 'frame')}, {len(text) / 1e6:.1f} MB: {path}"
