"""Weather and light, and what they do to a picture."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from minicity.camera import Camera
from minicity.curves import Array
from minicity.texture import Image

BGR = tuple[float, float, float]

# What is drawn at random for a scene, as (smallest, largest)
BRIGHTNESS = (0.88, 1.12)
CLEAR_ELEVATION_RAD = (0.45, 1.1)
CLEAR_WARMTH = (-0.04, 0.04)  # of the gain: added to red, taken from blue
RAIN_STREAKS = (60, 160)
VEILED_ELEVATION_RAD = 0.3  # of a sun that is not seen

SKY_CURVE = 0.6  # exponent: the sky changes fastest just above the horizon
WET_SLOPE = 0.12  # of the line of sight at which a wet road mirrors 1 / e of what it does at most
LEAST_VEIL = 0.02  # weaker haze is not drawn
NEAREST_GROUND_M = 0.1

NOISE_PX = 1024  # edge of the tile of noise
NOISE_SEED = 7
COLOR_NOISE = 0.5  # noise of each colour channel alone, as a share of the grey noise
STREAK_LENGTH_PX = (8, 30)  # in an image of REFERENCE_WIDTH_PX
STREAK_SLANT = 0.15  # sideways per length
STREAK_GREY = 70.0  # added to the picture
REFERENCE_WIDTH_PX = 800


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


# What each kind of weather gives `Lighting`, a column a kind, and how often it comes
WEATHERS = ("clear", "cloudy", "dusk", "rain")
SHARES = (0.5, 0.24, 0.13, 0.13)
_LOOKS: dict[str, tuple[Any, ...]] = {
    "ambient": (0.62, 0.88, 0.8, 0.9),
    "direct": (0.5, 0.12, 0.25, 0.08),
    "shadow": (0.42, 0.0, 0.0, 0.0),
    "sky_top": ((205, 150, 95), (190, 182, 175), (140, 95, 90), (165, 160, 155)),
    "haze": ((225, 205, 185), (212, 208, 204), (120, 150, 215), (200, 196, 192)),
    "haze_m": (320, 220, 260, 110),
    "wet": (0.0, 0.0, 0.0, 0.55),
    "noise": (2.0, 2.5, 4.5, 4.0),
}
_GAINS = ((1.08, 1.1, 1.12), (1.02, 1.0, 0.98), (0.52, 0.5, 0.62), (0.74, 0.72, 0.7))


def random_lighting(rng: np.random.Generator) -> Lighting:
    """Draw the light of a scene: mostly clear or cloudy, sometimes dusk or rain."""
    name = str(rng.choice(WEATHERS, p=SHARES))
    kind, clear = WEATHERS.index(name), name == "clear"
    azimuth, bright = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(*BRIGHTNESS))
    elevation = float(rng.uniform(*CLEAR_ELEVATION_RAD)) if clear else VEILED_ELEVATION_RAD
    warm = float(rng.uniform(*CLEAR_WARMTH)) if clear else 0.0
    level = np.cos(elevation)
    blue, green, red = _GAINS[kind]
    return Lighting(
        weather=name,
        sun=np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]),
        gain=(bright * (blue - warm), bright * green, bright * (red + warm)),
        streaks=int(rng.integers(*RAIN_STREAKS)) if name == "rain" else 0,
        **{field: values[kind] for field, values in _LOOKS.items()},
    )


def render_sky(camera: Camera, lighting: Lighting) -> Image:
    """The sky's gradient from the horizon upwards. (H, W, 3)"""
    rows = np.arange(camera.height)
    pixels = np.stack([np.full(rows.shape, camera.width / 2), rows, np.ones(rows.shape)])
    directions = camera.world_from_pixel @ pixels
    rise = np.clip(directions[2] / np.linalg.norm(directions, axis=0), 0, 1) ** SKY_CURVE
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
    slope = eye_m / np.maximum(distance_m, NEAREST_GROUND_M)
    veil = np.maximum(veil, lighting.wet * np.exp(-slope / WET_SLOPE))
    touched = np.flatnonzero((veil > LEAST_VEIL) & np.isfinite(distance_m))
    if not len(touched):
        return
    window = slice(int(touched[0]), int(touched[-1]) + 1)
    keep = (1 - veil[window]).astype(np.float32)[:, None, None]
    haze = np.asarray(lighting.haze, np.float32) * (1 - keep)
    image[window] = (image[window] * keep + haze).astype(np.uint8)


def finish(image: Image, lighting: Lighting, rng: np.random.Generator) -> Image:
    """Return a picture with exposure, rain streaks and sensor noise. (H, W, 3)

    Args:
        image: The picture, BGR. (H, W, 3)
        lighting: Gain, streaks and noise.
        rng: Draws streaks and noise.
    """
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
    rng = np.random.default_rng(NOISE_SEED)
    gray = rng.standard_normal((NOISE_PX, NOISE_PX, 1), np.float32)
    return gray + COLOR_NOISE * rng.standard_normal((NOISE_PX, NOISE_PX, 3), np.float32)


@lru_cache(maxsize=8)
def _sensor_noise(deviation: float) -> NDArray[np.int16]:
    """A fixed tile of noise, grey levels. (NOISE_PX, NOISE_PX, 3)"""
    return np.round(_unit_noise() * deviation).astype(np.int16)


def _draw_streaks(image: Image, lighting: Lighting, rng: np.random.Generator) -> None:
    """Draw rain, in place."""
    rows, columns = image.shape[:2]
    veil = np.zeros((rows, columns), np.uint8)
    starts = rng.uniform([0, 0], [columns, rows], (lighting.streaks, 2))
    lengths = rng.uniform(*STREAK_LENGTH_PX, lighting.streaks) * (columns / REFERENCE_WIDTH_PX)
    for (x, y), length in zip(starts, lengths, strict=True):
        start, end = (int(x), int(y)), (int(x + STREAK_SLANT * length), int(y + length))
        cv2.line(veil, start, end, (STREAK_GREY,), 1, cv2.LINE_AA)
    cv2.add(image, cv2.merge([veil] * 3), dst=image)
