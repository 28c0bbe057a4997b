"""Relief on the wall of an object, 0.1 to 6 mm high, drawn on the unrolled wall.

A pattern fills a `Sheet` (rows along t, columns along s, periodic in s) with numbers from 0 to 1. `Relief` sets height,
width, direction, elongation and sharpness, and whether the pattern is raised or engraved.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Rng = np.random.Generator


@dataclass(frozen=True)
class Relief:
    """One instance of a relief family.

    Attributes:
        amplitude_mm: greatest height or depth.
        pitch_mm: distance between elements.
        angle_rad: direction across which a directed pattern repeats (0: around the object).
        aspect: length of the elements over their width, at least 1.
        sharpness: 0 for rounded elements, up to 1 for flat tops with steep edges.
        engraved: whether the pattern goes inwards.
        seed: seed of random patterns.
    """

    name: str
    amplitude_mm: float
    pitch_mm: float
    angle_rad: float = 0.0
    aspect: float = 1.0
    sharpness: float = 0.3
    engraved: bool = False
    seed: int = 0

    def height(self, sheet: "Sheet") -> Floats | None:
        """Return the height in mm over the sheet, at most `amplitude_mm` out or, if engraved, in; None if it is 0."""
        if self.amplitude_mm == 0:
            return None
        unit = np.clip(RELIEFS[self.name](self, sheet, np.random.default_rng([self.seed, 7])), 0, 1)
        return np.asarray(unit * np.float32(-self.amplitude_mm if self.engraved else self.amplitude_mm), np.float32)


@dataclass(frozen=True)
class Sheet:
    """An unrolled wall, `width_mm` around (periodic) by `height_mm`, at (rows, columns) nodes."""

    width_mm: float
    height_mm: float
    rows: int
    columns: int

    @property
    def pixel_mm(self) -> tuple[float, float]:
        """Spacing of the nodes along t and s."""
        return self.height_mm / max(self.rows - 1, 1), self.width_mm / self.columns

    @property
    def s(self) -> Floats:
        """Positions of the columns in mm."""
        return np.arange(self.columns, dtype=np.float32) * np.float32(self.pixel_mm[1])

    @property
    def t(self) -> Floats:
        """Positions of the rows in mm."""
        return np.arange(self.rows, dtype=np.float32) * np.float32(self.pixel_mm[0])

    def phase(self, pitch_mm: float, angle_rad: float, *, multiple: int = 1) -> Floats:
        """Return the wave number at each node, (rows, columns); the waves around are a multiple of `multiple`."""
        waves = multiple * round(self.width_mm * np.cos(angle_rad) / pitch_mm / multiple)
        along = np.float32(waves / self.width_mm) * self.s
        return along[None, :] + (np.float32(np.sin(angle_rad) / pitch_mm) * self.t)[:, None]

    def blur(self, image: Floats, sigma_mm: float) -> Floats:
        """Gaussian blur, periodic in s."""
        sigma = [sigma_mm / pixel for pixel in self.pixel_mm]
        pad = min(int(4 * sigma[1]) + 1, self.columns)
        wide = cv2.copyMakeBorder(image, 0, 0, pad, pad, cv2.BORDER_WRAP)
        blurred = cv2.GaussianBlur(wide, (0, 0), sigmaX=sigma[1], sigmaY=sigma[0])
        return np.asarray(blurred[:, pad : pad + self.columns])

    def resample(self, image: Floats, pad: int, interpolation: int) -> Floats:
        """Return a coarser image over the same wall, with `pad` repeated columns on each side, at the nodes."""
        u = pad + np.arange(self.columns, dtype=np.float32) * np.float32((image.shape[1] - 2 * pad) / self.columns)
        v = np.arange(self.rows, dtype=np.float32) * np.float32((len(image) - 1) / max(self.rows - 1, 1))
        x, y = np.meshgrid(u, v)
        return np.asarray(cv2.remap(image, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE))

    def scatter(self, rng: Rng, pitch_mm: float, *, aspect: float = 1.0, jitter: float = 0.35) -> Floats:
        """Return the distance in mm to the nearest of points about one pitch apart, stretched by `aspect` along t.

        Points are on a staggered grid, with a random shift of up to `jitter` pitches.
        """
        columns, rows = max(round(self.width_mm / pitch_mm), 2), max(round(self.height_mm / aspect / pitch_mm), 1)
        i, j = np.meshgrid(np.arange(columns), np.arange(-1, rows + 2))
        shift = rng.uniform(-jitter, jitter, (2, *i.shape))
        scaled_rows = max(round(self.rows * self.pixel_mm[0] / self.pixel_mm[1] / aspect), 2)
        u = (i + 0.5 * (j % 2) + shift[0]) * (self.columns / columns)
        v = (j + 0.5 + shift[1]) * (scaled_rows / rows)
        pad = min(int(2 * self.columns / columns) + 2, self.columns)
        mask = np.full((scaled_rows + 2 * pad, self.columns), 255, np.uint8)
        mask[
            np.clip(np.rint(v).astype(int) + pad, 0, len(mask) - 1).ravel(),
            np.rint(u).astype(int).ravel() % self.columns,
        ] = 0
        wide = cv2.copyMakeBorder(mask, 0, 0, pad, pad, cv2.BORDER_WRAP)
        rough = cv2.distanceTransform(wide, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[pad:-pad, pad:-pad]
        # OpenCV's last bits depend on memory alignment and threads; squares of distances are whole numbers.
        distance = np.sqrt(np.rint(rough * rough))
        return np.asarray(cv2.resize(distance, (self.columns, self.rows)) * np.float32(self.pixel_mm[1]), np.float32)


def _crest(wave: Floats, sharpness: float) -> Floats:
    """Map a wave of -1..1 to 0..1: rounded at sharpness 0, flat tops and steep edges at 1."""
    gain = np.float32(0.4 + 4 * sharpness**2)
    return np.asarray(np.float32(0.5) + np.tanh(wave * gain) / np.float32(2 * np.tanh(gain)))


def _edge_blur_mm(relief: Relief) -> float:
    """Return the blur in mm of a step's edge, as a mould or a tool leaves it."""
    return 0.1 + 0.25 * (1 - relief.sharpness) + 0.2 * relief.amplitude_mm


def _cosine(phase: Floats) -> Floats:
    return np.asarray(np.cos(phase * np.float32(2 * np.pi)))


def _triangle(phase: Floats) -> Floats:
    """Return 1 at whole numbers, 0 halfway between."""
    return np.abs(2 * (phase - np.floor(phase)) - 1)


# Families ----------------------------------------------------------------------------------------------------


def smooth(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """No relief."""
    return np.zeros((sheet.rows, sheet.columns), np.float32)


def ribs(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Parallel ridges in any direction."""
    return _crest(_cosine(sheet.phase(relief.pitch_mm, relief.angle_rad)), relief.sharpness)


def knurl(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Pyramids between two crossed sets of grooves."""
    angle = np.arctan(relief.aspect)
    one = _triangle(sheet.phase(relief.pitch_mm, angle))
    two = _triangle(sheet.phase(relief.pitch_mm, -angle))
    return np.minimum(np.minimum(one, two) * np.float32(1 + relief.sharpness), np.float32(1))


def weave(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Strands that pass over and under one another, straight or on the bias."""
    turn = np.pi / 4 if np.cos(4 * relief.angle_rad) < 0 else 0.0
    a = np.sin(np.pi * sheet.phase(relief.pitch_mm, turn, multiple=2))
    b = np.sin(np.pi * sheet.phase(relief.pitch_mm * relief.aspect, turn + np.pi / 2, multiple=2))
    cross = np.float32(0.4) * a * b
    strand = np.maximum(np.float32(0.6) * np.abs(a) + cross, np.float32(0.6) * np.abs(b) - cross)
    return np.asarray(strand ** np.float32(1 - 0.5 * relief.sharpness))


def pebble(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Irregular domes side by side, like leather or cobbles."""
    distance = sheet.scatter(rng, relief.pitch_mm, aspect=relief.aspect) / np.float32(0.72 * relief.pitch_mm)
    return np.asarray(np.sqrt(np.maximum(1 - distance * distance, 0)) ** np.float32(1.2 - 0.7 * relief.sharpness))


def bumps(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Single domes on a staggered grid, with flat ground between them."""
    radius = relief.pitch_mm * (0.26 + 0.16 * relief.sharpness)
    distance = sheet.scatter(rng, relief.pitch_mm, aspect=relief.aspect, jitter=0.0) / np.float32(radius)
    return np.asarray(np.sqrt(np.maximum(1 - distance * distance, 0)))


def dimples(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Scattered rounded hollows, as on a golf ball."""
    distance = sheet.scatter(rng, relief.pitch_mm, aspect=relief.aspect, jitter=0.2)
    return np.asarray(
        1 - np.clip(np.float32(1.15) - distance / np.float32(0.42 * relief.pitch_mm), 0, 1) ** np.float32(1.5)
    )


def honeycomb(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Walls around six-sided cells: three sets of waves at 60 degrees."""
    waves = [sheet.phase(relief.pitch_mm, angle, multiple=2) for angle in (0.0, np.pi / 3, -np.pi / 3)]
    waves[0] = waves[1] + waves[2]  # exact in spite of rounding to whole waves
    total = np.sum([_cosine(wave) for wave in waves], axis=0)
    return _crest(np.float32(0.45) - total / np.float32(1.5), 0.3 + 0.5 * relief.sharpness)


def hammered(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Random rolling ground: stucco, beaten metal, or bark when stretched."""
    noise = rng.standard_normal((sheet.rows // 4 + 1, sheet.columns // 4), dtype=np.float32)
    coarse = Sheet(sheet.width_mm, sheet.height_mm, *noise.shape)
    image = coarse.blur(noise, relief.pitch_mm * 0.22)
    if relief.aspect > 1.3:
        sigma = relief.pitch_mm * 0.22 * relief.aspect / coarse.pixel_mm[0]
        image = cv2.GaussianBlur(image, (1, 2 * int(3 * sigma) + 1), sigmaX=0.1, sigmaY=sigma)
    image = sheet.resample(cv2.copyMakeBorder(image, 0, 0, 2, 2, cv2.BORDER_WRAP), 2, cv2.INTER_CUBIC)
    return _crest(image / np.float32(2 * image.std() + 1e-9), relief.sharpness)


def scratches(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Fine grooves of random length, most of them in one direction."""
    count = int(np.clip(sheet.width_mm * sheet.height_mm / (relief.pitch_mm * 9), 20, 3000))
    start = rng.uniform(0, 1, (count, 2)) * [sheet.width_mm, sheet.height_mm]
    angle = relief.angle_rad + np.pi / 2 + rng.normal(0, 0.5 / relief.aspect, count)
    ends = start + rng.uniform(5, 30, (count, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    canvas = np.zeros((sheet.rows, 2 * sheet.columns), np.uint8)
    per_mm = 16 / np.array(sheet.pixel_mm[::-1])
    for one, two in zip(np.rint(start * per_mm).astype(int), np.rint(ends * per_mm).astype(int), strict=True):
        cv2.line(
            canvas, one.tolist(), two.tolist(), int(rng.integers(90, 256)), int(rng.integers(1, 4)), cv2.LINE_AA, 4
        )
    return np.float32(1.5) * sheet.blur(_fold_seam(canvas), 0.12)


def layers(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Beads on one another, as from a 3D printer, each slightly shifted."""
    count = int(np.ceil(sheet.height_mm / relief.pitch_mm)) + 1
    phase = sheet.t / np.float32(relief.pitch_mm)
    size = rng.uniform(0.6, 1, count).astype(np.float32)[np.clip(phase.astype(int), 0, count - 1)]
    bead = size * np.sqrt(np.abs(np.sin(np.pi * phase)))
    sway = 1 - np.float32(0.25) * (1 + _cosine(sheet.phase(sheet.width_mm / rng.integers(2, 7), 0.3))) / 2
    return np.asarray(bead[:, None] * sway)


def glyphs(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Rows of letters and digits, each row once around the object."""
    canvas, font = np.zeros((sheet.rows, 2 * sheet.columns), np.uint8), cv2.FONT_HERSHEY_SIMPLEX
    down = sheet.pixel_mm[0]
    size = relief.pitch_mm / down / 21  # cv2's capitals are 21 px high at scale 1
    thick = max(round((0.1 + 0.12 * relief.sharpness) * relief.pitch_mm / down), 1)
    step = 1.7 * relief.pitch_mm / down
    for row, line in enumerate(np.arange(0.6 * step, sheet.rows + step, step)):
        text = "".join(rng.choice(list("ABCDEFGHJKLMNPRSTUVWXYZ2345678O"), int(sheet.columns / (12 * size)) + 1))
        while len(text) > 1 and cv2.getTextSize(text, font, size, thick)[0][0] > sheet.columns - 6 * size:
            text = text[:-1]
        cv2.putText(canvas, text, (int((2 + row % 2 * 9) * size), int(line)), font, size, 255, thick, cv2.LINE_AA)
    return sheet.blur(_fold_seam(np.ascontiguousarray(canvas[::-1])), _edge_blur_mm(relief))


def scales(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Overlapping scales or shingles, thick at the lower edge."""
    u = sheet.phase(relief.pitch_mm, 0.0)
    v = (sheet.t / np.float32(0.6 * relief.pitch_mm * relief.aspect))[:, None]
    height = np.zeros_like(u)
    for shift in (0.0, 0.5):
        x = u + np.float32(shift) - np.floor(u + np.float32(shift)) - np.float32(0.5)
        y = (v + np.float32(shift * 2) + np.float32(2.2) * x * x) / 2
        height = np.maximum(height, 1 - (y - np.floor(y)) - np.float32(0.9) * np.abs(x))
    return sheet.blur(height, _edge_blur_mm(relief))


def waffle(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """A grid of ridges around square or oblong pits."""
    one = _cosine(sheet.phase(relief.pitch_mm, 0.0))
    two = _cosine(sheet.phase(relief.pitch_mm * relief.aspect, np.pi / 2))
    return _crest(np.maximum(one, two) - np.float32(0.25), relief.sharpness)


def chevron(relief: Relief, sheet: Sheet, rng: Rng) -> Floats:
    """Zigzag ridges, as on a tyre or in herringbone."""
    zigzag = _triangle(sheet.phase(relief.pitch_mm * 3, 0.0))
    phase = (sheet.t / np.float32(relief.pitch_mm))[:, None] + zigzag * np.float32(relief.aspect)
    return _crest(_cosine(phase), relief.sharpness)


def _fold_seam(canvas: NDArray[np.uint8]) -> Floats:
    """Fold the second half of a canvas of twice the width over the first: drawings across the seam continue."""
    first, second = np.split(canvas, 2, axis=1)
    return np.asarray(np.maximum(first, second) / np.float32(255))


Pattern = Callable[[Relief, Sheet, Rng], Floats]
# Ranges of the draws: pitch in mm, amplitude in mm, greatest amplitude per pitch, probability of engraving.
_FAMILIES: tuple[tuple[Pattern, tuple[float, ...]], ...] = (
    (smooth, (2, 2, 0, 0, 0, 0)),
    (ribs, (1.8, 14, 0.25, 6, 0.4, 0.2)),
    (knurl, (1.8, 9, 0.2, 3, 0.35, 0.1)),
    (weave, (2, 10, 0.25, 2.5, 0.3, 0)),
    (pebble, (2.5, 13, 0.25, 3.5, 0.35, 0.1)),
    (bumps, (3, 14, 0.3, 4, 0.3, 0)),
    (scratches, (2, 10, 0.12, 0.5, 0.3, 1)),
    (layers, (1.5, 5, 0.15, 1.2, 0.35, 0)),
    (glyphs, (5, 14, 0.3, 1.5, 0.15, 0.35)),
    (dimples, (3, 13, 0.25, 2, 0.25, 0)),
    (honeycomb, (3.5, 14, 0.3, 3, 0.3, 0.2)),
    (hammered, (3, 14, 0.3, 3.5, 0.3, 0)),
    (scales, (4, 14, 0.3, 2, 0.2, 0)),
    (waffle, (3, 14, 0.3, 3, 0.3, 0.3)),
    (chevron, (2.5, 11, 0.25, 3, 0.35, 0.2)),
)
RELIEFS: Mapping[str, Pattern] = MappingProxyType({pattern.__name__: pattern for pattern, _ in _FAMILIES})
_RANGES = {pattern.__name__: ranges for pattern, ranges in _FAMILIES}


def draw_relief(name: str, rng: Rng, limit_mm: float) -> Relief:
    """Draw an instance of the family, no higher than the shape allows (`limit_mm`)."""
    short, long, low, high, max_ratio, engraved_probability = _RANGES[name]
    pitch = float(np.exp(rng.uniform(np.log(short), np.log(long))))
    top = max(min(high, max_ratio * pitch, limit_mm), min(low, limit_mm))
    amplitude = float(min(low, top) * (top / max(min(low, top), 1e-9)) ** rng.uniform())
    angle = float(rng.choice([0, np.pi / 2, rng.uniform(-np.pi / 2, np.pi / 2)], p=[0.3, 0.3, 0.4]))
    aspect = 1.0 if rng.random() < 0.4 else float(rng.uniform(1, 2.2))
    # The steepest flank is 60 degrees: pi amplitude gain / pitch at most 1.7.
    max_sharpness = np.sqrt(np.clip((1.7 * pitch / (np.pi * max(amplitude, 0.05)) - 0.4) / 4, 0, 1))
    sharpness, engraved = float(rng.uniform() * max_sharpness), bool(rng.random() < engraved_probability)
    return Relief(name, amplitude, pitch, angle, aspect, sharpness, engraved, int(rng.integers(2**31)))
