"""Bird's-eye-view panels with a metric grid, the ego vehicle and map elements; ahead is up.

Coordinates in the display are metres to the right and metres ahead of the vehicle.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib import colors as mcolors
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.patches import FancyBboxPatch, Polygon
from matplotlib.path import Path
from matplotlib.patheffects import withStroke

from gsmap.structures.elements import MapElements
from gsmap.structures.frames import FrameView
from gsmap.structures.grid import BEVGrid
from gsmap.visualization.style import FALSE_DASHES, MATCH_COLOURS, TRUTH_OPACITY, MapStyle

_SCORE_PT = 6.5  # font size of scores
# Control points of four Bezier curves that approximate the unit circle within 0.03 %. (13, 2)
# Points are complex numbers x + iy, so that a factor of i turns them by a quarter of the circle.
_HANDLE = 4 / 3 * (np.sqrt(2) - 1)  # distance of an inner control point from its end point
_FIRST_QUARTER = np.array([1, 1 + 1j * _HANDLE, _HANDLE + 1j])
# Factors that turn the first quarter by 0 to 4 quarters of the circle: 1, i, -1, -i, and 1 again.
_TURNS = 1j ** np.arange(5)
_QUARTERS = _FIRST_QUARTER * _TURNS[:, None]  # (5, 3)
# The points of four quarters, and the first point of the fifth one, which closes the circle.
_CIRCLE = _QUARTERS.ravel()[:13].view(np.float64).reshape(13, 2)
_CIRCLE_CODES = [Path.MOVETO, *[Path.CURVE4] * 12]


@dataclass(frozen=True)
class BEVPanel:
    """Content of one bird's-eye-view panel.

    Args:
        title: Heading of the panel.
        elements: Map elements in the annotation frame, or None for an empty panel.
        note: Text of a panel without elements.
        lines: Whether to draw the polylines.
        vertices: Whether to mark the vertices.
        order: Whether to mark the start and the direction of each polyline.
        gaussians: Whether to draw the Gaussian of each vertex as its 1-sigma ellipse.
        scores: Whether to write the scores.
        rasters: Occupancy in [0, 1] of each element on the rows and columns of ``BEVGrid``. The
            picture of the rasters covers the background. (N, H, W)
        points: Points in metres in the annotation frame, such as a LiDAR sweep, drawn as faint
            dots. (n, >= 2)
        truth: Ground truth, drawn in broad lines under the elements and coloured by its matches.
        hits: Index of the ground truth matched with each element, or -1 for a false prediction. The
            elements then have the colours of matches instead of classes. None without matches. (N,)
        colours: Colour of each element, instead of the colour of its class. (N,)
    """

    title: str
    elements: MapElements | None
    note: str = "no elements"
    lines: bool = True
    vertices: bool = False
    order: bool = False
    gaussians: bool = False
    scores: bool = False
    rasters: np.ndarray | None = None
    points: np.ndarray | None = None
    truth: MapElements | None = None
    hits: np.ndarray | None = None
    colours: Sequence[str] = ()

    @property
    def outcomes(self) -> tuple[list[str], list[str]]:
        """Kinds of matches, keys of ``MATCH_COLOURS``.

        Returns:
            Two lists: ``hit`` or ``false`` for each element (N,), empty if ``hits`` is None; and
            ``found`` or ``missed`` for each ground truth (K,), empty if ``truth`` is None.
        """
        hits: Sequence[int] = () if self.hits is None else self.hits.tolist()
        outcomes = ["hit" if hit >= 0 else "false" for hit in hits]
        num_truths = len(self.truth or ())
        truth_outcomes = ["found" if index in hits else "missed" for index in range(num_truths)]
        return outcomes, truth_outcomes


def display_extent(grid: BEVGrid, view: FrameView) -> tuple[float, float, float, float]:
    """Compute the extent of a grid in the display, where x points to the right and y ahead.

    Args:
        grid: Extent of the map in the annotation frame.
        view: Orientation of the annotation frame.

    Returns:
        Left, right, bottom and top in metres.
    """
    x0, x1 = grid.x_range
    y0, y1 = grid.y_range
    corners = view.display_from_frame(np.array([[x0, y0], [x1, y1]]))
    left, bottom = corners.min(axis=0).tolist()
    right, top = corners.max(axis=0).tolist()
    return left, right, bottom, top


def _ticks(low: float, high: float) -> tuple[np.ndarray, list[str]]:
    """Multiples of 10 m (5 m on a small map) between two bounds in metres, and their labels.

    The last label also has the unit. A map without a multiple has no labels.
    """
    step = 10 if high - low > 20 else 5
    positions = np.arange(np.ceil(low / step) * step, high + 1e-6, step)
    labels = [f"{position:g}".replace("-", "\N{MINUS SIGN}") for position in positions]
    if labels:
        labels[-1] += " m"
    return positions, labels


def _draw_background(
    ax: Axes, points: np.ndarray | None, grid: BEVGrid, view: FrameView, style: MapStyle
) -> None:
    """Draw the metric grid, its labels on the left and at the bottom, and LiDAR points if given."""
    left, right, bottom, top = display_extent(grid, view)
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", facecolor=style.ground)
    x_positions, x_labels = _ticks(left, right)
    y_positions, y_labels = _ticks(bottom, top)
    ax.set_xticks(x_positions, x_labels)
    ax.set_yticks(y_positions, y_labels)
    ax.grid(True, color=style.grid, linewidth=0.6, zorder=0)
    ax.set_axisbelow(True)
    ax.tick_params(length=0, labelsize=6.5, colors=style.muted, pad=2)
    ax.spines[:].set(color=style.grid, linewidth=0.8)
    if points is not None and len(points):
        x, y = view.display_from_frame(points).T
        ax.scatter(x, y, s=0.25, c="#9AA3AE", alpha=0.55, linewidths=0, zorder=2)


def _draw_vehicle(ax: Axes, view: FrameView) -> None:
    """Draw the ego vehicle to scale, with its windscreen towards the road ahead."""
    # The display has the vehicle around x = 0, from y = rear to y = front.
    rear, front, width = view.vehicle_m
    length = front - rear
    half_width = width / 2
    pad = 0.35  # the box style adds this padding on each side
    body = FancyBboxPatch(
        (-half_width + pad, rear + pad),
        width=width - 2 * pad,
        height=length - 2 * pad,
        boxstyle=f"round,pad={pad},rounding_size=0.55",
    )
    body.set(facecolor="#3A4452", edgecolor="white", linewidth=0.9, zorder=30)
    glass_top = front - 0.30 * length
    glass_bottom = glass_top - 0.62
    top_x = 0.72 * half_width
    bottom_x = 0.55 * half_width
    windscreen = [
        (-top_x, glass_top),
        (top_x, glass_top),
        (bottom_x, glass_bottom),
        (-bottom_x, glass_bottom),
    ]
    ax.add_patch(body)
    ax.add_patch(Polygon(windscreen, facecolor="#D5E3F2", edgecolor="none", zorder=31))


def draw_lines(
    ax: Axes,
    lines: list[np.ndarray],
    labels: np.ndarray,
    style: MapStyle,
    colours: Sequence[Any],
    width_pt: float,
    zorder: float = 10,
    outcomes: Sequence[str] = (),
) -> None:
    """Draw polylines, and fill the elements of closed classes. False predictions are dashed.

    Args:
        ax: Axes to draw on.
        lines: Polylines in metres in the display. each (n, 2)
        labels: Class index of each polyline. (N,)
        style: Style that defines the closed classes.
        colours: Colour of each polyline. (N,)
        width_pt: Width of the lines in points.
        zorder: Drawing order of the lines. Higher values are drawn later, on top.
        outcomes: ``hit`` or ``false`` for each polyline (N,); empty for no dashed lines.
    """
    shapes = []
    faces = []  # colours of the areas
    for line, label, colour in zip(lines, labels, colours, strict=True):
        if style.is_closed(label):
            shapes.append(line)
            faces.append((*mcolors.to_rgb(colour), 0.2))
    ax.add_collection(PolyCollection(shapes, facecolors=faces, edgecolors="none", zorder=4))
    line_styles = [FALSE_DASHES if outcome == "false" else "-" for outcome in outcomes]
    strokes = LineCollection(
        lines, colors=colours, linewidths=width_pt, linestyles=line_styles or "-"
    )
    strokes.set(joinstyle="round", zorder=zorder)
    ax.add_collection(strokes)


def _draw_order(ax: Axes, lines: list[np.ndarray], colours: list[str]) -> None:
    """Mark the first vertex of each line with a ring, and the direction with an arrow head."""
    starts = np.array([line[0] for line in lines]).reshape(-1, 2)  # (N, 2)
    x, y = starts.T
    ax.scatter(x, y, s=13, facecolors="white", edgecolors=colours, linewidths=1.0, zorder=13)
    for line, colour in zip(lines, colours, strict=True):
        if len(line) < 2:  # a single vertex has no direction
            continue
        middle = len(line) // 2
        head = {
            "arrowstyle": "-|>",
            "lw": 0,
            "mutation_scale": 8.5,
            "shrinkA": 0,
            "shrinkB": 0,
            "color": colour,
        }
        ax.annotate(
            "", xy=tuple(line[middle]), xytext=tuple(line[middle - 1]), arrowprops=head, zorder=13
        )


def _draw_gaussians(ax: Axes, elements: MapElements, view: FrameView, style: MapStyle) -> None:
    """Draw each Gaussian as the ellipse at one standard deviation."""
    assert elements.scales is not None
    assert elements.rotations is not None
    centres = view.display_from_frame(elements.points)  # (M, 2)
    angles = elements.rotations + view.display_turn_rad
    cos = np.cos(angles)
    sin = np.sin(angles)
    axes = np.stack([cos, sin, -sin, cos], axis=-1).reshape(-1, 2, 2)  # one axis per row
    half_axes = elements.scales[..., None] * axes  # (M, 2, 2)
    # A point (a, b) of the unit circle becomes a * first half axis + b * second half axis.
    outlines = _CIRCLE @ half_axes + centres[:, None]  # (M, 13, 2)
    ellipses = [Path(outline, _CIRCLE_CODES) for outline in outlines]
    paths = []  # one path per element
    for start, end in pairwise(elements.offsets.tolist()):
        paths.append(Path.make_compound_path(*ellipses[start:end]))
    colours = style.colours(elements.labels)
    shapes = PathCollection(paths, facecolors=mcolors.to_rgba_array(colours, 0.4), zorder=11)
    shapes.set(edgecolors=colours, linewidths=0.4)
    ax.add_collection(shapes)


def _draw_scores(
    ax: Axes, lines: list[np.ndarray], scores: np.ndarray, colours: list[str], view: FrameView
) -> None:
    """Write each score at the free vertex nearest to the middle of its element, if any is free.

    A vertex is free if its text overlaps neither the border, nor the vehicle, nor the score of a
    more confident element.
    """
    left, right = ax.get_xlim()
    bottom, top = ax.get_ylim()
    low = np.array([left, bottom])
    high = np.array([right, top])
    rear, front, width = view.vehicle_m
    font_px = _SCORE_PT / 72 * ax.figure.dpi  # a point is 1/72 inch
    font_m = font_px * (top - bottom) / ax.get_window_extent().height
    half_size = font_m * np.array([1.4, 0.6])  # half width and height of a text such as 0.87
    vehicle_centre = np.array([0, (rear + front) / 2])
    vehicle_size = np.array([width, front - rear])
    obstacles = [vehicle_centre]
    # A text is clear of an obstacle if their centres are farther apart than this along x or y.
    clearances = [half_size + vehicle_size / 2]
    for index in np.argsort(-scores, kind="stable"):  # the most confident element first
        line = lines[index]
        from_middle = np.abs(np.arange(len(line)) - len(line) // 2)
        candidates = line[np.argsort(from_middle, kind="stable")]
        # Each text is centred on its vertex, so it needs half of its size on every side.
        is_inside = (candidates > low + half_size) & (candidates < high - half_size)
        distances = np.abs(candidates[:, None] - obstacles)  # (P, obstacles, 2)
        clears_obstacle = (distances > clearances).any(axis=2)  # (P, obstacles)
        is_clear = clears_obstacle.all(axis=1)
        is_free = is_inside.all(axis=1) & is_clear
        if not is_free.any():
            continue
        position = candidates[is_free.argmax()]
        obstacles.append(position)
        clearances.append(2 * half_size)  # half of each of two texts
        x, y = position
        text = ax.text(x, y, f"{scores[index]:.2f}", ha="center", va="center", zorder=20)
        darker_colour = 0.62 * np.array(mcolors.to_rgb(colours[index]))
        text.set(fontsize=_SCORE_PT, color=darker_colour)
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])


def raster_picture(rasters: np.ndarray, labels: np.ndarray, style: MapStyle) -> np.ndarray:
    """Blend the occupancies of elements into one picture.

    Classes are painted over white one after another. The opacity of a class at a pixel is the
    largest occupancy of its elements.

    Args:
        rasters: Occupancy of each element, in [0, 1]. (N, H, W)
        labels: Class index of each element. (N,)
        style: Colours of the classes.

    Returns:
        RGB in [0, 1]. (H, W, 3)
    """
    picture = np.ones((*rasters.shape[1:], 3))
    for label in np.unique(labels):
        cover = rasters[labels == label].max(axis=0)[..., None]  # (H, W, 1)
        picture = picture * (1 - cover) + cover * mcolors.to_rgb(style.colour(label))
    return picture.clip(0, 1)


def _draw_rasters(ax: Axes, picture: np.ndarray, view: FrameView) -> None:
    """Draw the picture of the rasters in place of the background."""
    if view.forward == "x":
        # The rows of the picture run along y (left), and its columns along x (ahead). The display
        # has x upwards and -y to the right, so the axes are swapped and the columns reversed.
        picture = picture.transpose(1, 0, 2)[:, ::-1]
    # `_draw_background` has set the limits of the axes to the extent of the map, as in the rasters.
    extent = (*ax.get_xlim(), *ax.get_ylim())
    ax.imshow(picture, origin="lower", extent=extent, interpolation="bilinear", zorder=1)
    ax.grid(False)


def _draw_truth(ax: Axes, panel: BEVPanel, view: FrameView, style: MapStyle) -> None:
    """Draw the ground truth in broad lines, coloured by its matches."""
    if not panel.truth:  # None, or no elements
        return
    _, outcomes = panel.outcomes
    colours = []
    for outcome in outcomes:
        colours.append(mcolors.to_rgba(MATCH_COLOURS[outcome], TRUTH_OPACITY[outcome]))
    draw_lines(
        ax,
        lines=[view.display_from_frame(line) for line in panel.truth.polylines],
        labels=panel.truth.labels,
        style=style,
        colours=colours,
        width_pt=2.6 * style.bev_line_pt,
        zorder=8,
    )


def _element_colours(panel: BEVPanel, labels: np.ndarray, style: MapStyle) -> list[str]:
    """Colours of matches, or else the given colours, or else the colours of classes. (N,)"""
    outcomes, _ = panel.outcomes
    if outcomes:
        return [MATCH_COLOURS[outcome] for outcome in outcomes]
    return list(panel.colours) or style.colours(labels)


def draw_bev(ax: Axes, panel: BEVPanel, grid: BEVGrid, view: FrameView, style: MapStyle) -> None:
    """Draw one panel.

    Args:
        ax: Axes to draw on.
        panel: Content of the panel, in the annotation frame.
        grid: Extent of the map.
        view: Orientation of the annotation frame.
        style: Colours and widths.
    """
    elements = panel.elements
    _draw_background(ax, panel.points, grid=grid, view=view, style=style)
    # Names may contain dollar signs, which matplotlib would read as formulas.
    ax.set_title(panel.title, fontsize=8.5, color=style.ink, pad=5, parse_math=False)
    _draw_vehicle(ax, view)
    _draw_truth(ax, panel, view=view, style=style)
    if not elements:  # None, or no elements
        note = ax.text(0.5, 0.03, panel.note, transform=ax.transAxes, ha="center", va="bottom")
        note.set(fontsize=7, color=style.muted, parse_math=False)
        return
    lines = [view.display_from_frame(line) for line in elements.polylines]
    colours = _element_colours(panel, elements.labels, style=style)
    if panel.rasters is not None:
        picture = raster_picture(panel.rasters, elements.labels, style=style)
        _draw_rasters(ax, picture, view=view)
    if panel.gaussians and elements.has_gaussians:
        _draw_gaussians(ax, elements, view=view, style=style)
    if panel.lines:
        outcomes, _ = panel.outcomes
        draw_lines(
            ax,
            lines,
            labels=elements.labels,
            style=style,
            colours=colours,
            width_pt=style.bev_line_pt,
            outcomes=outcomes,
        )
    if panel.vertices:
        for line, colour in zip(lines, colours, strict=True):
            x, y = line.T
            ax.plot(x, y, "o", color=colour, markersize=2.2, markeredgewidth=0, zorder=12)
    if panel.order:
        _draw_order(ax, lines, colours=colours)
    if panel.scores:
        _draw_scores(ax, lines, scores=elements.confidence, colours=colours, view=view)
