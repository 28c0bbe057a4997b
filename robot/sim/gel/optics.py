"""From the shape of a gel to colours: near-field LEDs, or a low-order model fitted to real presses.

Both have a method `colours`, which returns grey levels (0 to 255, before clipping) for red, green and blue; a flat gel
gives the backdrop. The other effects of a sensor (tint, dust, blur, noise) are in `robot.sim.gel.sensor`.

LEDs: a point source at s with axis o and emission order m lights the point p of a matt surface with normal n by
w = max(0, n . d) max(0, -o . d)^m / |s - p|^2, d = (s - p) / |s - p|. A bar b is a row of such points; w_b is the sum
of their w, and w_flat_b is this sum for the unpressed gel. Channel c of the picture is
    I_c = backdrop_c * (ambient + (1 - ambient) * sum_b mix_cb * shade_b * w_b / w_flat_b)^gamma,
so the effects that the backdrop contains (the lamp's falloff, the vignette of the lens) are not counted twice. shade_b
is 1 minus the blocked part of the bar's light; LedOptics describes backdrop, mix, ambient and gamma.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from robot.sim.gel.surface import Array, Field, Surface, resized

# Near-field LEDs -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LedBar:
    """A bar of LEDs of one colour next to the gel; it faces the middle of the field.

    Attributes:
        angle_rad: direction from the middle of the field, from the right of the image, counter-clockwise on screen.
        distance_mm: distance from the middle of the field.
        height_mm: height above the gel, on the camera's side.
        points: number of LEDs.
        order: Lambertian order of emission.
    """

    angle_rad: float
    distance_mm: float = 13.0
    height_mm: float = 5.5
    length_mm: float = 12.0
    points: int = 4
    order: float = 1.0

    def positions(self) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        """Return x, y, z (points, 3) of the LEDs in mm, y down."""
        outwards = np.array([math.cos(self.angle_rad), -math.sin(self.angle_rad), 0.0])
        along = np.array([-outwards[1], outwards[0], 0.0])
        offsets = np.linspace(-0.5, 0.5, self.points) if self.points > 1 else np.zeros(1)
        middle = outwards * self.distance_mm + np.array([0.0, 0.0, self.height_mm])
        return np.asarray(middle + offsets[:, None] * self.length_mm * along)


@dataclass(frozen=True)
class GaussianBackdrop:
    """One channel of the unpressed gel: floor + span * exp(-(x-x0)^2/wx^2 - (y-y0)^2/wy^2), plus a slant.

    Grey levels; x and y run from -1 to 1 over the field.
    """

    floor: float
    span: float
    x0: float = 0.0
    y0: float = 0.0
    width_x: float = 1.0
    width_y: float = 1.0
    slant_x: float = 0.0
    slant_y: float = 0.0

    def __call__(self, field: Field) -> Array:
        """Return grey levels (rows, cols), at least 1."""
        x, y = field.unit_positions()
        hill = np.exp(-(((x - self.x0) / self.width_x) ** 2)) * np.exp(-(((y - self.y0) / self.width_y) ** 2))
        level = self.floor + self.span * hill + self.slant_x * x + self.slant_y * y
        return np.asarray(np.maximum(level, 1), np.float32)


# Like a GelSight Mini: blue from above, red from below on the left, green from the right; a pink middle.
MINI_BARS = (LedBar(math.radians(234)), LedBar(math.radians(346)), LedBar(math.radians(122)))
MINI_BACKDROPS = (
    GaussianBackdrop(64, 99, 0.0, -0.12, 1.09, 0.98, 0.0, -6.0),
    GaussianBackdrop(50, 76, 0.2, -0.13, 1.4, 1.9, -14.0, -1.0),
    GaussianBackdrop(28, 133, 0.03, 0.13, 0.88, 0.85, 0.0, 9.0),
)
# Contribution of each bar (columns) to each channel (rows); the rows add up to 1.
MINI_MIX = ((0.76, 0.19, 0.05), (0.23, 0.69, 0.08), (0.07, 0.07, 0.86))


@dataclass(frozen=True)
class LedOptics:
    """Bars of near-field LEDs.

    Attributes:
        backdrops: the unpressed gel, one for each channel.
        mix: contribution of each bar (columns) to each channel (rows); each row adds up to 1.
        ambient: fraction of the light that comes from all directions (reflected inside the gel).
        shadow: fraction of a bar's light that the surface can block; 0 skips cast shadows.
        gamma: exponent of the camera's response; the flat gel does not depend on it.
    """

    bars: tuple[LedBar, ...] = MINI_BARS
    backdrops: tuple[GaussianBackdrop, ...] = MINI_BACKDROPS
    mix: tuple[tuple[float, ...], ...] = MINI_MIX
    ambient: float = 0.38
    shadow: float = 0.25
    gamma: float = 1.0

    def colours(self, surface: Surface, slopes: tuple[Array, Array]) -> Array:
        """Return the picture (rows, cols, 3) of the surface with these slopes, those of its flaws included."""
        field, (slope_x, slope_y) = surface.field, slopes
        steep = np.float32(1) / np.sqrt(np.float32(1) + slope_x * slope_x + slope_y * slope_y)
        lights = [_light_of(bar, field, slope_x, slope_y) * steep for bar in self.bars]
        if self.shadow > 0 and surface.displacement_mm.any():
            for light, cast in zip(lights, cast_shadows(surface, self.bars), strict=True):
                light *= 1 - np.float32(self.shadow) * cast
        backdrop, ambient = backdrop_of(self.backdrops, field), np.float32(self.ambient)
        out = np.empty_like(backdrop)
        for channel, mix in enumerate(np.array(self.mix, np.float32)):
            mixed = sum(share * light for share, light in zip(mix, lights, strict=True))
            out[..., channel] = backdrop[..., channel] * (ambient + (1 - ambient) * mixed)
        return out if self.gamma == 1 else backdrop * (out / backdrop) ** np.float32(self.gamma)


@lru_cache(maxsize=16)
def backdrop_of(backdrops: tuple[GaussianBackdrop, ...], field: Field) -> Array:
    """Return the unpressed gel (rows, cols, 3)."""
    whole = np.stack([backdrop(field) for backdrop in backdrops], axis=-1)
    whole.flags.writeable = False
    return whole


def _light_of(bar: LedBar, field: Field, slope_x: Array, slope_y: Array) -> Array:
    """Return the light (rows, cols) of a bar on a surface with these slopes, before it is divided by |normal|."""
    x, y = field.positions()
    light = np.zeros((field.rows, field.cols), np.float32)
    for (led_x, led_y, led_z), strength in zip(
        bar.positions().astype(np.float32), led_strengths(bar, field), strict=True
    ):
        towards = led_z - slope_x * (led_x - x) - slope_y * (led_y - y)
        light += strength * np.maximum(towards, 0)
    return light


@lru_cache(maxsize=48)
def led_strengths(bar: LedBar, field: Field) -> Array:
    """Return the strength (points, rows, cols) of each LED at each pixel.

    Strength times (normal . vector to the LED) is the LED's contribution to w / w_flat.
    """
    x, y = (axis.astype(np.float64) for axis in field.positions())
    strengths, flat = [], np.zeros((field.rows, field.cols))
    for led in bar.positions():
        away = (led[0] - x, led[1] - y, np.full((1, 1), led[2]))
        distance = np.sqrt(away[0] ** 2 + away[1] ** 2 + away[2] ** 2)
        axis = -led / np.linalg.norm(led)
        facing = np.maximum(0, -sum(a * b for a, b in zip(axis, away, strict=True)) / distance)
        strengths.append(facing**bar.order / distance**3)
        flat += strengths[-1] * led[2]
    flat = np.maximum(flat, np.finfo(np.float64).tiny)
    return np.stack([strength / flat for strength in strengths]).astype(np.float32)


# Shadows ---------------------------------------------------------------------------------------------------

_SHADOW_STEP = 4  # image pixels per point of the shadow grid; penumbras are wider
_REACHES_MM = (0.4, 0.8, 1.4, 2.2)  # distances towards the bar at which the surface height is sampled
_PENUMBRA_MM = 0.5  # height above the ray at which the light is fully blocked: bars are long, light soft


def cast_shadows(surface: Surface, bars: tuple[LedBar, ...]) -> list[Array]:
    """Return the fraction (0 to 1) of each bar's light that the surface itself blocks at each pixel."""
    heights = surface.coarse(_SHADOW_STEP)
    full = (surface.field.rows, surface.field.cols)
    out = []
    for samples in _shadow_samples(bars, surface.field, heights.shape):
        over = np.zeros_like(heights)
        for map_x, map_y, rise in samples:
            towards = cv2.remap(heights, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            np.maximum(over, towards - heights - rise, out=over)
        shade = np.minimum(over / np.float32(_PENUMBRA_MM), 1)
        out.append(np.clip(resized(cv2.GaussianBlur(shade, (0, 0), 1.2), full), 0, 1))
    return out


@lru_cache(maxsize=6)
def _shadow_samples(
    bars: tuple[LedBar, ...], field: Field, shape: tuple[int, int]
) -> tuple[list[tuple[Array, Array, Array]], ...]:
    """Return, for each bar and reach, the x and y maps of the samples and the height (mm) of the light ray there."""
    grid = Field(shape[0], shape[1], 1.0)
    steps = (field.size_mm[1] / shape[1], field.size_mm[0] / shape[0])
    x, y = (axis * np.float32(step) for axis, step in zip(grid.positions(), steps, strict=True))
    columns, rows = np.meshgrid(np.arange(shape[1], dtype=np.float32), np.arange(shape[0], dtype=np.float32))
    out = []
    for bar in bars:
        led_x, led_y, led_z = bar.positions().mean(axis=0)
        away = np.hypot(led_x - x, led_y - y)
        unit_x, unit_y = (led_x - x) / away, (led_y - y) / away
        out.append(
            [
                (
                    (columns + reach / steps[0] * unit_x).astype(np.float32),
                    (rows + reach / steps[1] * unit_y).astype(np.float32),
                    (reach * led_z / away).astype(np.float32),
                )
                for reach in _REACHES_MM
            ]
        )
    return tuple(out)
