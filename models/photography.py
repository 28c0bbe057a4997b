"""Photos of simulated objects as people take them: other cameras, grounds, light, and faults of pictures.

    shot = shoot(scene, how.camera)
    photo = develop(shot, how, seed=3)

`CONDITIONS` are fixed, for measurements; `draw` gives random ones, for training.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot.sim.camera import CameraView, Picture, PinholeCamera
from robot.sim.scene import Scene

RIG_CAMERA = PinholeCamera()
Layer = NDArray[np.float32]
"""Grey levels (px, px, 3) in 0..1."""


@dataclass(frozen=True)
class Photography:
    """How a photo is taken.

    Attributes:
        camera: The camera.
        ground: "table", as on the rig, or what replaces it behind the object: a colour (red, green, blue) in 0..1, or
            "texture", random and of all scales.
        gains: Factors of red, green and blue.
        blur_px: Standard deviation of the blur in pixels.
        jpeg_quality: Quality of the JPEG compression; 100 for none.
        is_grey: Whether the photo has no colours.
        clutter: Number of other things at the margin.
    """

    camera: PinholeCamera = RIG_CAMERA
    ground: str | tuple[float, float, float] = "table"
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    blur_px: float = 0.0
    jpeg_quality: int = 100
    is_grey: bool = False
    clutter: int = 0


def _camera(**changes: Any) -> Photography:
    return Photography(camera=PinholeCamera(**changes))


CONDITIONS = {
    "as-the-rig": Photography(),
    "focal-500": _camera(focal_px=500.0),
    "focal-1300": _camera(focal_px=1300.0),
    "512-px": _camera(px=512, focal_px=1720.0),
    "camera-above": _camera(position_mm=(0.0, -280.0, 640.0)),
    "camera-low": _camera(position_mm=(0.0, -660.0, 190.0), target_mm=(0.0, 0.0, 50.0)),
    "half-as-bright": Photography(gains=(0.5, 0.5, 0.5)),
    "brighter": Photography(gains=(1.5, 1.5, 1.5)),
    "warm": Photography(gains=(1.15, 1.0, 0.7)),
    "rolled-25": _camera(roll_rad=math.radians(25)),
    "blurred": Photography(blur_px=1.5),
    "jpeg-25": Photography(jpeg_quality=25),
    "white-ground": Photography(ground=(1.0, 1.0, 1.0)),
    "black-ground": Photography(ground=(0.0, 0.0, 0.0)),
    "textured-ground": Photography(ground="texture"),
    "grey": Photography(is_grey=True),
    "rolled-90": _camera(roll_rad=math.radians(90)),
}
"""The conditions of `models.conditions`. The mean of the changed ones leaves out the first and the last."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A photo as the camera sees it, and what each pixel shows."""

    view: CameraView
    picture: Picture


def shoot(scene: Scene, camera: PinholeCamera) -> Shot:
    """Return what a camera sees of a scene."""
    scene = replace(scene, camera=camera)
    return Shot(scene.view, scene.image("photo"))


def develop(shot: Shot, how: Photography, seed: int) -> Picture:
    """Return the photo (px, px, 3) with ground, light and faults of `how`; `seed` determines texture and clutter."""
    rng = np.random.default_rng([94, seed])
    levels = shot.picture.astype(np.float32) / 255
    if how.ground != "table":
        levels = _behind(shot.view, levels, _ground(how.ground, shot.view.camera.px, rng))
    for _ in range(how.clutter):
        levels = _with_clutter(shot.view, levels, rng)
    levels = np.clip(levels * np.float32(how.gains), 0, 1)
    if how.is_grey:
        levels = np.repeat(levels.mean(axis=2, keepdims=True), 3, axis=2)
    if how.blur_px:
        levels = cv2.GaussianBlur(levels, (0, 0), how.blur_px)
    picture: Picture = np.rint(levels * 255).astype(np.uint8)
    if how.jpeg_quality < 100:
        _, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, how.jpeg_quality])
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]
    return np.ascontiguousarray(picture)


def draw(rng: np.random.Generator) -> Photography:
    """Draw how a training photo is taken; a third of them with the rig's camera, and most of them rolled."""
    brightness, warmth = math.exp(rng.normal(0, 0.3)), rng.normal(0, 0.12)
    grounds: tuple[Callable[[], Any], ...] = (
        lambda: "table",
        lambda: "texture",
        lambda: tuple(np.repeat(rng.choice([rng.uniform(0, 0.15), rng.uniform(0.8, 1)]), 3).tolist()),
        lambda: tuple(rng.uniform(0, 1, 3).tolist()),
    )
    return Photography(
        camera=replace(RIG_CAMERA if rng.random() < 1 / 3 else draw_camera(rng), roll_rad=draw_roll(rng)),
        ground=grounds[rng.choice(4, p=[0.5, 0.2, 0.2, 0.1])](),
        gains=(brightness * (1 + warmth), brightness, brightness * (1 - warmth)),
        blur_px=float(rng.choice([0, rng.uniform(0.3, 2.0)])),
        jpeg_quality=int(rng.choice([100, rng.integers(15, 95)])),
        is_grey=rng.random() < 0.1,
        clutter=int(rng.choice([0, 1, 2, 3], p=[0.7, 0.1, 0.1, 0.1])),
    )


def draw_camera(rng: np.random.Generator) -> PinholeCamera:
    """Draw an upright camera: 12 to 72 degrees high, whose picture shows 130 to 380 mm about the object."""
    height, distance = math.radians(rng.uniform(12, 72)), rng.uniform(350, 1100)
    target = np.array([*rng.uniform(-15, 15, 2), rng.uniform(30, 90)])
    position = target + distance * np.array([0, -math.cos(height), math.sin(height)])
    px, shown_mm = int(rng.choice([256, 320, 400])), math.exp(rng.uniform(math.log(130), math.log(380)))
    x, y, z = position.tolist()
    return PinholeCamera(px, px * distance / shown_mm, (x, y, max(z, 40.0)), tuple(target.tolist()))


def draw_roll(rng: np.random.Generator) -> float:
    """Draw the roll of a camera in radians: none, a small one, or any."""
    return float(rng.choice([0.0, rng.normal(0, 0.3), rng.uniform(0, 2 * math.pi)], p=[0.3, 0.3, 0.4]))


def _behind(view: CameraView, levels: Layer, ground: Layer) -> Layer:
    """Return a photo whose ground is replaced; edges of the object stay soft."""
    px = view.camera.px
    share = cv2.GaussianBlur(view.is_object.reshape(px, px).astype(np.float32), (0, 0), 0.6)[..., None]
    return np.asarray(share * levels + (1 - share) * ground, np.float32)


def _ground(kind: str | tuple[float, float, float], px: int, rng: np.random.Generator) -> Layer:
    """Return a plain ground, or a random texture: noise of all scales, of one colour or of three."""
    if not isinstance(kind, str):
        return np.broadcast_to(np.float32(kind), (px, px, 3))
    texture = np.zeros((px, px, 3), np.float32)
    slope, cells = rng.uniform(0.3, 1.2), 3
    while cells < px:
        octave = rng.standard_normal((cells, cells, 3)) * [1, 0.5, 0.5] + rng.standard_normal((cells, cells, 1))
        texture += cv2.resize(octave.astype(np.float32), (px, px), interpolation=cv2.INTER_CUBIC) * cells**-slope
        cells *= 2
    texture *= rng.uniform(0.05, 0.3) / texture.std()
    return np.clip(texture + rng.uniform(0.2, 0.8, 3), 0, 1).astype(np.float32)


def _with_clutter(view: CameraView, levels: Layer, rng: np.random.Generator) -> Layer:
    """Return a photo with another thing, a coloured ellipse or box, that begins near the margin, behind the object."""
    px = view.camera.px
    turn, sides = rng.uniform(0, 2 * math.pi), rng.uniform(0.12, 0.44, 2) * px
    middle = px / 2 + px * rng.uniform(0.4, 0.55) * np.array([math.cos(turn), math.sin(turn)])
    outline = tuple(middle.tolist()), tuple(sides.tolist()), math.degrees(turn)
    mask = np.zeros((px, px), np.float32)
    if rng.random() < 0.5:
        cv2.fillPoly(mask, [np.rint(cv2.boxPoints(outline)).astype(np.int32)], 1.0)
    else:
        cv2.ellipse(mask, outline, 1.0, -1)
    mask = cv2.GaussianBlur(mask * ~view.is_object.reshape(px, px), (0, 0), 0.7)[..., None]
    colour = (
        np.float32(rng.uniform(0, 1, 3)) * np.linspace(*rng.uniform(0.5, 1, 2), px, dtype=np.float32)[:, None, None]
    )
    return np.asarray((1 - mask) * levels + mask * colour, np.float32)
