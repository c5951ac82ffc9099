"""Things that stand on the ground, as coloured quads and discs."""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from gsmap.datasets.minicity.curves import Array
from gsmap.datasets.minicity.town import Building

Color = tuple[float, float, float]
Size = tuple[float, float, float]


@dataclass(frozen=True)
class Vehicle:
    """A vehicle or a person at one moment.

    Attributes:
        category: nuScenes category name.
        center: x, y, z of the box's centre in the world. (3,)
        yaw_rad: Heading.
        size: Length, width, height in metres.
        color: Paint, BGR.
        identity: Name that stays with it through a scene.
        speed: Speed in m/s.
    """

    category: str
    center: Array
    yaw_rad: float
    size: tuple[float, float, float]
    color: Color
    identity: str = ""
    speed: float = 0.0


@dataclass
class Mesh:
    """Quads and discs, grouped by the object that they belong to. ``add_*`` fill it, ``freeze`` makes arrays of it.

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
        self.discs.append((*(float(c) for c in center), radius_m))
        self.disc_colors.append(color)
        self.disc_groups.append(len(self.anchors) - 1)

    def freeze(self) -> "FrozenMesh":
        """The same as arrays."""
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


def prism_faces(
    base: Array, low_m: float, high_m: float, top_scale: float = 1.0
) -> list[tuple[Array, Array]]:
    """Side and top faces over a rectangle.

    Args:
        base: Corners, anticlockwise. (4, 2)
        low_m: Height of the bottom.
        high_m: Height of the top.
        top_scale: Size of the top relative to the bottom.

    Returns:
        (corners (4, 3), outward normal (3,)) of four sides and the top.
    """
    middle = base.mean(0)
    low = np.column_stack([base, np.full(4, low_m)])
    high = np.column_stack([middle + top_scale * (base - middle), np.full(4, high_m)])
    faces = []
    for i in range(4):
        j = (i + 1) % 4
        corners = np.stack([low[i], low[j], high[j], high[i]])
        normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
        faces.append((corners, normal / max(float(np.linalg.norm(normal)), 1e-9)))
    faces.append((high, np.array([0.0, 0.0, 1.0])))
    return faces


def _patch(face: Array, left: float, right: float, bottom: float, top: float) -> Array:
    """A part of a quad, in shares of its width and height. (4, 3)"""
    low, high = (
        face[0] + np.outer([left, right], face[1] - face[0]),
        face[3] + np.outer([left, right], face[2] - face[3]),
    )
    at = np.array([bottom, bottom, top, top])[:, None]
    foot, head = low[[0, 1, 1, 0]], high[[0, 1, 1, 0]]
    return foot + at * (head - foot)


def add_building(mesh: Mesh, building: Building, lit_windows: bool = False) -> None:
    """Walls with rows of windows, and a roof."""
    mesh.begin(np.append(building.footprint.mean(0), 0.0), backdrop=True)
    faces = prism_faces(building.footprint, 0.0, building.height_m)
    glass = (110.0, 190.0, 235.0) if lit_windows else (95.0, 80.0, 62.0)
    for corners, normal in faces:
        mesh.add_quad(corners, building.color)
        if normal[2] > 0.5:
            continue
        columns = max(1, int(np.linalg.norm(corners[1] - corners[0]) / 3.4))
        storeys = max(1, int(building.height_m / 3.0))
        for storey in range(storeys):
            bottom, top = (storey + 0.3) / storeys, (storey + 0.78) / storeys
            for column in range(columns):
                patch = _patch(
                    corners, (column + 0.25) / columns, (column + 0.75) / columns, bottom, top
                )
                mesh.add_quad(patch, glass, 1, lit_windows)


def add_tree(mesh: Mesh, tree: Array, ground_z_m: float = 0.0) -> None:
    """A trunk and a crown of five discs."""
    x, y, height = (float(v) for v in tree)
    mesh.begin(np.array([x, y, ground_z_m]))
    base = np.array([[0.14, 0.14], [-0.14, 0.14], [-0.14, -0.14], [0.14, -0.14]]) + [x, y]
    for corners, normal in prism_faces(base, ground_z_m, ground_z_m + 0.5 * height)[:4]:
        mesh.add_quad(corners, (48, 62, 78))
    radius = 0.24 * height
    shade = 0.8 + 0.05 * (int(x * 10) % 7)
    for dx, dy, dz, tone in (
        (0, 0, 0, 0.8),
        (0.6, 0.3, -0.1, 0.9),
        (-0.5, 0.5, 0.1, 1.0),
        (0.1, -0.6, 0.3, 1.1),
    ):
        spot = np.array(
            [x + radius * dx, y + radius * dy, ground_z_m + 0.68 * height + radius * dz]
        )
        color = (52, 104 * shade, 72 * shade)
        mesh.add_disc(spot, radius, (color[0] * tone, color[1] * tone, color[2] * tone))


def add_pole(mesh: Mesh, pole: Array, ground_z_m: float = 0.0) -> None:
    """A lamp post."""
    x, y, height = (float(v) for v in pole)
    mesh.begin(np.array([x, y, ground_z_m]))
    base = np.array([[0.08, 0.08], [-0.08, 0.08], [-0.08, -0.08], [0.08, -0.08]]) + [x, y]
    for corners, normal in prism_faces(base, ground_z_m, ground_z_m + height)[:4]:
        mesh.add_quad(corners, (92, 94, 96))
    for corners, normal in prism_faces(
        base + 3 * (base - [x, y]), ground_z_m + height - 0.3, ground_z_m + height
    ):
        mesh.add_quad(corners, (120, 122, 124))


def _local_rectangle(size: Size, back: float, front: float, width_share: float) -> Array:
    """A rectangle in shares of a vehicle's length, from -0.5 at its back to 0.5 at its front. (4, 2)"""
    length, width = size[0], size[1] * width_share
    return np.array(
        [
            [front * length, width / 2],
            [back * length, width / 2],
            [back * length, -width / 2],
            [front * length, -width / 2],
        ]
    )


@lru_cache(maxsize=4096)
def _template(category: str, size: Size, color: Color) -> FrozenMesh:
    """A car, truck, bus or person at the origin, heading along +x."""
    mesh = Mesh()
    height = size[2]
    mesh.begin(np.array([0.0, 0.0, height / 2]))
    if category.startswith("human"):
        _add_person(mesh, size, color)
        return mesh.freeze()
    tall = category != "vehicle.car"
    split = 0.9 if tall else 0.55
    for corners, normal in prism_faces(_local_rectangle(size, -0.5, 0.5, 1.0), 0.0, 0.28):
        mesh.add_quad(corners, (34, 34, 34), 0)
    body = prism_faces(_local_rectangle(size, -0.5, 0.5, 1.0), 0.22, split * height, 0.97)
    for k, (corners, normal) in enumerate(body):
        mesh.add_quad(corners, color, 1)
        if k == 1:
            _add_lights(mesh, corners, (40, 40, 215))
        elif k == 3:
            _add_lights(mesh, corners, (225, 235, 235))
        if tall and k < 4:
            mesh.add_quad(_patch(corners, 0.05, 0.95, 0.55, 0.85), (70, 58, 50), 2)
    if not tall:
        cabin = prism_faces(_local_rectangle(size, -0.42, 0.22, 0.92), split * height, height, 0.82)
        for corners, normal in cabin:
            roof = normal[2] > 0.9
            mesh.add_quad(corners, color if roof else (78, 66, 56), 3)

    return mesh.freeze()


def _add_lights(mesh: Mesh, face: Array, color: Color) -> None:
    for left, right in ((0.04, 0.22), (0.78, 0.96)):
        mesh.add_quad(_patch(face, left, right, 0.5, 0.8), color, 2, glow=True)


def _add_person(mesh: Mesh, size: Size, color: Color) -> None:
    height = size[2]
    for corners, normal in prism_faces(_local_rectangle(size, -0.3, 0.3, 0.7), 0.0, 0.48 * height):
        mesh.add_quad(corners, (70, 58, 52), 0)
    for corners, normal in prism_faces(
        _local_rectangle(size, -0.4, 0.4, 1.0), 0.46 * height, 0.84 * height
    ):
        mesh.add_quad(corners, color, 1)
    mesh.add_disc(np.array([0.0, 0.0, 0.92 * height]), 0.08 * height, (120, 150, 190))


def vehicle_mesh(vehicles: list[Vehicle]) -> FrozenMesh:
    """Vehicles and people where they are. An object's number is its place in the list."""
    templates = [_template(v.category, v.size, v.color) for v in vehicles]
    if not templates:
        return Mesh().freeze()
    numbers = np.arange(len(templates))
    of_quad = np.repeat(numbers, [len(t.quads) for t in templates])
    of_disc = np.repeat(numbers, [len(t.discs) for t in templates])
    turn = np.zeros((len(vehicles), 3, 3))
    yaw = np.array([v.yaw_rad for v in vehicles])
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(yaw)
    turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = np.sin(yaw), -np.sin(yaw), 1.0
    centers = np.array([v.center for v in vehicles])
    floor = centers - np.array([[0.0, 0.0, v.size[2] / 2] for v in vehicles])
    quads = np.concatenate([t.quads for t in templates])
    discs = np.concatenate([t.discs for t in templates])
    quads = np.einsum("fij,fkj->fki", turn[of_quad], quads) + floor[of_quad][:, None]
    discs[:, :3] += floor[of_disc]
    return FrozenMesh(
        quads,
        np.concatenate([t.colors for t in templates]),
        of_quad,
        np.concatenate([t.layers for t in templates]),
        np.concatenate([t.glow for t in templates]),
        discs,
        np.concatenate([t.disc_colors for t in templates]),
        of_disc,
        centers,
        np.zeros(len(vehicles), bool),
    )
