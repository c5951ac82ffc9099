"""Composition of cameras and bird's-eye views into one picture, rendered or written."""

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

DPI = 220  # so that text of 6.5 points stays legible where a picture is shown 800 px wide
_WIDTH = 1500  # px at DPI, for which everything is laid out
_SAVE_OPTIONS: dict[str, dict[str, Any]] = {
    "png": {"pil_kwargs": {"compress_level": 4}},
    "jpg": {"pil_kwargs": {"quality": 92}},
    "webp": {"pil_kwargs": {"quality": 90}},
    "pdf": {"metadata": {"CreationDate": None}},
    "svg": {"metadata": {"Date": None}},
}
FORMATS = tuple(_SAVE_OPTIONS)
_MARGIN, _GAP, _HEADER, _TICKS, _TITLE = 26, 6, 84, 60, 44  # px at DPI
_USABLE = _WIDTH - 2 * _MARGIN
_PNG_IN_SVG = re.compile(rb"data:image/png;base64,([\w+/=\s]+)")
_RANDOM = re.compile(r"[0-9a-f]{16,}")
_LONG_NUMBER = re.compile(rb"(?<!scale\()\b(\d+\.\d\d)\d{2,}")
_TALLEST = 0.5 * _USABLE  # of a camera row or a BEV panel
_LONGEST_TITLE = 88  # characters

Box = tuple[float, float, float, float]  # left, top, width, height in px, from the top left corner


def _row(aspects: Sequence[float], left: float, top: float, height: float, gap: float) -> list[Box]:
    """Place pictures of these aspect ratios (width / height) side by side."""
    boxes = []
    for aspect in aspects:
        boxes.append((left, top, height * aspect, height))
        left += height * aspect + gap
    return boxes


def _camera_boxes(rows: Sequence[Sequence[float]], width: float) -> tuple[list[Box], float]:
    """Place rows of pictures, each as wide as all; return their boxes and the lower edge."""
    boxes, top = [], float(_HEADER)
    for row in rows:
        gaps = _GAP * (len(row) - 1)
        height = min((width - gaps) / sum(row), _TALLEST)
        left = _MARGIN + (width - gaps - height * sum(row)) / 2
        boxes += _row(row, left, top, height, _GAP)
        top += height + _GAP
    return boxes, top


def _layout(
    rows: Sequence[Sequence[float]], num_panels: int, aspect: float
) -> tuple[list[Box], list[Box], float]:
    """Place rows of cameras, one panel beside them or several in a centred row below.

    Returns the boxes of the cameras and of the panels, and the lower edge of all.
    """
    if num_panels == 1 and len(rows) > 1:
        # The cameras' height is slope * width + offset, so both heights agree at one width.
        slope = sum(1 / sum(row) for row in rows)
        offset = _GAP * (len(rows) - 1) - sum(_GAP * (len(row) - 1) / sum(row) for row in rows)
        frame = _TITLE + _TICKS  # px above and below the panel
        taken = 1.3 * _TICKS + aspect * (offset - frame)
        boxes, bottom = _camera_boxes(rows, (_USABLE - taken) / (1 + aspect * slope))
        height = bottom - _GAP - _HEADER - frame
        left = _WIDTH - _MARGIN - height * aspect
        return boxes, [(left, _HEADER + _TITLE, height * aspect, height)], bottom - _GAP
    boxes, top = _camera_boxes(rows, _USABLE)
    if not num_panels:
        return boxes, [], top - _GAP
    slot = _USABLE / num_panels
    height = min((slot - _TICKS) / aspect, _TALLEST)
    width = height * aspect
    pitch = min(slot, width + 3 * _TICKS)
    left = _MARGIN + (_USABLE - pitch * num_panels + pitch - width + _TICKS) / 2
    panels = _row([aspect] * num_panels, left, top + _TITLE, height, pitch - width)
    return boxes, panels, top + _TITLE + height + _TICKS


def _add_axes(figure: Figure, box: Box) -> Axes:
    """Add axes at a box."""
    left, top, width, height = box
    bottom = figure.get_figheight() * DPI - top - height
    scale = np.tile(figure.get_size_inches() * DPI, 2)
    return figure.add_axes(tuple(np.array([left, bottom, width, height]) / scale))


def _legend_lines(
    maps: Sequence[MapElements | None], panels: Sequence[BEVPanel], style: MapStyle
) -> list[Line2D]:
    """Return what the legend explains: the classes and the kinds of matches that are drawn."""
    classes = sorted({int(label) for elements in maps if elements for label in elements.labels})
    lines = [Line2D([], [], color=style.colour(i), lw=2.6, label=style.title(i)) for i in classes]
    fates = [fate for panel in panels for fate in chain(*panel.fates)]
    for fate, colour in MATCH_COLOURS.items():
        if fate in fates:
            title = f"truth {fate}" if fate in TRUTH_OPACITY else fate
            line = Line2D([], [], color=colour, label=f"{title} ({fates.count(fate)})")
            line.set(linewidth=1.8, linestyle=FALSE_DASHES if fate == "false" else "-")
            if fate in TRUTH_OPACITY:
                line.set(linewidth=4.2, alpha=TRUTH_OPACITY[fate], solid_capstyle="butt")
            lines.append(line)
    return lines


def _draw_header(figure: Figure, title: str, lines: Sequence[Line2D], style: MapStyle) -> None:
    """Write the title, and the legend below it."""
    width, height = figure.get_size_inches() * DPI
    margin = _MARGIN / width
    if len(title) > _LONGEST_TITLE:
        title = title[: _LONGEST_TITLE - 1] + "\N{HORIZONTAL ELLIPSIS}"
    figure.text(margin, 1 - 0.3 * _HEADER / height, title, size=9, color=style.ink, va="center")
    letters = sum(len(str(line.get_label())) + 5 for line in lines)
    text = {"fontsize": round(min(8, 800 / max(letters, 1)), 1), "labelcolor": style.ink}
    gaps = {"borderpad": 0, "borderaxespad": 0, "handlelength": 1.4, "columnspacing": 1.4}
    options: dict[str, Any] = {"ncols": max(len(lines), 1), "frameon": False, **text, **gaps}
    corner = margin, 1 - 0.75 * _HEADER / height
    figure.legend(handles=lines, loc="center left", bbox_to_anchor=corner, **options)


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
    """Compose one picture: cameras arranged as on the car, bird's-eye views in a row below.

    ``figure_to_rgb`` and ``save_figure`` render it.

    Args:
        cameras: Any number of cameras, also none.
        panels: Bird's-eye views, at least one if there is no camera.
        grid: Extent of the map in metres.
        view: Orientation and ground plane of the frame.
        style: Colours and widths.
        camera_elements: Map elements drawn over the images.
        title: Heading.
        width_px: Width of the picture.

    Raises:
        ValueError: If there is nothing to draw.
    """
    if not cameras and not panels:
        raise InputError("compose_figure needs at least one camera or one panel.")
    rows = arrange_cameras(cameras, view)
    aspects = [[c.size_px[0] / c.size_px[1] for c in row] for row in rows]
    left, right, low, high = display_extent(grid, view)
    aspect = (right - left) / (high - low)
    camera_boxes, panel_boxes, bottom = _layout(aspects, len(panels), aspect)
    size_in = _WIDTH / DPI, (bottom + _MARGIN / 2) / DPI
    scale = width_px / _WIDTH  # boxes are laid out for one width and the dots per inch follow
    figure = Figure(figsize=size_in, dpi=DPI * scale, facecolor="white")
    maps = [camera_elements, *(panel.elements for panel in panels)]
    _draw_header(figure, title, _legend_lines(maps, panels, style), style)
    for camera, box in zip(chain(*rows), camera_boxes, strict=True):
        size_px = max(round(box[2] * scale), 1), max(round(box[3] * scale), 1)
        draw_camera(_add_axes(figure, box), camera, camera_elements, view, style, size_px)
    for panel, box in zip(panels, panel_boxes, strict=True):
        draw_bev(_add_axes(figure, box), panel, grid, view, style)
    return figure


def figure_to_rgb(figure: Figure) -> np.ndarray:
    """Render a figure. Returns RGB (h, w, 3) uint8."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def sample_title(metainfo: Mapping[str, Any]) -> str:
    """Return a sample's scene, seconds into the scene, and token, as far as they are known."""
    token, seconds = str(metainfo.get("token") or ""), metainfo.get("seconds")
    parts = [metainfo.get("scene"), None if seconds is None else f"{seconds:.2f} s", token]
    return "  \N{MIDDLE DOT}  ".join(part for part in parts if part)


def sample_name(metainfo: Mapping[str, Any], suffix: str) -> str:
    """Return a file name that sorts by scene and time and ends in the last letters of the token.

    A token that is not a random number of 16 hexadecimal digits or more may end as another one
    does, so that its digest comes last.
    """
    token, seconds = str(metainfo.get("token") or ""), metainfo.get("seconds")
    if seconds is None:
        return file_name(token) + suffix
    name = file_name(f"{metainfo.get('scene') or 'scene'}_{seconds:07.2f}s_{token[-8:]}")
    if len(token) > 8 and not _RANDOM.fullmatch(token):
        name += f"-{hashlib.sha256(token.encode(errors='surrogatepass')).hexdigest()[:8]}"
    return name + suffix


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write a figure and return the path; the file appears only when it is whole.

    ``.png``, ``.jpg`` and ``.webp`` hold pixels, ``.pdf`` and ``.svg`` vectors.

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
    write_bytes(path, _compact(content.getvalue()) if kind == "svg" else content.getvalue())
    return path


def _compact(svg: bytes) -> bytes:
    """Shorten an SVG to its half: images as JPEG, long numbers with two decimals, fewer blanks."""
    svg = _LONG_NUMBER.sub(rb"\1", _PNG_IN_SVG.sub(_as_jpeg, svg))
    return re.sub(rb" \n([MLC]) ", rb"\1", svg)


def _as_jpeg(image: re.Match[bytes]) -> bytes:
    """Turn an image in an SVG from PNG to JPEG."""
    pixels = decode_image(base64.b64decode(image[1]), "an image", "figure")
    return b"data:image/jpeg;base64," + base64.b64encode(encode_jpeg(pixels, 65))
