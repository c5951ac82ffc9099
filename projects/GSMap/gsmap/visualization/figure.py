"""Composition of cameras and bird's-eye views into one picture, rendered or written."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gsmap.structures import BEVGrid
from gsmap.structures.elements import MapElements
from gsmap.utils.files import atomic_write
from gsmap.visualization.bev_view import BEVPanel, display_extent, draw_bev
from gsmap.visualization.camera_view import CameraView, arrange_cameras, draw_camera
from gsmap.visualization.frame_view import FrameView
from gsmap.visualization.style import MapStyle

DPI = 150
_WIDTH = 1500  # px at DPI, for which everything is laid out
VECTOR_SUFFIXES = (".pdf", ".svg")
RASTER_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
_MARGIN, _GAP, _HEADER, _TICKS, _TITLE = 26, 6, 52, 38, 34  # px at DPI
_LONGEST_TITLE = 66  # characters beside the legend of three classes
_TALLEST = 0.5  # of a camera row or a BEV panel, as a share of the figure's width


@dataclass(frozen=True)
class _Box:
    """A rectangle on the canvas, from the top left corner, in pixels."""

    x: float
    y: float
    width: float
    height: float


def _justified_rows(
    rows: Sequence[Sequence[float]], width: float, top: float
) -> tuple[list[list[_Box]], float]:
    """Place rows of pictures so that each fills the width at one height.

    Args:
        rows: Aspect ratios (width / height) of the pictures in each row.
        width: Width of the figure in pixels.
        top: Upper edge of the first row.

    Returns:
        The boxes of each row, and the lower edge of the last row.
    """
    usable, boxes = width - 2 * _MARGIN, []
    for row in rows:
        gaps = _GAP * (len(row) - 1)
        height = min((usable - gaps) / sum(row), _TALLEST * usable)
        x = _MARGIN + (usable - gaps - height * sum(row)) / 2
        placed = []
        for aspect in row:
            placed.append(_Box(x, top, height * aspect, height))
            x += height * aspect + _GAP
        boxes.append(placed)
        top += height + _GAP
    return boxes, top - _GAP if rows else top


def _panel_boxes(count: int, aspect: float, width: float, top: float) -> tuple[list[_Box], float]:
    """Place bird's-eye views in a centred row; return their boxes and the lower edge."""
    usable = width - 2 * _MARGIN
    slot = usable / count
    height = min((slot - _TICKS) / aspect, _TALLEST * usable)
    pitch = min(slot, height * aspect + 3 * _TICKS)
    left = _MARGIN + (usable - pitch * count) / 2
    boxes = [
        _Box(
            left + i * pitch + (pitch - height * aspect + _TICKS) / 2,
            top + _TITLE,
            height * aspect,
            height,
        )
        for i in range(count)
    ]
    return boxes, top + _TITLE + height + _TICKS


def _side_boxes(
    rows: Sequence[Sequence[float]], aspect: float, width: float, top: float
) -> tuple[list[list[_Box]], list[_Box], float]:
    """Place one bird's-eye view to the right of the cameras, as high as they are together.

    The cameras' height grows linearly with the width that they get, ``slope * width + offset``, so
    the width at which both heights agree has a closed form.
    """
    usable = width - 2 * _MARGIN
    slope = sum(1 / sum(row) for row in rows)
    offset = _GAP * (len(rows) - 1) - sum(_GAP * (len(row) - 1) / sum(row) for row in rows)
    frame = _TITLE + _TICKS  # px above and below the panel
    taken = 2 * _TICKS + aspect * (offset - frame)
    camera_width = (usable - taken) / (1 + aspect * slope)
    boxes, bottom = _justified_rows(rows, camera_width + 2 * _MARGIN, top)
    height = bottom - top - frame
    left = width - _MARGIN - height * aspect
    return boxes, [_Box(left, top + _TITLE, height * aspect, height)], bottom


def _layout(
    rows: Sequence[Sequence[float]], num_panels: int, grid: BEVGrid, view: FrameView
) -> tuple[list[list[_Box]], list[_Box], float]:
    """Place all pictures: a single panel beside the cameras, several below them.

    Args:
        rows: Aspect ratios (width / height) of the cameras in each row.
        num_panels: Number of bird's-eye views.
        grid: Extent of the map.
        view: Orientation of the frame.

    Returns:
        The boxes of the camera rows and of the panels, and the lower edge of all.
    """
    left, right, low, high = display_extent(grid, view)
    aspect = (right - left) / (high - low)
    if num_panels == 1 and len(rows) > 1:
        return _side_boxes(rows, aspect, _WIDTH, _HEADER)
    boxes, bottom = _justified_rows(rows, _WIDTH, _HEADER)
    if not num_panels:
        return boxes, [], bottom
    top = bottom + (_GAP if rows else 0)
    return boxes, *_panel_boxes(num_panels, aspect, _WIDTH, top)


def _add_axes(figure: Figure, box: _Box) -> Axes:
    """Add axes at a box given in pixels from the top left corner."""
    width, height = figure.get_size_inches() * DPI
    return figure.add_axes(
        (box.x / width, 1 - (box.y + box.height) / height, box.width / width, box.height / height)
    )


def _draw_header(figure: Figure, title: str, style: MapStyle) -> None:
    """Write the title on the left and the legend of classes on the right."""
    width, height = figure.get_size_inches() * DPI
    if len(title) > _LONGEST_TITLE:
        title = title[: _LONGEST_TITLE - 1] + "\N{HORIZONTAL ELLIPSIS}"
    figure.text(
        _MARGIN / width, 1 - _HEADER / 2 / height, title, fontsize=9, color=style.ink, va="center"
    )
    handles = [
        Line2D(
            [],
            [],
            color=style.colour(i),
            linewidth=2.6,
            solid_capstyle="round",
            label=style.title(i),
        )
        for i in range(len(style.classes))
    ]
    figure.legend(
        handles=handles,
        loc="center right",
        bbox_to_anchor=(1 - _MARGIN / width, 1 - _HEADER / 2 / height),
        ncols=len(handles),
        frameon=False,
        fontsize=8,
        labelcolor=style.ink,
        borderaxespad=0,
        handlelength=1.4,
        columnspacing=1.6,
    )


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

    Args:
        cameras: Any number of cameras, also none.
        panels: Bird's-eye views, at least one if there is no camera.
        grid: Extent of the map in metres.
        view: Orientation and ground plane of the frame.
        style: Colours and widths.
        camera_elements: Map elements drawn over the images.
        title: Heading.
        width_px: Width of the picture in pixels.

    Returns:
        The figure; ``figure_to_rgb`` and ``save_figure`` render it.

    Raises:
        ValueError: If there is nothing to draw.
    """
    if not cameras and not panels:
        raise ValueError("compose_figure needs at least one camera or one panel.")
    scale = _WIDTH / width_px  # boxes are laid out for one width and the dots per inch follow
    rows = arrange_cameras(cameras, view)
    aspects = [[c.image.shape[1] / c.image.shape[0] for c in row] for row in rows]
    camera_boxes, panel_boxes, bottom = _layout(aspects, len(panels), grid, view)
    figure = Figure(
        figsize=(_WIDTH / DPI, (bottom + _MARGIN / 2) / DPI), dpi=DPI / scale, facecolor="white"
    )
    FigureCanvasAgg(figure)
    with matplotlib.rc_context({"font.family": style.font_family}):
        _draw_header(figure, title, style)
        for row, boxes in zip(rows, camera_boxes, strict=True):
            for camera, box in zip(row, boxes, strict=True):
                size_px = (max(round(box.width / scale), 1), max(round(box.height / scale), 1))
                draw_camera(_add_axes(figure, box), camera, camera_elements, view, style, size_px)
        for panel, box in zip(panels, panel_boxes, strict=True):
            draw_bev(_add_axes(figure, box), panel, grid, view, style)
    return figure


def figure_to_rgb(figure: Figure) -> np.ndarray:
    """Render a figure. Returns RGB (h, w, 3) uint8."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write a figure; the file appears only when it is whole.

    Args:
        figure: What to write.
        path: ``.png``, ``.jpg`` or ``.webp`` for pixels, ``.pdf`` or ``.svg`` for vectors.

    Returns:
        The path.

    Raises:
        ValueError: If the suffix is none of these.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in VECTOR_SUFFIXES + RASTER_SUFFIXES:
        raise ValueError(
            f"Cannot write a picture to {path}: "
            f"the name must end in one of {VECTOR_SUFFIXES + RASTER_SUFFIXES}."
        )
    with atomic_write(path, "wb") as file:
        if suffix in VECTOR_SUFFIXES:
            undated = {"CreationDate": None} if suffix == ".pdf" else {"Date": None}
            figure.savefig(file, format=suffix[1:], metadata=undated)
        else:
            file.write(_encode_pixels(figure_to_rgb(figure), suffix))
    return path


def _encode_pixels(picture: np.ndarray, suffix: str) -> bytes:
    """Encode an RGB picture."""
    options = {
        ".png": [cv2.IMWRITE_PNG_COMPRESSION, 4],
        ".webp": [cv2.IMWRITE_WEBP_QUALITY, 90],
    }.get(suffix, [cv2.IMWRITE_JPEG_QUALITY, 92])
    good, encoded = cv2.imencode(suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)
    if not good:
        raise ValueError(f"OpenCV could not encode a picture as {suffix}.")
    return encoded.tobytes()
