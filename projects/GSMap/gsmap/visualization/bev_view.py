"""One bird's-eye-view panel: road ahead pointing up, metric grid, ego vehicle, map elements."""

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

_SCORE_PT = 6.5
_K = 4 / 3 * (np.sqrt(2) - 1)  # four Bezier curves that make a circle within 0.03 %
_QUARTERS = np.array([1, 1 + 1j * _K, _K + 1j]) * 1j ** np.arange(5)[:, None]
_CIRCLE = _QUARTERS.ravel()[:13].view(np.float64).reshape(13, 2)
_CURVES = [Path.MOVETO, *[Path.CURVE4] * 12]


@dataclass(frozen=True)
class BEVPanel:
    """What one bird's-eye-view panel shows.

    Args:
        title: Heading of the panel.
        elements: Map elements, or None for an empty panel.
        note: What to say where there are no elements.
        lines: Whether to draw the polylines.
        vertices: Whether to mark their vertices.
        order: Whether to mark the start and the direction of each.
        gaussians: Whether to draw each vertex's Gaussian as its 1-sigma ellipse.
        scores: Whether to write the scores.
        rasters: Occupancy in [0, 1] per element on ``BEVGrid`` rows and columns, drawn instead of a
            background. (N, H, W)
        points: Points (x, y) to draw as faint dots, such as a LiDAR sweep. (n, >= 2)
        truth: Ground truth in broad lines under the elements, coloured by whether it is found.
        hits: Index of the ground truth that each element hits, or -1; colours elements by it. (N,)
        colours: A colour for each element in place of its class's. (N,)
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
    def fates(self) -> tuple[list[str], list[str]]:
        """What becomes of each element with ``hits`` and of each ground truth in ``truth``."""
        hits = () if self.hits is None else self.hits
        truth = range(len(self.truth or ()))
        fates = ["hit" if hit >= 0 else "false" for hit in hits]
        return fates, ["found" if index in hits else "missed" for index in truth]


def display_extent(grid: BEVGrid, view: FrameView) -> tuple[float, float, float, float]:
    """Return left, right, bottom, top of the grid as displayed, in metres."""
    corners = np.array([(x, y) for x in grid.x_range for y in grid.y_range])
    shown = view.display_from_frame(corners)
    (left, bottom), (right, top) = shown.min(axis=0), shown.max(axis=0)
    return float(left), float(right), float(bottom), float(top)


def _ticks(low: float, high: float) -> tuple[np.ndarray, list[str]]:
    """Return round positions every 10 m (5 m on a small map) and their labels."""
    step = 10 if high - low > 20 else 5
    at = np.arange(np.ceil(low / step) * step, high + 1e-6, step)
    labels = [f"{value:g}".replace("-", "\N{MINUS SIGN}") for value in at]
    return at, [*labels[:-1], f"{labels[-1]} m"]


def _draw_ground(
    ax: Axes, points: np.ndarray | None, grid: BEVGrid, view: FrameView, style: MapStyle
) -> None:
    """Draw a metric grid with labels on the left and at the bottom, and LiDAR points faintly."""
    left, right, bottom, top = display_extent(grid, view)
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", facecolor=style.ground)
    ax.set_xticks(*_ticks(left, right))
    ax.set_yticks(*_ticks(bottom, top))
    ax.grid(True, color=style.grid, linewidth=0.6, zorder=0)
    ax.set_axisbelow(True)
    ax.tick_params(length=0, labelsize=6.5, colors=style.muted, pad=2)
    ax.spines[:].set(color=style.grid, linewidth=0.8)
    if points is not None and len(points):
        x, y = view.display_from_frame(points).T
        ax.scatter(x, y, s=0.25, c="#9AA3AE", alpha=0.55, linewidths=0, zorder=2)


def _draw_vehicle(ax: Axes, view: FrameView) -> None:
    """Draw the ego vehicle to scale, its windscreen towards the road ahead."""
    rear, front, width = view.vehicle_m
    half, glass = width / 2, front - 0.30 * (front - rear)
    corner, size = (-half + 0.35, rear + 0.35), (width - 0.7, front - rear - 0.7)
    body = FancyBboxPatch(corner, *size, boxstyle="round,pad=0.35,rounding_size=0.55")
    body.set(facecolor="#3A4452", edgecolor="white", linewidth=0.9, zorder=30)
    top, bottom, low = 0.72 * half, 0.55 * half, glass - 0.62
    windscreen = [(-top, glass), (top, glass), (bottom, low), (-bottom, low)]
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
    fates: Sequence[str] = (),
) -> None:
    """Draw polylines, false ones dashed, and fill those of closed classes.

    Args:
        ax: Where to draw.
        lines: Polylines in display coordinates, in metres. each (n, 2)
        labels: Their class indices. (N,)
        style: Says which classes are closed.
        colours: A colour for each.
        width_pt: Width of the lines in points.
        zorder: Height of the lines over the rest of the drawing.
        fates: ``hit`` or ``false`` for each; empty draws no dashes.
    """
    areas = [i for i, label in enumerate(labels) if style.is_closed(label)]
    faces = [(*mcolors.to_rgb(colours[i]), 0.2) for i in areas]
    shapes = [lines[i] for i in areas]
    ax.add_collection(PolyCollection(shapes, facecolors=faces, edgecolors="none", zorder=4))
    dashes = [FALSE_DASHES if fate == "false" else "-" for fate in fates] or "-"
    strokes = LineCollection(lines, colors=colours, linewidths=width_pt, linestyles=dashes)
    strokes.set(joinstyle="round", zorder=zorder)
    ax.add_collection(strokes)


def _draw_order(ax: Axes, lines: list[np.ndarray], colours: list[str]) -> None:
    """Mark the first vertex with a ring and the direction with an arrow head at the middle."""
    x, y = np.stack([line[0] for line in lines]).T
    ax.scatter(x, y, s=13, facecolors="white", edgecolors=colours, linewidths=1.0, zorder=13)
    head = {"arrowstyle": "-|>", "lw": 0, "mutation_scale": 8.5, "shrinkA": 0, "shrinkB": 0}
    for line, colour in zip(lines, colours, strict=True):
        middle = max(len(line) // 2, 1)
        start, end = tuple(line[middle - 1]), tuple(line[middle])
        ax.annotate("", end, start, arrowprops={**head, "color": colour}, zorder=13)


def _draw_gaussians(ax: Axes, elements: MapElements, view: FrameView, style: MapStyle) -> None:
    """Draw each Gaussian as the ellipse at one standard deviation."""
    assert elements.scales is not None
    assert elements.rotations is not None
    centres = view.display_from_frame(elements.points)  # (M, 2)
    turn = elements.rotations + view.display_turn_rad
    axes = np.stack([np.cos(turn), np.sin(turn), -np.sin(turn), np.cos(turn)], -1).reshape(-1, 2, 2)
    edges = _CIRCLE @ (elements.scales[..., None] * axes) + centres[:, None]  # (M, 13, 2)
    ellipses = [Path(edge, _CURVES) for edge in edges]
    ends = pairwise(elements.offsets.tolist())
    paths = [Path.make_compound_path(*ellipses[a:b]) for a, b in ends]
    colours = style.colours(elements.labels)
    shapes = PathCollection(paths, facecolors=mcolors.to_rgba_array(colours, 0.4), zorder=11)
    shapes.set(edgecolors=colours, linewidths=0.4)
    ax.add_collection(shapes)


def _draw_scores(
    ax: Axes, lines: list[np.ndarray], scores: np.ndarray, colours: list[str], view: FrameView
) -> None:
    """Write each score at the vertex nearest its element's middle that is free, if there is one.

    Free is what the border, the vehicle and the scores of surer elements leave.
    """
    low, high = np.transpose([ax.get_xlim(), ax.get_ylim()])
    rear, front, width = view.vehicle_m
    letter_m = _SCORE_PT / 72 * ax.figure.dpi * (high - low)[1] / ax.get_window_extent().height
    half = letter_m * np.array([1.4, 0.6])  # of a score's width and height
    taken = [np.array([0, (rear + front) / 2])]
    reach = [half + np.array([width, front - rear]) / 2]
    for i in np.argsort(-scores, kind="stable"):
        count = len(lines[i])
        at = lines[i][np.argsort(np.abs(np.arange(count) - count // 2), kind="stable")]
        free = ((at > low + half) & (at < high - half)).all(axis=1)
        free &= (np.abs(at[:, None] - taken) > reach).any(axis=2).all(axis=1)
        if not free.any():
            continue
        taken.append(at[free.argmax()])
        reach.append(2 * half)
        x, y = taken[-1]
        text = ax.text(x, y, f"{scores[i]:.2f}", ha="center", va="center", zorder=20)
        text.set(fontsize=_SCORE_PT, color=0.62 * np.array(mcolors.to_rgb(colours[i])))
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])


def raster_picture(rasters: np.ndarray, labels: np.ndarray, style: MapStyle) -> np.ndarray:
    """Blend the elements' occupancies in [0, 1] (N, H, W) into one picture, RGB in [0, 1].

    Each class covers white by the largest occupancy of its elements. -> (H, W, 3)
    """
    picture = np.ones((*rasters.shape[1:], 3))
    for label in np.unique(labels):
        cover = rasters[labels == label].max(axis=0)[..., None]
        picture = picture * (1 - cover) + cover * mcolors.to_rgb(style.colour(label))
    return picture.clip(0, 1)


def _draw_rasters(ax: Axes, picture: np.ndarray, view: FrameView) -> None:
    """Draw the rendered masks in place of the ground."""
    if view.forward == "x":
        picture = picture.transpose(1, 0, 2)[:, ::-1]  # row = x, column = -y
    extent = (*ax.get_xlim(), *ax.get_ylim())
    ax.imshow(picture, origin="lower", extent=extent, interpolation="bilinear", zorder=1)
    ax.grid(False)


def draw_bev(ax: Axes, panel: BEVPanel, grid: BEVGrid, view: FrameView, style: MapStyle) -> None:
    """Draw one panel of a map.

    Args:
        ax: Where to draw.
        panel: What to draw, in the annotation frame.
        grid: The extent of the drawing.
        view: How the annotation frame is turned in the display.
        style: Colours and sizes.
    """
    elements = panel.elements
    fates, truth_fates = panel.fates
    _draw_ground(ax, panel.points, grid, view, style)
    ax.set_title(panel.title, fontsize=8.5, color=style.ink, pad=5)
    _draw_vehicle(ax, view)
    if panel.truth:
        lines = [view.display_from_frame(line) for line in panel.truth.polylines]
        shades = [mcolors.to_rgba(MATCH_COLOURS[f], TRUTH_OPACITY[f]) for f in truth_fates]
        width_pt = 2.6 * style.bev_line_pt
        draw_lines(ax, lines, panel.truth.labels, style, shades, width_pt, zorder=8)
    if not elements:
        note = ax.text(0.5, 0.03, panel.note, transform=ax.transAxes, ha="center", va="bottom")
        note.set(fontsize=7, color=style.muted)
        return
    lines = [view.display_from_frame(line) for line in elements.polylines]
    colours = [MATCH_COLOURS[fate] for fate in fates] or list(panel.colours)
    colours = colours or style.colours(elements.labels)
    if panel.rasters is not None:
        _draw_rasters(ax, raster_picture(panel.rasters, elements.labels, style), view)
    if panel.gaussians and elements.has_gaussians:
        _draw_gaussians(ax, elements, view, style)
    if panel.lines:
        draw_lines(ax, lines, elements.labels, style, colours, style.bev_line_pt, fates=fates)
    if panel.vertices:
        for line, colour in zip(lines, colours, strict=True):
            ax.plot(*line.T[:2], "o", color=colour, markersize=2.2, markeredgewidth=0, zorder=12)
    if panel.order:
        _draw_order(ax, lines, colours)
    if panel.scores:
        _draw_scores(ax, lines, elements.confidence, colours, view)
