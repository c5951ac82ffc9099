"""Colours and widths of map elements in all pictures."""

from collections.abc import Iterable, Sequence
from colorsys import hsv_to_rgb
from dataclasses import dataclass

from matplotlib.colors import to_hex

from gsmap.structures.classes import AREA_CLASSES

CLASS_COLOURS = {
    "divider": "#FF9500",
    "ped_crossing": "#2D8CFF",
    "boundary": "#1DB954",
    "centerline": "#8E8E93",
}
# Titles of classes whose names are not plain words. Other classes use their names.
CLASS_TITLES = {
    "ped_crossing": "pedestrian crossing",
    "boundary": "road boundary",
    "centerline": "centre line",
}
_GREY = "#8E8E93"
# Colours of matches: a prediction is a hit or false, a ground truth is found or missed.
MATCH_COLOURS = {"hit": "#00A39A", "false": "#FF3B30", "found": _GREY, "missed": "#AF52DE"}
# Opacity of ground truths: found ones are fainter than missed ones.
TRUTH_OPACITY = {"found": 0.4, "missed": 0.75}
FALSE_DASHES = (0, (3, 1.5))  # line style of matplotlib: offset, and lengths of dash and gap
# Colours of runs and methods in plots, distinct from the colours of classes and matches.
RUN_COLOURS = (
    "#34495E",
    "#E0457B",
    "#A2845E",
    "#5AC8FA",
    "#5856D6",
    "#B7A000",
    "#7F1D1D",
    "#000000",
)
_HUE_STEP = (5**0.5 - 1) / 2  # golden section, which keeps the hues of successive numbers apart
_TRACK_VALUES = (0.85, 0.6)  # brightness in HSV, which changes after every six tracks
_TRACKS_PER_VALUE = 6


def track_colours(tracks: Iterable[int]) -> list[str]:
    """Colours of tracks. The number of a track alone determines its colour.

    Args:
        tracks: Numbers of the tracks, -1 for elements without a track. (N,)

    Returns:
        Colours ``#rrggbb``, grey for -1. (N,)
    """
    colours = []
    for track in tracks:
        if track < 0:
            colours.append(_GREY)
            continue
        hue = (track * _HUE_STEP) % 1  # a fraction of the colour circle
        value = _TRACK_VALUES[(track // _TRACKS_PER_VALUE) % len(_TRACK_VALUES)]
        colours.append(to_hex(hsv_to_rgb(hue, 0.85, value)))  # hue, saturation 0.85, value
    return colours


@dataclass(frozen=True)
class MapStyle:
    """Colours and widths of map elements.

    Args:
        classes: Class names in label order.
        bev_line_pt: Line width in bird's-eye view, in points.
        camera_line_pt: Line width over an image 10 m away, in points. Nearer lines are
            thicker.
        halo: Outline colour of lines over an image, for legibility.
        ink: Colour of titles.
        muted: Colour of labels and notes.
        ground: Background of bird's-eye views.
        grid: Colour of the metric grid of bird's-eye views.
        spare: Colours of classes without an entry in ``CLASS_COLOURS``, by label.
    """

    classes: Sequence[str] = ("divider", "ped_crossing", "boundary")
    bev_line_pt: float = 1.6
    camera_line_pt: float = 1.7
    halo: str = "#101418"
    ink: str = "#1C1C1E"
    muted: str = "#8A8F98"
    ground: str = "#F4F5F7"
    grid: str = "#DCDFE4"
    spare: Sequence[str] = ("#AF52DE", "#FF3B30", "#5AC8FA", "#A2845E", "#FF2D92", "#34495E")

    def colour(self, label: int) -> str:
        """Colour of a class, from ``CLASS_COLOURS`` or else from ``spare``."""
        return CLASS_COLOURS.get(self.classes[label], self.spare[label % len(self.spare)])

    def colours(self, labels: Iterable[int]) -> list[str]:
        """Colours of elements by their class index. (N,)"""
        return [self.colour(label) for label in labels]

    def title(self, label: int) -> str:
        """Class name in plain words, for legends and titles."""
        name = self.classes[label]
        return CLASS_TITLES.get(name, name.replace("_", " "))

    def is_closed(self, label: int) -> bool:
        """Whether elements of a class enclose an area, and are drawn with a faint fill."""
        return self.classes[label] in AREA_CLASSES
