"""Weather and light, and what they do to a picture."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from minicity.camera import Camera
from minicity.curves import Array
from minicity.texture import Image

NOISE_PX = 1024
WET_SLOPE = 0.12
BGR = tuple[float, float, float]


@dataclass(frozen=True)
class Lighting:
    """Light of a scene. Colours are BGR.

    Attributes:
        weather: ``clear``, ``cloudy``, ``dusk`` or ``rain``.
        sun: Unit direction towards the sun. (3,)
        ambient: Share of light that comes from everywhere.
        direct: Share of light that comes from the sun.
        shadow: Share of light lost in a shadow on the ground.
        gain: Factor per colour channel over the whole picture.
        sky_top: Colour of the sky overhead.
        haze: Colour of the sky at the horizon and of all that is far.
        haze_m: Distance at which haze hides 63 %.
        wet: How much of the sky a wet road mirrors at a grazing angle.
        noise: Standard deviation of the sensor noise, grey levels.
        streaks: Rain streaks per image, for an image 800 pixels wide.
    """

    weather: str
    sun: Array
    ambient: float
    direct: float
    shadow: float
    gain: BGR
    sky_top: BGR
    haze: BGR
    haze_m: float
    wet: float
    noise: float
    streaks: int


def random_lighting(rng: np.random.Generator) -> Lighting:
    """Draw the light of a scene: mostly clear or cloudy, sometimes dusk or rain."""
    weather = str(rng.choice(["clear", "cloudy", "dusk", "rain"], p=[0.5, 0.24, 0.13, 0.13]))
    azimuth, bright = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(0.88, 1.12))
    elevation = float(rng.uniform(0.45, 1.1)) if weather == "clear" else 0.3
    horizontal = np.cos(elevation)
    sun = np.array([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(elevation)])
    if weather == "clear":
        warm = float(rng.uniform(-0.04, 0.04))
        gain = (bright * (1.08 - warm), bright * 1.1, bright * (1.12 + warm))
        return Lighting(
            weather, sun, 0.62, 0.5, 0.42, gain, (205, 150, 95), (225, 205, 185), 320, 0, 2.0, 0
        )
    if weather == "cloudy":
        gain = (bright * 1.02, bright, bright * 0.98)
        return Lighting(
            weather, sun, 0.88, 0.12, 0.0, gain, (190, 182, 175), (212, 208, 204), 220, 0, 2.5, 0
        )
    if weather == "dusk":
        gain = (0.52 * bright, 0.5 * bright, 0.62 * bright)
        return Lighting(
            weather, sun, 0.8, 0.25, 0.0, gain, (140, 95, 90), (120, 150, 215), 260, 0, 4.5, 0
        )
    gain = (0.74 * bright, 0.72 * bright, 0.7 * bright)
    streaks = int(rng.integers(60, 160))
    return Lighting(
        weather,
        sun,
        0.9,
        0.08,
        0.0,
        gain,
        (165, 160, 155),
        (200, 196, 192),
        110,
        0.55,
        4.0,
        streaks,
    )


def render_sky(camera: Camera, lighting: Lighting) -> Image:
    """The sky's gradient from the horizon upwards. (H, W, 3)"""
    rows = np.arange(camera.height)
    pixels = np.stack([np.full(rows.shape, camera.width / 2), rows, np.ones(rows.shape)])
    directions = camera.world_from_pixel @ pixels
    rise = np.clip(directions[2] / np.linalg.norm(directions, axis=0), 0, 1) ** 0.6
    top, low = np.array(lighting.sky_top), np.array(lighting.haze)
    column = (low + rise[:, None] * (top - low)).astype(np.uint8)
    size = (camera.width, camera.height)
    return cv2.resize(column[:, None], size, interpolation=cv2.INTER_NEAREST)


def haze_ground(image: Image, distance_m: Array, eye_m: float, lighting: Lighting) -> None:
    """Blend the ground into the haze and let a wet road mirror the sky, in place.

    Args:
        image: Picture with the ground. (H, W, 3)
        distance_m: Distance of the ground in each row, inf where none is seen. (H,)
        eye_m: Height of the camera above the ground.
        lighting: Haze and wetness.
    """
    veil = 1 - np.exp(-distance_m / lighting.haze_m)
    slope = eye_m / np.maximum(distance_m, 0.1)
    veil = np.maximum(veil, lighting.wet * np.exp(-slope / WET_SLOPE))
    touched = np.flatnonzero((veil > 0.02) & np.isfinite(distance_m))
    if not len(touched):
        return
    window = slice(int(touched[0]), int(touched[-1]) + 1)
    keep = (1 - veil[window]).astype(np.float32)[:, None, None]
    haze = np.asarray(lighting.haze, np.float32) * (1 - keep)
    image[window] = (image[window] * keep + haze).astype(np.uint8)


def finish(image: Image, lighting: Lighting, rng: np.random.Generator) -> Image:
    """Exposure, rain streaks and sensor noise. (H, W, 3)"""
    table = np.clip(np.arange(256)[:, None] * np.array(lighting.gain), 0, 255).astype(np.uint8)
    image = cv2.LUT(image, np.ascontiguousarray(table[:, None]))
    if lighting.streaks:
        _draw_streaks(image, lighting, rng)
    rows, columns = image.shape[:2]
    tile = _sensor_noise(lighting.noise)
    room = (max(1, NOISE_PX - rows), max(1, NOISE_PX - columns))
    top, left = (int(v) for v in rng.integers(0, room))
    wraps = rows + top > NOISE_PX or columns + left > NOISE_PX
    if wraps:
        repeats = (-(-(rows + top) // NOISE_PX), -(-(columns + left) // NOISE_PX), 1)
        tile = np.tile(tile, repeats)
    noise = tile[top : top + rows, left : left + columns]
    return cv2.add(image, noise, dtype=cv2.CV_8U)


@lru_cache(maxsize=1)
def _unit_noise() -> NDArray[np.float32]:
    rng = np.random.default_rng(7)
    gray = rng.standard_normal((NOISE_PX, NOISE_PX, 1), np.float32)
    return gray + 0.5 * rng.standard_normal((NOISE_PX, NOISE_PX, 3), np.float32)


@lru_cache(maxsize=8)
def _sensor_noise(deviation: float) -> NDArray[np.int16]:
    """A fixed tile of noise, grey levels. (NOISE_PX, NOISE_PX, 3)"""
    return np.round(_unit_noise() * deviation).astype(np.int16)


def _draw_streaks(image: Image, lighting: Lighting, rng: np.random.Generator) -> None:
    rows, columns = image.shape[:2]
    scale = columns / 800
    veil = np.zeros((rows, columns), np.uint8)
    starts = rng.uniform([0, 0], [columns, rows], (lighting.streaks, 2))
    lengths = rng.uniform(8, 30, lighting.streaks) * scale
    for (x, y), length in zip(starts, lengths, strict=True):
        cv2.line(
            veil,
            (int(x), int(y)),
            (int(x + 0.15 * length), int(y + length)),
            (70.0,),
            1,
            cv2.LINE_AA,
        )
    cv2.add(image, cv2.merge([veil] * 3), dst=image)
