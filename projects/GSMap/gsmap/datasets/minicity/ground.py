"""The ground in a camera's image, filtered so that thin paint survives at a distance.

Far away a pixel covers much more ground along the line of sight than across it. A plain mip-map
would blur a lane line of 15 cm away, so image rows are grouped into bands, each sampled several
times per row from the level that fits its width.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsmap.datasets.minicity.camera import Camera
from gsmap.datasets.minicity.curves import Array
from gsmap.datasets.minicity.scene_map import HeightGrid
from gsmap.datasets.minicity.texture import GroundTexture, Image

MAX_SAMPLES = 8
HORIZON_EPS = 1e-4
HEIGHT_STEPS = 3


@dataclass(frozen=True)
class Band:
    """Image rows that share a filter.

    Attributes:
        start: First row.
        stop: Row after the last.
        level: Texture level to read.
        samples: Samples per row.
    """

    start: int
    stop: int
    level: int
    samples: int


def ground_from_pixel(camera: Camera, ground_z_m: float) -> Array:
    """Homography from pixels to world x, y on the plane z = ``ground_z_m``. (3, 3)

    Its third row gives the vertical part of the viewing direction: negative below the horizon.
    """
    ray = camera.world_from_pixel
    center = camera.center
    height = center[2] - ground_z_m
    return np.stack(
        [center[0] * ray[2] - height * ray[0], center[1] * ray[2] - height * ray[1], ray[2]]
    )


def make_bands(
    camera: Camera, homography: Array, resolution_m: float, num_levels: int
) -> list[Band]:
    """Group the rows below the horizon by the size of a pixel's footprint on the ground."""
    rows = np.arange(camera.height + 1)
    column = np.full(rows.shape, (camera.width - 1) / 2)
    center = homography @ np.stack([column, rows - 0.5, np.ones(rows.shape)])
    beside = homography @ np.stack([column + 1, rows - 0.5, np.ones(rows.shape)])
    # A tilted camera sees the horizon at another row on each side: one end below it is enough.
    edges = homography[2] @ np.stack([[0, camera.width - 1], [0, 0], [1, 1]]) + np.outer(
        rows, [homography[2, 1]] * 2
    )
    visible = (edges.min(1) < -HORIZON_EPS)[:-1]
    w = np.minimum(center[2], -HORIZON_EPS * 4)
    along = np.linalg.norm(np.diff(center[:2] / w, axis=1), axis=0)
    across = np.linalg.norm(
        center[:2] / w - beside[:2] / np.minimum(beside[2], -HORIZON_EPS * 4), axis=0
    )[:-1]
    wanted = np.maximum(across, along / MAX_SAMPLES)
    levels = np.clip(
        np.floor(np.log2(np.maximum(wanted / resolution_m, 1.0) * 1.2)), 0, num_levels - 1
    ).astype(int)
    samples = np.clip(np.ceil(along / (resolution_m * 2.0**levels)), 1, MAX_SAMPLES)
    samples = (2 ** np.ceil(np.log2(samples))).astype(int)
    bands: list[Band] = []
    for row in np.flatnonzero(visible):
        level, count = int(levels[row]), int(samples[row])
        last = bands[-1] if bands else None
        if last and last.stop == row and (last.level, last.samples) == (level, count):
            bands[-1] = Band(last.start, int(row) + 1, level, count)
        else:
            bands.append(Band(int(row), int(row) + 1, level, count))
    return bands


def _texture_from_world(texture: GroundTexture, level: int) -> Array:
    scale = 1.0 / (texture.resolution_m * 2**level)
    return np.array(
        [
            [scale, 0, -texture.origin[0] * scale - 0.5],
            [0, scale, -texture.origin[1] * scale - 0.5],
            [0, 0, 1.0],
        ]
    )


def _sample_from_row(band: Band) -> Array:
    """Maps (column, sample row of a band) to (u, v) in pixels. (3, 3)"""
    return np.array(
        [[1.0, 0, 0], [0, 1.0 / band.samples, band.start + 0.5 / band.samples - 0.5], [0, 0, 1.0]]
    )


def render_ground(
    camera: Camera,
    texture: GroundTexture,
    background: Image,
    border: tuple[float, float, float],
    ground_z_m: float = 0.0,
    height: HeightGrid | None = None,
) -> Image:
    """Draw the ground into a picture of the sky.

    Args:
        camera: Viewing camera, above the ground.
        texture: The ground from above.
        background: What is seen where no ground is. (H, W, 3)
        border: Colour of ground outside the texture, BGR.
        ground_z_m: Height of flat ground, used where ``height`` is None.
        height: Height of the ground; bands are planned for the plane below the camera.

    Returns:
        The picture. (H, W, 3)
    """
    if height is not None:
        ground_z_m = float(sample_height(height, camera.center[None, :2])[0])
    image = background.copy()
    homography = ground_from_pixel(camera, ground_z_m)
    for band in make_bands(camera, homography, texture.resolution_m, len(texture.levels)):
        source = texture.levels[band.level]
        size = (camera.width, (band.stop - band.start) * band.samples)
        rows = _sample_from_row(band)
        to_texture = _texture_from_world(texture, band.level)
        if height is None:
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            warp = to_texture @ homography @ rows
            drawn = cv2.warpPerspective(
                source, warp, size, None, flags, cv2.BORDER_CONSTANT, border
            )
        else:
            world = _hits(camera, rows, size, ground_z_m, height)
            at = [
                (world[..., i] * to_texture[i, i] + to_texture[i, 2]).astype(np.float32)
                for i in (0, 1)
            ]
            drawn = cv2.remap(
                source, at[0], at[1], cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, border
            )
        if band.samples > 1:
            drawn = cv2.resize(
                drawn, (camera.width, band.stop - band.start), interpolation=cv2.INTER_AREA
            )
        _put(image, drawn, band, homography[2])
    return image


def _put(image: Image, drawn: Image, band: Band, horizon: Array) -> None:
    """Copy a band into place, leaving out pixels above the horizon."""
    rows, columns = np.arange(band.start, band.stop), np.array([0, image.shape[1] - 1])
    corners = horizon[0] * columns[None] + horizon[1] * rows[:, None] + horizon[2]
    if (corners < -HORIZON_EPS).all():
        image[band.start : band.stop] = drawn
        return
    all_columns = np.arange(image.shape[1])
    below = horizon[0] * all_columns[None] + horizon[1] * rows[:, None] + horizon[2] < -HORIZON_EPS
    np.copyto(image[band.start : band.stop], drawn, where=below[..., None])


def sample_height(grid: HeightGrid, points: Array) -> NDArray[np.float64]:
    """Ground height at world points, linear between cells. (..., 2) -> (...)"""
    at = (points - grid.origin) / grid.cell_m
    rows, columns = grid.height_m.shape
    flat = at.reshape(-1, 1, 2).astype(np.float32)
    # cv2.remap handles at most 32767 rows a call, which a picture's samples exceed.
    flat = flat.reshape(-1, 1, 2)
    x = np.clip(flat[:, 0, 0], 0, columns - 1)
    y = np.clip(flat[:, 0, 1], 0, rows - 1)
    x0, y0 = (
        np.minimum(x.astype(int), max(columns - 2, 0)),
        np.minimum(y.astype(int), max(rows - 2, 0)),
    )
    x1, y1 = np.minimum(x0 + 1, columns - 1), np.minimum(y0 + 1, rows - 1)
    fx, fy = x - x0, y - y0
    table = grid.height_m
    low = table[y0, x0] * (1 - fx) + table[y0, x1] * fx
    high = table[y1, x0] * (1 - fx) + table[y1, x1] * fx
    return (low * (1 - fy) + high * fy).reshape(points.shape[:-1])


COARSE_PX = 4


def _hits(
    camera: Camera, rows: Array, size: tuple[int, int], ground_z_m: float, height: HeightGrid
) -> Array:
    """World x, y where each sample's ray meets uneven ground, by fixed-point iteration. (h, w, 2)

    Solved in every ``COARSE_PX``-th column and linear in between: roads are smooth at that scale.
    """
    columns = np.unique(np.append(np.arange(0, size[0], COARSE_PX), size[0] - 1)).astype(float)
    u, v = np.meshgrid(columns, np.arange(size[1], dtype=float))
    pixels = np.stack([u, v, np.ones_like(u)], -1) @ rows.T
    rays = pixels @ camera.world_from_pixel.T
    down = np.minimum(rays[..., 2], -HORIZON_EPS)
    center = camera.center
    level = np.full(u.shape, ground_z_m)
    for _ in range(HEIGHT_STEPS):
        reach = (level - center[2]) / down
        hit = center[:2] + reach[..., None] * rays[..., :2]
        level = 0.5 * (level + sample_height(height, hit)) if _ else sample_height(height, hit)
        level = np.minimum(level, center[2] - 0.2)
    reach = (level - center[2]) / down
    hit = center[:2] + reach[..., None] * rays[..., :2]
    low = np.searchsorted(columns, np.arange(size[0]), side="right") - 1
    low = np.minimum(low, len(columns) - 2)
    share = ((np.arange(size[0]) - columns[low]) / (columns[low + 1] - columns[low]))[None, :, None]
    return hit[:, low] * (1 - share) + hit[:, low + 1] * share
