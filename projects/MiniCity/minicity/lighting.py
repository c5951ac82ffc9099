"""Weather and light of a scene, and their effects on a picture."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from minicity.camera import Camera
from minicity.curves import Array
from minicity.texture import Image

BGR = tuple[float, float, float]  # values for blue, green and red, the order of OpenCV

# Ranges of the random values of a scene: (smallest, largest).
BRIGHTNESS = (0.88, 1.12)
CLEAR_ELEVATION_RAD = (0.45, 1.1)
CLEAR_WARMTH = (-0.04, 0.04)  # share of the gain added to red and subtracted from blue
RAIN_STREAKS = (60, 160)
VEILED_ELEVATION_RAD = 0.3  # elevation of a sun behind clouds

SKY_CURVE = 0.6  # an exponent below 1 lets the colour change fastest just above the horizon
WET_SLOPE = 0.12  # slope of the line of sight at which the mirroring drops to 1 / e
LEAST_VEIL = 0.02  # rows with a smaller share of the sky's colour are not changed
NEAREST_GROUND_M = 0.1  # smaller distances are raised to this value when the slope is computed

NOISE_PX = 1024  # edge of the noise tile
NOISE_SEED = 7
COLOR_NOISE = 0.5  # independent noise of each colour channel, relative to the grey noise
STREAK_LENGTH_PX = (8, 30)  # range for an image of REFERENCE_WIDTH_PX
STREAK_SLANT = 0.15  # sideways shift per length
STREAK_GREY = 70.0  # grey levels added to the picture
REFERENCE_WIDTH_PX = 800


@dataclass(frozen=True)
class Lighting:
    """Light and weather of a scene. Colours are BGR.

    Attributes:
        weather: ``clear``, ``cloudy``, ``dusk`` or ``rain``.
        sun: Unit direction towards the sun. (3,)
        ambient: Share of light from all directions.
        direct: Share of light from the sun.
        shadow: Share of light lost in a shadow on the ground, in [0, 1].
        gain: Exposure factor per colour channel.
        sky_top: Colour of the sky overhead, in [0, 255].
        haze: Colour of the sky at the horizon and of distant objects, in [0, 255].
        haze_m: Distance in metres at which haze hides 63 % (1 - 1 / e) of an object's colour.
        wet: Share of the sky mirrored by the road at a grazing angle, in [0, 1].
        noise: Standard deviation of the sensor noise in grey levels.
        streaks: Number of rain streaks per image.
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


# Kinds of weather, their probabilities, and their values of fields of `Lighting`, in the order of
# WEATHERS.
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
# Exposure factor (blue, green, red) of each weather, before the random brightness and warmth.
_GAINS = ((1.08, 1.1, 1.12), (1.02, 1.0, 0.98), (0.52, 0.5, 0.62), (0.74, 0.72, 0.7))


def random_lighting(rng: np.random.Generator) -> Lighting:
    """Draw the light of a scene: mostly clear or cloudy, sometimes dusk or rain."""
    weather = str(rng.choice(WEATHERS, p=SHARES))
    index = WEATHERS.index(weather)
    azimuth = float(rng.uniform(low=0, high=2 * np.pi))
    bright = float(rng.uniform(low=BRIGHTNESS[0], high=BRIGHTNESS[1]))
    elevation = VEILED_ELEVATION_RAD
    warm = 0.0
    if weather == "clear":
        lowest, highest = CLEAR_ELEVATION_RAD
        elevation = float(rng.uniform(low=lowest, high=highest))
        warm = float(rng.uniform(low=CLEAR_WARMTH[0], high=CLEAR_WARMTH[1]))
    streaks = 0
    if weather == "rain":
        streaks = int(rng.integers(RAIN_STREAKS[0], RAIN_STREAKS[1]))
    horizontal = np.cos(elevation)  # length of the horizontal part of the direction to the sun
    sun = [horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(elevation)]
    blue, green, red = _GAINS[index]
    look = {name: values[index] for name, values in _LOOKS.items()}
    return Lighting(
        weather=weather,
        sun=np.array(sun),
        gain=(bright * (blue - warm), bright * green, bright * (red + warm)),
        streaks=streaks,
        **look,
    )


def render_sky(camera: Camera, lighting: Lighting) -> Image:
    """Render the sky as a gradient from the horizon upwards.

    Args:
        camera: The camera.
        lighting: Colours of the sky.

    Returns:
        The picture, BGR. (H, W, 3)
    """
    # The sky is computed along the middle column, and repeated for all columns.
    rows = np.arange(camera.height)
    pixels = np.stack([np.full(rows.shape, camera.width / 2), rows, np.ones(rows.shape)])
    directions = camera.world_from_pixel @ pixels
    # Sine of the elevation of each row, which is 0 at the horizon and 1 overhead.
    # Rows below the horizon get 0.
    sines = np.clip(directions[2] / np.linalg.norm(directions, axis=0), 0, 1)
    top_share = sines**SKY_CURVE
    top = np.array(lighting.sky_top)
    horizon = np.array(lighting.haze)
    column = (horizon + top_share[:, None] * (top - horizon)).astype(np.uint8)
    size = (camera.width, camera.height)
    return cv2.resize(column[:, None], size, interpolation=cv2.INTER_NEAREST)


def haze_ground(image: Image, distance_m: Array, eye_m: float, lighting: Lighting) -> None:
    """Blend the ground into the haze and let a wet road mirror the sky, in place.

    Args:
        image: Picture with the ground, BGR. (H, W, 3)
        distance_m: Distance of the ground in each row, inf for rows without ground. (H,)
        eye_m: Height of the camera above the ground in metres.
        lighting: Haze and wetness.
    """
    # Share of the sky's colour in each row: by haze or by the mirroring, whichever is stronger.
    haze_share = 1 - np.exp(-distance_m / lighting.haze_m)
    # The road mirrors more at a flatter line of sight.
    slope = eye_m / np.maximum(distance_m, NEAREST_GROUND_M)
    mirror_share = lighting.wet * np.exp(-slope / WET_SLOPE)
    veil = np.maximum(haze_share, mirror_share)
    hazy_rows = np.flatnonzero((veil > LEAST_VEIL) & np.isfinite(distance_m))
    if not len(hazy_rows):
        return
    window = slice(int(hazy_rows[0]), int(hazy_rows[-1]) + 1)
    ground_share = (1 - veil[window]).astype(np.float32)[:, None, None]
    haze = np.asarray(lighting.haze, dtype=np.float32) * (1 - ground_share)
    image[window] = (image[window] * ground_share + haze).astype(np.uint8)


def finish(image: Image, lighting: Lighting, rng: np.random.Generator) -> Image:
    """Apply exposure, rain streaks and sensor noise to a picture.

    Args:
        image: The picture, BGR. (H, W, 3)
        lighting: Gain, streaks and noise.
        rng: Source of the streaks and the noise.

    Returns:
        The finished picture, BGR. (H, W, 3)
    """
    # Lookup table: the new value for each value of a colour channel. (256, 3)
    table = np.clip(np.arange(256)[:, None] * np.array(lighting.gain), 0, 255).astype(np.uint8)
    image = cv2.LUT(image, np.ascontiguousarray(table[:, None]))  # OpenCV takes (256, 1, 3)
    if lighting.streaks:
        _draw_streaks(image, lighting, rng=rng)  # `image` is a new picture since `cv2.LUT`
    rows, columns = image.shape[:2]
    # The noise of a picture is a random part of a fixed tile, which repeats for large pictures.
    tile = _sensor_noise(lighting.noise)
    num_corners = (max(1, NOISE_PX - rows), max(1, NOISE_PX - columns))  # along y, x
    top, left = rng.integers(0, num_corners).tolist()
    bottom = top + rows
    right = left + columns
    if bottom > NOISE_PX or right > NOISE_PX:
        repeats = (-(-bottom // NOISE_PX), -(-right // NOISE_PX), 1)  # quotients rounded up
        tile = np.tile(tile, repeats)
    # The sum is limited to [0, 255].
    return cv2.add(image, tile[top:bottom, left:right], dtype=cv2.CV_8U)


@lru_cache(maxsize=1)
def _unit_noise() -> NDArray[np.float32]:
    """Fixed tile of noise whose grey part has a standard deviation of 1. (NOISE_PX, NOISE_PX, 3)"""
    rng = np.random.default_rng(NOISE_SEED)
    gray = rng.standard_normal((NOISE_PX, NOISE_PX, 1), dtype=np.float32)
    color = rng.standard_normal((NOISE_PX, NOISE_PX, 3), dtype=np.float32)
    return gray + COLOR_NOISE * color


@lru_cache(maxsize=8)
def _sensor_noise(deviation: float) -> NDArray[np.int16]:
    """Fixed tile of noise, scaled by ``deviation`` to grey levels. (NOISE_PX, NOISE_PX, 3)"""
    return np.round(_unit_noise() * deviation).astype(np.int16)


def _draw_streaks(image: Image, lighting: Lighting, rng: np.random.Generator) -> None:
    """Draw rain streaks into a picture (H, W, 3), in place."""
    rows, columns = image.shape[:2]
    streaks = np.zeros((rows, columns), dtype=np.uint8)
    count = lighting.streaks
    starts = rng.uniform(low=[0, 0], high=[columns, rows], size=(count, 2))
    shortest, longest = STREAK_LENGTH_PX
    lengths = rng.uniform(low=shortest, high=longest, size=count) * (columns / REFERENCE_WIDTH_PX)
    for (x, y), length in zip(starts, lengths, strict=True):
        cv2.line(
            streaks,
            pt1=(int(x), int(y)),
            pt2=(int(x + STREAK_SLANT * length), int(y + length)),
            color=(STREAK_GREY,),
            thickness=1,
            lineType=cv2.LINE_AA,
        )
    cv2.add(image, cv2.merge([streaks] * 3), dst=image)
