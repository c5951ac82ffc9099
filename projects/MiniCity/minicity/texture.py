"""Texture of the ground from above, at several resolutions.

Level 0 is the finest resolution. The renderer reads distant ground from coarser levels.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from minicity.curves import Array
from minicity.scene_map import MATERIALS, PAINTS, SceneMap

SHIFT = 4  # fractional bits of OpenCV's fixed-point coordinates
TILE_PX = 1024  # edge of the noise tiles
LEVELS = 6  # number of resolutions of the colour image
BLOTCH_WEIGHT = 0.16  # weight of the large noise in the brightness of the ground
GRAIN_WEIGHT = 0.75  # weight of the fine noise in the brightness of the ground
Image = MatLike  # array of OpenCV, here always of numpy


@dataclass(frozen=True)
class GroundTexture:
    """Top views of the ground. Row 0 has the smallest y. Pixels are sampled at their centres.

    Attributes:
        origin: World x, y of the corner of pixel (0, 0), in metres. (2,)
        resolution_m: Edge of a pixel at level 0 in metres; it doubles from level to level.
        levels: Colour images, BGR. Each (rows, columns, 3)
        reflectivity: Reflectivity for laser pulses at level 0, in [0, 255]. (rows, columns)
    """

    origin: Array
    resolution_m: float
    levels: list[Image]
    reflectivity: Image

    def sample_reflectivity(self, points: Array) -> Image:
        """Sample the reflectivity at world points.

        Args:
            points: World x, y in metres. (n, 2)

        Returns:
            Values in [0, 255], 0 outside the texture. (n,)
        """
        cells = np.floor((points - self.origin) / self.resolution_m).astype(int)
        rows, columns = self.reflectivity.shape
        inside = (cells >= 0).all(axis=1) & (cells[:, 0] < columns) & (cells[:, 1] < rows)
        values = np.zeros(len(points), dtype=np.uint8)
        values[inside] = self.reflectivity[cells[inside, 1], cells[inside, 0]]
        return values


@lru_cache(maxsize=1)
def _noise_tiles() -> tuple[Image, Image]:
    """Create tiles of periodic noise, equal in every process: blotches (large) and grain (fine).

    (TILE_PX, TILE_PX) each
    """
    rng = np.random.default_rng(20)
    blotches = np.zeros((TILE_PX, TILE_PX), dtype=np.float32)
    # Cells along an edge of the tile, and weight of their noise: from coarse to fine.
    for cells, weight in ((16, 1.0), (64, 0.8), (256, 0.6), (512, 0.5)):
        # Random values on a coarse grid, enlarged by smooth interpolation. One more cell on each
        # side, from the opposite side, makes the noise periodic.
        coarse = np.pad(rng.random((cells, cells), dtype=np.float32), 1, mode="wrap")
        scale = TILE_PX // cells
        fine = cv2.resize(coarse, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        blotches += weight * fine[scale : scale + TILE_PX, scale : scale + TILE_PX]
    # Each value is replaced by its rank, so that a threshold covers a known share of the ground.
    order = np.argsort(blotches, axis=None, kind="stable")
    rank = np.argsort(order, kind="stable")  # the inverse permutation
    uniform = (rank * (255.0 / rank.size)).astype(np.uint8).reshape(TILE_PX, TILE_PX)
    normal = rng.standard_normal((TILE_PX, TILE_PX))
    grain = np.clip(128 + 20 * normal, 0, 255).astype(np.uint8)
    return uniform, grain


def _tile_noise(tile: Image, shape: tuple[int, int], start: list[int]) -> Image:
    """Repeat a periodic tile, shifted by (rows, columns), up to the size (rows, columns). (H, W)"""
    shifted = np.roll(tile, (start[0], start[1]), axis=(0, 1))
    repeats = [-(-n // TILE_PX) for n in shape]  # number of tiles along each axis, rounded up
    return np.tile(shifted, repeats)[: shape[0], : shape[1]]


def _fixed_point_pixels(points: Array, origin: Array, resolution_m: float) -> NDArray[np.int32]:
    """Convert world points to pixels in OpenCV's fixed-point format. (n, 2 or 3) -> (n, 2)"""
    # In OpenCV's coordinates, the centre of a pixel, not its corner, is at a whole number.
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
        scene: Surfaces, kerbs and paint.
        bounds: xmin, ymin, xmax, ymax of the texture in the world, in metres.
        resolution_m: Edge of a pixel of the finest level, in metres, > 0.
        rng: Source of the surface noise.

    Returns:
        The ground at ``LEVELS`` resolutions.
    """
    xmin, ymin, xmax, ymax = bounds
    origin = np.array([xmin, ymin])
    columns = int(np.ceil((xmax - xmin) / resolution_m))
    rows = int(np.ceil((ymax - ymin) / resolution_m))
    blotch_start, grain_start = rng.integers(0, TILE_PX, size=(2, 2)).tolist()
    blotch_tile, grain_tile = _noise_tiles()
    blotches = _tile_noise(blotch_tile, (rows, columns), start=blotch_start)
    grain = _tile_noise(grain_tile, (rows, columns), start=grain_start)
    color: Image = np.empty((rows, columns, 3), dtype=np.uint8)
    color[:] = MATERIALS["grass"]
    _paint_surfaces(color, scene, origin=origin, resolution_m=resolution_m)
    _paint_kerbs(color, scene, origin=origin, resolution_m=resolution_m)
    # The colours are multiplied by noise / 128. The offset gives the noise a mean of 128, which
    # keeps the mean brightness. Blotches have a mean of 127.5, and grain has a mean of 128.
    offset = 128 - BLOTCH_WEIGHT * 127.5 - GRAIN_WEIGHT * 128
    noise = cv2.addWeighted(blotches, BLOTCH_WEIGHT, grain, beta=GRAIN_WEIGHT, gamma=offset)
    color = cv2.multiply(color, cv2.merge([noise] * 3), scale=1 / 128)
    opacity = np.zeros((rows, columns), dtype=np.uint8)
    for marking in scene.markings:
        coat = _paint_coat(
            outlines=marking.outlines,
            wear=marking.wear,
            blotches=blotches,
            origin=origin,
            resolution_m=resolution_m,
        )
        if coat is not None:
            window, alpha = coat
            # `color[window]` is a view, so the texture itself is changed.
            _blend(color[window], PAINTS[marking.paint], alpha=alpha)
            opacity[window] = np.maximum(opacity[window], alpha)
    gray = cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)
    return GroundTexture(
        origin=origin,
        resolution_m=resolution_m,
        levels=_halve_repeatedly(color),
        # Paint reflects laser pulses more strongly than the ground: the weighted sum of brightness
        # and opacity of the paint.
        reflectivity=cv2.addWeighted(gray, 0.12, opacity, beta=0.45, gamma=0),
    )


def _halve_repeatedly(color: Image) -> list[Image]:
    """Resize an image (H, W, 3) to ``LEVELS`` resolutions, each half of the previous one."""
    levels: list[Image] = [color]
    for _ in range(LEVELS - 1):
        rows, columns = levels[-1].shape[:2]
        half_rows = max(1, rows // 2)
        half_columns = max(1, columns // 2)
        # Without an odd last row or column, each new pixel is the mean of 2 x 2 pixels.
        even = levels[-1][: 2 * half_rows, : 2 * half_columns]
        levels.append(cv2.resize(even, (half_columns, half_rows), interpolation=cv2.INTER_AREA))
    return levels


def _paint_surfaces(color: Image, scene: SceneMap, origin: Array, resolution_m: float) -> None:
    """Fill the surfaces of a scene in an image (H, W, 3), in place."""
    for surface in scene.surfaces:
        shade = [min(255.0, c * surface.tone) for c in MATERIALS[surface.material]]
        outlines = []  # the outer edge and the holes; `fillPoly` leaves the holes unchanged
        for ring in (surface.polygon.exterior, *surface.polygon.interiors):
            outlines.append(_fixed_point_pixels(np.array(ring.coords), origin, resolution_m))
        cv2.fillPoly(color, outlines, color=shade, lineType=cv2.LINE_AA, shift=SHIFT)


def _paint_kerbs(color: Image, scene: SceneMap, origin: Array, resolution_m: float) -> None:
    """Draw the kerbs of a scene in an image (H, W, 3): a light band with a dark gutter in it."""
    for line in scene.kerbs:
        px = _fixed_point_pixels(line, origin, resolution_m)
        # Width in metres and BGR colour of the band, then of the gutter, which is drawn over it.
        for width_m, shade in ((0.34, (172, 178, 180)), (0.1, (58, 58, 58))):
            cv2.polylines(
                color,
                [px],
                isClosed=False,
                color=shade,
                thickness=max(1, round(width_m / resolution_m)),
                lineType=cv2.LINE_AA,
                shift=SHIFT,
            )


def _paint_coat(
    outlines: list[Array], wear: float, blotches: Image, origin: Array, resolution_m: float
) -> tuple[tuple[slice, slice], Image] | None:
    """Compute the opacity of paint that is worn off in blotches.

    Args:
        outlines: Painted areas in the world, in metres. Each (n, 2)
        wear: Share of the paint that is worn off, in [0, 1).
        blotches: Noise over the whole texture. (H, W)
        origin: World x, y of the texture's corner, in metres. (2,)
        resolution_m: Edge of a pixel in metres.

    Returns:
        Window (rows, columns) of the texture, and the opacity in the window in [0, 255], (h, w).
        None if no paint lies on the texture.
    """
    if not outlines:
        return None
    # OpenCV rounds edges along the axes to whole pixels, so the paint is drawn at twice the
    # resolution and averaged.
    px = [_fixed_point_pixels(outline, origin, resolution_m / 2) for outline in outlines]
    # Whole pixels of the texture. The shift removes SHIFT bits of the fraction, and one bit of the
    # doubled resolution.
    all_px = np.concatenate(px) >> (SHIFT + 1)
    # The window has a margin of two pixels for smoothed edges. `high` is exclusive.
    low = np.maximum(all_px.min(axis=0) - 2, 0)
    high = np.minimum(all_px.max(axis=0) + 3, blotches.shape[::-1])  # columns, rows
    if (high <= low).any():
        return None
    left, top = low.tolist()
    right, bottom = high.tolist()
    window = (slice(top, bottom), slice(left, right))
    rows = bottom - top
    columns = right - left
    fine = np.zeros((2 * rows, 2 * columns), dtype=np.uint8)
    shift = (2 * low << SHIFT).astype(np.int32)  # corner of the window in fixed-point coordinates
    for outline in px:
        cv2.fillPoly(fine, [outline - shift], color=(255.0,), lineType=cv2.LINE_AA, shift=SHIFT)
    mask = cv2.resize(fine, (columns, rows), interpolation=cv2.INTER_AREA)
    # The paint is opaque where the noise is below 1 - wear, and nearly transparent where it is
    # above, with a soft edge in between.
    noise = np.arange(256) / 255.0
    cover = np.clip((1.0 - wear - noise) * 5 + 0.35, 0.12, 0.97)
    # The table has the opacity for each of the 256 values of the noise.
    cover_px = cv2.LUT(blotches[window], (cover * 255).astype(np.uint8))
    return window, cv2.multiply(mask, cover_px, scale=1 / 255)


def _blend(target: Image, paint: tuple[int, int, int], alpha: Image) -> None:
    """Blend a BGR colour over an image (h, w, 3) with opacity ``alpha`` (h, w), in place."""
    rows, columns = np.nonzero(alpha)
    opacity = alpha[rows, columns, None].astype(np.float32) / 255
    under = target[rows, columns].astype(np.float32)
    # The brightness of the surface modulates the paint. Brightness 90 leaves its colour unchanged.
    brightness = np.clip(under.mean(axis=1, keepdims=True) / 90, 0.5, 1.4)
    coat = np.asarray(paint, dtype=np.float32) * (0.86 + 0.14 * brightness)
    target[rows, columns] = np.clip(under + opacity * (coat - under), 0, 255).astype(np.uint8)


def darken(texture: GroundTexture, outlines: list[Array], strength: float) -> GroundTexture:
    """Darken the ground by shadows with soft edges.

    Args:
        texture: The ground in full light.
        outlines: Outlines of the shadows in the world, in metres. Each (n, 2)
        strength: Share of the light that is lost in a shadow, in [0, 1].

    Returns:
        A texture with shadows, or ``texture`` itself if nothing is darkened. The reflectivity is
        not changed, because laser pulses do not depend on daylight.
    """
    if not outlines or strength <= 0:
        return texture
    shape = texture.levels[0].shape[:2]
    light: Image = np.full(shape, 255, dtype=np.uint8)
    shade = 255 * (1 - strength)
    for outline in outlines:
        px = _fixed_point_pixels(outline, texture.origin, texture.resolution_m)
        cv2.fillPoly(light, [px], color=(shade,), lineType=cv2.LINE_AA, shift=SHIFT)
    # The blur reaches 15 cm into and out of a shadow.
    radius_px = max(1, round(0.15 / texture.resolution_m))
    size_px = 2 * radius_px + 1
    light = cv2.blur(light, (size_px, size_px))
    levels = []
    for level in texture.levels:
        level_size = level.shape[1::-1]  # (columns, rows)
        small = cv2.resize(light, level_size, interpolation=cv2.INTER_AREA)
        levels.append(cv2.multiply(level, cv2.merge([small] * 3), scale=1 / 255))
    return GroundTexture(
        origin=texture.origin,
        resolution_m=texture.resolution_m,
        levels=levels,
        reflectivity=texture.reflectivity,
    )
