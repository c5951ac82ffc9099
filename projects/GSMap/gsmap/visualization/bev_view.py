"""One bird's-eye-view panel: road ahead pointing up, metric grid, ego vehicle, map elements."""

from dataclasses import dataclass

import numpy as np
from matplotlib import colors as mcolors
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.patches import FancyBboxPatch, Polygon
from matplotlib.patheffects import withStroke

from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.visualization.frame_view import FrameView
from gsmap.visualization.style import MapStyle


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


def _draw_grid(ax: Axes, extent: tuple[float, float, float, float], style: MapStyle) -> None:
    """Draw a metric grid with labels on the left and at the bottom."""
    left, right, bottom, top = extent
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", facecolor=style.ground)
    ax.set_xticks(*_ticks(left, right))
    ax.set_yticks(*_ticks(bottom, top))
    ax.grid(True, color=style.grid, linewidth=0.6, zorder=0)
    ax.set_axisbelow(True)
    ax.tick_params(length=0, labelsize=6.5, colors=style.muted, pad=2)
    ax.spines[:].set(color=style.grid, linewidth=0.8)


def _draw_vehicle(ax: Axes, view: FrameView) -> None:
    """Draw the ego vehicle to scale, its windscreen towards the road ahead."""
    rear, front, width = view.vehicle_m
    half, glass = width / 2, front - 0.30 * (front - rear)
    body = FancyBboxPatch(
        (-half + 0.35, rear + 0.35),
        width - 0.7,
        front - rear - 0.7,
        boxstyle="round,pad=0.35,rounding_size=0.55",
        facecolor="#3A4452",
        edgecolor="white",
        linewidth=0.9,
        zorder=30,
    )
    top, bottom, low = 0.72 * half, 0.55 * half, glass - 0.62
    windscreen = [(-top, glass), (top, glass), (bottom, low), (-bottom, low)]
    ax.add_patch(body)
    ax.add_patch(Polygon(windscreen, facecolor="#D5E3F2", edgecolor="none", zorder=31))


def _draw_lines(
    ax: Axes, lines: list[np.ndarray], labels: np.ndarray, style: MapStyle, width_pt: float
) -> None:
    """Draw polylines in their classes' colours and fill the closed ones faintly."""
    closed = [i for i, label in enumerate(labels) if style.is_closed(label)]
    faces = mcolors.to_rgba_array(style.colours(labels[closed]), 0.16)
    areas = PolyCollection(
        [lines[i] for i in closed], facecolors=faces, edgecolors="none", zorder=4
    )
    ax.add_collection(areas)
    ax.add_collection(
        LineCollection(
            lines,
            colors=style.colours(labels),
            linewidths=width_pt,
            capstyle="round",
            joinstyle="round",
            zorder=10,
        )
    )


def _draw_order(ax: Axes, lines: list[np.ndarray], colours: list[str]) -> None:
    """Mark the first vertex with a ring and the direction with an arrow head at the middle."""
    x, y = np.stack([line[0] for line in lines]).T
    ax.scatter(x, y, s=20, facecolors="white", edgecolors=colours, linewidths=1.1, zorder=13)
    head = {"arrowstyle": "-|>", "lw": 0, "mutation_scale": 9, "shrinkA": 0, "shrinkB": 0}
    for line, colour in zip(lines, colours, strict=True):
        middle = max(len(line) // 2, 1)
        start, end = tuple(line[middle - 1]), tuple(line[middle])
        ax.annotate("", end, start, arrowprops={**head, "color": colour}, zorder=13)


def _draw_gaussians(ax: Axes, elements: MapElements, view: FrameView, style: MapStyle) -> None:
    """Draw each Gaussian as the ellipse at one standard deviation."""
    assert elements.scales is not None
    assert elements.rotations is not None
    colours = style.colours(np.repeat(elements.labels, elements.num_points))
    ellipses = EllipseCollection(
        widths=2 * elements.scales[:, 0],
        heights=2 * elements.scales[:, 1],
        angles=np.degrees(elements.rotations + view.display_turn_rad),
        units="xy",
        offsets=view.display_from_frame(elements.points),
        transOffset=ax.transData,
        facecolors=mcolors.to_rgba_array(colours, 0.22),
        edgecolors=colours,
        linewidths=0.8,
        zorder=11,
    )
    ax.add_collection(ellipses)


def _draw_scores(ax: Axes, lines: list[np.ndarray], elements: MapElements, style: MapStyle) -> None:
    """Write each score at the middle of its element, in a darker colour."""
    left, right = ax.get_xlim()
    bottom, top = ax.get_ylim()
    colours = 0.62 * mcolors.to_rgba_array(style.colours(elements.labels))[:, :3]
    for line, colour, score in zip(lines, colours, elements.confidence, strict=True):
        x, y = line[len(line) // 2]
        ax.text(
            np.clip(x, left + 1.2, right - 1.2),
            np.clip(y, bottom + 0.8, top - 0.8),
            f"{score:.2f}",
            fontsize=5.5,
            color=tuple(colour),
            ha="center",
            va="center",
            path_effects=[withStroke(linewidth=1.8, foreground="white")],
            zorder=20,
        )


def raster_picture(rasters: np.ndarray, labels: np.ndarray, style: MapStyle) -> np.ndarray:
    """Blend the elements' rasters into one picture over white.

    Args:
        rasters: Occupancy in [0, 1]. (N, H, W)
        labels: Class index of each. (N,)
        style: Colours.

    Returns:
        RGB in [0, 1]: each class covers white by the largest occupancy of its elements. (H, W, 3)
    """
    picture = np.ones((*rasters.shape[1:], 3))
    for label in np.unique(labels):
        cover = rasters[labels == label].max(axis=0)[..., None]
        picture = picture * (1 - cover) + cover * mcolors.to_rgb(style.colour(label))
    return picture.clip(0, 1)


def draw_bev(ax: Axes, panel: BEVPanel, grid: BEVGrid, view: FrameView, style: MapStyle) -> None:
    """Draw one panel.

    Args:
        ax: Axes to fill.
        panel: What to show.
        grid: Extent of the map in metres.
        view: Orientation of the frame.
        style: Colours and widths.
    """
    extent = display_extent(grid, view)
    _draw_grid(ax, extent, style)
    ax.set_title(panel.title, fontsize=8.5, color=style.ink, pad=5)
    if panel.points is not None and len(panel.points):
        x, y = view.display_from_frame(panel.points).T
        ax.scatter(x, y, s=0.25, c="#9AA3AE", alpha=0.55, linewidths=0, zorder=2)
    _draw_vehicle(ax, view)
    elements = panel.elements
    if elements is None or len(elements) == 0:
        ax.text(0, extent[2] + 2, panel.note, fontsize=7, color=style.muted, ha="center")
        return
    if panel.rasters is not None:
        picture = raster_picture(panel.rasters, elements.labels, style)
        if view.forward == "x":
            picture = picture.transpose(1, 0, 2)[:, ::-1]  # row = x, column = -y
        ax.imshow(picture, origin="lower", extent=extent, interpolation="bilinear", zorder=1)
        ax.grid(False)
    lines = [view.display_from_frame(line) for line in elements.polylines]
    if panel.gaussians and elements.has_gaussians:
        _draw_gaussians(ax, elements, view, style)
    if panel.lines:
        width_pt = style.bev_line_pt * (0.5 if panel.gaussians else 1)
        _draw_lines(ax, lines, elements.labels, style, width_pt)
    if panel.vertices:
        colours = style.colours(np.repeat(elements.labels, elements.num_points))
        x, y = np.concatenate(lines).T
        ax.scatter(x, y, s=7, c=colours, linewidths=0, zorder=12)
    if panel.order:
        _draw_order(ax, lines, style.colours(elements.labels))
    if panel.scores and elements.scores is not None:
        _draw_scores(ax, lines, elements, style)
    ax.set(xlim=extent[:2], ylim=extent[2:])
