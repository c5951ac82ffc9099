"""Ground in a camera's image, filtered so that thin paint survives at a distance.

Far from the camera, a pixel covers much more ground along the line of sight than across it. A plain
mip-map, whose level fits the length of this footprint, would blur away a lane line of 15 cm. Here
the texture level fits the width of the footprint, and each image row takes several samples along
its length. Adjacent rows with equal levels and numbers of samples form a band.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from minicity.camera import Camera
from minicity.curves import Array
from minicity.scene_map import HeightGrid
from minicity.terrain import Footprints, make_terrain, terrain_footprints
from minicity.texture import GroundTexture, Image

MAX_SAMPLES = 8  # largest number of samples per image row
HORIZON_EPS = 1e-4  # a ray whose vertical part is not below -HORIZON_EPS is above the horizon
Color = tuple[float, float, float]


@dataclass(frozen=True)
class Band:
    """Image rows that share a filter.

    Attributes:
        start: First row.
        stop: Row after the last.
        level: Texture level of the samples.
        samples: Samples per row.
    """

    start: int
    stop: int
    level: int
    samples: int

    def sample_rows(self) -> Array:
        """Image rows of the samples, in pixels. ((stop - start) * samples,)"""
        count = (self.stop - self.start) * self.samples
        # The first row begins at `start - 0.5`. A sample is in the middle of its part of a row.
        return self.start - 0.5 + (np.arange(count) + 0.5) / self.samples


def ground_from_pixel(camera: Camera, ground_z_m: float) -> Array:
    """Homography from pixels to world x, y on the plane z = ``ground_z_m``, in metres. (3, 3)

    Its third row gives the vertical part of the viewing direction: negative below the horizon.
    """
    ray = camera.world_from_pixel  # maps (u, v, 1) to a viewing direction in the world. (3, 3)
    x, y, z = camera.center
    height = z - ground_z_m
    # A ray (rx, ry, rz) meets the plane at x - height * rx / rz and y - height * ry / rz. In
    # homogeneous coordinates, the point is multiplied by rz.
    return np.stack([x * ray[2] - height * ray[0], y * ray[2] - height * ray[1], ray[2]])


def plane_footprints(camera: Camera, homography: Array) -> Footprints:
    """Footprints of the image rows on flat ground, at the middle column of the image.

    Args:
        camera: The camera, above the ground.
        homography: Transform from pixels to the ground (``ground_from_pixel``). (3, 3)

    Returns:
        Footprints of all rows.
    """
    rows = np.arange(camera.height + 1)  # one more, for the lower edge of the last row
    column = np.full(rows.shape, (camera.width - 1) / 2)
    # Upper edge of each row, in homogeneous coordinates of the ground. (3, H + 1)
    center = homography @ np.stack([column, rows - 0.5, np.ones(rows.shape)])
    beside = homography @ np.stack([column + 1, rows - 0.5, np.ones(rows.shape)])
    # The third coordinate is the vertical part of a ray, negative below the horizon. Rays near and
    # above the horizon get the bound instead. They then end at a distance of a few kilometres: the
    # height of the camera divided by the bound.
    hit = center[:2] / np.minimum(center[2], -4 * HORIZON_EPS)
    hit_beside = beside[:2] / np.minimum(beside[2], -4 * HORIZON_EPS)
    distance = np.linalg.norm(hit - camera.center[:2, None], axis=0)
    # In a tilted camera, the horizon is at different rows on the left and right of the image. A row
    # is visible if one of its two ends is below the horizon.
    ends = homography[2, 0] * np.array([0, camera.width - 1]) + homography[2, 2]
    vertical = (ends + homography[2, 1] * rows[:-1, None]).min(axis=1)
    return Footprints(
        along=np.linalg.norm(np.diff(hit, axis=1), axis=0),
        across=np.linalg.norm(hit - hit_beside, axis=0)[:-1],
        distance=distance[:-1],
        visible=vertical < -HORIZON_EPS,
    )


def make_bands(footprints: Footprints, resolution_m: float, num_levels: int) -> list[Band]:
    """Group adjacent rows with equal texture levels and numbers of samples.

    Args:
        footprints: Footprints of the image rows.
        resolution_m: Pixel edge of texture level 0, in metres.
        num_levels: Number of texture levels.

    Returns:
        Bands from the top of the image to its bottom.
    """
    # A texture pixel should be as large as the footprint is wide, and `MAX_SAMPLES` texture pixels
    # should cover the length of the footprint. The factor 1.2 allows 20 percent larger pixels.
    target = np.maximum(footprints.across, footprints.along / MAX_SAMPLES)
    fit = np.floor(np.log2(np.maximum(target / resolution_m, 1.0) * 1.2))
    levels = np.clip(fit, 0, num_levels - 1).astype(int)
    # Number of texture pixels along the footprint, at the level of the row.
    counts = np.clip(np.ceil(footprints.along / (resolution_m * 2.0**levels)), 1, MAX_SAMPLES)
    # Powers of two, so that more adjacent rows have equal numbers and form one band.
    samples = (2 ** np.ceil(np.log2(counts))).astype(int)
    bands: list[Band] = []
    for row in np.flatnonzero(footprints.visible).tolist():
        level = int(levels[row])
        count = int(samples[row])
        start = row
        if bands:
            last = bands[-1]
            is_adjacent = last.stop == row
            is_equal = (last.level, last.samples) == (level, count)
            if is_adjacent and is_equal:
                bands.pop()  # replaced below by a band that includes this row
                start = last.start
        bands.append(Band(start, row + 1, level=level, samples=count))
    return bands


def _texture_from_world(texture: GroundTexture, level: int) -> Array:
    """Transform from world x, y in metres to pixels of a texture level. (3, 3)"""
    scale = 1.0 / (texture.resolution_m * 2**level)
    x, y = -texture.origin * scale - 0.5  # the centre of pixel (0, 0) is at (0, 0)
    return np.array([[scale, 0, x], [0, scale, y], [0, 0, 1.0]])


def render_flat_ground(
    camera: Camera, texture: GroundTexture, background: Image, border: Color, ground_z_m: float
) -> tuple[Image, Array]:
    """Render flat ground into a picture of the sky.

    Args:
        camera: The camera, above the ground.
        texture: Texture of the ground.
        background: Picture of the sky, BGR. (H, W, 3)
        border: Colour of ground outside the texture, BGR.
        ground_z_m: Height of the ground in metres.

    Returns:
        The picture (H, W, 3), and the distance of the ground in each row in metres, inf for rows
        without ground (H,).
    """
    image = background.copy()
    homography = ground_from_pixel(camera, ground_z_m)
    skyline = _plane_skyline(camera, homography[2])  # image row of the horizon in each column
    footprints = plane_footprints(camera, homography)
    for band in make_bands(footprints, texture.resolution_m, num_levels=len(texture.levels)):
        # As in `Band.sample_rows`: row k of the samples is at row first_row + k / band.samples.
        first_row = band.start - 0.5 + 0.5 / band.samples
        pixel_from_sample = np.array([[1.0, 0, 0], [0, 1.0 / band.samples, first_row], [0, 0, 1.0]])
        # With `WARP_INVERSE_MAP`, M maps a pixel of the output to a pixel of the texture.
        samples = cv2.warpPerspective(
            texture.levels[band.level],
            M=_texture_from_world(texture, band.level) @ homography @ pixel_from_sample,
            dsize=(camera.width, (band.stop - band.start) * band.samples),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=border,
        )
        _paste_band(image, samples, band=band, skyline=skyline)
    return image, np.where(footprints.visible, footprints.distance, np.inf)


def render_uneven_ground(
    camera: Camera, texture: GroundTexture, background: Image, border: Color, height: HeightGrid
) -> tuple[Image, Array]:
    """Render uneven ground into a picture of the sky.

    Args:
        camera: The camera, above the ground.
        texture: Texture of the ground.
        background: Picture of the sky, BGR. (H, W, 3)
        border: Colour of ground outside the texture, BGR.
        height: Height of the ground.

    Returns:
        The picture (H, W, 3), and the distance of the ground in each row in metres, inf for rows
        without ground (H,).
    """
    image = background.copy()
    # Intersections of the rays of the camera with the ground. `terrain.points` returns the world
    # (x, y) of each pixel of the given rows, (rows, W, 2).
    terrain = make_terrain(camera, height)
    skyline = terrain.horizon()  # image row in each column, above which there is no ground
    footprints = terrain_footprints(terrain)
    for band in make_bands(footprints, texture.resolution_m, num_levels=len(texture.levels)):
        texture_from_world = _texture_from_world(texture, band.level)
        world = terrain.points(band.sample_rows())
        texture_x = world[..., 0] * texture_from_world[0, 0] + texture_from_world[0, 2]
        texture_y = world[..., 1] * texture_from_world[1, 1] + texture_from_world[1, 2]
        samples = cv2.remap(
            texture.levels[band.level],
            map1=texture_x.astype(np.float32),
            map2=texture_y.astype(np.float32),
            interpolation=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=border,
        )
        _paste_band(image, samples, band=band, skyline=skyline)
    return image, np.where(footprints.visible, footprints.distance, np.inf)


def _plane_skyline(camera: Camera, horizon: Array) -> Array:
    """Image row of a plane's horizon in every column, from the homography's third row (3,). (W,)"""
    # Row v of column u at which h0 u + h1 v + h2 = -HORIZON_EPS. A camera that is not upside down
    # has h1 < 0, as its rays fall from row to row.
    slope = min(horizon[1], -1e-9)
    return -(horizon[0] * np.arange(camera.width) + horizon[2] + HORIZON_EPS) / slope


def _paste_band(image: Image, samples: Image, band: Band, skyline: Array) -> None:
    """Average the samples of a band and paste the pixels below the skyline, in place."""
    rows = samples
    if band.samples > 1:
        size = (image.shape[1], band.stop - band.start)
        rows = cv2.resize(samples, size, interpolation=cv2.INTER_AREA)
    target = image[band.start : band.stop]
    if skyline.max() < band.start:  # no sky in these rows
        target[:] = rows
        return
    below = np.arange(band.start, band.stop)[:, None] > skyline
    np.copyto(target, rows, where=below[..., None])
