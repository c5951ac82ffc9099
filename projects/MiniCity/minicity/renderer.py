"""Camera pictures of a scene: sky, ground, then everything that stands on it from far to near."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from minicity.camera import NEAR_M, Camera, clip_near
from minicity.curves import Array
from minicity.ground import render_flat_ground, render_uneven_ground
from minicity.lighting import REFERENCE_WIDTH_PX, Lighting, finish, haze_ground, render_sky
from minicity.meshes import FrozenMesh, Mesh, merge
from minicity.scene_map import MATERIALS, HeightGrid, SceneMap
from minicity.terrain import sample_height
from minicity.texture import SHIFT, GroundTexture, Image, darken, paint_ground
from minicity.vehicles import Vehicle, vehicle_mesh

FAR_M = 160.0
SMALL_FAR_M = 90.0
MIN_PIXELS = 1.2
BACKDROP_RADIUS_M = 26.0
SMALL_RADIUS_M = 9.0
SHADOW_FAR_M = 45.0
LIGHT_UNDER_VEHICLES = 0.62  # share of the ground's light left under a vehicle, without sun
LIGHT_IN_SHADOW = 0.52  # and under it or in its shadow, with sun
LOWEST_SUN = 0.2  # sine of the elevation below which shadows grow no longer
TOP_LIGHT = 0.1  # share of the ambient light that depends on how far a face looks up
GLOW = 1.3  # brightness of lamps and lit windows, whatever the light
PAINTED_MARGIN_M = 50.0  # ground that is painted around a camera
FINE_RESOLUTION_M = 0.06  # edge of a ground pixel for images of REFERENCE_WIDTH_PX
NARROWEST_PX = 400


class SceneRenderer:
    """Renders cameras of one scene.

    Args:
        scene_map: Surfaces, kerbs, paint and height of the ground.
        bounds: xmin, ymin, xmax, ymax of the ground that is painted, world metres: about 50 m
            around every camera.
        lighting: Light and weather.
        resolution_m: Edge of a ground pixel; 0.06 suits images 800 pixels wide, 0.12 images of 400.
        rng: Source of the surface's noise.
        static: Buildings, trees and poles.
        shadows: Outlines of their shadows on the ground. Each (n, 2)
    """

    def __init__(
        self,
        scene_map: SceneMap,
        bounds: tuple[float, float, float, float],
        lighting: Lighting,
        resolution_m: float,
        rng: np.random.Generator,
        static: FrozenMesh | None = None,
        shadows: list[Array] | None = None,
    ) -> None:
        if not (bounds[2] > bounds[0] and bounds[3] > bounds[1]):
            raise ValueError(
                f"bounds must be (xmin, ymin, xmax, ymax) with a positive area, got {bounds}."
            )
        if resolution_m <= 0:
            raise ValueError(f"resolution_m must be positive, got {resolution_m}.")
        self.lighting = lighting
        self.height: HeightGrid | None = scene_map.height
        self.ground_z_m = scene_map.ground_z_m
        self.texture: GroundTexture = paint_ground(scene_map, bounds, resolution_m, rng)
        self.lit_texture = darken(self.texture, shadows or [], lighting.shadow)
        self.static = static if static is not None else Mesh().freeze()

    def render_camera(
        self, camera: Camera, vehicles: list[Vehicle], rng: np.random.Generator
    ) -> Image:
        """Take one picture.

        Args:
            camera: The camera, above the ground.
            vehicles: Everything that moves, at the moment of the picture.
            rng: Source of the sensor's noise and of rain streaks.

        Returns:
            The picture, BGR. (H, W, 3)
        """
        sky = render_sky(camera, self.lighting)
        border = MATERIALS["grass"]
        if self.height is None:
            image, distance = render_flat_ground(
                camera, self.lit_texture, sky, border, self.ground_z_m
            )
        else:
            image, distance = render_uneven_ground(
                camera, self.lit_texture, sky, border, self.height
            )
        _shade_under(image, camera, vehicles, self.lighting)
        eye_m = float(camera.center[2]) - self._ground_below(camera)
        haze_ground(image, distance, eye_m, self.lighting)
        eye = camera.center[:2]
        near = [v for v in vehicles if np.linalg.norm(v.center[:2] - eye) < SMALL_FAR_M]
        draw_mesh(image, camera, merge(self.static, vehicle_mesh(near)), self.lighting)
        return finish(image, self.lighting, rng)

    def _ground_below(self, camera: Camera) -> float:
        if self.height is None:
            return self.ground_z_m
        return float(sample_height(self.height, camera.center[None, :2])[0])


def render_camera(
    scene_map: SceneMap, camera: Camera, lighting: Lighting, vehicles: list[Vehicle], seed: int = 0
) -> Image:
    """One picture, BGR; for many of one scene make a ``SceneRenderer`` once. (H, W, 3)"""
    x, y = camera.center[:2]
    resolution = FINE_RESOLUTION_M * REFERENCE_WIDTH_PX / max(camera.width, NARROWEST_PX)
    edge = PAINTED_MARGIN_M
    rng = np.random.default_rng(seed)
    renderer = SceneRenderer(
        scene_map, (x - edge, y - edge, x + edge, y + edge), lighting, resolution, rng
    )
    return renderer.render_camera(camera, vehicles, rng)


def _shade_under(image: Image, camera: Camera, vehicles: list[Vehicle], lighting: Lighting) -> None:
    """Darken the ground under vehicles and in their shadows, in place."""
    mask: Image | None = None
    dark = 255 * (LIGHT_IN_SHADOW if lighting.shadow > 0 else LIGHT_UNDER_VEHICLES)
    forward = camera.cam_from_world[2, :3]
    for vehicle in vehicles:
        sight = vehicle.center - camera.center
        if np.hypot(sight[0], sight[1]) > SHADOW_FAR_M or sight @ forward < -SMALL_RADIUS_M:
            continue
        base = vehicle_shadow(vehicle, lighting)
        z = float(vehicle.center[2] - vehicle.size[2] / 2)
        polygon = clip_near(camera.to_camera(np.column_stack([base, np.full(len(base), z)])))
        if len(polygon) < 3:
            continue
        px = camera.to_pixels(polygon)
        if (px.max(0) < 0).any() or px[:, 0].min() > camera.width or px[:, 1].min() > camera.height:
            continue
        if mask is None:
            mask = np.full(image.shape[:2], 255, np.uint8)
        cv2.fillConvexPoly(mask, _fixed(px), (dark,), cv2.LINE_AA, SHIFT)
    if mask is not None:
        cv2.multiply(image, cv2.merge([mask] * 3), dst=image, scale=1 / 255)


def vehicle_shadow(vehicle: Vehicle, lighting: Lighting) -> Array:
    """Outline points of a vehicle's footprint and of its top cast along the sun's rays. (n, 2)"""
    c, s = np.cos(vehicle.yaw_rad), np.sin(vehicle.yaw_rad)
    half = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * vehicle.size[:2]
    base = half @ np.array([[c, s], [-s, c]]) + vehicle.center[:2]
    if lighting.shadow <= 0:
        return base
    cast = -lighting.sun[:2] / max(float(lighting.sun[2]), LOWEST_SUN) * vehicle.size[2]
    hull = cv2.convexHull(np.concatenate([base, base + cast]).astype(np.float32))
    return hull[:, 0].astype(float)


def _fixed(px: Array) -> NDArray[np.int32]:
    return np.round(np.clip(px, -2e4, 2e4) * (1 << SHIFT)).astype(np.int32)


@dataclass(frozen=True)
class _Drawable:
    order: tuple[int, float, int, float]
    polygon: NDArray[np.int32] | None
    disc: tuple[int, int, int] | None
    color: Array


def draw_mesh(image: Image, camera: Camera, mesh: FrozenMesh, lighting: Lighting) -> None:
    """Paint a mesh into a picture, far objects first, buildings before all else, in place."""
    distance = np.linalg.norm(mesh.anchors - camera.center, axis=1)
    shown = distance < np.where(mesh.backdrop, FAR_M, SMALL_FAR_M)
    shown &= in_view(camera, mesh)
    shown &= ~hidden_by_buildings(camera, mesh, shown, distance)
    veil = 1 - np.exp(-distance / lighting.haze_m)
    drawables = _visible_quads(camera, mesh, shown, distance, lighting) + _visible_discs(
        camera, mesh, shown, distance, lighting
    )
    haze = np.array(lighting.haze)
    for drawable, group in sorted(drawables, key=lambda d: d[0].order):
        color = drawable.color * (1 - veil[group]) + haze * veil[group]
        if drawable.polygon is not None:
            cv2.fillConvexPoly(image, drawable.polygon, color.tolist(), cv2.LINE_AA, SHIFT)
        elif drawable.disc is not None:
            x, y, radius = drawable.disc
            cv2.circle(image, (x, y), radius, color.tolist(), -1, cv2.LINE_AA, SHIFT)


def _visible_quads(
    camera: Camera, mesh: FrozenMesh, shown: NDArray[np.bool_], distance: Array, lighting: Lighting
) -> list[tuple[_Drawable, int]]:
    """Quads that face the camera and touch the picture."""
    index = np.flatnonzero(shown[mesh.groups]) if len(mesh.groups) else np.zeros(0, int)
    if not len(index):
        return []
    corners = camera.to_camera(mesh.quads[index])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
    facing = np.einsum("ij,ij->i", normal, corners[:, 0]) < 0
    in_front = (corners[..., 2] > NEAR_M).any(1)
    index, corners = index[facing & in_front], corners[facing & in_front]
    whole = (corners[..., 2] > NEAR_M).all(1)
    px = camera.to_pixels(np.where(whole[:, None, None], corners, [0.0, 0.0, 1.0]))
    low, high = px.min(1), px.max(1)
    outside = (high < 0).any(1) | (low[:, 0] > camera.width) | (low[:, 1] > camera.height)
    small = (high - low).max(1) < MIN_PIXELS
    decal_far = (
        (mesh.layers[index] > 0) & mesh.backdrop[mesh.groups[index]] & ((high - low).min(1) < 2)
    )
    keep = ~whole | ~(outside | small | decal_far)
    colors = _lit(mesh.colors[index], normal[facing & in_front], mesh.glow[index], camera, lighting)
    depth = np.linalg.norm(corners.mean(1), axis=1)
    fixed = _fixed(px)
    found = []
    for k in np.flatnonzero(keep):
        face, group = int(index[k]), int(mesh.groups[index[k]])
        if whole[k]:
            polygon = fixed[k]
        elif mesh.backdrop[group] and mesh.layers[face] > 0:
            continue
        else:
            polygon = _fixed(camera.to_pixels(clip_near(corners[k])))
        backdrop, layer = bool(mesh.backdrop[group]), int(mesh.layers[face])
        order = (int(not backdrop), -float(distance[group]), layer, -float(depth[k]))
        found.append((_Drawable(order, polygon, None, colors[k]), group))
    return found


def _lit(
    colors: Array, normals_cam: Array, glow: NDArray[np.bool_], camera: Camera, lighting: Lighting
) -> Array:
    """Colours of faces under sky and sun; outward normals in the camera's frame. (F, 3)"""
    unit = normals_cam / np.maximum(np.linalg.norm(normals_cam, axis=1, keepdims=True), 1e-9)
    up, sun = camera.cam_from_world[:3, 2], camera.cam_from_world[:3, :3] @ lighting.sun
    light = lighting.ambient * (
        1 - TOP_LIGHT + TOP_LIGHT * unit @ up
    ) + lighting.direct * np.maximum(unit @ sun, 0)
    return colors * np.where(glow, GLOW, light)[:, None]


def _visible_discs(
    camera: Camera, mesh: FrozenMesh, shown: NDArray[np.bool_], distance: Array, lighting: Lighting
) -> list[tuple[_Drawable, int]]:
    """Discs in front of the camera that touch the picture."""
    index = np.flatnonzero(shown[mesh.disc_groups]) if len(mesh.disc_groups) else np.zeros(0, int)
    centers = camera.to_camera(mesh.discs[index, :3])
    light = lighting.ambient + lighting.direct * max(0.0, float(lighting.sun[2]))
    found = []
    for k in np.flatnonzero(centers[:, 2] > 1.0):
        x, y = camera.to_pixels(centers[k])
        radius = float(mesh.discs[index[k], 3] * camera.intrinsics[0, 0] / centers[k, 2])
        outside = not (-radius < x < camera.width + radius and -radius < y < camera.height + radius)
        if outside or radius < 0.5:
            continue
        group = int(mesh.disc_groups[index[k]])
        disc = (round(x * (1 << SHIFT)), round(y * (1 << SHIFT)), round(radius * (1 << SHIFT)))
        order = (1, -float(distance[group]), 9, -float(np.linalg.norm(centers[k])))
        found.append((_Drawable(order, None, disc, mesh.disc_colors[index[k]] * light), group))
    return found


def in_view(camera: Camera, mesh: FrozenMesh) -> NDArray[np.bool_]:
    """Whether an object may touch the picture, judged by a sphere about its anchor. (G,)"""
    at = camera.to_camera(mesh.anchors)
    radius = np.where(mesh.backdrop, BACKDROP_RADIUS_M, SMALL_RADIUS_M)
    focal, cx = camera.intrinsics[0, 0], camera.intrinsics[0, 2]
    seen = at[:, 2] > -radius
    for side, edge in ((-at[:, 0], cx), (at[:, 0], camera.width - cx)):
        # distance beyond the plane through the camera and this edge of the picture
        beyond = (side * focal - at[:, 2] * edge) / np.hypot(focal, edge)
        seen &= beyond < radius
    return seen


def hidden_by_buildings(
    camera: Camera, mesh: FrozenMesh, shown: NDArray[np.bool_], distance: Array
) -> NDArray[np.bool_]:
    """Whether the line of sight to each object crosses the wall of a building. (G,)"""
    hidden = np.zeros(len(mesh.anchors), bool)
    walls = (
        np.flatnonzero((mesh.layers == 0) & mesh.backdrop[mesh.groups])
        if len(mesh.groups)
        else np.zeros(0, int)
    )
    walls = walls[shown[mesh.groups[walls]] & (distance[mesh.groups[walls]] < SMALL_FAR_M)]
    small = np.flatnonzero(shown & ~mesh.backdrop)
    if not len(walls) or not len(small):
        return hidden
    eye = camera.center[:2]
    start, end = mesh.quads[walls, 0, :2], mesh.quads[walls, 1, :2]
    wall, sight = end - start, mesh.anchors[small, :2] - eye
    cross = sight[:, None, 0] * wall[None, :, 1] - sight[:, None, 1] * wall[None, :, 0]
    cross = np.where(np.abs(cross) < 1e-9, 1e-9, cross)
    gap = start - eye
    along_sight = (gap[:, 0] * wall[:, 1] - gap[:, 1] * wall[:, 0])[None] / cross
    along_wall = (gap[None, :, 0] * sight[:, None, 1] - gap[None, :, 1] * sight[:, None, 0]) / cross
    hits = (along_sight > 0) & (along_sight < 1) & (along_wall > 0) & (along_wall < 1)
    hidden[small] = hits.any(1)
    return hidden
