"""Colours and widths that all pictures share."""

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
CLASS_TITLES = {
    "ped_crossing": "pedestrian crossing",
    "boundary": "road boundary",
    "centerline": "centre line",
}
# Where predictions are coloured by what they match instead of by class.
MATCH_COLOURS = {"hit": "#00A39A", "false": "#FF3B30", "found": "#8E8E93", "missed": "#AF52DE"}
TRUTH_OPACITY = {"found": 0.4, "missed": 0.75}
FALSE_DASHES = (0, (3, 1.5))  # as matplotlib has them
# Of runs and methods in plots; none is a class's or a match's colour.
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
_HUE_STEP = (5**0.5 - 1) / 2  # golden section: no two of a dozen successive hues are alike


def track_colours(tracks: Iterable[int]) -> list[str]:
    """Return a colour for each track, always the same for a number; grey for -1, no track. (N,)"""
    values = [0.85, 0.6]
    return [
        to_hex(hsv_to_rgb(track * _HUE_STEP % 1, 0.85, values[track // 6 % 2]))
        if track >= 0
        else MATCH_COLOURS["found"]
        for track in tracks
    ]


@dataclass(frozen=True)
class MapStyle:
    """How map elements are drawn.

    Args:
        classes: Class names in label order.
        bev_line_pt: Line width in bird's-eye view, in points.
        camera_line_pt: Line width over an image 10 m away, in points; nearer is thicker.
        halo: Colour of the edge that keeps lines legible over an image.
        ink: Colour of titles.
        muted: Colour of labels and notes.
        ground: Background of bird's-eye views.
        grid: Colour of their metric grid.
        spare: Colours for classes that ``CLASS_COLOURS`` does not name, in the order of labels.
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
        """Return the colour of a class: the same for a class name in every data set."""
        return CLASS_COLOURS.get(self.classes[label], self.spare[label % len(self.spare)])

    def colours(self, labels: Iterable[int]) -> list[str]:
        """Return the colours of elements by their class index. (N,)"""
        return [self.colour(label) for label in labels]

    def title(self, label: int) -> str:
        """Return the class name as a reader would write it."""
        name = self.classes[label]
        return CLASS_TITLES.get(name, name.replace("_", " "))

    def is_closed(self, label: int) -> bool:
        """Whether elements of the class enclose an area, which is filled faintly."""
        return self.classes[label] in AREA_CLASSES
