"""The ground seen from above, at several resolutions."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from minicity.curves import Array
from minicity.scene_map import MATERIALS, PAINTS, SceneMap

SHIFT = 4
TILE_PX = 1024
LEVELS = 6
Image = MatLike


@dataclass(frozen=True)
class GroundTexture:
    """Top views of the ground. Row 0 has the smallest y; a pixel's value is taken at its centre.

    Attributes:
        origin: World x, y of the corner of pixel (0, 0). (2,)
        resolution_m: Edge of a pixel at level 0; it doubles from level to level.
        levels: Colour images, BGR. Each (rows, columns, 3)
        reflectivity: How strongly level 0 returns a laser pulse. (rows, columns)
    """

    origin: Array
    resolution_m: float
    levels: list[Image]
    reflectivity: Image

    def sample_reflectivity(self, points: Array) -> Image:
        """Reflectivity at world points; 0 outside. (n, 2) -> (n,)"""
        cells = np.floor((points - self.origin) / self.resolution_m).astype(int)
        rows, columns = self.reflectivity.shape
        inside = (cells >= 0).all(1) & (cells[:, 0] < columns) & (cells[:, 1] < rows)
        values = np.zeros(len(points), np.uint8)
        values[inside] = self.reflectivity[cells[inside, 1], cells[inside, 0]]
        return values


@lru_cache(maxsize=1)
def _noise_tiles() -> tuple[Image, Image]:
    """(blotches, grain): periodic noise, the same in every process. (TILE_PX, TILE_PX)"""
    rng = np.random.default_rng(20)
    blotches = np.zeros((TILE_PX, TILE_PX), np.float32)
    for cells, weight in ((16, 1.0), (64, 0.8), (256, 0.6), (512, 0.5)):
        coarse = np.pad(rng.random((cells, cells), dtype=np.float32), 1, mode="wrap")
        scale = TILE_PX // cells
        fine = cv2.resize(coarse, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        blotches += weight * fine[scale : scale + TILE_PX, scale : scale + TILE_PX]
    rank = np.argsort(np.argsort(blotches, axis=None, kind="stable"), kind="stable")
    flat = (rank * (255.0 / rank.size)).astype(np.uint8).reshape(TILE_PX, TILE_PX)
    grain = np.clip(128 + 20 * rng.standard_normal((TILE_PX, TILE_PX)), 0, 255).astype(np.uint8)
    return flat, grain


def _tiled(tile: Image, shape: tuple[int, int], start: list[int]) -> Image:
    rolled = np.roll(tile, tuple(start), axis=(0, 1))
    repeats = [-(-n // TILE_PX) for n in shape]
    return np.tile(rolled, repeats)[: shape[0], : shape[1]]


def _pixels(points: Array, origin: Array, resolution_m: float) -> NDArray[np.int32]:
    px = (np.asarray(points)[:, :2] - origin) / resolution_m - 0.5
    return np.round(px * (1 << SHIFT)).astype(np.int32)


def paint_ground(
    scene: SceneMap,
    bounds: tuple[float, float, float, float],
    resolution_m: float,
    rng: np.random.Generator,
) -> GroundTexture:
    """Paint the ground of a scene.

    Args:
        scene: What lies on the ground.
        bounds: xmin, ymin, xmax, ymax of the painted area in the world, metres.
        resolution_m: Edge of a pixel of the finest level.
        rng: Source of the surface noise.

    Returns:
        The ground at ``LEVELS`` resolutions.
    """
    origin = np.array(bounds[:2])
    columns, rows = (int(np.ceil(e)) for e in (np.array(bounds[2:]) - origin) / resolution_m)
    starts = rng.integers(0, TILE_PX, (2, 2)).tolist()
    blotches, grain = (
        _tiled(t, (rows, columns), s) for t, s in zip(_noise_tiles(), starts, strict=True)
    )
    color: Image = np.empty((rows, columns, 3), np.uint8)
    color[:] = MATERIALS["grass"]
    for surface in scene.surfaces:
        shade = [min(255.0, c * surface.tone) for c in MATERIALS[surface.material]]
        rings = [surface.polygon.exterior, *surface.polygon.interiors]
        outlines = [_pixels(np.array(ring.coords), origin, resolution_m) for ring in rings]
        cv2.fillPoly(color, outlines, shade, cv2.LINE_AA, SHIFT)
    _paint_kerbs(color, scene, origin, resolution_m)
    texture = cv2.addWeighted(blotches, 0.16, grain, 0.75, 128 - 0.16 * 127.5 - 0.75 * 128)
    color = cv2.multiply(color, cv2.merge([texture] * 3), scale=1 / 128)
    painted = np.zeros((rows, columns), np.uint8)
    for marking in scene.markings:
        coat = _coat(marking.outlines, marking.wear, blotches, origin, resolution_m)
        if coat is not None:
            window, alpha = coat
            _blend(color[window], PAINTS[marking.paint], alpha)
            painted[window] = np.maximum(painted[window], alpha)
    gray = cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)
    reflectivity = cv2.addWeighted(gray, 0.12, painted, 0.45, 0)
    levels: list[Image] = [color]
    for _ in range(LEVELS - 1):
        half = (max(1, levels[-1].shape[1] // 2), max(1, levels[-1].shape[0] // 2))
        even = levels[-1][: 2 * half[1], : 2 * half[0]]
        levels.append(cv2.resize(even, half, interpolation=cv2.INTER_AREA))
    return GroundTexture(origin, resolution_m, levels, reflectivity)


def _paint_kerbs(color: Image, scene: SceneMap, origin: Array, resolution_m: float) -> None:
    for line in scene.kerbs:
        px = _pixels(line, origin, resolution_m)
        for width_m, shade in ((0.34, (172, 178, 180)), (0.1, (58, 58, 58))):
            thickness = max(1, round(width_m / resolution_m))
            cv2.polylines(color, [px], False, shade, thickness, cv2.LINE_AA, SHIFT)


def _coat(
    outlines: list[Array], wear: float, blotches: Image, origin: Array, resolution_m: float
) -> tuple[tuple[slice, slice], Image] | None:
    """The window of the texture that paint covers, and its opacity, worn off in blotches."""
    if not outlines:
        return None
    # Drawn twice as fine and averaged: OpenCV rounds level edges to whole pixels.
    px = [_pixels(outline, origin, resolution_m / 2) for outline in outlines]
    everything = np.concatenate(px) >> (SHIFT + 1)
    low = np.maximum(everything.min(0) - 2, 0)
    high = np.minimum(everything.max(0) + 3, blotches.shape[::-1])
    if (high <= low).any():
        return None
    window = (slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0])))
    columns, rows = (int(n) for n in high - low)
    fine = np.zeros((2 * rows, 2 * columns), np.uint8)
    shift = (2 * low << SHIFT).astype(np.int32)
    for outline in px:
        cv2.fillPoly(fine, [outline - shift], (255.0,), cv2.LINE_AA, SHIFT)
    mask = cv2.resize(fine, (columns, rows), interpolation=cv2.INTER_AREA)
    # Opaque where the noise stays below 1 - wear, bare above, with a soft edge between.
    limit = np.arange(256) / 255.0
    left = np.clip((1.0 - wear - limit) * 5 + 0.35, 0.12, 0.97)
    keep = cv2.LUT(blotches[window], (left * 255).astype(np.uint8))
    return window, cv2.multiply(mask, keep, scale=1 / 255)


def _blend(target: Image, paint: tuple[int, int, int], alpha: Image) -> None:
    """Lay a colour over ``target`` in place where ``alpha`` is set."""
    rows, columns = np.nonzero(alpha)
    opacity = alpha[rows, columns, None].astype(np.float32) / 255
    under = target[rows, columns].astype(np.float32)
    # The surface's grain shows through the paint, so that it is no flat colour.
    coat = np.asarray(paint, np.float32) * (
        0.86 + 0.14 * np.clip(under.mean(1, keepdims=True) / 90, 0.5, 1.4)
    )
    target[rows, columns] = np.clip(under + opacity * (coat - under), 0, 255).astype(np.uint8)


def darken(texture: GroundTexture, outlines: list[Array], strength: float) -> GroundTexture:
    """Return the ground under shadows with soft edges.

    Args:
        texture: The ground.
        outlines: Shadow outlines in the world. Each (n, 2)
        strength: Share of the light that they take, in [0, 1].

    Returns:
        A new texture; the laser's reflectivity is not touched.
    """
    if not outlines or strength <= 0:
        return texture
    shape = texture.levels[0].shape[:2]
    light: Image = np.full(shape, 255, np.uint8)
    for outline in outlines:
        px = _pixels(outline, texture.origin, texture.resolution_m)
        cv2.fillPoly(light, [px], (255 * (1 - strength),), cv2.LINE_AA, SHIFT)
    size = 2 * max(1, round(0.15 / texture.resolution_m)) + 1
    light = cv2.blur(light, (size, size))
    levels = []
    for level in texture.levels:
        small = cv2.resize(light, level.shape[1::-1], interpolation=cv2.INTER_AREA)
        levels.append(cv2.multiply(level, cv2.merge([small] * 3), scale=1 / 255))
    return GroundTexture(texture.origin, texture.resolution_m, levels, texture.reflectivity)
