"""Intersections of a camera's rays with uneven ground.

The ray of a pixel is followed over the ground in a vertical plane. The height of the ground is
sampled at ``RINGS`` fixed distances from the camera, for a part of the image columns. The image row
of each sample gives a first estimate of the distance at which the ray of a pixel meets the ground.
Newton's method refines it.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsmap.utils.errors import InputError
from minicity.camera import NEAR_M, Camera
from minicity.curves import Array
from minicity.scene_map import HeightGrid

COLUMNS_PER_PICTURE = 100  # largest number of intervals between sampled image columns
NEAREST_M, FARTHEST_M = 0.7, 160.0  # range of the distances of height samples
RINGS = 224  # number of distances
NEWTON_STEPS = 2  # steps that refine a distance
_ROW = 1024  # number of points that `sample_height` puts into a row


def sample_height(grid: HeightGrid, points: Array) -> Array:
    """Sample the ground height with linear interpolation between cells.

    Args:
        grid: Height of the ground.
        points: World x, y in metres. (..., 2)

    Returns:
        Heights in metres. (...)
    """
    cells = ((points - grid.origin) / grid.cell_m).reshape(-1, 2).astype(np.float32)
    count = len(cells)
    # cv2.remap interpolates a raster at given columns and rows. It accepts no side longer than
    # 32767, so the list of points is folded into rows.
    rows = -(-count // _ROW)  # rounded up
    folded = np.zeros((rows, _ROW, 2), dtype=np.float32)
    folded.reshape(-1, 2)[:count] = cells
    heights = cv2.remap(
        grid.height_m.astype(np.float32, copy=False),
        map1=folded[..., 0],
        map2=folded[..., 1],
        interpolation=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    flat = np.asarray(heights, dtype=np.float64).reshape(-1)[:count]  # without the padding
    return flat.reshape(points.shape[:-1])


@dataclass(frozen=True)
class Terrain:
    """Uneven ground in the view of one camera, at about a hundred of its image columns.

    `make_terrain` creates it.

    Attributes:
        camera: The camera.
        grid: Height of the ground.
        columns: Image columns in pixels, ascending, from the first to the last one. (c,)
        distances_m: Horizontal distances of the height samples in metres, ascending. (RINGS,)
        skyline_rows: Image row of the skyline of the ground up to each distance, in pixels. It is
            the topmost row that shows this ground, so it never increases with the distance.
            (RINGS, c)
    """

    camera: Camera
    grid: HeightGrid
    columns: Array
    distances_m: Array
    skyline_rows: Array

    def horizon(self) -> Array:
        """Return the image row of the skyline of the ground in every image column. (W,)"""
        return np.interp(np.arange(self.camera.width), self.columns, self.skyline_rows[-1])

    def distances(self, rows: Array) -> Array:
        """Compute the horizontal distance to the ground along the rays of ``columns``.

        Args:
            rows: Image rows in pixels. (h,)

        Returns:
            Distances in metres; about ``FARTHEST_M`` for rays above the skyline. (h, c)
        """
        reach = np.empty((len(rows), len(self.columns)))  # estimate of the distances, (h, c)
        # The first estimate is the distance at which the skyline reaches the row of the pixel.
        # Rows decrease with the distance. np.interp needs increasing rows, so both are reversed.
        for i, profile in enumerate(self.skyline_rows.T):
            reach[:, i] = np.interp(rows, profile[::-1], self.distances_m[::-1])
        direction, rise = self._rays(rows)  # rise per metre, < 0 if the ray descends
        eye = self.camera.center
        # Newton's method for the distance at which the ray is 0 m above the ground.
        for _ in range(NEWTON_STEPS):
            step = 0.02 * reach + 0.02  # step of the finite difference for the derivative
            here = sample_height(self.grid, eye[:2] + reach[..., None] * direction)
            ahead = sample_height(self.grid, eye[:2] + (reach + step)[..., None] * direction)
            above = eye[2] + reach * rise - here  # height of the ray above the ground
            closing = rise - (ahead - here) / step  # derivative of `above` by the distance
            # `closing` is kept away from 0 (nearly parallel to the ground), and the distance
            # changes by at most a tenth, so that a step stays near the estimate.
            move = -above / np.where(np.abs(closing) < 1e-3, -1e-3, closing)
            move = np.clip(move, -0.1 * reach, 0.1 * reach)
            reach = np.clip(reach + move, 0.1, FARTHEST_M)
        return reach

    def points(self, rows: Array) -> Array:
        """Compute the points (world x, y) at which the rays of image rows meet the ground.

        Args:
            rows: Image rows in pixels. (h,)

        Returns:
            Points for all image columns, in metres. (h, W, 2)
        """
        direction, _ = self._rays(rows)
        hits = self.camera.center[:2] + self.distances(rows)[..., None] * direction  # (h, c, 2)
        # Interpolate from `columns` to all image columns, each between `left` and `left + 1`.
        image_columns = np.arange(self.camera.width)
        right = np.searchsorted(self.columns, image_columns, side="right")
        left = np.clip(right - 1, 0, len(self.columns) - 2)
        span = self.columns[left + 1] - self.columns[left]
        share = ((image_columns - self.columns[left]) / span)[None, :, None]
        return hits[:, left] * (1 - share) + hits[:, left + 1] * share

    def _rays(self, rows: Array) -> tuple[Array, Array]:
        """Compute the directions of the rays of ``columns`` at image rows (h,).

        Returns:
            Horizontal unit directions, (h, c, 2), and the rise per horizontal metre, (h, c), which
            is negative if the ray descends.
        """
        u, v = np.meshgrid(self.columns, rows)  # pixel coordinates, (h, c) each
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ self.camera.world_from_pixel.T
        # Horizontal length of each ray; 1e-9 avoids a division by 0 for vertical rays.
        level_length = np.maximum(np.linalg.norm(rays[..., :2], axis=-1), 1e-9)
        return rays[..., :2] / level_length[..., None], rays[..., 2] / level_length


def make_terrain(camera: Camera, grid: HeightGrid) -> Terrain:
    """Compute the profile of uneven ground for a camera.

    Crests hide the ground behind them, and slopes may rise above the horizon.

    Args:
        camera: The camera, at least 2 pixels wide.
        grid: Height of the ground.

    Returns:
        The ground in the camera's view.

    Raises:
        ValueError: If the image is narrower than 2 pixels.
    """
    last = camera.width - 1
    if last < 1:
        raise InputError(f"the picture must be at least 2 pixels wide, got {camera.width}.")
    columns = np.linspace(0.0, last, num=min(last, COLUMNS_PER_PICTURE) + 1)
    distances = np.geomspace(NEAREST_M, FARTHEST_M, num=RINGS)
    # The ground of a column is sampled in the direction of one of its pixels below the middle of
    # the image, where most pixels of the ground are. `middle` are these pixels as (u, v, 1), (3,
    # c).
    middle = np.stack([columns, np.full_like(columns, 0.65 * camera.height), np.ones_like(columns)])
    rays = (camera.world_from_pixel @ middle)[:2].T
    direction = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    spots = camera.center[:2] + distances[:, None, None] * direction  # (RINGS, c, 2)
    world = np.concatenate([spots, sample_height(grid, spots)[..., None]], axis=-1)
    points_cam = camera.to_camera(world)
    in_front = points_cam[..., 2] > NEAR_M
    # Points behind the camera are replaced by a point in front of it, whose row is not used.
    rows = camera.to_pixels(np.where(in_front[..., None], points_cam, [0.0, 0.0, 1.0]))[..., 1]
    # Ground that is behind the camera or far below the image gets rows below the image. These rows
    # decrease with the distance, because `Terrain.distances` interpolates between them. The running
    # minimum below makes all rows decrease: ground behind a crest gets the row of the crest.
    below_image = 10.0 * camera.height + 10.0 * np.geomspace(1.0, 0.1, num=RINGS)[:, None]
    rows = np.where(in_front, np.minimum(rows, below_image), below_image)
    return Terrain(
        camera=camera,
        grid=grid,
        columns=columns,
        distances_m=distances,
        skyline_rows=np.minimum.accumulate(rows, axis=0),
    )


@dataclass(frozen=True)
class Footprints:
    """Area on the ground that a pixel of each image row covers.

    Attributes:
        along: Length along the line of sight, in metres. (H,)
        across: Width across the line of sight, in metres. (H,)
        distance: Horizontal distance in metres. (H,)
        visible: Whether the row shows any ground. (H,)
    """

    along: Array
    across: Array
    distance: Array
    visible: NDArray[np.bool_]


def terrain_footprints(terrain: Terrain) -> Footprints:
    """Compute the footprints of the image rows on uneven ground, as medians over the columns.

    The width of a pixel on the ground is the distance divided by the focal length in pixels. A row
    is visible if it is below the highest point of the skyline.
    """
    camera = terrain.camera
    edges = terrain.distances(np.arange(camera.height + 1) - 0.5)  # upper edges of rows (H + 1, c)
    distance = np.median(edges[:-1], axis=1)
    return Footprints(
        along=np.median(np.abs(np.diff(edges, axis=0)), axis=1),
        across=distance / camera.intrinsics[0, 0],
        distance=distance,
        visible=np.arange(camera.height) > terrain.skyline_rows[-1].min(),
    )
