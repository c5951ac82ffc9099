"""Camera panels: images arranged as on the vehicle, with the map drawn over them."""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from matplotlib import colors as mcolors
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection, PolyCollection
from matplotlib.path import Path as Outline

from gsmap.datasets.annotations.record import CameraRecord
from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.image_files import read_image
from gsmap.structures.elements import MapElements
from gsmap.structures.frames import FrameView, viewing_azimuth
from gsmap.utils.errors import InputError
from gsmap.visualization.camera_projection import project_polygon, project_segments, subdivide
from gsmap.visualization.style import MapStyle

_STEP_M = 2.0  # largest length of a segment; each is drawn with one depth and one line width
# Natural logarithm of the ratio of successive line widths. Widths are rounded to such steps,
# because all segments of a class with equal widths are drawn together, as one path.
_WIDTH_STEP = 0.2
_NOMINAL_SIZE_IN = 2.4  # square root of the area of a panel on which line widths are not scaled
# Arguments of matplotlib for paths without filled area.
_OPEN_PATHS: dict[str, Any] = {"facecolors": "none", "capstyle": "round", "joinstyle": "round"}


@dataclass(frozen=True)
class CameraView:
    """Image and projection of one camera.

    Args:
        name: Channel name, such as ``CAM_FRONT_LEFT``.
        image: RGB, 0 to 255. (h, w, 3) uint8
        img_from_frame: Projection from metres in the annotation frame to pixels. (4, 4)

    Raises:
        ValueError: If the image has another shape or type.
    """

    name: str
    image: np.ndarray
    img_from_frame: np.ndarray

    def __post_init__(self) -> None:
        kind = self.image.dtype
        shape = self.image.shape
        if len(shape) != 3 or shape[2] != 3 or kind != np.uint8:
            raise InputError(
                f"image of camera {self.name} must be RGB uint8 (h, w, 3), got {kind} {shape}."
            )

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.image.shape[1], self.image.shape[0]

    @property
    def aspect(self) -> float:
        """Width over height of the image."""
        width, height = self.size_px
        return width / height


Camera = TypeVar("Camera", CameraView, CameraRecord)  # both have `img_from_frame`


def camera_title(name: str) -> str:
    """Name of a channel in plain words, such as ``front left``."""
    words = name.lower().replace("_", " ").split()
    return " ".join(word for word in words if word not in ("cam", "ring", "camera"))


def camera_views(
    cameras: Sequence[CameraRecord], data_root: Path, token: str, grey: bool = False
) -> list[CameraView]:
    """Read the images of the cameras of a sample.

    Args:
        cameras: Cameras of the sample.
        data_root: Folder that image paths are relative to.
        token: Token of the sample, for messages.
        grey: Whether a missing or damaged image is replaced by a grey one.

    Returns:
        Images with their projections, in the order of the cameras.

    Raises:
        BrokenSampleError: If an image is missing or damaged, and ``grey`` is False.
    """
    views = []
    for camera in cameras:
        where = f"sample {token!r}, camera {camera.name}"
        try:
            size = (camera.width, camera.height)  # the intrinsics are for this size
            image = read_image(str(data_root / camera.path), where, size)[..., ::-1]  # BGR to RGB
        except BrokenSampleError:
            if not grey:
                raise
            image = np.full((camera.height, camera.width, 3), 128, np.uint8)
        views.append(CameraView(camera.name, image, camera.img_from_frame))
    return views


def arrange_cameras(cameras: Sequence[Camera], view: FrameView) -> list[list[Camera]]:
    """Arrange cameras as on the vehicle, from left to right.

    Args:
        cameras: Cameras in any order.
        view: Orientation of the annotation frame.

    Returns:
        A row of the cameras that look ahead and a row of the cameras that look back, without
        empty rows.
    """
    # Sort key that increases from left to right, and camera.
    looking_ahead: list[tuple[float, Camera]] = []
    looking_back: list[tuple[float, Camera]] = []
    for camera in cameras:
        # Angle from straight ahead in (-pi, pi], positive to the left.
        azimuth = viewing_azimuth(camera.img_from_frame, view)
        # The tolerance lets a camera that looks exactly sideways count as looking ahead.
        if abs(azimuth) > np.pi / 2 + 1e-3:
            # In [0, 2 pi), the angle runs from pi / 2 (left) over pi (back) to 3 pi / 2 (right).
            looking_back.append((azimuth % (2 * np.pi), camera))
        else:
            looking_ahead.append((-azimuth, camera))
    rows = []
    for row in (looking_ahead, looking_back):
        if row:
            row.sort(key=itemgetter(0))
            rows.append([camera for _, camera in row])
    return rows


def _draw_areas(
    ax: Axes, elements: MapElements, camera: CameraView, view: FrameView, style: MapStyle
) -> None:
    """Fill the areas of closed elements with a faint colour.

    `FrameView.lift` adds the height of the ground plane to points. `project_polygon` returns the
    visible part of an area in pixels, which may be empty.
    """
    is_closed = np.array([style.is_closed(label) for label in elements.labels])
    closed = elements.select(is_closed)
    shapes = []
    for ring in closed.polylines:
        shape = project_polygon(
            view.lift(ring), img_from_frame=camera.img_from_frame, size_px=camera.size_px
        )
        shapes.append(shape)
    faces = mcolors.to_rgba_array(style.colours(closed.labels), 0.25)
    ax.add_collection(PolyCollection(shapes, facecolors=faces, edgecolors="none", zorder=3))


def _draw_polylines(
    ax: Axes, elements: MapElements, camera: CameraView, view: FrameView, style: MapStyle
) -> None:
    """Draw polylines with a dark outline. Lines far away are thinner, but still legible.

    `subdivide` inserts vertices, so that no segment is longer than `_STEP_M`.
    """
    starts = []
    ends = []
    num_segments = []
    for line in elements.polylines:
        dense = subdivide(view.lift(line), _STEP_M)
        starts.append(dense[:-1])
        ends.append(dense[1:])
        num_segments.append(len(dense) - 1)
    segment_labels = np.repeat(elements.labels, num_segments)
    # The m visible parts of the segments in pixels (m, 2, 2), the depth of each part, and the index
    # of its segment.
    segments, depth_m, segment_index = project_segments(
        np.concatenate(starts),
        np.concatenate(ends),
        img_from_frame=camera.img_from_frame,
        size_px=camera.size_px,
    )
    box = ax.get_window_extent()  # panel in pixels of the canvas
    # Side of a square with the area of the panel in inches, relative to the nominal side.
    scale = np.sqrt(box.width * box.height) / ax.figure.dpi / _NOMINAL_SIZE_IN
    nearness = np.log(10 / np.maximum(depth_m, 0.1))  # 0 at 10 m
    # Widths are proportional to depth to the power of -0.6, in steps of _WIDTH_STEP.
    width_level = np.rint(0.6 * nearness / _WIDTH_STEP).astype(int)
    # All segments of one class and one width make one path, so that few paths are drawn.
    pairs = np.c_[segment_labels[segment_index], width_level]  # (m, 2)
    distinct_pairs, pair_of_segment = np.unique(pairs, axis=0, return_inverse=True)
    paths = []
    for pair in range(len(distinct_pairs)):
        path_segments = segments[pair_of_segment == pair]  # (k, 2, 2)
        codes = [Outline.MOVETO, Outline.LINETO] * len(path_segments)
        paths.append(Outline(np.concatenate(path_segments), codes))
    width_factors = np.exp(_WIDTH_STEP * distinct_pairs[:, 1]).clip(0.45, 2.6)
    widths = scale * style.camera_line_pt * width_factors
    outlines = PathCollection(
        paths,
        edgecolors=mcolors.to_rgba(style.halo, 0.55),
        linewidths=widths + 1.1 * scale,
        **_OPEN_PATHS,
    )
    lines = PathCollection(
        paths, edgecolors=style.colours(distinct_pairs[:, 0]), linewidths=widths, **_OPEN_PATHS
    )
    outlines.set_zorder(4)
    lines.set_zorder(5)
    ax.add_collection(outlines)
    ax.add_collection(lines)


def draw_camera(
    ax: Axes,
    camera: CameraView,
    elements: MapElements | None,
    view: FrameView,
    style: MapStyle,
    size_px: tuple[int, int],
) -> None:
    """Draw the image of a camera with the map over it.

    Args:
        ax: Axes with the aspect ratio of the image, which are filled.
        camera: Image and projection.
        elements: Map elements in the annotation frame, or None for the image alone.
        view: Ground plane of the annotation frame.
        style: Colours and widths.
        size_px: Width and height of the axes on the canvas in pixels, to which the image is
            resampled.
    """
    width, height = camera.size_px
    # INTER_AREA averages pixels, which is best for a smaller image.
    method = cv2.INTER_AREA if size_px[0] < width else cv2.INTER_CUBIC
    image = cv2.resize(camera.image, size_px, interpolation=method)
    # The axes keep the pixels of the camera as their unit, so that projected points fit.
    ax.imshow(image, extent=(0, width, height, 0), interpolation="nearest", zorder=1)
    if elements is not None and len(elements):
        _draw_areas(ax, elements, camera=camera, view=view, style=style)
        _draw_polylines(ax, elements, camera=camera, view=view, style=style)
    ax.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
    # Title in the upper left corner, on a dark plate.
    plate = {"boxstyle": "round,pad=0.3", "facecolor": (0, 0, 0, 0.5), "edgecolor": "none"}
    title = ax.text(0.014, 0.965, camera_title(camera.name), transform=ax.transAxes, zorder=8)
    title.set(fontsize=7, color="white", va="top", bbox=plate)
