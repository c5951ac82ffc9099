"""Pictures of maps that were built from drives."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gsmap.structures.elements import MapElements
from gsmap.visualization.bev_view import draw_lines
from gsmap.visualization.plots import WIDTH_IN, finish_panel, panel_grid
from gsmap.visualization.style import MapStyle


def plot_maps(maps: Mapping[str, MapElements], track: np.ndarray, style: MapStyle) -> Figure:
    """Draw maps of one drive with the driven track, side by side or, if they are wide, in a column.

    Args:
        maps: Maps in the global frame, by title.
        track: Positions of the vehicle in the global frame, in metres. (n, 2)
        style: Colours and titles of the classes.

    Returns:
        Figure with one panel per map and a common legend. Coordinates begin at the lower left
        corner of all maps, because global coordinates are large numbers.
    """
    vertices = [elements.points[:, :2] for elements in maps.values()]
    points = np.concatenate([track, *vertices])
    low = points.min(axis=0) - 5  # lower left corner of all panels, with a margin of 5 m
    high = points.max(axis=0) + 5
    width, height = high - low  # metres
    rows = len(maps) if width > 2.5 * height else 1  # one column or one row of panels
    columns = len(maps) // rows
    figure, axes = panel_grid(rows, columns)
    panel_width_in = WIDTH_IN * rows / len(maps) - 0.5  # 0.5 inches are for the labels
    panel_height_in = panel_width_in * min(height / width, 2)  # at most twice as high as wide
    # 0.4 inches are for the legend, 0.5 inches in each row for the title and the labels.
    figure.set_figheight(0.4 + rows * (panel_height_in + 0.5))
    for ax, (title, elements) in zip(axes.ravel(), maps.items(), strict=True):
        lines = [line[:, :2] - low for line in elements.polylines]
        draw_lines(
            ax,
            lines,
            labels=elements.labels,
            style=style,
            colours=style.colours(elements.labels),
            width_pt=0.8,
        )
        x, y = (track - low).T
        ax.plot(x, y, ".", color=style.ink, markersize=1.2)
        ax.set(xlim=(0, width), ylim=(0, height), aspect="equal")
        finish_panel(ax, title)
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter("{x:g} m")
    # The legend has the classes that occur in a map.
    labels = np.unique(np.concatenate([elements.labels for elements in maps.values()]))
    handles = []
    for label in labels.astype(int).tolist():
        line = Line2D([], [], color=style.colour(label), lw=2, label=style.title(label))
        handles.append(line)
    figure.legend(handles=handles, loc="outside upper right", ncols=4, fontsize=8, frameon=False)
    return figure
