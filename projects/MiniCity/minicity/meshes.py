"""Things that stand on the ground, as coloured quads and discs."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from minicity.curves import Array, rectangle
from minicity.town import Building

WINDOW_PITCH_M = 3.4
STOREY_M = 3.0
TRUNK_M = 0.28
POLE_M = 0.16
BARK = (48.0, 62.0, 78.0)
# offsets in crown radii, then brightness
CROWN = (
    (0.0, 0.0, 0.0, 0.8),
    (0.6, 0.3, -0.1, 0.9),
    (-0.5, 0.5, 0.1, 1.0),
    (0.1, -0.6, 0.3, 1.1),
)
Color = tuple[float, float, float]


@dataclass
class Mesh:
    """Quads and discs, grouped by the object that they belong to; ``freeze`` makes arrays of them.

    Attributes:
        quads: Corners, anticlockwise seen from outside. Each (4, 3)
        colors: Colours in full light, BGR.
        groups: Index of the object of each quad.
        layers: Order inside an object: a higher one is drawn over a lower.
        glow: Whether a quad shines by itself.
        discs: (x, y, z, radius) facing the camera.
        disc_colors: Their colours.
        disc_groups: Their objects.
        anchors: Reference point of each object. (3,)
        backdrop: Whether the object is a building, drawn before all else.
    """

    quads: list[Array] = field(default_factory=list)
    colors: list[Color] = field(default_factory=list)
    groups: list[int] = field(default_factory=list)
    layers: list[int] = field(default_factory=list)
    glow: list[bool] = field(default_factory=list)
    discs: list[tuple[float, float, float, float]] = field(default_factory=list)
    disc_colors: list[Color] = field(default_factory=list)
    disc_groups: list[int] = field(default_factory=list)
    anchors: list[Array] = field(default_factory=list)
    backdrop: list[bool] = field(default_factory=list)

    def begin(self, anchor: Array, backdrop: bool = False) -> None:
        """Start an object."""
        self.anchors.append(np.asarray(anchor, float))
        self.backdrop.append(backdrop)

    def add_quad(self, corners: Array, color: Color, layer: int = 0, glow: bool = False) -> None:
        """Add a quad to the current object."""
        self.quads.append(corners)
        self.colors.append(color)
        self.groups.append(len(self.anchors) - 1)
        self.layers.append(layer)
        self.glow.append(glow)

    def add_disc(self, center: Array, radius_m: float, color: Color) -> None:
        """Add a disc to the current object."""
        self.discs.append((float(center[0]), float(center[1]), float(center[2]), radius_m))
        self.disc_colors.append(color)
        self.disc_groups.append(len(self.anchors) - 1)

    def freeze(self) -> "FrozenMesh":
        """Return the faces and discs so far as arrays."""
        return FrozenMesh(
            np.array(self.quads, float).reshape(-1, 4, 3),
            np.array(self.colors, float).reshape(-1, 3),
            np.array(self.groups, int),
            np.array(self.layers, int),
            np.array(self.glow, bool),
            np.array(self.discs, float).reshape(-1, 4),
            np.array(self.disc_colors, float).reshape(-1, 3),
            np.array(self.disc_groups, int),
            np.array(self.anchors, float).reshape(-1, 3),
            np.array(self.backdrop, bool),
        )


@dataclass(frozen=True)
class FrozenMesh:
    """A ``Mesh`` as arrays; the fields correspond."""

    quads: Array
    colors: Array
    groups: NDArray[np.int64]
    layers: NDArray[np.int64]
    glow: NDArray[np.bool_]
    discs: Array
    disc_colors: Array
    disc_groups: NDArray[np.int64]
    anchors: Array
    backdrop: NDArray[np.bool_]


def merge(first: FrozenMesh, second: FrozenMesh) -> FrozenMesh:
    """Both meshes in one."""
    shift = len(first.anchors)
    return FrozenMesh(
        np.concatenate([first.quads, second.quads]),
        np.concatenate([first.colors, second.colors]),
        np.concatenate([first.groups, second.groups + shift]),
        np.concatenate([first.layers, second.layers]),
        np.concatenate([first.glow, second.glow]),
        np.concatenate([first.discs, second.discs]),
        np.concatenate([first.disc_colors, second.disc_colors]),
        np.concatenate([first.disc_groups, second.disc_groups + shift]),
        np.concatenate([first.anchors, second.anchors]),
        np.concatenate([first.backdrop, second.backdrop]),
    )


def prism_faces(base: Array, low_m: float, high_m: float, top_scale: float = 1.0) -> Array:
    """Side and top faces over a rectangle, anticlockwise seen from outside.

    Args:
        base: Corners, anticlockwise. (4, 2)
        low_m: Height of the bottom.
        high_m: Height of the top.
        top_scale: Size of the top relative to the bottom.

    Returns:
        Corners of the four sides, then of the top. (5, 4, 3)
    """
    middle = base.mean(0)
    low = np.column_stack([base, np.full(4, low_m)])
    high = np.column_stack([middle + top_scale * (base - middle), np.full(4, high_m)])
    following = [1, 2, 3, 0]
    sides = np.stack([low, low[following], high[following], high], axis=1)
    return np.concatenate([sides, high[None]])


def patches(face: Array, left: Array, right: Array, bottom: Array, top: Array) -> Array:
    """Parts of a quad, their edges in shares of its width and height. (n, 4, 3)"""
    across = np.stack([left, right, right, left], axis=1)[..., None]
    upward = np.stack([bottom, bottom, top, top], axis=1)[..., None]
    foot = face[0] + across * (face[1] - face[0])
    head = face[3] + across * (face[2] - face[3])
    return foot + upward * (head - foot)


def patch(face: Array, left: float, right: float, bottom: float, top: float) -> Array:
    """Return one part of a quad. (4, 3)

    Args:
        face: Corners: bottom left, bottom right, top right, top left, in metres. (4, 3)
        left: Where it begins along the bottom, of 1.
        right: Where it ends along the bottom, of 1.
        bottom: Where it begins along the height, of 1.
        top: Where it ends along the height, of 1.
    """
    edges = (np.array([edge]) for edge in (left, right, bottom, top))
    return patches(face, *edges)[0]


def add_building(mesh: Mesh, building: Building, lit_windows: bool = False) -> None:
    """Add walls with rows of windows, and a roof.

    Args:
        mesh: Gets the quads, in world coordinates.
        building: Footprint, height and colour.
        lit_windows: Whether light shines in the windows.
    """
    mesh.begin(np.append(building.footprint.mean(0), 0.0), backdrop=True)
    glass = (110.0, 190.0, 235.0) if lit_windows else (95.0, 80.0, 62.0)
    *walls, roof = prism_faces(building.footprint, 0.0, building.height_m)
    mesh.add_quad(roof, building.color)
    for wall in walls:
        mesh.add_quad(wall, building.color)
        columns = max(1, int(np.linalg.norm(wall[1] - wall[0]) / WINDOW_PITCH_M))
        storeys = max(1, int(building.height_m / STOREY_M))
        storey, column = (i.reshape(-1) for i in np.mgrid[:storeys, :columns])
        for window in patches(
            wall,
            (column + 0.25) / columns,
            (column + 0.75) / columns,
            (storey + 0.3) / storeys,
            (storey + 0.78) / storeys,
        ):
            mesh.add_quad(window, glass, 1, lit_windows)


def add_tree(mesh: Mesh, tree: Array, ground_z_m: float = 0.0) -> None:
    """Add a trunk and a crown of discs.

    Args:
        mesh: Gets the quads and discs, in world coordinates.
        tree: x, y and height in metres. (3,)
        ground_z_m: Height of the ground.
    """
    x, y, height = (float(v) for v in tree)
    mesh.begin(np.array([x, y, ground_z_m]))
    trunk = rectangle(np.array([x, y]), 0.0, TRUNK_M, TRUNK_M)
    for side in prism_faces(trunk, ground_z_m, ground_z_m + 0.5 * height)[:4]:
        mesh.add_quad(side, BARK)
    radius = 0.24 * height
    shade = 0.8 + 0.05 * (int(x * 10) % 7)
    for dx, dy, dz, tone in CROWN:
        above = 0.68 * height + radius * dz
        spot = np.array([x + radius * dx, y + radius * dy, ground_z_m + above])
        mesh.add_disc(spot, radius, (52 * tone, 104 * shade * tone, 72 * shade * tone))


def add_pole(mesh: Mesh, pole: Array, ground_z_m: float = 0.0) -> None:
    """Add a lamp post.

    Args:
        mesh: Gets the quads, in world coordinates.
        pole: x, y and height in metres. (3,)
        ground_z_m: Height of the ground.
    """
    x, y, height = (float(v) for v in pole)
    at = np.array([x, y])
    mesh.begin(np.array([x, y, ground_z_m]))
    top = ground_z_m + height
    for side in prism_faces(rectangle(at, 0.0, POLE_M, POLE_M), ground_z_m, top)[:4]:
        mesh.add_quad(side, (92, 94, 96))
    for face in prism_faces(rectangle(at, 0.0, 4 * POLE_M, 4 * POLE_M), top - 0.3, top):
        mesh.add_quad(face, (120, 122, 124))
