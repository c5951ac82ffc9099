"""Pictures of the maps of drives."""

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
    """
    vertices = [elements.points[:, :2] for elements in maps.values()]
    points = np.concatenate([track, *vertices])
    low = points.min(axis=0) - 5  # a margin of 5 m
    high = points.max(axis=0) + 5
    width, height = high - low
    rows = len(maps) if width > 2.5 * height else 1  # one column or one row of panels
    figure, axes = panel_grid(rows, len(maps) // rows)
    panel_width = WIDTH_IN * rows / len(maps) - 0.5  # inches, without the labels
    panel_height = panel_width * min(height / width, 2)
    figure.set_figheight(0.4 + rows * (panel_height + 0.5))
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
    labels = np.unique(np.concatenate([elements.labels for elements in maps.values()]))
    handles = []
    for label in labels.astype(int).tolist():
        line = Line2D([], [], color=style.colour(label), lw=2, label=style.title(label))
        handles.append(line)
    figure.legend(handles=handles, loc="outside upper right", ncols=4, fontsize=8, frameon=False)
    return figure
