"""What the renderer is told about the ground: surfaces, kerbs, paint and height."""

from dataclasses import dataclass, field

import numpy as np
from shapely.geometry import Polygon

from minicity.curves import Array, arc_lengths, strip, subline

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
    """A part of the ground.

    Attributes:
        polygon: Its outline in the world, metres; holes are left out.
        material: A key of ``MATERIALS``.
        tone: Brightness relative to the material's own.
    """

    polygon: Polygon
    material: str
    tone: float = 1.0


@dataclass(frozen=True)
class Marking:
    """Paint on the ground.

    Attributes:
        outlines: Painted areas in the world, metres. Each (n, 2)
        paint: A key of ``PAINTS``.
        wear: Share of the paint that has worn off, in [0, 1).
    """

    outlines: list[Array]
    paint: str = "white"
    wear: float = 0.1


@dataclass(frozen=True)
class HeightGrid:
    """Ground height on a regular grid; outside it the nearest cell counts.

    Attributes:
        origin: World x, y of cell (0, 0)'s centre. (2,)
        cell_m: Edge of a cell.
        height_m: Height of each cell, rows along y, columns along x. (rows, columns)
    """

    origin: Array
    cell_m: float
    height_m: Array

    def __post_init__(self) -> None:
        """Refuse holes: the renderer would show them as cliffs."""
        if self.height_m.ndim != 2 or not np.isfinite(self.height_m).all():
            raise ValueError(
                f"height_m must be a finite (rows, columns) array, got shape "
                f"{self.height_m.shape} with "
                f"{int((~np.isfinite(self.height_m)).sum())} non-finite cells: fill them first."
            )


@dataclass
class SceneMap:
    """The ground of a scene.

    Attributes:
        surfaces: Painted in order, later over earlier; what none covers is grass.
        kerbs: Kerb lines. Each (n, 2)
        markings: Paint, over the surfaces.
        height: Height of the ground, or the constant ``ground_z_m``.
        ground_z_m: Height of flat ground, used where ``height`` is None.
    """

    surfaces: list[Surface] = field(default_factory=list)
    kerbs: list[Array] = field(default_factory=list)
    markings: list[Marking] = field(default_factory=list)
    height: HeightGrid | None = None
    ground_z_m: float = 0.0


def solid_line(line: Array, width_m: float) -> list[Array]:
    """The painted area of an unbroken line. (n, 2) -> one (2n, 2)"""
    return [strip(line, width_m / 2)] if len(line) > 1 and arc_lengths(line)[-1] > 0.05 else []


def dashed_line(line: Array, width_m: float, dash_m: float, gap_m: float) -> list[Array]:
    """Return the painted areas of a dashed line. each (m, 2)

    Args:
        line: Its middle, in metres. (n, 2)
        width_m: Width of the paint.
        dash_m: Length of a dash.
        gap_m: Length between dashes.
    """
    total = float(arc_lengths(line)[-1]) if len(line) > 1 else 0.0
    starts = np.arange(0.0, max(total - 0.3, 0.0), dash_m + gap_m)
    return [strip(subline(line, s, min(s + dash_m, total)), width_m / 2) for s in starts]


def double_line(line: Array, width_m: float, gap_m: float) -> list[Array]:
    """Return the painted areas of two unbroken lines side by side. two (2n, 2)

    Args:
        line: The middle between them, in metres. (n, 2)
        width_m: Width of each line.
        gap_m: Distance between them.
    """
    if len(line) < 2:
        return []
    band, inner = strip(line, gap_m / 2 + width_m), strip(line, gap_m / 2)
    n = len(line)
    left = np.concatenate([band[:n], inner[:n][::-1]])
    right = np.concatenate([band[n:], inner[n:][::-1]])
    return [left, right]


def zebra(side_a: Array, side_b: Array, stripe_m: float = 0.5, gap_m: float = 0.5) -> list[Array]:
    """Stripes of a crossing, parallel to the traffic.

    Args:
        side_a: One long side of the crossing, kerb to kerb. (n, 2)
        side_b: The other long side, in the same direction. (m, 2)
        stripe_m: Width of a stripe.
        gap_m: Bare space between stripes.

    Returns:
        Painted areas, each (4, 2).
    """
    lengths = arc_lengths(side_a), arc_lengths(side_b)
    total = float(lengths[0][-1])
    count = max(1, int((total - 0.3) / (stripe_m + gap_m)))
    first = (total - count * (stripe_m + gap_m) + gap_m) / 2
    stripes = []
    for k in range(count):
        at = (
            np.array([first + k * (stripe_m + gap_m), first + k * (stripe_m + gap_m) + stripe_m])
            / total
        )
        edge_a = _at(side_a, lengths[0], at)
        edge_b = _at(side_b, lengths[1], at)
        stripes.append(np.concatenate([edge_a, edge_b[::-1]]))
    return stripes


def _at(line: Array, lengths: Array, share: Array) -> Array:
    return np.stack([np.interp(share * lengths[-1], lengths, column) for column in line.T], axis=1)
