"""Objects on the ground as coloured quads and discs.

A quad is a flat face with four corners. Seen from outside of the object, they run anticlockwise.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from minicity.curves import Array, rectangle
from minicity.town import Building

WINDOW_PITCH_M = 3.4  # distance between the centres of neighbouring windows, about
STOREY_M = 3.0  # height of a storey, about
TRUNK_M = 0.28  # width of a trunk
POLE_M = 0.16  # width of a pole
BARK = (48.0, 62.0, 78.0)  # BGR
# Discs of a crown: x, y, z offsets in crown radii, then brightness.
CROWN = (
    (0.0, 0.0, 0.0, 0.8),
    (0.6, 0.3, -0.1, 0.9),
    (-0.5, 0.5, 0.1, 1.0),
    (0.1, -0.6, 0.3, 1.1),
)
Color = tuple[float, float, float]  # BGR in [0, 255]


@dataclass
class Mesh:
    """Lists of quads and discs, grouped by object. ``freeze`` converts them to arrays.

    Coordinates are in metres in the world frame.

    Attributes:
        quads: Corners of each quad, anticlockwise from outside. Each (4, 3)
        colors: Colour of each quad in full light, BGR in [0, 255].
        groups: Index of the object of each quad.
        layers: Drawing order of each quad inside its object; higher layers cover lower ones.
        glow: Whether each quad shines without light on it, like a lit window.
        discs: (x, y, z, radius) of each disc; discs always face the camera.
        disc_colors: Colour of each disc in full light, BGR in [0, 255].
        disc_groups: Index of the object of each disc.
        anchors: Reference point of each object, from which its distance is measured. Each (3,)
        backdrop: Whether each object is a building, drawn before all other objects.
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
        """Start a new object.

        Args:
            anchor: Reference point in metres. (3,)
            backdrop: Whether the object is a building.
        """
        self.anchors.append(np.asarray(anchor, dtype=float))
        self.backdrop.append(backdrop)

    def add_quad(self, corners: Array, color: Color, layer: int = 0, glow: bool = False) -> None:
        """Add a quad to the current object.

        Args:
            corners: Corners in metres, anticlockwise from outside. (4, 3)
            color: Colour in full light, BGR in [0, 255].
            layer: Drawing order inside the object.
            glow: Whether the quad shines without light on it.
        """
        self.quads.append(corners)
        self.colors.append(color)
        self.groups.append(len(self.anchors) - 1)
        self.layers.append(layer)
        self.glow.append(glow)

    def add_disc(self, center: Array, radius_m: float, color: Color) -> None:
        """Add a disc to the current object.

        Args:
            center: Centre in metres. (3,)
            radius_m: Radius in metres.
            color: Colour in full light, BGR in [0, 255].
        """
        self.discs.append((float(center[0]), float(center[1]), float(center[2]), radius_m))
        self.disc_colors.append(color)
        self.disc_groups.append(len(self.anchors) - 1)

    def freeze(self) -> "FrozenMesh":
        """Copy all quads and discs to arrays."""
        return FrozenMesh(
            quads=np.array(self.quads, dtype=float).reshape(-1, 4, 3),
            colors=np.array(self.colors, dtype=float).reshape(-1, 3),
            groups=np.array(self.groups, dtype=int),
            layers=np.array(self.layers, dtype=int),
            glow=np.array(self.glow, dtype=bool),
            discs=np.array(self.discs, dtype=float).reshape(-1, 4),
            disc_colors=np.array(self.disc_colors, dtype=float).reshape(-1, 3),
            disc_groups=np.array(self.disc_groups, dtype=int),
            anchors=np.array(self.anchors, dtype=float).reshape(-1, 3),
            backdrop=np.array(self.backdrop, dtype=bool),
        )


@dataclass(frozen=True)
class FrozenMesh:
    """Arrays of a ``Mesh`` with F quads, D discs and G objects.

    Attributes:
        quads: Corners in metres, anticlockwise from outside. (F, 4, 3)
        colors: Colours of the quads in full light, BGR in [0, 255]. (F, 3)
        groups: Index of the object of each quad. (F,)
        layers: Drawing order of each quad inside its object. (F,)
        glow: Whether each quad shines without light on it. (F,)
        discs: x, y, z and radius in metres. (D, 4)
        disc_colors: Colours of the discs in full light, BGR in [0, 255]. (D, 3)
        disc_groups: Index of the object of each disc. (D,)
        anchors: Reference point of each object in metres, from which its distance is measured.
            (G, 3)
        backdrop: Whether each object is a building, drawn before all other objects. (G,)
    """

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
    """Concatenate two meshes. The numbers of the second mesh's objects follow the first mesh's."""
    shift = len(first.anchors)
    return FrozenMesh(
        quads=np.concatenate([first.quads, second.quads]),
        colors=np.concatenate([first.colors, second.colors]),
        groups=np.concatenate([first.groups, second.groups + shift]),
        layers=np.concatenate([first.layers, second.layers]),
        glow=np.concatenate([first.glow, second.glow]),
        discs=np.concatenate([first.discs, second.discs]),
        disc_colors=np.concatenate([first.disc_colors, second.disc_colors]),
        disc_groups=np.concatenate([first.disc_groups, second.disc_groups + shift]),
        anchors=np.concatenate([first.anchors, second.anchors]),
        backdrop=np.concatenate([first.backdrop, second.backdrop]),
    )


def prism_faces(base: Array, low_m: float, high_m: float, top_scale: float = 1.0) -> Array:
    """Compute the side and top faces of a prism over a rectangle, anticlockwise from outside.

    Side i stands on the edge from corner i of the rectangle to the next corner. It begins with its
    lower corners. There is no bottom face.

    Args:
        base: Corners of the rectangle in metres, anticlockwise. (4, 2)
        low_m: Height of the bottom in metres.
        high_m: Height of the top in metres.
        top_scale: Size of the top relative to the bottom.

    Returns:
        Corners of the four sides, then of the top, in metres. (5, 4, 3)
    """
    middle = base.mean(axis=0)
    low = np.column_stack([base, np.full(4, low_m)])
    high = np.column_stack([middle + top_scale * (base - middle), np.full(4, high_m)])
    following = [1, 2, 3, 0]  # the next corner of each corner
    sides = np.stack([low, low[following], high[following], high], axis=1)
    return np.concatenate([sides, high[None]])


def patches(face: Array, left: Array, right: Array, bottom: Array, top: Array) -> Array:
    """Compute rectangular parts of a quad.

    Args:
        face: Corners: bottom left, bottom right, top right, top left, in metres. (4, 3)
        left: Left edges as shares of the width, in [0, 1]. (n,)
        right: Right edges as shares of the width, in [0, 1]. (n,)
        bottom: Lower edges as shares of the height, in [0, 1]. (n,)
        top: Upper edges as shares of the height, in [0, 1]. (n,)

    Returns:
        Corners of each part in the order of ``face``, in metres. (n, 4, 3)
    """
    # The four corners of a part are at these shares of the width and of the height. (n, 4, 1)
    across = np.stack([left, right, right, left], axis=1)[..., None]
    upward = np.stack([bottom, bottom, top, top], axis=1)[..., None]
    foot = face[0] + across * (face[1] - face[0])
    head = face[3] + across * (face[2] - face[3])
    return foot + upward * (head - foot)


def patch(face: Array, left: float, right: float, bottom: float, top: float) -> Array:
    """Compute one rectangular part of a quad.

    Args:
        face: Corners: bottom left, bottom right, top right, top left, in metres. (4, 3)
        left: Left edge as a share of the width, in [0, 1].
        right: Right edge as a share of the width, in [0, 1].
        bottom: Lower edge as a share of the height, in [0, 1].
        top: Upper edge as a share of the height, in [0, 1].

    Returns:
        Corners of the part in the order of ``face``, in metres. (4, 3)
    """
    parts = patches(
        face,
        left=np.array([left]),
        right=np.array([right]),
        bottom=np.array([bottom]),
        top=np.array([top]),
    )
    return parts[0]


def add_building(mesh: Mesh, building: Building, lit_windows: bool = False) -> None:
    """Add walls with rows of windows, and a roof.

    Args:
        mesh: Mesh in world coordinates, extended in place.
        building: Footprint, height and colour.
        lit_windows: Whether the windows shine.
    """
    mesh.begin(np.append(building.footprint.mean(axis=0), 0.0), backdrop=True)
    glass = (110.0, 190.0, 235.0) if lit_windows else (95.0, 80.0, 62.0)  # yellow, or dark blue
    *walls, roof = prism_faces(building.footprint, low_m=0.0, high_m=building.height_m)
    mesh.add_quad(roof, building.color)
    storeys = max(1, int(building.height_m / STOREY_M))
    for wall in walls:
        mesh.add_quad(wall, building.color)
        columns = max(1, int(np.linalg.norm(wall[1] - wall[0]) / WINDOW_PITCH_M))
        # Storey and column of each window.
        storey, column = np.mgrid[:storeys, :columns].reshape(2, -1)
        windows = patches(
            wall,
            left=(column + 0.25) / columns,
            right=(column + 0.75) / columns,
            bottom=(storey + 0.3) / storeys,
            top=(storey + 0.78) / storeys,
        )
        for window in windows:
            mesh.add_quad(window, glass, layer=1, glow=lit_windows)


def add_tree(mesh: Mesh, tree: Array, ground_z_m: float = 0.0) -> None:
    """Add a trunk and a crown of discs.

    Args:
        mesh: Mesh in world coordinates, extended in place.
        tree: x, y and height in metres. (3,)
        ground_z_m: Height of the ground in metres.
    """
    x, y, height = tree.tolist()
    mesh.begin(np.array([x, y, ground_z_m]))
    trunk = rectangle(np.array([x, y]), 0.0, length_m=TRUNK_M, width_m=TRUNK_M)
    trunk_top = ground_z_m + 0.5 * height
    for side in prism_faces(trunk, low_m=ground_z_m, high_m=trunk_top)[:4]:  # without the top
        mesh.add_quad(side, BARK)
    radius = 0.24 * height
    # The shade depends on the position, so that neighbouring trees differ.
    shade = 0.8 + 0.05 * (int(x * 10) % 7)
    for dx, dy, dz, tone in CROWN:
        above = 0.68 * height + radius * dz
        spot = np.array([x + radius * dx, y + radius * dy, ground_z_m + above])
        mesh.add_disc(spot, radius, color=(52 * tone, 104 * shade * tone, 72 * shade * tone))


def add_pole(mesh: Mesh, pole: Array, ground_z_m: float = 0.0) -> None:
    """Add a lamp post.

    Args:
        mesh: Mesh in world coordinates, extended in place.
        pole: x, y and height in metres. (3,)
        ground_z_m: Height of the ground in metres.
    """
    x, y, height = pole.tolist()
    foot = np.array([x, y])
    mesh.begin(np.array([x, y, ground_z_m]))
    top = ground_z_m + height
    shaft = rectangle(foot, 0.0, length_m=POLE_M, width_m=POLE_M)
    for side in prism_faces(shaft, low_m=ground_z_m, high_m=top)[:4]:  # without the top
        mesh.add_quad(side, (92, 94, 96))
    lamp = rectangle(foot, 0.0, length_m=4 * POLE_M, width_m=4 * POLE_M)
    for face in prism_faces(lamp, low_m=top - 0.3, high_m=top):  # a box at the top of the pole
        mesh.add_quad(face, (120, 122, 124))
