"""Camera panels: a mosaic that mirrors the rig, and the map drawn over each image."""

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
from gsmap.visualization.camera_projection import project_polygon, project_segments, subdivided
from gsmap.visualization.style import MapStyle

_STEP_M = 2.0  # a line's width follows its depth in steps of this length
_WIDTH_STEP = 0.2  # widths differ by this share, so that lines are few paths
_NOMINAL_SIZE_IN = 2.4  # on a panel of this size (root of its area) lines have the style's widths


@dataclass(frozen=True)
class CameraView:
    """One camera's image and projection.

    Args:
        name: Channel name, such as ``CAM_FRONT_LEFT``.
        image: RGB, 0 to 255. (h, w, 3) uint8
        img_from_frame: Projection from the annotation frame to this image's pixels. (4, 4)

    Raises:
        ValueError: If the image has another shape or type.
    """

    name: str
    image: np.ndarray
    img_from_frame: np.ndarray

    def __post_init__(self) -> None:
        kind, shape = self.image.dtype, self.image.shape
        if len(shape) != 3 or shape[2] != 3 or kind != np.uint8:
            raise InputError(
                f"image of camera {self.name} must be RGB uint8 (h, w, 3), got {kind} {shape}."
            )

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the image."""
        return self.image.shape[1], self.image.shape[0]


Camera = TypeVar("Camera", CameraView, CameraRecord)


def camera_title(name: str) -> str:
    """Return a channel's name as a reader would write it."""
    words = name.lower().replace("_", " ").split()
    return " ".join(word for word in words if word not in ("cam", "ring", "camera"))


def camera_views(
    cameras: Sequence[CameraRecord], data_root: Path, token: str, grey: bool = False
) -> list[CameraView]:
    """Pair the images of a sample's records with their projections.

    Args:
        cameras: The cameras.
        data_root: Folder that their paths start from.
        token: The sample's, for messages.
        grey: Whether an image that is missing or damaged is grey instead of an error.

    Raises:
        BrokenSampleError: If an image is missing or damaged.
    """
    views = []
    for camera in cameras:
        path, where = data_root / camera.path, f"sample {token!r}, camera {camera.name}"
        try:
            image = read_image(str(path), where)[..., ::-1]
        except BrokenSampleError:
            if not grey:
                raise
            image = np.full((camera.height, camera.width, 3), 128, np.uint8)
        views.append(CameraView(camera.name, image, camera.img_from_frame))
    return views


def arrange_cameras(cameras: Sequence[Camera], view: FrameView) -> list[list[Camera]]:
    """Arrange cameras as on the car, left to right: looking ahead in a row, looking back below.

    A row without cameras is left out.
    """
    rows: tuple[list[Any], list[Any]] = [], []
    for camera in cameras:
        azimuth = viewing_azimuth(camera.img_from_frame, view)
        looks_back = abs(azimuth) > np.pi / 2 + 1e-3
        rows[looks_back].append((azimuth % (2 * np.pi) if looks_back else -azimuth, camera))
    return [[camera for _, camera in sorted(row, key=itemgetter(0))] for row in rows if row]


def _draw_areas(
    ax: Axes, elements: MapElements, camera: CameraView, view: FrameView, style: MapStyle
) -> None:
    """Fill the closed elements faintly."""
    closed = elements.select(np.array([style.is_closed(label) for label in elements.labels]))
    rings = (view.lift(line) for line in closed.polylines)
    shapes = [project_polygon(ring, camera.img_from_frame, camera.size_px) for ring in rings]
    faces = mcolors.to_rgba_array(style.colours(closed.labels), 0.25)
    ax.add_collection(PolyCollection(shapes, facecolors=faces, edgecolors="none", zorder=3))


def _draw_polylines(
    ax: Axes, elements: MapElements, camera: CameraView, view: FrameView, style: MapStyle
) -> None:
    """Draw the polylines, thinner with distance within what stays legible, on a dark edge."""
    dense = [subdivided(view.lift(line), _STEP_M) for line in elements.polylines]
    starts = np.concatenate([line[:-1] for line in dense])
    ends = np.concatenate([line[1:] for line in dense])
    owner = np.repeat(elements.labels, [len(line) - 1 for line in dense])
    segments, depth_m, index = project_segments(starts, ends, camera.img_from_frame, camera.size_px)
    box = ax.get_window_extent()
    scale = np.sqrt(box.width * box.height) / ax.figure.dpi / _NOMINAL_SIZE_IN
    level = np.rint(0.6 * np.log(10 / np.maximum(depth_m, 0.1)) / _WIDTH_STEP).astype(int)
    kinds, kind = np.unique(np.c_[owner[index], level], axis=0, return_inverse=True)
    parts = [segments[kind == i] for i in range(len(kinds))]  # one path per class and width
    codes = [Outline.MOVETO, Outline.LINETO]
    paths = [Outline(np.concatenate(part), codes * len(part)) for part in parts]
    thinning = np.exp(_WIDTH_STEP * kinds[:, 1]).clip(0.45, 2.6)
    widths = scale * style.camera_line_pt * thinning
    halo = mcolors.to_rgba(style.halo, 0.55)
    rounded: dict[str, Any] = {"facecolors": "none", "capstyle": "round", "joinstyle": "round"}
    for colour, extra, zorder in ((halo, 1.1, 4), (style.colours(kinds[:, 0]), 0.0, 5)):
        line = {"edgecolors": colour, "linewidths": widths + extra * scale, "zorder": zorder}
        ax.add_collection(PathCollection(paths, **line, **rounded))


def draw_camera(
    ax: Axes,
    camera: CameraView,
    elements: MapElements | None,
    view: FrameView,
    style: MapStyle,
    size_px: tuple[int, int],
) -> None:
    """Draw one image with the map over it.

    Args:
        ax: Axes to fill; it has the image's aspect ratio.
        camera: Image and projection.
        elements: Map elements, or None for the bare image.
        view: Ground plane of the frame.
        style: Colours and widths.
        size_px: Width and height of the axes on the canvas, to which the image is resampled.
    """
    width, height = camera.size_px
    method = cv2.INTER_AREA if size_px[0] < width else cv2.INTER_CUBIC
    image = cv2.resize(camera.image, size_px, interpolation=method)
    ax.imshow(image, extent=(0, width, height, 0), interpolation="nearest", zorder=1)
    if elements is not None and len(elements):
        _draw_areas(ax, elements, camera, view, style)
        _draw_polylines(ax, elements, camera, view, style)
    ax.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
    plate = {"boxstyle": "round,pad=0.3", "facecolor": (0, 0, 0, 0.5), "edgecolor": "none"}
    title = ax.text(0.014, 0.965, camera_title(camera.name), transform=ax.transAxes, zorder=8)
    title.set(fontsize=7, color="white", va="top", bbox=plate)
