"""Description of the ground for the renderer: surfaces, kerbs, paint and height.

The functions at the end compute the outlines of painted areas for `Marking`.
"""

from dataclasses import dataclass, field

import numpy as np
from shapely.geometry import Polygon

from gsmap.utils.errors import InputError
from minicity.curves import Array, arc_lengths, strip, subline

# Colours are BGR, 0 to 255, as in OpenCV.
MATERIALS = {
    "asphalt": (84, 82, 80),
    "carpark": (72, 70, 70),
    "walkway": (138, 146, 152),
    "median": (70, 105, 92),
    "grass": (62, 98, 84),
    "concrete": (120, 126, 128),
}
PAINTS = {"white": (232, 234, 234), "yellow": (60, 176, 222)}


@dataclass(frozen=True)
class Surface:
    """Part of the ground of one material.

    Attributes:
        polygon: Outline and holes in the world, in metres.
        material: Key of ``MATERIALS``, which has the colours.
        tone: Factor of the colour in ``MATERIALS``; the result is limited to 255.
    """

    polygon: Polygon
    material: str
    tone: float = 1.0


@dataclass(frozen=True)
class Marking:
    """Paint on the ground.

    Attributes:
        outlines: Outlines of the painted areas in the world, in metres. Each (n, 2)
        paint: Key of ``PAINTS``.
        wear: Share of the paint that is worn off, in [0, 1).
    """

    outlines: list[Array]
    paint: str = "white"
    wear: float = 0.1


@dataclass(frozen=True)
class HeightGrid:
    """Ground height on a regular grid. A point outside the grid has the height of the nearest cell.

    Attributes:
        origin: World x, y of the centre of cell (0, 0), in metres. (2,)
        cell_m: Side of a cell in metres.
        height_m: Height of each cell in metres, rows along y, columns along x. (rows, columns)

    Raises:
        ValueError: If ``height_m`` is no matrix or has cells that are not finite.
    """

    origin: Array
    cell_m: float
    height_m: Array

    def __post_init__(self) -> None:
        """Reject cells that are not finite, which would be rendered as cliffs."""
        if self.height_m.ndim != 2 or not np.isfinite(self.height_m).all():
            raise InputError(
                f"height_m must be a finite (rows, columns) array, got shape "
                f"{self.height_m.shape} with "
                f"{int((~np.isfinite(self.height_m)).sum())} non-finite cells: fill them first."
            )


@dataclass
class SceneMap:
    """Ground of a scene.

    Attributes:
        surfaces: Surfaces in the order of painting, so a later one covers earlier ones. Ground
            without a surface is grass.
        kerbs: Kerb lines in the world, in metres. Each (n, 2)
        markings: Paint over the surfaces.
        height: Height of uneven ground; None for flat ground at ``ground_z_m``.
        ground_z_m: Height of flat ground in metres, used where ``height`` is None.
    """

    surfaces: list[Surface] = field(default_factory=list)
    kerbs: list[Array] = field(default_factory=list)
    markings: list[Marking] = field(default_factory=list)
    height: HeightGrid | None = None
    ground_z_m: float = 0.0


def solid_line(line: Array, width_m: float) -> list[Array]:
    """Painted area of an unbroken line.

    Args:
        line: Centre line in metres. (n, 2)
        width_m: Width of the paint in metres.

    Returns:
        One outline (2n, 2), or none for a line of at most 5 cm.
    """
    # The last arc length is the length of the line. `strip` takes half the width.
    if len(line) > 1 and arc_lengths(line)[-1] > 0.05:
        return [strip(line, width_m / 2)]
    return []


def dashed_line(line: Array, width_m: float, dash_m: float, gap_m: float) -> list[Array]:
    """Painted areas of a dashed line.

    Args:
        line: Centre line in metres. (n, 2)
        width_m: Width of the paint in metres.
        dash_m: Length of a dash in metres.
        gap_m: Length between two dashes in metres.

    Returns:
        One outline per dash, none for a line of at most 0.3 m. Each (m, 2)
    """
    total = float(arc_lengths(line)[-1]) if len(line) > 1 else 0.0
    # A dash begins more than 0.3 m before the end of the line, so that the last one is not a dot.
    starts = np.arange(0.0, max(total - 0.3, 0.0), dash_m + gap_m)
    outlines = []
    for start in starts:
        dash = subline(line, start_m=start, end_m=min(start + dash_m, total))
        outlines.append(strip(dash, width_m / 2))
    return outlines


def double_line(line: Array, width_m: float, gap_m: float) -> list[Array]:
    """Painted areas of two unbroken lines side by side.

    Args:
        line: Middle between the two lines, in metres. (n, 2)
        width_m: Width of each line in metres.
        gap_m: Bare space between the two lines in metres.

    Returns:
        The left and the right outline, or none for fewer than two points. Each (2n, 2)
    """
    if len(line) < 2:
        return []
    # `strip` returns n points of the left side, then n points of the right side in reverse order,
    # so the halves are the two sides.
    outer_left, outer_right = np.split(strip(line, gap_m / 2 + width_m), 2)
    inner_left, inner_right = np.split(strip(line, gap_m / 2), 2)
    # Each outline goes along its outer side and returns along its inner side.
    left = np.concatenate([outer_left, inner_left[::-1]])
    right = np.concatenate([outer_right, inner_right[::-1]])
    return [left, right]


def zebra(side_a: Array, side_b: Array, stripe_m: float = 0.5, gap_m: float = 0.5) -> list[Array]:
    """Stripes of a crossing, parallel to the traffic.

    The stripes run from one long side to the other and are lined up from kerb to kerb.

    Args:
        side_a: One long side of the crossing, kerb to kerb, in metres. (n, 2)
        side_b: The other long side, in the direction of ``side_a``. (m, 2)
        stripe_m: Width of a stripe in metres.
        gap_m: Bare space between two stripes in metres.

    Returns:
        One outline per stripe. Each (4, 2)
    """
    lengths_a = arc_lengths(side_a)
    lengths_b = arc_lengths(side_b)
    total = float(lengths_a[-1])
    # At least one stripe; 0.3 m of the length remain free.
    count = max(1, int((total - 0.3) / (stripe_m + gap_m)))
    # The stripes, with gaps between them, are centred between the kerbs.
    first = (total - count * (stripe_m + gap_m) + gap_m) / 2
    stripes = []
    for k in range(count):
        start = first + k * (stripe_m + gap_m)
        # Both edges of the stripe, as shares of the length, because the sides may differ in length.
        shares = np.array([start, start + stripe_m]) / total
        edge_a = _points_at_shares(side_a, lengths_a, shares)
        edge_b = _points_at_shares(side_b, lengths_b, shares)
        # An outline goes along side a and returns along side b.
        stripes.append(np.concatenate([edge_a, edge_b[::-1]]))
    return stripes


def _points_at_shares(line: Array, lengths: Array, shares: Array) -> Array:
    """Points of a polyline (n, 2) at shares (k,) of its length, in [0, 1]. (k, 2)

    Args:
        line: Vertices in metres. (n, 2)
        lengths: Arc length at each vertex, in metres. (n,)
        shares: Shares of the length of the polyline. (k,)
    """
    arc_m = shares * lengths[-1]
    x = np.interp(arc_m, lengths, line[:, 0])
    y = np.interp(arc_m, lengths, line[:, 1])
    return np.stack([x, y], axis=1)
