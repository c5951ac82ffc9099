"""Vehicles and people: what they look like at the origin, and where they are."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from minicity.curves import Array, rectangle
from minicity.meshes import Color, FrozenMesh, Mesh, patch, prism_faces

Size = tuple[float, float, float]
TYRES: Color = (34.0, 34.0, 34.0)
GLASS: Color = (74.0, 62.0, 53.0)
TROUSERS: Color = (70.0, 58.0, 52.0)
SKIN: Color = (120.0, 150.0, 190.0)
TAIL_LIGHT: Color = (40.0, 40.0, 215.0)
HEAD_LIGHT: Color = (225.0, 235.0, 235.0)
BACK_FACE, FRONT_FACE, TOP_FACE = 1, 3, 4


@dataclass(frozen=True)
class Vehicle:
    """A vehicle or a person at one moment.

    Attributes:
        category: nuScenes category; ``human.*`` is drawn as a person, ``vehicle.car`` with a cabin.
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


def _body(size: Size, back: float, front: float, width: float) -> Array:
    """A rectangle in shares of a vehicle's size, -0.5 at its back, 0.5 at its front. (4, 2)"""
    center = np.array([(back + front) / 2 * size[0], 0.0])
    return rectangle(center, 0.0, (front - back) * size[0], width * size[1])


def _add_lights(mesh: Mesh, face: Array, color: Color) -> None:
    for left, right in ((0.04, 0.22), (0.78, 0.96)):
        mesh.add_quad(patch(face, left, right, 0.5, 0.8), color, 2, glow=True)


def _add_motor(mesh: Mesh, size: Size, color: Color, tall: bool) -> None:
    """A car with a cabin on its body, or a tall box with windows along its sides."""
    height, shoulder = size[2], size[2] * (0.9 if tall else 0.55)
    for face in prism_faces(_body(size, -0.5, 0.5, 1.0), 0.0, 0.28):
        mesh.add_quad(face, TYRES, 0)
    for k, face in enumerate(prism_faces(_body(size, -0.5, 0.5, 1.0), 0.22, shoulder, 0.97)):
        mesh.add_quad(face, color, 1)
        if k == BACK_FACE:
            _add_lights(mesh, face, TAIL_LIGHT)
        elif k == FRONT_FACE:
            _add_lights(mesh, face, HEAD_LIGHT)
        if tall and k != TOP_FACE:
            mesh.add_quad(patch(face, 0.05, 0.95, 0.55, 0.85), GLASS, 2)
    if not tall:
        for k, face in enumerate(
            prism_faces(_body(size, -0.42, 0.22, 0.92), shoulder, height, 0.82)
        ):
            mesh.add_quad(face, color if k == TOP_FACE else GLASS, 3)


def _add_person(mesh: Mesh, size: Size, color: Color) -> None:
    height = size[2]
    for face in prism_faces(_body(size, -0.3, 0.3, 0.7), 0.0, 0.48 * height):
        mesh.add_quad(face, TROUSERS, 0)
    for face in prism_faces(_body(size, -0.4, 0.4, 1.0), 0.46 * height, 0.84 * height):
        mesh.add_quad(face, color, 1)
    mesh.add_disc(np.array([0.0, 0.0, 0.92 * height]), 0.08 * height, SKIN)


@lru_cache(maxsize=4096)
def _template(category: str, size: Size, color: Color) -> FrozenMesh:
    """A vehicle or person at the origin, standing on z = 0 and heading along +x."""
    mesh = Mesh()
    mesh.begin(np.array([0.0, 0.0, size[2] / 2]))
    if category.startswith("human"):
        _add_person(mesh, size, color)
    else:
        _add_motor(mesh, size, color, tall=category != "vehicle.car")
    return mesh.freeze()


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
