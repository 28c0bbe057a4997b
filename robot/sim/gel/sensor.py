"""The simulated gel sensor: it turns a displacement map into the picture of its camera.

    sensor = draw_sensor(seed=3, finger="a")
    before = sensor.background(seed=1)
    during = sensor.render(contact.displacement_mm, seed=2)

A sensor is one physical device: its gel, its lamps, its dust. Pictures of one sensor differ only by the surface and by
the camera noise of their seed.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot.errors import UnknownName
from robot.gel_settings import GelSettings
from robot.sim.contact.layer import Layer
from robot.sim.gel.fitted_optics import FittedOptics, load_fitted
from robot.sim.gel.marks import Flaws, Markers, flaw_maps, marker_darkening
from robot.sim.gel.optics import MINI_BACKDROPS, MINI_BARS, GaussianBackdrop, LedBar, LedOptics
from robot.sim.gel.surface import Array, Field, Surface

Picture = NDArray[np.uint8]
Optics = LedOptics | FittedOptics

MODULUS_MPA = (0.2, 0.8)
POISSON = (0.45, 0.49)
THICKNESS_MM = (2.0, 4.0)


@dataclass(frozen=True)
class Noise:
    """Camera noise in grey levels: variance = read^2 + shot * grey level."""

    read: float = 0.8
    shot: float = 0.006


_PLAIN_LED, _PLAIN_FIELD, _PLAIN_NOISE, _UNKNOWN_GEL = LedOptics(), Field(), Noise(), GelSettings()


@dataclass(frozen=True)
class GelSensor:
    """One gel with its lamps and camera; frozen and hashable.

    Attributes:
        layer: the elastic gel.
        optics: model that turns the surface into colours.
        field: the part of the gel in the camera's view.
        tint: factor of each channel.
        exposure: factor of all channels.
        blur_px: standard deviation of the camera's point spread.
        noise: camera noise.
        flaws: dust, hairs, grains and roughness, or None.
        wear: flaws that a session adds, or None.
        markers: printed dots, or None.
        detail: resolution of the camera as a fraction of the picture's; the picture is scaled down and up again.
        jpeg_quality: quality (1 to 100) at which the camera compresses the picture; None: no compression.
    """

    layer: Layer
    optics: Optics = _PLAIN_LED
    field: Field = _PLAIN_FIELD
    tint: tuple[float, ...] = (1.0, 1.0, 1.0)
    exposure: float = 1.0
    blur_px: float = 0.7
    noise: Noise = _PLAIN_NOISE
    flaws: Flaws | None = None
    wear: Flaws | None = None
    markers: Markers | None = None
    detail: float = 1.0
    jpeg_quality: int | None = None

    @property
    def gel(self) -> GelSettings:
        """Thickness and elasticity of the gel."""
        return GelSettings(self.layer.thickness_mm, self.layer.modulus_mpa, self.layer.poisson)

    def background(self, seed: int) -> Picture:
        """Return the no-contact frame, (rows, cols, 3) uint8 RGB; equal to render() of zero displacement."""
        return self.capture(_no_contact_image(self), seed)

    def render(self, displacement_mm: NDArray[Any], seed: int) -> Picture:
        """Return the picture of a pressed gel, (rows, cols, 3) uint8 RGB.

        Args:
            displacement_mm: (r, c), inwards, on any grid that covers the field.
            seed: seed of the camera noise.

        Raises:
            SceneError: The map is not finite.
        """
        return self.capture(self.render_clean(displacement_mm), seed)

    def render_clean(self, displacement_mm: NDArray[Any]) -> Array:
        """Return grey levels (rows, cols, 3) before noise and clipping; pictures of one press share them."""
        surface = Surface(displacement_mm, self.field)
        return self._render_surface(surface) if surface.displacement_mm.any() else _no_contact_image(self)

    def _render_surface(self, surface: Surface) -> Array:
        slope_x, slope_y = surface.slopes
        darkening = np.ones((), np.float32)
        for flaws in filter(None, (self.flaws, self.wear)):
            darker, right, down = flaw_maps(flaws, self.field)
            darkening, slope_x, slope_y = darkening * darker, slope_x + right, slope_y + down
        image = self.optics.colours(surface, (slope_x, slope_y))
        if self.markers is not None:
            darkening = darkening * marker_darkening(self.markers, surface)
        image *= darkening[..., None]
        image *= np.array(self.tint, np.float32) * np.float32(self.exposure)
        return cv2.GaussianBlur(image, (0, 0), self.blur_px) if self.blur_px > 0 else image

    def capture(self, clean: Array, seed: int) -> Picture:
        """Return the camera's picture of `clean`: noisy, rounded, clipped to 0..255, reduced and compressed."""
        read, shot = np.float32(self.noise.read), np.float32(self.noise.shot)
        spread = np.sqrt(np.maximum(clean, 0) * shot + read * read)
        noisy = np.rint(clean + spread * _draw_noise(self.field.rows, self.field.cols, seed))
        picture: Picture = np.clip(noisy, 0, 255).astype(np.uint8)
        if self.detail < 1:
            height, width = (max(1, round(self.detail * size)) for size in picture.shape[:2])
            small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
            picture = np.asarray(cv2.resize(small, picture.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.uint8)
        if self.jpeg_quality is not None:
            data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])[1]
            picture = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)[..., ::-1]
        return picture


@lru_cache(maxsize=64)
def _no_contact_image(sensor: GelSensor) -> Array:
    return sensor._render_surface(Surface(np.zeros((1, 1)), sensor.field))


_TILE_MARGIN = 64


@lru_cache(maxsize=4)
def _tile(rows: int, cols: int) -> Array:
    shape = (rows + _TILE_MARGIN, cols + _TILE_MARGIN, 3)
    return np.random.default_rng([0x6E15, rows, cols]).standard_normal(shape, dtype=np.float32)


def _draw_noise(rows: int, cols: int, seed: int) -> Array:
    """Return a window (rows, cols, 3) of a large tile of standard normal noise.

    Fresh random values would cost more than the optics. 64 x 64 places, mirrored and of either sign, do not repeat
    visibly for a person or a tower.
    """
    rng = np.random.default_rng([seed, 0x7015E])
    down, right = rng.integers(0, _TILE_MARGIN, 2)
    keeps_rows, keeps_cols, is_positive = rng.integers(0, 2, 3)
    window = _tile(rows, cols)[down : down + rows, right : right + cols]
    window = window[:: 1 if keeps_rows else -1, :: 1 if keeps_cols else -1]
    return window if is_positive else -window


# Drawing sensors -------------------------------------------------------------------------------------------


def draw_sensor(seed: int, finger: str, *, optics: str = "led", gel: GelSettings = _UNKNOWN_GEL) -> GelSensor:
    """Draw a used sensor with its own gel, lamps, tint and dust; the same arguments give the same sensor.

    Args:
        seed: seed of the sensor.
        finger: name of its finger.
        optics: led, grey, varied (a sensor of any make), or the name of a fitted sensor.
        gel: known properties of the gel; they do not change the other random values.

    Raises:
        UnknownName: There are no optics of this name.

    >>> robot.draw_sensor(seed=0, finger="a") == robot.draw_sensor(seed=0, finger="a")
    True
    """
    if optics not in OPTICS:
        raise UnknownName(f"there are no optics {optics!r}; known are {', '.join(sorted(OPTICS))}")
    rng = np.random.default_rng([seed, *finger.encode(), 0x6E1])
    layer = Layer(
        modulus_mpa=float(np.exp(rng.uniform(*np.log(MODULUS_MPA)))),
        poisson=float(rng.uniform(*POISSON)),
        thickness_mm=float(rng.uniform(*THICKNESS_MM)),
    )
    sensor = GelSensor(
        replace(layer, **gel.known()),
        tint=tuple((1 + 0.02 * rng.standard_normal(3)).tolist()),
        exposure=float(rng.uniform(0.9, 1.12)),
        blur_px=float(rng.uniform(0.5, 0.9)),
        noise=Noise(float(rng.uniform(0.6, 1.1)), float(rng.uniform(0.003, 0.012))),
        flaws=Flaws(
            seed=int(rng.integers(1 << 31)),
            specks=int(rng.poisson(12)),
            hairs=int(rng.poisson(2.5)),
            grains=int(rng.poisson(20)),
            texture=float(rng.uniform(0.003, 0.01)),
        ),
    )
    sensor = replace(sensor, optics=OPTICS[optics](rng))
    return _draw_camera(sensor, rng) if optics == "varied" else sensor


def _draw_led(rng: np.random.Generator) -> LedOptics:
    """Draw LEDs slightly misaligned (5 degrees, a millimetre) and of unequal power (4 %)."""
    power = np.exp(0.04 * rng.standard_normal(3))
    bars = tuple(_draw_bar(bar, rng) for bar in MINI_BARS)
    backdrops = tuple(
        _draw_backdrop(backdrop, float(gain), rng) for backdrop, gain in zip(MINI_BACKDROPS, power, strict=True)
    )
    return LedOptics(
        bars,
        backdrops,
        ambient=float(rng.uniform(0.33, 0.43)),
        shadow=float(rng.uniform(0.15, 0.35)),
    )


def _draw_grey(rng: np.random.Generator) -> LedOptics:
    """Draw the optics of another maker: white lamps in other places, equal channels (before the sensor's tint)."""
    bars = tuple(_draw_bar(replace(bar, angle_rad=bar.angle_rad + math.radians(40)), rng) for bar in MINI_BARS)
    backdrop = _draw_backdrop(MINI_BACKDROPS[1], float(np.exp(0.04 * rng.standard_normal())), rng)
    return LedOptics(bars, (backdrop,) * 3, ((0.55, 0.3, 0.15),) * 3, ambient=0.45, shadow=0.2)


def _draw_varied(rng: np.random.Generator) -> LedOptics:
    """Draw the lamps of any make: 1 to 6 bars of any colour and place, white or coloured, a camera of any gamma.

    The ranges contain GelSight Mini, Wedge and DIGIT and go beyond them, so that a tower trained on such sensors does
    not depend on one make (domain randomisation, Tobin et al., IROS 2017).
    """
    count, is_grey = int(rng.integers(1, 7)), bool(rng.uniform() < 0.25)
    angles = rng.uniform(0, 2 * math.pi) + np.arange(count) * 2 * math.pi / count + 0.35 * rng.standard_normal(count)
    bars = tuple(
        LedBar(
            float(angle),
            distance_mm=float(rng.uniform(11, 22)),
            height_mm=float(rng.uniform(3, 16)),
            length_mm=float(rng.uniform(1, 14)),
            points=int(rng.integers(1, 5)),
            order=float(rng.uniform(0.5, 2.0)),
        )
        for angle in angles
    )
    rows = rng.dirichlet(np.full(count, rng.uniform(0.3, 2.0)), size=3)
    backdrops = tuple(_draw_any_backdrop(rng) for _ in range(3))
    if is_grey:
        rows, backdrops = rows[[0, 0, 0]], backdrops[:1] * 3
    return LedOptics(
        bars,
        backdrops,
        tuple(tuple(float(value) for value in row / row.sum()) for row in rows),
        ambient=float(rng.uniform(0.15, 0.6)),
        shadow=float(rng.uniform(0, 0.4)),
        gamma=float(np.exp(rng.uniform(-0.5, 0.5))),
    )


def _draw_any_backdrop(rng: np.random.Generator) -> GaussianBackdrop:
    """Draw a channel of the flat gel: dark to bright, its maximum anywhere, with a weak or strong vignette."""
    numbers = [*rng.uniform(-0.6, 0.6, 2), *np.exp(rng.uniform(-0.5, 1.2, 2)), *rng.uniform(-18, 18, 2)]
    return GaussianBackdrop(float(rng.uniform(15, 90)), float(rng.uniform(15, 130)), *map(float, numbers))


def _draw_camera(sensor: GelSensor, rng: np.random.Generator) -> GelSensor:
    """Return the sensor with the camera of any make: scale, colour, noise, resolution, compression, markers."""
    pitch_mm = float(rng.uniform(0.8, 2.5))
    markers = Markers(pitch_mm, pitch_mm * float(rng.uniform(0.08, 0.22)), float(rng.uniform(0.3, 0.9)))
    has_markers, is_reduced, is_compressed = (bool(value) for value in rng.uniform(size=3) < (0.25, 0.5, 0.5))
    return replace(
        sensor,
        field=Field(pixel_mm=float(rng.uniform(0.045, 0.08))),
        tint=tuple(np.exp(0.08 * rng.standard_normal(3)).tolist()),
        exposure=float(np.exp(rng.uniform(-0.3, 0.3))),
        blur_px=float(rng.uniform(0.4, 2.0)),
        noise=Noise(float(rng.uniform(0.3, 3.0)), float(rng.uniform(0.002, 0.03))),
        markers=markers if has_markers else None,
        detail=float(rng.uniform(0.3, 1.0)) if is_reduced else 1.0,
        jpeg_quality=int(rng.integers(40, 96)) if is_compressed else None,
    )


def _draw_bar(bar: LedBar, rng: np.random.Generator) -> LedBar:
    turn, out, up = rng.standard_normal(3) * (math.radians(5), 0.8, 0.35)
    return replace(
        bar,
        angle_rad=float(bar.angle_rad + turn),
        distance_mm=float(max(11.0, bar.distance_mm + out)),
        height_mm=float(max(3.0, bar.height_mm + up)),
        order=float(rng.uniform(0.7, 1.5)),
    )


def _draw_backdrop(backdrop: GaussianBackdrop, gain: float, rng: np.random.Generator) -> GaussianBackdrop:
    """Return the backdrop of a lamp of `gain` times the power, moved, wider or narrower, and slightly slanted."""
    x, y, slant_x, slant_y = (rng.standard_normal(4) * (0.05, 0.05, 2.5, 2.5)).tolist()
    wide_x, wide_y = np.exp(0.06 * rng.standard_normal(2)).tolist()
    return GaussianBackdrop(
        backdrop.floor * gain,
        backdrop.span * gain,
        backdrop.x0 + x,
        backdrop.y0 + y,
        backdrop.width_x * wide_x,
        backdrop.width_y * wide_y,
        backdrop.slant_x + slant_x,
        backdrop.slant_y + slant_y,
    )


# Sessions ---------------------------------------------------------------------------------------------------

# Measured on no-contact frames of real sensors, as logarithms of the mean colours of two sessions: EstimateModulus
# (GelSight Wedge, three days) and PhysiCLeAR (GelSight Mini, two sittings). The change that all channels share has an
# rms of 0.07 over the four pairs of sessions, that of a channel against the others 0.085, that of an 8 x 6 thumbnail
# less its mean 1 to 15 grey levels. Within a session the mean colour spreads by 0.01 to 0.02, slowly in PhysiCLeAR.
_LAMPS, _WHITE_BALANCE, _EXPOSURE = 0.05, 0.05, 0.03
_WAVE, _PERIODS_H = 0.01, (0.5, 2.0, 8.0)


def drift(sensor: GelSensor, seed: tuple[int, ...], hours: float) -> GelSensor:
    """Return the sensor in a session: other lamps and white balance, a worn and dirty gel, and a slow change of colour.

    Args:
        sensor: the sensor without drift.
        seed: seed of this sensor in this session.
        hours: time since the session began.
    """
    rng = np.random.default_rng([*seed, 0xD41F7])
    sizes, starts = _WAVE * rng.standard_normal((3, len(_PERIODS_H))), rng.uniform(size=(3, len(_PERIODS_H)))
    slow = np.exp((sizes * np.sin(2 * math.pi * (starts + hours / np.array(_PERIODS_H)))).sum(axis=1))
    begun = _begin_session(sensor, seed)
    tint, before = begun.tint * slow, np.array(sensor.tint)
    if isinstance(sensor.optics, LedOptics) and len(set(sensor.optics.backdrops)) == 1:  # a grey camera: one gain
        tint = before * (tint / before)[0]
    return replace(begun, tint=tuple(tint.tolist()))


@lru_cache(maxsize=64)
def _begin_session(sensor: GelSensor, seed: tuple[int, ...]) -> GelSensor:
    rng = np.random.default_rng([*seed, 0x5E5510])
    tint, exposure = np.exp(_WHITE_BALANCE * rng.standard_normal(3)), np.exp(_EXPOSURE * rng.standard_normal())
    specks, hairs, grains = rng.poisson((8, 4, 6)).tolist()
    wear = Flaws(int(rng.integers(1 << 31)), specks, hairs, grains, texture=0.0)
    optics = sensor.optics
    if isinstance(optics, LedOptics):  # a fitted sensor has no lamps: tint and exposure are their drift
        light = np.array(optics.mix) * np.exp(_LAMPS * rng.standard_normal(len(optics.bars)))
        gains, seed_of = light.sum(axis=1), dict(zip(optics.backdrops, rng.integers(1 << 31, size=3), strict=True))
        optics = replace(
            optics,
            mix=tuple(map(tuple, (light / gains[:, None]).tolist())),
            backdrops=tuple(  # equal backdrops, as of a grey camera, stay equal
                _draw_backdrop(backdrop, float(gain), np.random.default_rng(seed_of[backdrop]))
                for backdrop, gain in zip(optics.backdrops, gains, strict=True)
            ),
        )
    tint *= sensor.tint
    return replace(
        sensor, optics=optics, tint=tuple(tint.tolist()), exposure=sensor.exposure * float(exposure), wear=wear
    )


OPTICS: dict[str, Callable[[np.random.Generator], Optics]] = {
    "led": _draw_led,
    "grey": _draw_grey,
    "varied": _draw_varied,
    "gelsight": lambda _: load_fitted("gelsight"),
    "gelsight_mini": lambda _: load_fitted("gelsight_mini"),
}
