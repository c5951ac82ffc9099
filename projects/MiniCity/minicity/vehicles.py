"""Vehicles and people, and their meshes."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from minicity.curves import Array, rectangle
from minicity.meshes import Color, FrozenMesh, Mesh, patch, prism_faces

Size = tuple[float, float, float]  # length, width, height in metres
# Colours are BGR.
TYRES: Color = (34.0, 34.0, 34.0)
GLASS: Color = (74.0, 62.0, 53.0)
TROUSERS: Color = (70.0, 58.0, 52.0)
SKIN: Color = (120.0, 150.0, 190.0)
TAIL_LIGHT: Color = (40.0, 40.0, 215.0)
HEAD_LIGHT: Color = (225.0, 235.0, 235.0)
# Indices of the faces of `prism_faces` over a rectangle that heads along +x. `rectangle` lists the
# corners front left, back left, back right, front right, so face 1 stands on the back edge.
BACK_FACE = 1
FRONT_FACE = 3
TOP_FACE = 4


@dataclass(frozen=True)
class Vehicle:
    """Vehicle or person at one moment.

    Attributes:
        category: Category of nuScenes. ``human.*`` is drawn as a person, ``vehicle.car`` as a car
            with a cabin, and every other category as a tall box with windows.
        center: x, y, z of the box's centre in the world, in metres. (3,)
        yaw_rad: Heading in radians, anticlockwise from +x.
        size: Length, width, height in metres.
        color: Colour of the paint, BGR in [0, 255].
        identity: Name of the object, constant through a scene.
        speed: Speed in m/s.
    """

    category: str
    center: Array
    yaw_rad: float
    size: Size
    color: Color
    identity: str = ""
    speed: float = 0.0


def _body(size: Size, back: float, front: float, width: float) -> Array:
    """Rectangle in metres around the origin, heading along +x. (4, 2)

    ``back`` and ``front`` are positions along x as shares of the length in ``size``, -0.5 to 0.5.
    ``width`` is a share of the width in ``size``.
    """
    center = np.array([(back + front) / 2 * size[0], 0.0])
    length_m = (front - back) * size[0]
    return rectangle(center, 0.0, length_m=length_m, width_m=width * size[1])


def _add_lights(mesh: Mesh, face: Array, color: Color) -> None:
    """Add two lamps to a face. (4, 3)

    The corners are in the order bottom left, bottom right, top right, top left.
    """
    for left, right in ((0.04, 0.22), (0.78, 0.96)):  # edges as shares of the width of the face
        lamp = patch(face, left, right, bottom=0.5, top=0.8)
        mesh.add_quad(lamp, color, layer=2, glow=True)


def _add_motor_vehicle(mesh: Mesh, size: Size, color: Color, tall: bool) -> None:
    """Add a car with a cabin on its body, or a tall box with windows along its sides.

    Faces of a higher ``layer`` are drawn over the faces of lower ones.
    """
    height = size[2]
    shoulder_share = 0.9 if tall else 0.55
    shoulder_m = height * shoulder_share  # top of the body
    outline = _body(size, back=-0.5, front=0.5, width=1.0)
    # The wheels are one dark box. The body covers its upper edge.
    for face in prism_faces(outline, low_m=0.0, high_m=0.28):
        mesh.add_quad(face, TYRES, layer=0)
    body = prism_faces(outline, low_m=0.22, high_m=shoulder_m, top_scale=0.97)
    for index, face in enumerate(body):
        mesh.add_quad(face, color, layer=1)
        if index == BACK_FACE:
            _add_lights(mesh, face, color=TAIL_LIGHT)
        elif index == FRONT_FACE:
            _add_lights(mesh, face, color=HEAD_LIGHT)
        if tall and index != TOP_FACE:
            window = patch(face, left=0.05, right=0.95, bottom=0.55, top=0.85)
            mesh.add_quad(window, GLASS, layer=2)
    if not tall:
        cabin_outline = _body(size, back=-0.42, front=0.22, width=0.92)
        cabin = prism_faces(cabin_outline, low_m=shoulder_m, high_m=height, top_scale=0.82)
        for index, face in enumerate(cabin):
            face_color = color if index == TOP_FACE else GLASS
            mesh.add_quad(face, face_color, layer=3)


def _add_person(mesh: Mesh, size: Size, color: Color) -> None:
    """Add legs, a torso and a head."""
    height = size[2]
    legs = _body(size, back=-0.3, front=0.3, width=0.7)
    for face in prism_faces(legs, low_m=0.0, high_m=0.48 * height):
        mesh.add_quad(face, TROUSERS, layer=0)
    torso = _body(size, back=-0.4, front=0.4, width=1.0)
    for face in prism_faces(torso, low_m=0.46 * height, high_m=0.84 * height):
        mesh.add_quad(face, color, layer=1)
    head_center = np.array([0.0, 0.0, 0.92 * height])
    mesh.add_disc(head_center, radius_m=0.08 * height, color=SKIN)


@lru_cache(maxsize=4096)  # the meshes of a scene's vehicles are needed in every frame
def _template(category: str, size: Size, color: Color) -> FrozenMesh:
    """Mesh of a vehicle or person that stands at the origin, on z = 0, and heads along +x."""
    mesh = Mesh()
    mesh.begin(anchor=np.array([0.0, 0.0, size[2] / 2]))
    if category.startswith("human"):
        _add_person(mesh, size, color=color)
    else:
        is_tall = category != "vehicle.car"
        _add_motor_vehicle(mesh, size, color=color, tall=is_tall)
    return mesh.freeze()


def vehicle_mesh(vehicles: list[Vehicle]) -> FrozenMesh:
    """Mesh of vehicles and people in the world, with one object for each, in their order."""
    if not vehicles:
        return Mesh().freeze()
    templates = []  # meshes at the origin, which are shared through a cache and not changed here
    yaws = []
    centers = []
    half_heights = []
    for vehicle in vehicles:
        templates.append(_template(vehicle.category, vehicle.size, color=vehicle.color))
        yaws.append(vehicle.yaw_rad)
        centers.append(vehicle.center)
        half_heights.append([0.0, 0.0, vehicle.size[2] / 2])
    anchors = np.array(centers)
    floor = anchors - np.array(half_heights)  # centres of the bottoms
    local = _concatenate(templates)
    discs = local.discs.copy()
    # No rotation: the disc of a head lies on the vertical axis.
    discs[:, :3] += floor[local.disc_groups]
    # Each of the four corners k of a quad f is rotated by the matrix of the quad's vehicle.
    turn = _rotations(np.array(yaws))[local.groups]
    turned_quads = np.einsum("fij,fkj->fki", turn, local.quads)  # (F, 4, 3)
    quads = turned_quads + floor[local.groups][:, None]
    return replace(local, quads=quads, discs=discs, anchors=anchors)


def _rotations(yaws: Array) -> Array:
    """Rotation matrices about z, by angles in radians. (N,) -> (N, 3, 3)"""
    turn = np.zeros((len(yaws), 3, 3))
    turn[:, 0, 0] = np.cos(yaws)
    turn[:, 0, 1] = -np.sin(yaws)
    turn[:, 1, 0] = np.sin(yaws)
    turn[:, 1, 1] = np.cos(yaws)
    turn[:, 2, 2] = 1.0
    return turn


def _concatenate(meshes: list[FrozenMesh]) -> FrozenMesh:
    """Concatenate meshes of one object each, in new arrays."""
    objects = np.arange(len(meshes))  # index of each object
    num_quads = [len(mesh.quads) for mesh in meshes]
    num_discs = [len(mesh.discs) for mesh in meshes]
    return FrozenMesh(
        quads=np.concatenate([mesh.quads for mesh in meshes]),
        colors=np.concatenate([mesh.colors for mesh in meshes]),
        groups=np.repeat(objects, num_quads),
        layers=np.concatenate([mesh.layers for mesh in meshes]),
        glow=np.concatenate([mesh.glow for mesh in meshes]),
        discs=np.concatenate([mesh.discs for mesh in meshes]),
        disc_colors=np.concatenate([mesh.disc_colors for mesh in meshes]),
        disc_groups=np.repeat(objects, num_discs),
        anchors=np.concatenate([mesh.anchors for mesh in meshes]),
        backdrop=np.concatenate([mesh.backdrop for mesh in meshes]),
    )
