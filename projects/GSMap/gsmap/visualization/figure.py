"""Composition of cameras and bird's-eye views into one picture."""

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gsmap.datasets.image_files import decode_image, encode_jpeg
from gsmap.structures.elements import MapElements
from gsmap.structures.frames import FrameView
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.files import file_name, write_bytes
from gsmap.visualization.bev_view import BEVPanel, display_extent, draw_bev
from gsmap.visualization.camera_view import CameraView, arrange_cameras, draw_camera
from gsmap.visualization.style import FALSE_DASHES, MATCH_COLOURS, TRUTH_OPACITY, MapStyle

DPI = 220
"""Dots per inch: text of 6.5 points is legible in a picture that is displayed 800 px wide."""
_WIDTH = 1500  # width of the layout in px at DPI
# Options of Matplotlib by format. Metadata have no date, because it would differ between the files
# of equal figures.
_SAVE_OPTIONS: dict[str, dict[str, Any]] = {
    "png": {"metadata": {"Software": "gsmap"}, "pil_kwargs": {"compress_level": 4}},
    "jpg": {"pil_kwargs": {"quality": 92}},
    "webp": {"pil_kwargs": {"quality": 90}},
    "pdf": {"metadata": {"CreationDate": None}},
    "svg": {"metadata": {"Creator": "gsmap", "Date": None}},
}
FORMATS = tuple(_SAVE_OPTIONS)
_MARGIN = 26  # px at DPI, like all lengths of the layout
_GAP = 6  # between cameras
_HEADER = 84  # space for the title and the legend
_TICKS = 60  # space for the labels at the left of a panel and below it
_TITLE = 44  # space for the title of a panel
_USABLE = _WIDTH - 2 * _MARGIN
_PNG_IN_SVG = re.compile(rb"data:image/png;base64,([\w+/=\s]+)")
_RANDOM_TOKEN = re.compile(r"[0-9a-f]{16,}")
# Numbers with four or more decimals, of which two are kept. Factors in scale(...) do not match.
_LONG_NUMBER = re.compile(rb"(?<!scale\()\b(\d+\.\d\d)\d{2,}")
_TALLEST = 0.5 * _USABLE  # largest height of a row of cameras or a panel, in px at DPI
_LONGEST_TITLE = 88  # characters

Box = tuple[float, float, float, float]  # left, top, width, height in px, from the top left corner


def _row(aspects: Sequence[float], left: float, top: float, height: float, gap: float) -> list[Box]:
    """Place pictures side by side.

    Args:
        aspects: Width / height of each picture. (N,)
        left: Left edge of the first picture in px.
        top: Upper edge in px.
        height: Height of the pictures in px.
        gap: Distance between pictures in px.

    Returns:
        Boxes of the pictures. (N,)
    """
    boxes = []
    for aspect in aspects:
        boxes.append((left, top, height * aspect, height))
        left += height * aspect + gap
    return boxes


def _camera_boxes(rows: Sequence[Sequence[float]], width: float) -> tuple[list[Box], float]:
    """Place rows of pictures below the header, each row over the full width if it is not too tall.

    Args:
        rows: Width / height of the pictures of each row.
        width: Full width in px.

    Returns:
        Boxes of the pictures, row by row, and the lower edge of the last row with a gap, in px.
    """
    boxes = []
    top = float(_HEADER)
    for row in rows:
        gaps = _GAP * (len(row) - 1)
        height = min((width - gaps) / sum(row), _TALLEST)
        left = _MARGIN + (width - gaps - height * sum(row)) / 2
        boxes += _row(row, left=left, top=top, height=height, gap=_GAP)
        top += height + _GAP
    return boxes, top


def _layout(
    rows: Sequence[Sequence[float]], num_panels: int, aspect: float
) -> tuple[list[Box], list[Box], float]:
    """Place rows of cameras and panels: one panel beside the cameras, or a row of panels below.

    Args:
        rows: Width / height of the images of each row of cameras.
        num_panels: Number of panels.
        aspect: Width / height of the panels.

    Returns:
        Boxes of the cameras, boxes of the panels, and the lower edge of the whole layout in px.
    """
    if num_panels == 1 and len(rows) > 1:
        # Cameras of total width w have rows of total height slope * w + offset. The panel and its
        # frame have this height, so the panel has the width
        # aspect * (slope * w + offset - frame_height). Both widths and the labels fill the figure.
        slope = sum(1 / sum(row) for row in rows)
        offset = _GAP * (len(rows) - 1) - sum(_GAP * (len(row) - 1) / sum(row) for row in rows)
        frame_height = _TITLE + _TICKS  # above and below the panel
        # Part of the total width that does not depend on the width of the cameras: the labels
        # beside the panel with a margin, and the constant part of the panel's width.
        fixed_width = 1.3 * _TICKS + aspect * (offset - frame_height)
        camera_width = (_USABLE - fixed_width) / (1 + aspect * slope)
        camera_boxes, bottom = _camera_boxes(rows, camera_width)
        height = bottom - _GAP - _HEADER - frame_height
        left = _WIDTH - _MARGIN - height * aspect
        panel_box = (left, _HEADER + _TITLE, height * aspect, height)
        return camera_boxes, [panel_box], bottom - _GAP
    camera_boxes, top = _camera_boxes(rows, _USABLE)
    if not num_panels:
        return camera_boxes, [], top - _GAP
    slot = _USABLE / num_panels
    height = min((slot - _TICKS) / aspect, _TALLEST)
    width = height * aspect
    pitch = min(slot, width + 3 * _TICKS)  # from the left edge of a panel to the next one's
    gap = pitch - width
    total_width = pitch * num_panels - gap
    left = _MARGIN + (_USABLE - total_width + _TICKS) / 2  # centred, with the labels at the left
    panel_boxes = _row([aspect] * num_panels, left=left, top=top + _TITLE, height=height, gap=gap)
    return camera_boxes, panel_boxes, top + _TITLE + height + _TICKS


def _add_axes(figure: Figure, box: Box) -> Axes:
    """Add axes in a box of the layout."""
    left, top, width, height = box
    bottom = figure.get_figheight() * DPI - top - height
    scale = np.tile(figure.get_size_inches() * DPI, 2)  # width, height, width, height of the figure
    # Matplotlib takes shares of the figure's width and height, from the bottom left corner.
    shares = np.array([left, bottom, width, height]) / scale
    return figure.add_axes(tuple(shares))


def _legend_lines(
    maps: Sequence[MapElements | None], panels: Sequence[BEVPanel], style: MapStyle
) -> list[Line2D]:
    """Legend entries of all classes and kinds of matches in a figure."""
    labels: set[int] = set()
    for elements in maps:
        if elements:  # neither None nor empty
            labels.update(elements.labels.tolist())
    lines = []
    for label in sorted(labels):
        lines.append(Line2D([], [], color=style.colour(label), lw=2.6, label=style.title(label)))
    outcomes: list[str] = []  # "hit" and "false" of predictions, "found" and "missed" of truths
    for panel in panels:
        for panel_outcomes in panel.outcomes:
            outcomes += panel_outcomes
    for outcome, colour in MATCH_COLOURS.items():
        if outcome not in outcomes:
            continue
        is_truth = outcome in TRUTH_OPACITY  # the outcomes of ground truths alone have an opacity
        title = f"truth {outcome}" if is_truth else outcome
        line = Line2D([], [], color=colour, label=f"{title} ({outcomes.count(outcome)})")
        line.set(linewidth=1.8, linestyle=FALSE_DASHES if outcome == "false" else "-")
        if is_truth:
            line.set(linewidth=4.2, alpha=TRUTH_OPACITY[outcome], solid_capstyle="butt")
        lines.append(line)
    return lines


def _draw_header(figure: Figure, title: str, lines: Sequence[Line2D], style: MapStyle) -> None:
    """Draw the title and the legend below it."""
    width, height = figure.get_size_inches() * DPI
    margin = _MARGIN / width
    if len(title) > _LONGEST_TITLE:
        title = title[: _LONGEST_TITLE - 1] + "\N{HORIZONTAL ELLIPSIS}"
    # Names may contain dollar signs, which matplotlib would read as formulas.
    heading = figure.text(margin, 1 - 0.3 * _HEADER / height, title, size=9, va="center")
    heading.set(color=style.ink, parse_math=False)
    # A handle and the gap after an entry take about as much space as five letters.
    num_letters = sum(len(str(line.get_label())) + 5 for line in lines)
    legend = figure.legend(
        handles=lines,
        loc="center left",
        bbox_to_anchor=(margin, 1 - 0.75 * _HEADER / height),
        ncols=max(len(lines), 1),
        fontsize=round(min(8, 800 / max(num_letters, 1)), 1),  # all entries fit in one row
        labelcolor=style.ink,
        frameon=False,
        borderpad=0,
        borderaxespad=0,
        handlelength=1.4,
        columnspacing=1.4,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)


def compose_figure(
    cameras: Sequence[CameraView],
    panels: Sequence[BEVPanel],
    grid: BEVGrid,
    view: FrameView,
    style: MapStyle,
    camera_elements: MapElements | None = None,
    title: str = "",
    width_px: int = 1500,
) -> Figure:
    """Compose one picture of cameras, arranged as on the vehicle, and bird's-eye views.

    ``figure_to_rgb`` and ``save_figure`` render it.

    Args:
        cameras: Any number of cameras, or none.
        panels: Bird's-eye views, at least one if there is no camera.
        grid: Extent of the map in metres.
        view: Orientation and ground plane of the annotation frame.
        style: Colours and widths.
        camera_elements: Map elements that are drawn over the images.
        title: Heading, abbreviated if it is long.
        width_px: Width of the picture in pixels.

    Returns:
        Figure, not rendered yet.

    Raises:
        ValueError: If there are neither cameras nor panels.
    """
    if not cameras and not panels:
        raise InputError("compose_figure needs at least one camera or one panel.")
    rows = arrange_cameras(cameras, view)
    camera_aspects = []
    for row in rows:
        camera_aspects.append([camera.aspect for camera in row])
    left, right, low, high = display_extent(grid, view)
    panel_aspect = (right - left) / (high - low)
    camera_boxes, panel_boxes, bottom = _layout(
        camera_aspects, num_panels=len(panels), aspect=panel_aspect
    )
    # The layout is in px at DPI. Another number of dots per inch scales the whole figure.
    size_in = (_WIDTH / DPI, (bottom + _MARGIN / 2) / DPI)
    scale = width_px / _WIDTH
    figure = Figure(figsize=size_in, dpi=DPI * scale, facecolor="white")
    maps = [camera_elements, *(panel.elements for panel in panels)]
    legend = _legend_lines(maps, panels=panels, style=style)
    _draw_header(figure, title=title, lines=legend, style=style)
    for camera, box in zip(chain.from_iterable(rows), camera_boxes, strict=True):
        _, _, width, height = box
        draw_camera(
            _add_axes(figure, box),
            camera,
            elements=camera_elements,
            view=view,
            style=style,
            size_px=(max(round(width * scale), 1), max(round(height * scale), 1)),
        )
    for panel, box in zip(panels, panel_boxes, strict=True):
        draw_bev(_add_axes(figure, box), panel, grid=grid, view=view, style=style)
    return figure


def figure_to_rgb(figure: Figure) -> np.ndarray:
    """Render a figure as RGB. -> (h, w, 3) uint8"""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def sample_title(metainfo: Mapping[str, Any]) -> str:
    """Format the title of a sample: its scene, time and token.

    Args:
        metainfo: Metadata with ``scene``, ``seconds`` since the start of the scene, and ``token``.
            Missing entries are left out.

    Returns:
        Title, which may be empty.
    """
    seconds = metainfo.get("seconds")
    parts = [str(metainfo.get("scene") or "")]
    if seconds is not None:
        parts.append(f"{seconds:.2f} s")
    parts.append(str(metainfo.get("token") or ""))
    return "  \N{MIDDLE DOT}  ".join(part for part in parts if part)


def sample_name(metainfo: Mapping[str, Any], suffix: str) -> str:
    """Create a file name that sorts by scene and time and ends in the last letters of the token.

    The last letters are unique only in tokens that are random hexadecimal numbers of 16 digits or
    more. For other tokens, a digest of the token is appended. Without ``seconds``, the name is the
    token alone.

    Args:
        metainfo: Metadata with ``scene``, ``seconds`` since the start of the scene, and ``token``.
        suffix: Ending of the name, such as ``.jpg``.

    Returns:
        Name without a folder.
    """
    token = str(metainfo.get("token") or "")
    seconds = metainfo.get("seconds")
    if seconds is None:
        return file_name(token) + suffix
    scene = metainfo.get("scene") or "scene"
    name = file_name(f"{scene}_{seconds:07.2f}s_{token[-8:]}")
    # The name has the last 8 letters, which are all of a short token.
    if len(token) > 8 and not _RANDOM_TOKEN.fullmatch(token):
        digest = hashlib.sha256(token.encode(errors="surrogatepass")).hexdigest()
        name += f"-{digest[:8]}"
    return name + suffix


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write a figure to a file, which appears only when it is complete.

    Args:
        figure: Figure to render.
        path: File to write: pixels in ``.png``, ``.jpg`` and ``.webp``, vectors in ``.pdf`` and
            ``.svg``.

    Returns:
        Path of the file.

    Raises:
        ValueError: If the suffix is none of these.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip(".").replace("jpeg", "jpg")
    if kind not in FORMATS:
        raise InputError(
            f"Cannot write a picture to {path}: the name must end in one of {FORMATS}."
        )
    content = BytesIO()
    figure.savefig(content, format=kind, **_SAVE_OPTIONS[kind])
    picture = content.getvalue()
    if kind == "svg":
        picture = _compress_svg(picture)
    write_bytes(path, picture)
    return path


def _compress_svg(svg: bytes) -> bytes:
    """Reduce the size of an SVG by half: images as JPEG, two decimals, fewer blanks."""
    svg = _PNG_IN_SVG.sub(_jpeg_from_png, svg)
    svg = _LONG_NUMBER.sub(rb"\1", svg)
    # Remove the blanks and line breaks around the letters of path commands (move, line, curve).
    return re.sub(rb" \n([MLC]) ", rb"\1", svg)


def _jpeg_from_png(match: re.Match[bytes]) -> bytes:
    """Convert an image in an SVG, a PNG data URI, to a JPEG data URI."""
    pixels = decode_image(base64.b64decode(match[1]), path="an image", where="figure")
    jpeg = base64.b64encode(encode_jpeg(pixels, quality=65))
    return b"data:image/jpeg;base64," + jpeg
