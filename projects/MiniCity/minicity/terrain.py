"""Where the rays of a camera meet uneven ground."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from minicity.camera import NEAR_M, Camera
from minicity.curves import Array
from minicity.scene_map import HeightGrid

COLUMNS_PER_PICTURE = 100
NEAREST_M, FARTHEST_M = 0.7, 160.0
RINGS = 224
NEWTON_STEPS = 2
_ROW = 1024


def sample_height(grid: HeightGrid, points: Array) -> Array:
    """Ground height at world points, linear between cells. (..., 2) -> (...)"""
    at = ((points - grid.origin) / grid.cell_m).reshape(-1, 2).astype(np.float32)
    # cv2.remap takes no side longer than 32767, so the list is folded into rows.
    folded = np.zeros((-(-len(at) // _ROW), _ROW, 2), np.float32)
    folded.reshape(-1, 2)[: len(at)] = at
    heights = cv2.remap(
        grid.height_m.astype(np.float32, copy=False),
        folded[..., 0],
        folded[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(heights, np.float64).reshape(-1)[: len(at)].reshape(points.shape[:-1])


@dataclass(frozen=True)
class Terrain:
    """The ground as one camera sees it, in some hundred of its image columns.

    Attributes:
        camera: The camera.
        grid: Height of the ground.
        columns: The image columns. (c,)
        distances_m: Level distances at which the ground was looked up. (RINGS,)
        lowest_row: Topmost image row that the ground up to each distance reaches. (RINGS, c)
    """

    camera: Camera
    grid: HeightGrid
    columns: Array
    distances_m: Array
    lowest_row: Array

    def horizon(self) -> Array:
        """Image row of the ground's skyline in every column of the picture. (W,)"""
        return np.interp(np.arange(self.camera.width), self.columns, self.lowest_row[-1])

    def distances(self, rows: Array) -> Array:
        """Level distance to the ground along the rays of ``columns`` at some image rows. (h, c)

        Rays that pass over the skyline get the farthest distance.
        """
        reach = np.empty((len(rows), len(self.columns)))
        for i, profile in enumerate(self.lowest_row.T):
            reach[:, i] = np.interp(rows, profile[::-1], self.distances_m[::-1])
        direction, fall = self._rays(rows)
        eye = self.camera.center
        for _ in range(NEWTON_STEPS):
            step = 0.02 * reach + 0.02
            here = sample_height(self.grid, eye[:2] + reach[..., None] * direction)
            ahead = sample_height(self.grid, eye[:2] + (reach + step)[..., None] * direction)
            above = eye[2] + reach * fall - here
            closing = fall - (ahead - here) / step
            move = -above / np.where(np.abs(closing) < 1e-3, -1e-3, closing)
            reach = np.clip(reach + np.clip(move, -0.1 * reach, 0.1 * reach), 0.1, FARTHEST_M)
        return reach

    def points(self, rows: Array) -> Array:
        """World x, y where the rays of all columns at some image rows meet the ground. (h, W, 2)"""
        direction, _ = self._rays(rows)
        hits = self.camera.center[:2] + self.distances(rows)[..., None] * direction
        at = np.arange(self.camera.width)
        left = np.clip(
            np.searchsorted(self.columns, at, side="right") - 1, 0, len(self.columns) - 2
        )
        span = self.columns[left + 1] - self.columns[left]
        share = ((at - self.columns[left]) / span)[None, :, None]
        return hits[:, left] * (1 - share) + hits[:, left + 1] * share

    def _rays(self, rows: Array) -> tuple[Array, Array]:
        """Level unit directions (h, c, 2) of the rays, and their rise per level metre (h, c)."""
        u, v = np.meshgrid(self.columns, rows)
        rays = np.stack([u, v, np.ones_like(u)], -1) @ self.camera.world_from_pixel.T
        level = np.maximum(np.linalg.norm(rays[..., :2], axis=-1), 1e-9)
        return rays[..., :2] / level[..., None], rays[..., 2] / level


def see_terrain(camera: Camera, grid: HeightGrid) -> Terrain:
    """Look at uneven ground: crests hide what lies behind, slopes may rise above the horizon."""
    last = camera.width - 1
    if last < 1:
        raise ValueError(f"the picture must be at least 2 pixels wide, got {camera.width}.")
    columns = np.linspace(0.0, last, min(last, COLUMNS_PER_PICTURE) + 1)
    distances = np.geomspace(NEAREST_M, FARTHEST_M, RINGS)
    middle = np.stack([columns, np.full_like(columns, 0.65 * camera.height), np.ones_like(columns)])
    rays = (camera.world_from_pixel @ middle)[:2].T
    direction = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    spots = camera.center[:2] + distances[:, None, None] * direction  # (RINGS, c, 2)
    world = np.concatenate([spots, sample_height(grid, spots)[..., None]], axis=-1)
    seen = camera.to_camera(world)
    in_front = seen[..., 2] > NEAR_M
    rows = camera.to_pixels(np.where(in_front[..., None], seen, [0.0, 0.0, 1.0]))[..., 1]
    below_everything = 10.0 * camera.height + 10.0 * np.geomspace(1.0, 0.1, RINGS)[:, None]
    rows = np.where(in_front, np.minimum(rows, below_everything), below_everything)
    return Terrain(camera, grid, columns, distances, np.minimum.accumulate(rows, axis=0))


@dataclass(frozen=True)
class Footprints:
    """What a pixel of each image row covers on the ground.

    Attributes:
        along: Length along the line of sight, metres. (H,)
        across: Width across it, metres. (H,)
        distance: Level distance, metres. (H,)
        visible: Whether any ground is seen. (H,)
    """

    along: Array
    across: Array
    distance: Array
    visible: NDArray[np.bool_]


def terrain_footprints(terrain: Terrain) -> Footprints:
    """Footprints on uneven ground, medians over the columns."""
    camera = terrain.camera
    edges = terrain.distances(np.arange(camera.height + 1) - 0.5)
    along = np.median(np.abs(np.diff(edges, axis=0)), axis=1)
    distance = np.median(edges[:-1], axis=1)
    visible = np.arange(camera.height) > terrain.lowest_row[-1].min()
    return Footprints(along, distance / camera.intrinsics[0, 0], distance, visible)
