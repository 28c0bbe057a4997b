"""Synthetic test pictures, not a simulation of contact: matching photos and gel-like touches of random textures.

An object has a relief (family, pitch, depth, ...) and, from another random stream, an appearance (colours, paint,
outline). The SAME relief field shades the photo and dents the gel. They have nothing else in common, so a model that
matches them uses the relief. Lengths are in millimetres, pictures are uint8 RGB (height, width, 3), `px` is (width,
height). Everything is a function of its seeds.
"""

import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot.recording.folder import RecordingWriter

FloatImage = NDArray[np.float32]
Picture = NDArray[np.uint8]

PX_PER_MM = 8.0  # of the relief field, and of a touch
FIELD_PX = 512  # the field is a 64 mm square, mirrored beyond its edges
TOUCH_PX = (160, 120)
TOUCH_WIDTH_MM = 20.0
PHOTO_WIDTH_MM = 44.0
FORCE_N = (4.0, 15.0)
_CATALOGUE, _QUERIES = 10**6, 2 * 10**6  # first seeds of pictures outside recordings
_RELIEF, _APPEARANCE, _FIELD, _PHOTO, _TOUCH, _SENSOR, _FRAME, _GRASP = range(8)  # one random stream for each purpose


@dataclass(frozen=True)
class DrawnObject:
    """Relief (first group) and appearance (second group) of a synthetic object."""

    object_id: str
    seed: int
    family: str
    pitch_mm: float
    depth_mm: float
    anisotropy: float  # 0 isotropic, 1 strongly elongated
    regularity: float  # 0 distorted, 1 regular
    sharpness: float  # 0 rounded profile, 1 flat-topped

    colour: tuple[float, float, float]
    paint: tuple[float, float, float]
    paint_fraction: float
    gloss: float
    outline: tuple[float, float, float]  # half width and half height as fractions of the photo, corner exponent


def make_object(seed: int) -> DrawnObject:
    """Return the object of a seed; consecutive seeds cycle through the families."""
    relief_rng, appearance_rng = np.random.default_rng([_RELIEF, seed]), np.random.default_rng([_APPEARANCE, seed])
    family = list(FAMILIES)[seed % len(FAMILIES)]
    return DrawnObject(
        object_id=f"{family}-{seed:04d}",
        seed=seed,
        family=family,
        pitch_mm=float(np.exp(relief_rng.uniform(np.log(1.6), np.log(6.5)))),
        depth_mm=float(np.exp(relief_rng.uniform(np.log(0.25), np.log(0.9)))),
        anisotropy=relief_rng.uniform(),
        regularity=relief_rng.uniform(),
        sharpness=relief_rng.uniform(),
        colour=_colour(appearance_rng),
        paint=_colour(appearance_rng),
        paint_fraction=appearance_rng.uniform(0.0, 0.35),
        gloss=appearance_rng.uniform(0.0, 0.35),
        outline=tuple(appearance_rng.uniform(low, high) for low, high in ((0.36, 0.47), (0.36, 0.47), (2, 8))),
    )


def make_objects(count: int, seed: int = 0) -> list[DrawnObject]:
    """Return `count` different objects; other seeds give other objects."""
    return [make_object(1000 * seed + number) for number in range(count)]


def _colour(rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a stock colour with small noise: many objects have it, so colour does not identify an object."""
    return tuple((_STOCK[rng.integers(len(_STOCK))] + rng.normal(0, 0.02, 3)).tolist())


# Steel, plaster, sand, terracotta, slate blue, olive.
_STOCK = np.array([60, 62, 64, 80, 78, 75, 72, 62, 46, 70, 42, 33, 40, 48, 60, 52, 56, 40]).reshape(6, 3) / 100


@lru_cache(maxsize=128)
def relief(obj: DrawnObject) -> FloatImage:
    """Return the height in mm, 0..depth_mm: (FIELD_PX, FIELD_PX)."""
    rng = np.random.default_rng([_FIELD, obj.seed])
    axis = (np.arange(FIELD_PX, dtype=np.float32) + 0.5) / PX_PER_MM
    x, y = np.meshgrid(axis, axis)
    wander = 0.2 * (1.0 - obj.regularity) * obj.pitch_mm
    x, y = x + wander * _noise(rng, 3 * obj.pitch_mm), y + wander * _noise(rng, 3 * obj.pitch_mm)
    shape = FAMILIES[obj.family](obj, x, y, rng)
    low, high = np.percentile(shape, [0.5, 99.5])
    flat = np.clip((shape - low) / max(high - low, 1e-6), 0.0, 1.0)
    field = cv2.GaussianBlur((obj.depth_mm * flat).astype(np.float32), (0, 0), 1.0)
    field.flags.writeable = False
    return field


def _noise(rng: np.random.Generator, pitch_mm: float, stretch: float = 1.0) -> FloatImage:
    """Return smooth noise of unit deviation with its power around one wavelength; `stretch` elongates it along y."""
    f = np.fft.fftfreq(FIELD_PX, 1 / PX_PER_MM)
    radius = np.hypot(np.fft.rfftfreq(FIELD_PX, 1 / PX_PER_MM)[None, :], f[:, None] * stretch) * pitch_mm
    band = np.exp(-0.5 * ((radius - 1.0) / 0.35) ** 2)
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((FIELD_PX, FIELD_PX))) * band)
    return (noise / noise.std()).astype(np.float32)


def _profile(obj: DrawnObject, phase: FloatImage) -> FloatImage:
    """Return a wave, 0..1, from a cosine (sharpness 0) to a flat-topped bar (sharpness 1)."""
    steep = 0.4 + 4.0 * obj.sharpness**2
    return 0.5 + 0.5 * np.tanh(steep * np.cos(2 * np.pi * phase)) / np.tanh(steep)


def _waves(obj: DrawnObject, x: FloatImage, y: FloatImage, rng: np.random.Generator) -> FloatImage:
    swing = (0.25 + 0.35 * obj.anisotropy) * np.sin(2 * np.pi * y / (3 * obj.pitch_mm))
    return _profile(obj, x / obj.pitch_mm + swing)


def _knurl(obj: DrawnObject, x: FloatImage, y: FloatImage, rng: np.random.Generator) -> FloatImage:
    lean = 0.45 + 0.55 * (1 - obj.anisotropy)
    one, two = (_profile(obj, (x + sign * lean * y) / (1.3 * obj.pitch_mm)) for sign in (-1, 1))
    return np.minimum(one, two)


def _tiles(obj: DrawnObject, x: FloatImage, y: FloatImage, rng: np.random.Generator) -> FloatImage:
    wide, high = x / obj.pitch_mm, y / (obj.pitch_mm * (1 + obj.anisotropy))
    edge = np.minimum(0.5 - np.abs(wide % 1 - 0.5), (0.5 - np.abs(high % 1 - 0.5)) * (1 + obj.anisotropy))
    return np.clip(edge / (0.25 - 0.15 * obj.sharpness), 0, 1)


def _weave(obj: DrawnObject, x: FloatImage, y: FloatImage, rng: np.random.Generator) -> FloatImage:
    u, v = x / obj.pitch_mm, y / (obj.pitch_mm * (1 + 0.6 * obj.anisotropy))
    warp = np.abs(np.sin(np.pi * u)) ** 0.7 * (1 + 0.9 * np.sin(np.pi * v) * np.sign(np.sin(np.pi * u)))
    weft = np.abs(np.sin(np.pi * v)) ** 0.7 * (1 - 0.9 * np.sin(np.pi * u) * np.sign(np.sin(np.pi * v)))
    return np.maximum(warp, weft)


def _grain(obj: DrawnObject, x: FloatImage, y: FloatImage, rng: np.random.Generator) -> FloatImage:
    noise = _noise(rng, obj.pitch_mm, 1 + 2 * obj.anisotropy)
    return np.tanh((0.4 + 2 * obj.sharpness) * noise)


def _smooth(obj: DrawnObject, x: FloatImage, y: FloatImage, rng: np.random.Generator) -> FloatImage:
    """Return a nearly flat relief with a few shallow pits."""
    return np.minimum(_noise(rng, 2 * obj.pitch_mm, 1 + obj.anisotropy) + 1.2 + obj.sharpness, 0)


Family = Callable[[DrawnObject, FloatImage, FloatImage, np.random.Generator], FloatImage]
FAMILIES: Mapping[str, Family] = {
    "ribs": lambda obj, x, y, rng: _profile(obj, x / obj.pitch_mm),
    "knurl": _knurl,
    "weave": _weave,
    "grain": _grain,
    "waves": _waves,
    "tiles": _tiles,
    "pits": lambda obj, x, y, rng: 1 - _knurl(obj, x, y, rng),
    "smooth": _smooth,
}


def _patch(obj: DrawnObject, px: tuple[int, int], width_mm: float, angle: float, centre: NDArray[Any]) -> FloatImage:
    """Return the relief, in mm, in a rotated window with its centre at `centre` (mm) of the field."""
    scale = width_mm / px[0] * PX_PER_MM
    cos, sin = scale * np.cos(angle), scale * np.sin(angle)
    x0 = centre[0] * PX_PER_MM - cos * px[0] / 2 + sin * px[1] / 2
    y0 = centre[1] * PX_PER_MM - sin * px[0] / 2 - cos * px[1] / 2
    window = np.array([[cos, -sin, x0], [sin, cos, y0]], np.float32)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(relief(obj), window, px, flags=flags, borderMode=cv2.BORDER_REFLECT_101)


def _slopes(height: FloatImage, mm_per_px: float) -> tuple[FloatImage, FloatImage]:
    """Return central differences along x and y, without unit."""
    options = {"ksize": 3, "scale": 1 / (8 * mm_per_px), "borderType": cv2.BORDER_REPLICATE}
    return cv2.Sobel(height, cv2.CV_32F, 1, 0, **options), cv2.Sobel(height, cv2.CV_32F, 0, 1, **options)


def _grid(px: tuple[int, int]) -> tuple[FloatImage, FloatImage]:
    """Return x and y of every pixel, -1..1 across the width of the picture, with square pixels."""
    x = (np.arange(px[0], dtype=np.float32) + 0.5) * 2 / px[0] - 1
    y = ((np.arange(px[1], dtype=np.float32) + 0.5) * 2 - px[1]) / px[0]
    x, y = np.meshgrid(x, y)
    return x, y


def _turned(x: FloatImage, y: FloatImage, angle: float) -> tuple[FloatImage, FloatImage]:
    cos, sin = math.cos(angle), math.sin(angle)
    return x * cos + y * sin, y * cos - x * sin


def _blotches(rng: np.random.Generator, px: tuple[int, int], cells: int) -> FloatImage:
    """Return soft random blotches, 0..1."""
    coarse = rng.uniform(size=(cells, cells)).astype(np.float32)
    return np.clip(cv2.resize(coarse, px, interpolation=cv2.INTER_CUBIC), 0, 1)


def _to_picture(values: FloatImage, rng: np.random.Generator, noise: float) -> Picture:
    """Return 0..255 with sensor noise of `noise` grey levels, clipped and rounded."""
    row, column = rng.integers(0, 512 - np.array(values.shape[:2]), endpoint=True)
    grain = _grain_tile()[row : row + values.shape[0], column : column + values.shape[1]]
    return np.clip(values + noise * grain + 0.5, 0, 255).astype(np.uint8)


@lru_cache(maxsize=1)
def _grain_tile() -> FloatImage:
    """Return white noise, from which sensor noise is cropped: new noise would take half the time of a picture."""
    return np.random.default_rng(0).standard_normal((512, 512, 3), np.float32)


def draw_photo(obj: DrawnObject, seed: int, px: int = 256) -> Picture:
    """Return a photo of the object on a table, with random rotation and light: (px, px, 3)."""
    rng = np.random.default_rng([_PHOTO, obj.seed, seed])
    size, angle = (px, px), rng.uniform(0, 2 * math.pi)
    width_mm = PHOTO_WIDTH_MM * rng.uniform(0.92, 1.08)
    height = _patch(obj, size, width_mm, angle, rng.uniform(20, 44, 2))
    mask, shadow = _outline(obj, rng, size, angle)
    surface = _albedo(obj, size, angle) * _shading(obj, rng, height, width_mm / px, mask)[..., None]
    table = np.array(_colour(rng), np.float32) * (0.85 + 0.15 * _blotches(rng, size, 9))[..., None]
    picture = table * shadow[..., None] * (1 - mask[..., None]) + surface * mask[..., None]
    return _to_picture(255 * picture * rng.uniform(0.85, 1.1), rng, 2.0)


def _shading(
    obj: DrawnObject, rng: np.random.Generator, height: FloatImage, mm_per_px: float, mask: FloatImage
) -> FloatImage:
    """Return Lambertian shading with a highlight under one lamp and darker valleys; its mean on the object is 0.8."""
    turn, tilt = rng.uniform(0, 2 * math.pi), rng.uniform(0.6, 1.0)
    sx, sy = _slopes(height, mm_per_px)
    lamp = math.cos(tilt) * math.cos(turn), math.cos(tilt) * math.sin(turn), math.sin(tilt)
    facing = (lamp[2] - sx * lamp[0] - sy * lamp[1]) / np.sqrt(1 + sx * sx + sy * sy)
    hollow = cv2.GaussianBlur(height, (0, 0), 1.2 / mm_per_px) - height
    light = (0.25 + np.maximum(facing, 0)) * np.exp(-0.9 * np.maximum(hollow, 0))
    light += obj.gloss * np.maximum(facing, 0) ** 16
    return 0.8 * light / max(float((light * mask).sum() / mask.sum()), 1e-3)


def _albedo(obj: DrawnObject, size: tuple[int, int], angle: float) -> FloatImage:
    """Return the base colour with painted blotches, independent of the relief."""
    blotches = _blotches(np.random.default_rng([_APPEARANCE, obj.seed, 1]), size, 7)
    turn = cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), -float(np.degrees(angle)), 1.0)
    blotches = cv2.warpAffine(blotches, turn, size, borderMode=cv2.BORDER_REFLECT_101)
    paint = np.clip((blotches - 1 + obj.paint_fraction) * 6, 0, 1)[..., None]
    return (1 - paint) * np.array(obj.colour, np.float32) + paint * np.array(obj.paint, np.float32)


def _outline(
    obj: DrawnObject, rng: np.random.Generator, size: tuple[int, int], angle: float
) -> tuple[FloatImage, FloatImage]:
    """Return the mask of the object (0..1), and the light on the table with its shadow (0..1)."""
    x, y = _grid(size)
    x, y = x - rng.uniform(-0.06, 0.06), y - rng.uniform(-0.06, 0.06)
    u, v = _turned(x, y, angle)
    wide, high, corner = obj.outline
    radius = (np.abs(u / (2 * wide)) ** corner + np.abs(v / (2 * high)) ** corner) ** (1 / corner)
    mask = np.clip((1 - radius) * 0.4 * size[0], 0, 1).astype(np.float32)
    shift = np.array([[1, 0, rng.uniform(-6, 6)], [0, 1, rng.uniform(-6, 6)]], np.float32)
    shadow = cv2.GaussianBlur(cv2.warpAffine(mask, shift, size), (0, 0), 5)
    return mask, 1 - 0.55 * shadow


def draw_touch(
    obj: DrawnObject, seed: int, fingers: Sequence[str] = ("a", "b"), force_n: float | None = None
) -> dict[str, Picture]:
    """Return the gel pictures of one grasp by finger; each finger touches another patch of the relief."""
    force = grasp_force(obj, seed) if force_n is None else force_n
    return {finger: _draw_finger(obj, seed, finger, force) for finger in fingers}


def grasp_force(obj: DrawnObject, seed: int) -> float:
    """Return the closing force of grasp `seed` of the object."""
    return float(np.random.default_rng([_GRASP, obj.seed, seed]).uniform(*FORCE_N))


def draw_background(seed: int, finger: str = "a") -> Picture:
    """Return a no-contact frame: the tint of the sensor with the noise of this frame."""
    rng = np.random.default_rng([_FRAME, seed, *finger.encode()])
    return _to_picture(_tint(finger), rng, 1.5)


def _draw_finger(obj: DrawnObject, seed: int, finger: str, force_n: float) -> Picture:
    rng = np.random.default_rng([_TOUCH, obj.seed, seed, *finger.encode()])
    mm_per_px = TOUCH_WIDTH_MM / TOUCH_PX[0]
    height = _patch(obj, TOUCH_PX, TOUCH_WIDTH_MM, rng.uniform(0, 2 * np.pi), rng.uniform(10, 54, 2))
    dent = _indent(height + _body(rng), force_n, mm_per_px)
    sx, sy = _slopes(dent, mm_per_px)
    light = np.stack([1 + 0.75 * np.tanh(1.1 * (sx * c + sy * s)) for c, s in _LAMPS], -1)
    return _to_picture(_tint(finger) * light * (1 - 0.06 * dent)[..., None], rng, 1.5)


def _body(rng: np.random.Generator) -> FloatImage:
    """Return the curvature of the object under the finger, random for each touch, so it identifies nothing."""
    x, y = (axis * TOUCH_WIDTH_MM / 2 - rng.uniform(-2, 2) for axis in _grid(TOUCH_PX))
    turn, radii = rng.uniform(0, math.pi), np.exp(rng.uniform(math.log(25), math.log(200), 2)).tolist()
    u, v = _turned(x, y, turn)
    return -u * u / (2 * radii[0]) - v * v / (2 * radii[1])


def _indent(surface: FloatImage, force_n: float, mm_per_px: float) -> FloatImage:
    """Return the indentation (mm) of the gel: the overlap, and a soft skirt where the gel is stretched."""
    if force_n <= 0:
        return np.zeros_like(surface)
    press_mm = 0.9 * (force_n / 10.0) ** (2 / 3)
    overlap = np.maximum(surface - float(np.percentile(surface, 98)) + press_mm, 0)
    skirt = overlap
    for sigma_mm in (1.0, 0.5, 0.25):
        skirt = np.maximum(overlap, 0.92 * cv2.GaussianBlur(skirt, (0, 0), sigma_mm / mm_per_px))
    return cv2.GaussianBlur(skirt, (0, 0), 0.16 / mm_per_px)


_LAMPS = [(math.cos(angle), math.sin(angle)) for angle in (2.6, 4.7, 0.5)]
"""Directions of the red, green and blue lamps."""


@lru_cache
def _tint(finger: str) -> FloatImage:
    """Return the gel without contact: lamps are brighter on their side, edges are darker."""
    rng = np.random.default_rng([_SENSOR, 0, *finger.encode()])
    base = np.array([142, 124, 134], np.float32) + rng.normal(0, 7, 3).astype(np.float32)
    x, y = _grid(TOUCH_PX)
    lean = [1 - rng.uniform(0.1, 0.22) * (x * c + y * s) for c, s in _LAMPS]
    tint: FloatImage = base * np.stack(lean, -1) * (1 - rng.uniform(0.1, 0.2) * (x * x + y * y))[..., None]
    return tint


def write_recording(
    folder: Path,
    objects: Sequence[DrawnObject],
    grasps: int,
    seed: int = 0,
    fingers: Sequence[str] = ("a", "b"),
    before: bool = True,
    misses: int = 0,
) -> Path:
    """Write a recording: for each object, `grasps` successes, then `misses` that closed on nothing.

    `before` adds no-contact frames to each grasp. Returns the folder.
    """
    info = {"source": "drawn test pictures, not a simulation of contact", "sensor": "drawn gel", "seed": seed}
    with RecordingWriter(folder, info) as writer:
        for obj in objects:
            for number in range(grasps + misses):
                key, missed = 1000 * seed + number, number >= grasps
                force_n = 0.0 if missed else grasp_force(obj, key)
                images = {"photo": _jpeg(draw_photo(obj, key))}
                images |= _touch_files(obj, key, fingers, force_n, before)
                fields = {"force_n": force_n, "grasped": not missed, "sequence_id": f"of-{obj.object_id}"}
                writer.append(f"{obj.object_id}-{key:06d}", obj.object_id, images, **fields)
    return folder


def _touch_files(obj: DrawnObject, key: int, fingers: Sequence[str], force_n: float, before: bool) -> dict[str, bytes]:
    touches = draw_touch(obj, key, fingers=fingers, force_n=force_n)
    files = {f"touch_{finger}": _png(picture) for finger, picture in touches.items()}
    if before:
        frame = 1_000_000 * obj.seed + key
        files |= {f"touch_{finger}_before": _png(draw_background(frame, finger)) for finger in fingers}
    return files


def write_catalogue(folder: Path, objects: Sequence[DrawnObject], photos_per_object: int = 3) -> Path:
    """Write `<folder>/<object_id>/<n>.jpg`, photos that are in no recording. Returns the folder."""
    for obj in objects:
        (folder / obj.object_id).mkdir(parents=True, exist_ok=True)
        for number in range(photos_per_object):
            (folder / obj.object_id / f"{number + 1}.jpg").write_bytes(_jpeg(draw_photo(obj, _CATALOGUE + number)))
    return folder


def put_touch(catalogue: Path, object_id: str, number: int, files: Sequence[Path]) -> None:
    """Copy the gel images of a touch next to the photos of an object."""
    (catalogue / object_id).mkdir(exist_ok=True)
    for finger, path in zip("ab", files, strict=True):
        shutil.copy(path, catalogue / object_id / f"touch_{number}_{finger}.png")


def write_queries(
    folder: Path, objects: Sequence[DrawnObject], touches_per_object: int = 1
) -> dict[str, list[tuple[Path, ...]]]:
    """Write `<folder>/<object_id>/<n>_<finger>.png`, new touches. Returns the files of each touch by object_id."""
    queries: dict[str, list[tuple[Path, ...]]] = {}
    for obj in objects:
        (folder / obj.object_id).mkdir(parents=True, exist_ok=True)
        for number in range(touches_per_object):
            touch = draw_touch(obj, _QUERIES + number)
            files = {folder / obj.object_id / f"{number + 1}_{finger}.png": touch[finger] for finger in touch}
            for path, picture in files.items():
                path.write_bytes(_png(picture))
            queries.setdefault(obj.object_id, []).append(tuple(files))
    return queries


def _jpeg(picture: Picture) -> bytes:  # OpenCV requires BGR
    return bytes(cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])[1])


def _png(picture: Picture) -> bytes:
    return bytes(cv2.imencode(".png", picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])
