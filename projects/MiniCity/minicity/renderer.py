"""Camera pictures of a scene: sky, ground, then the objects on it from far to near."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsmap.utils.errors import InputError
from minicity.camera import NEAR_M, Camera, clip_near
from minicity.curves import Array
from minicity.ground import render_flat_ground, render_uneven_ground
from minicity.lighting import REFERENCE_WIDTH_PX, Lighting, finish, haze_ground, render_sky
from minicity.meshes import FrozenMesh, Mesh, merge
from minicity.scene_map import MATERIALS, HeightGrid, SceneMap
from minicity.terrain import sample_height
from minicity.texture import SHIFT, GroundTexture, Image, darken, paint_ground
from minicity.vehicles import Vehicle, vehicle_mesh

FAR_M = 160.0  # largest distance of visible buildings
SMALL_FAR_M = 90.0  # largest distance of other visible objects
MIN_PIXELS = 1.2  # quads with a smaller extent are not drawn
BACKDROP_RADIUS_M = 26.0  # radius of a sphere around any building (`FrozenMesh.backdrop`)
SMALL_RADIUS_M = 9.0  # radius of a sphere around any other object
SHADOW_FAR_M = 45.0  # largest distance of vehicles with a shadow
LIGHT_UNDER_VEHICLES = 0.62  # share of the light that remains under a vehicle if no sun shines
LIGHT_IN_SHADOW = 0.52  # share that remains under a vehicle and in its shadow if the sun shines
LOWEST_SUN = 0.2  # sine of the elevation below which shadows do not become longer
TOP_LIGHT = 0.1  # share of the ambient light that depends on how far a face is turned upwards
GLOW = 1.3  # brightness of lamps and lit windows under any light
PAINTED_MARGIN_M = 50.0  # extent of the painted ground around a camera
FINE_RESOLUTION_M = 0.06  # edge of a ground pixel for images of REFERENCE_WIDTH_PX
NARROWEST_PX = 400  # narrower images get the ground pixels of an image of this width


class SceneRenderer:
    """Renderer for the cameras of one scene.

    Args:
        scene_map: Surfaces, kerbs, paint and height of the ground.
        bounds: xmin, ymin, xmax, ymax of the painted ground in the world, in metres: about 50 m
            around every camera.
        lighting: Light and weather.
        resolution_m: Edge of a ground pixel in metres, > 0. Suitable values are 0.06 for images 800
            pixels wide, and 0.12 for 400 pixels.
        rng: Source of the surface noise.
        static: Buildings, trees and poles.
        shadows: Outlines of the shadows of ``static`` on the ground, in metres. Each (n, 2)

    Raises:
        ValueError: If ``bounds`` have no area or ``resolution_m`` is not positive.
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
            raise InputError(
                f"bounds must be (xmin, ymin, xmax, ymax) with a positive area, got {bounds}."
            )
        if resolution_m <= 0:
            raise InputError(f"resolution_m must be positive, got {resolution_m}.")
        self.lighting = lighting
        self.height: HeightGrid | None = scene_map.height
        self.ground_z_m = scene_map.ground_z_m
        self.texture: GroundTexture = paint_ground(
            scene_map, bounds, resolution_m=resolution_m, rng=rng
        )
        self.lit_texture = darken(self.texture, shadows or [], strength=lighting.shadow)
        self.static = static if static is not None else Mesh().freeze()

    def render_camera(
        self, camera: Camera, vehicles: list[Vehicle], rng: np.random.Generator
    ) -> Image:
        """Render one picture.

        Args:
            camera: The camera, above the ground.
            vehicles: Vehicles and people at the moment of the picture.
            rng: Source of the sensor noise and of rain streaks.

        Returns:
            The picture, BGR. (H, W, 3)
        """
        sky = render_sky(camera, self.lighting)
        border = MATERIALS["grass"]
        if self.height is None:
            ground_z_m = self.ground_z_m
            image, distance = render_flat_ground(
                camera, self.lit_texture, background=sky, border=border, ground_z_m=ground_z_m
            )
        else:
            ground_z_m = float(sample_height(self.height, camera.center[None, :2])[0])
            image, distance = render_uneven_ground(
                camera, self.lit_texture, background=sky, border=border, height=self.height
            )
        _shade_under(image, camera, vehicles=vehicles, lighting=self.lighting)
        eye_m = float(camera.center[2]) - ground_z_m
        haze_ground(image, distance, eye_m=eye_m, lighting=self.lighting)
        eye = camera.center[:2]
        # `draw_mesh` leaves out farther vehicles in any case, so no meshes are made for them.
        near = [v for v in vehicles if np.linalg.norm(v.center[:2] - eye) < SMALL_FAR_M]
        mesh = merge(self.static, vehicle_mesh(near))
        draw_mesh(image, camera, mesh=mesh, lighting=self.lighting)
        return finish(image, self.lighting, rng=rng)


def render_camera(
    scene_map: SceneMap, camera: Camera, lighting: Lighting, vehicles: list[Vehicle], seed: int = 0
) -> Image:
    """Render one picture. For several pictures of a scene, ``SceneRenderer`` is faster.

    Args:
        scene_map: Surfaces, kerbs, paint and height of the ground.
        camera: The camera, above the ground.
        lighting: Light and weather.
        vehicles: Vehicles and people.
        seed: Seed of the noise and of rain streaks.

    Returns:
        The picture, BGR. (H, W, 3)
    """
    x, y = camera.center[:2]
    edge = PAINTED_MARGIN_M
    rng = np.random.default_rng(seed)
    renderer = SceneRenderer(
        scene_map,
        bounds=(x - edge, y - edge, x + edge, y + edge),
        lighting=lighting,
        resolution_m=FINE_RESOLUTION_M * REFERENCE_WIDTH_PX / max(camera.width, NARROWEST_PX),
        rng=rng,
    )
    return renderer.render_camera(camera, vehicles, rng=rng)


def _shade_under(image: Image, camera: Camera, vehicles: list[Vehicle], lighting: Lighting) -> None:
    """Darken the ground under vehicles and in their shadows, in place."""
    mask: Image | None = None  # share of the light of each pixel, 255 for all of it
    light = LIGHT_IN_SHADOW if lighting.shadow > 0 else LIGHT_UNDER_VEHICLES
    shade = 255 * light
    forward = camera.cam_from_world[2, :3]  # optical axis in the world
    for vehicle in vehicles:
        sight = vehicle.center - camera.center
        is_far = np.hypot(sight[0], sight[1]) > SHADOW_FAR_M
        is_behind = sight @ forward < -SMALL_RADIUS_M
        if is_far or is_behind:
            continue
        outline = vehicle_shadow(vehicle, lighting)
        z = float(vehicle.center[2] - vehicle.size[2] / 2)
        world = np.column_stack([outline, np.full(len(outline), z)])
        polygon = clip_near(camera.to_camera(world))  # the part in front of the camera
        if len(polygon) < 3:
            continue
        px = camera.to_pixels(polygon)
        left, top = px.min(axis=0)
        right, bottom = px.max(axis=0)
        if right < 0 or bottom < 0 or left > camera.width or top > camera.height:
            continue
        if mask is None:
            mask = np.full(image.shape[:2], 255, dtype=np.uint8)
        cv2.fillConvexPoly(
            mask, _fixed_point(px), color=(shade,), lineType=cv2.LINE_AA, shift=SHIFT
        )
    if mask is not None:
        cv2.multiply(image, cv2.merge([mask] * 3), dst=image, scale=1 / 255)


def vehicle_shadow(vehicle: Vehicle, lighting: Lighting) -> Array:
    """Outline of a vehicle's footprint, together with its shadow if the sun shines.

    Args:
        vehicle: The vehicle.
        lighting: Direction of the sun, and strength of shadows.

    Returns:
        Convex outline on the ground, in metres. (n, 2)
    """
    c = np.cos(vehicle.yaw_rad)
    s = np.sin(vehicle.yaw_rad)
    half = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * vehicle.size[:2]
    # Corners turned by yaw. The matrix is transposed, as it multiplies row vectors. (4, 2)
    base = half @ np.array([[c, s], [-s, c]]) + vehicle.center[:2]
    if lighting.shadow <= 0:
        return base
    height = vehicle.size[2]
    # Displacement of the shadow of the roof from the footprint.
    shadow_shift = -lighting.sun[:2] / max(float(lighting.sun[2]), LOWEST_SUN) * height
    hull = cv2.convexHull(np.concatenate([base, base + shadow_shift]).astype(np.float32))
    return hull[:, 0].astype(float)  # OpenCV returns (n, 1, 2)


def _fixed_point(px: Array) -> NDArray[np.int32]:
    """Convert pixels to OpenCV's fixed-point format. (..., 2) -> (..., 2)"""
    # Points far outside of the image are moved to the limit, as they would overflow int32.
    return np.round(np.clip(px, -2e4, 2e4) * (1 << SHIFT)).astype(np.int32)


@dataclass(frozen=True)
class _Drawable:
    """Polygon or disc in image coordinates.

    Attributes:
        order: Sort key; the shape with the smallest key is drawn first. Its four numbers are 0 for
            buildings or 1 for other objects, the negative distance of the object in metres, the
            layer inside the object, and the negative depth of the shape in metres.
        group: Index of the object.
        polygon: Corners in fixed-point pixels, or None. (n, 2)
        disc: x, y and radius in fixed-point pixels, or None.
        color: Colour under the light of the scene, BGR. (3,)
    """

    order: tuple[int, float, int, float]
    group: int
    polygon: NDArray[np.int32] | None
    disc: tuple[int, int, int] | None
    color: Array


def draw_mesh(image: Image, camera: Camera, mesh: FrozenMesh, lighting: Lighting) -> None:
    """Draw a mesh into a picture, in place: buildings first, then other objects, far ones first.

    Args:
        image: Picture with sky and ground, BGR. (H, W, 3)
        camera: The camera.
        mesh: Objects in world coordinates.
        lighting: Light and haze.
    """
    distance = np.linalg.norm(mesh.anchors - camera.center, axis=1)
    visible = distance < np.where(mesh.backdrop, FAR_M, SMALL_FAR_M)
    visible &= frustum_mask(camera, mesh)
    visible &= ~occlusion_mask(camera, mesh, visible=visible, distance=distance)
    drawables = [
        *_visible_quads(camera, mesh, visible=visible, distance=distance, lighting=lighting),
        *_visible_discs(camera, mesh, visible=visible, distance=distance, lighting=lighting),
    ]
    veil = 1 - np.exp(-distance / lighting.haze_m)  # share of the colour of the haze, by object
    haze = np.array(lighting.haze)
    for drawable in sorted(drawables, key=lambda d: d.order):
        share = veil[drawable.group]
        color = (drawable.color * (1 - share) + haze * share).tolist()
        if drawable.polygon is not None:
            cv2.fillConvexPoly(
                image, drawable.polygon, color=color, lineType=cv2.LINE_AA, shift=SHIFT
            )
        elif drawable.disc is not None:
            x, y, radius = drawable.disc
            cv2.circle(
                image,
                (x, y),
                radius=radius,
                color=color,
                thickness=-1,
                lineType=cv2.LINE_AA,
                shift=SHIFT,
            )


def _visible_quads(
    camera: Camera,
    mesh: FrozenMesh,
    visible: NDArray[np.bool_],
    distance: Array,
    lighting: Lighting,
) -> Iterator[_Drawable]:
    """Quads of visible objects that face the camera and touch the picture.

    Args:
        camera: The camera.
        mesh: Objects in world coordinates.
        visible: Whether each object may be visible. (G,)
        distance: Distance of each object in metres. (G,)
        lighting: Light on the quads.
    """
    index = np.flatnonzero(visible[mesh.groups])  # quads of visible objects
    if not len(index):
        return
    corners = camera.to_camera(mesh.quads[index])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
    # The camera is the origin of camera coordinates, so `corners` are directions of sight.
    facing = np.einsum("ij,ij->i", normals, corners[:, 0]) < 0  # normals point to the camera
    in_front = (corners[..., 2] > NEAR_M).any(axis=1)
    candidates = facing & in_front
    index = index[candidates]
    corners = corners[candidates]
    normals = normals[candidates]
    whole = (corners[..., 2] > NEAR_M).all(axis=1)  # no corner behind the near plane
    # Other quads get an arbitrary point in front of the camera here, and are clipped below.
    px = camera.to_pixels(np.where(whole[:, None, None], corners, [0.0, 0.0, 1.0]))
    low = px.min(axis=1)
    high = px.max(axis=1)
    extent = high - low
    outside = (high < 0).any(axis=1) | (low[:, 0] > camera.width) | (low[:, 1] > camera.height)
    small = extent.max(axis=1) < MIN_PIXELS
    # Layer 0 of a building has the walls and the roof; the layer above has the windows.
    windows = (mesh.layers[index] > 0) & mesh.backdrop[mesh.groups[index]]
    narrow_windows = windows & (extent.min(axis=1) < 2)
    drawn_whole = whole & ~(outside | small | narrow_windows)
    drawn_clipped = ~whole & ~windows
    colors = _shade_faces(
        mesh.colors[index], normals, glow=mesh.glow[index], camera=camera, lighting=lighting
    )
    depth = np.linalg.norm(corners.mean(axis=1), axis=1)
    polygons = _fixed_point(px)
    for k in np.flatnonzero(drawn_whole | drawn_clipped):
        polygon = polygons[k]
        if not whole[k]:
            polygon = _fixed_point(camera.to_pixels(clip_near(corners[k])))
        group = int(mesh.groups[index[k]])
        foreground = int(not mesh.backdrop[group])
        layer = int(mesh.layers[index[k]])
        yield _Drawable(
            order=(foreground, -float(distance[group]), layer, -float(depth[k])),
            group=group,
            polygon=polygon,
            disc=None,
            color=colors[k],
        )


def _shade_faces(
    colors: Array,
    normals_cam: Array,
    glow: NDArray[np.bool_],
    camera: Camera,
    lighting: Lighting,
) -> Array:
    """Colours of faces under sky and sun.

    Args:
        colors: Colours in full light, BGR. (F, 3)
        normals_cam: Outward normals in the camera frame, of any length. (F, 3)
        glow: Whether each face emits light. (F,)
        camera: The camera.
        lighting: Light on the faces.

    Returns:
        Shaded colours, BGR. (F, 3)
    """
    unit = normals_cam / np.maximum(np.linalg.norm(normals_cam, axis=1, keepdims=True), 1e-9)
    up = camera.cam_from_world[:3, 2]  # z axis of the world in the camera frame
    sun = camera.cam_from_world[:3, :3] @ lighting.sun
    from_sky = lighting.ambient * (1 - TOP_LIGHT + TOP_LIGHT * unit @ up)
    from_sun = lighting.direct * np.maximum(unit @ sun, 0)
    return colors * np.where(glow, GLOW, from_sky + from_sun)[:, None]


def _visible_discs(
    camera: Camera,
    mesh: FrozenMesh,
    visible: NDArray[np.bool_],
    distance: Array,
    lighting: Lighting,
) -> Iterator[_Drawable]:
    """Discs of visible objects in front of the camera that touch the picture.

    Args:
        camera: The camera.
        mesh: Objects in world coordinates.
        visible: Whether each object may be visible. (G,)
        distance: Distance of each object in metres. (G,)
        lighting: Light on the discs.
    """
    index = np.flatnonzero(visible[mesh.disc_groups])  # discs of visible objects
    centers = camera.to_camera(mesh.discs[index, :3])
    light = lighting.ambient + lighting.direct * max(0.0, float(lighting.sun[2]))
    scale = 1 << SHIFT  # fixed-point steps of OpenCV per pixel
    for k in np.flatnonzero(centers[:, 2] > 1.0):
        x, y = camera.to_pixels(centers[k])
        radius = float(mesh.discs[index[k], 3] * camera.intrinsics[0, 0] / centers[k, 2])
        inside_x = -radius < x < camera.width + radius
        inside_y = -radius < y < camera.height + radius
        if not (inside_x and inside_y) or radius < 0.5:
            continue
        group = int(mesh.disc_groups[index[k]])
        depth = float(np.linalg.norm(centers[k]))
        yield _Drawable(
            order=(1, -float(distance[group]), 9, -depth),  # 9 is above all layers of quads
            group=group,
            polygon=None,
            disc=(round(x * scale), round(y * scale), round(radius * scale)),
            color=mesh.disc_colors[index[k]] * light,
        )


def frustum_mask(camera: Camera, mesh: FrozenMesh) -> NDArray[np.bool_]:
    """Whether each object may touch the picture, by a sphere around its anchor. (G,)

    Only the left and right edges of the picture are tested.
    """
    centers = camera.to_camera(mesh.anchors)
    radius = np.where(mesh.backdrop, BACKDROP_RADIUS_M, SMALL_RADIUS_M)
    focal = camera.intrinsics[0, 0]
    cx = camera.intrinsics[0, 2]
    mask = centers[:, 2] > -radius
    # For the left and the right edge: the position of each object towards the edge in metres, and
    # the distance of the edge from the optical axis in pixels.
    for side, edge in ((-centers[:, 0], cx), (centers[:, 0], camera.width - cx)):
        # Distance beyond the plane through the camera and this edge of the picture.
        beyond = (side * focal - centers[:, 2] * edge) / np.hypot(focal, edge)
        mask &= beyond < radius
    return mask


def occlusion_mask(
    camera: Camera, mesh: FrozenMesh, visible: NDArray[np.bool_], distance: Array
) -> NDArray[np.bool_]:
    """Whether a wall of a visible building crosses the line of sight to each object.

    Args:
        camera: The camera.
        mesh: Objects in world coordinates.
        visible: Whether each object may be visible; only these are tested. (G,)
        distance: Distance of each object in metres. (G,)

    Returns:
        The mask, False for buildings. (G,)
    """
    mask = np.zeros(len(mesh.anchors), dtype=bool)
    walls = np.flatnonzero((mesh.layers == 0) & mesh.backdrop[mesh.groups])
    wall_groups = mesh.groups[walls]
    walls = walls[visible[wall_groups] & (distance[wall_groups] < SMALL_FAR_M)]
    small = np.flatnonzero(visible & ~mesh.backdrop)
    if not len(walls) or not len(small):
        return mask
    eye = camera.center[:2]
    # The first two corners of a wall are the ends of its lower edge.
    start = mesh.quads[walls, 0, :2]
    end = mesh.quads[walls, 1, :2]
    wall = end - start
    sight = mesh.anchors[small, :2] - eye
    # A line of sight and a wall cross where along_sight * sight = gap + along_wall * wall. The
    # cross product of both sides with `wall` gives `along_sight`. The cross product of both sides
    # with `sight` gives `along_wall`.
    cross = sight[:, None, 0] * wall[None, :, 1] - sight[:, None, 1] * wall[None, :, 0]
    cross = np.where(np.abs(cross) < 1e-9, 1e-9, cross)
    gap = start - eye
    along_sight = (gap[:, 0] * wall[:, 1] - gap[:, 1] * wall[:, 0])[None] / cross
    along_wall = (gap[None, :, 0] * sight[:, None, 1] - gap[None, :, 1] * sight[:, None, 0]) / cross
    hits = (along_sight > 0) & (along_sight < 1) & (along_wall > 0) & (along_wall < 1)
    mask[small] = hits.any(axis=1)
    return mask
