"""The camera over the table: a photo and a Kinect-like depth image of one object, each computed on request.

Both use one geometry pass: one ray per pixel against the object and the table. The photo adds normals at the scale of a
pixel, one lamp, sky light, a cast shadow, lens blur and sensor noise. The depth image adds the faults of a
structured-light or time-of-flight sensor. Camera frame: x right, y down, z forward, mm.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from robot.sim.light import GAMMA, Floats, GBuffer, Lamps, develop, radiance
from robot.sim.objects.body import Body
from robot.sim.objects.draw import SimObject

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]
Pixels = npt.NDArray[np.intp]
"""Indices of pixels in a picture, row by row."""

NOISE = 1.5
"""Standard deviation of the sensor noise in grey levels."""
_LENS_BLUR_PX = 0.45
_SHADOW_BLUR_PX = 0.8
SKY_STEPS, _SKY_WIDTH = 4, 0.03
"""The object hides sky from the table near it. Standard deviation of this blur, relative to the image side."""

_TABLE_GLOSS = 0.03
_TABLE_PX_PER_MM = 0.8
_TABLE_PX = (400, 560)
_SHADOW_DETAIL = 2.0
"""Shadows show only relief of at least this many pixels."""

_SHADOW_BIAS_MM = 0.4
"""Shadow rays start this far above the surface, so that rounding does not put a point in its own shadow."""


@dataclass(frozen=True)
class Placement:
    """Pose of the object on the table: its origin, and its rotation about the vertical."""

    x_mm: float = 0.0
    y_mm: float = 0.0
    yaw_rad: float = 0.0

    def rotation(self) -> Array:
        """Return the rotation (3, 3) from object frame to rig frame."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def to_object(self, points: Array) -> Array:
        """Transform points (N, 3) from the rig frame to the object frame."""
        return (points - [self.x_mm, self.y_mm, 0.0]) @ self.rotation()

    def corners(self, body: Body) -> Array:
        """Return the corners (8, 3) of the body's bounding box in the rig frame."""
        box = np.stack(np.meshgrid(*zip(body.lower, body.upper, strict=True)), axis=-1).reshape(-1, 3)
        return np.asarray(box @ self.rotation().T + [self.x_mm, self.y_mm, 0.0])


@dataclass(frozen=True)
class PinholeCamera:
    """Pinhole camera with square pixels that looks at `target_mm`, with the rig's z upward in the picture.

    Attributes:
        px: pixels of each side of the picture.
        focal_px: focal length in pixels.
        position_mm: centre of projection in the rig frame.
        target_mm: point in the middle of the picture, in the rig frame.
        roll_rad: rotation of the camera about its axis; the picture turns anticlockwise.
    """

    px: int = 256
    focal_px: float = 860.0
    position_mm: tuple[float, float, float] = (0.0, -560.0, 390.0)
    target_mm: tuple[float, float, float] = (0.0, 0.0, 80.0)
    roll_rad: float = 0.0

    @property
    def field_mm(self) -> float:
        """What the picture shows along a side, at the distance of `target_mm`."""
        return math.dist(self.target_mm, self.position_mm) * self.px / self.focal_px

    @cached_property
    def to_rig(self) -> Array:
        """Transform (4, 4) from camera frame to rig frame."""
        forward = np.subtract(self.target_mm, self.position_mm)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        c, s = math.cos(self.roll_rad), math.sin(self.roll_rad)
        matrix = np.eye(4)
        matrix[:3] = np.stack([c * right + s * down, c * down - s * right, forward, self.position_mm], axis=1)
        return matrix

    @cached_property
    def rays(self) -> Array:
        """Unit directions (px * px, 3) through the pixel centres in the rig frame, row by row."""
        axis = (np.arange(self.px) + 0.5 - self.px / 2) / self.focal_px
        x, y = np.meshgrid(axis, axis)
        local = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        return np.asarray(local @ self.to_rig[:3, :3].T)

    @cached_property
    def table_distance_mm(self) -> Array:
        """Distance (px * px,) to the table along each ray."""
        return -self.position_mm[2] / self.rays[:, 2]

    @cached_property
    def table(self) -> Array:
        """Point (px * px, 3) where each ray meets the table, in the rig frame."""
        return self.position_mm + self.table_distance_mm[:, None] * self.rays

    def pixels_around(self, corners: Array) -> Pixels:
        """Return the sorted pixels of the upright rectangle around a convex body with these corners (N, 3)."""
        x, y, forward = ((corners - self.position_mm) @ self.to_rig[:3, :3]).T
        spans = []
        for along in (y, x):
            place = along / forward * self.focal_px + self.px / 2
            spans.append(np.arange(max(0, math.floor(place.min())), min(self.px, math.ceil(place.max()))))
        return np.asarray((spans[0][:, None] * self.px + spans[1]).ravel())


@dataclass(frozen=True)
class Lighting:
    """One lamp and a sky, drawn independently of the object, so the light contains no information about it.

    `direction` is the unit vector towards the lamp, `lamp` and `sky` are RGB intensities, `exposure` is their factor,
    and `table_seed` is that of the table's texture.
    """

    direction: tuple[float, ...]
    lamp: tuple[float, ...]
    sky: tuple[float, ...]
    exposure: float
    table_seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator) -> "Lighting":
        """Draw a lamp on the camera's side of the room, 30 to 65 degrees high, warm or cool."""
        turn, height = rng.uniform(np.radians([185, 30]), np.radians([355, 65]))
        warmth = rng.uniform(-0.08, 0.08)
        lamp = rng.uniform(0.75, 1.0) * np.array([1 + warmth, 1.0, 1 - warmth])
        sky = rng.uniform(0.18, 0.32) * np.array([1 - warmth, 1.0, 1 + warmth])
        direction = math.cos(height) * math.cos(turn), math.cos(height) * math.sin(turn), math.sin(height)
        return cls(
            direction, tuple(lamp.tolist()), tuple(sky.tolist()), rng.uniform(0.85, 1.15), int(rng.integers(2**31))
        )


@dataclass(frozen=True)
class CameraView:
    """Result of the geometry pass.

    Attributes:
        detail_mm: size of a pixel on the object.
        distance_mm: (px * px,) distance along each ray.
        points: (px * px, 3) first point on each ray, in the rig frame.
        pixels: pixels that show the object.
    """

    obj: SimObject
    placement: Placement
    camera: PinholeCamera
    detail_mm: float
    distance_mm: Array
    points: Array = field(repr=False)
    pixels: Pixels

    @cached_property
    def is_object(self) -> npt.NDArray[np.bool_]:
        """Mask (px * px,) of the pixels that show the object."""
        mask = np.zeros(len(self.points), bool)
        mask[self.pixels] = True
        return mask

    @cached_property
    def object_points(self) -> Array:
        """Points of the object's pixels in the object frame."""
        return self.placement.to_object(self.points[self.pixels])


def cast_camera_rays(obj: SimObject, placement: Placement, camera: PinholeCamera) -> CameraView:
    """Intersect each ray with object and table; cast only the rays near the object."""
    distance, points = camera.table_distance_mm.copy(), camera.table.copy()
    pixels = camera.pixels_around(placement.corners(obj.body))
    origin, rays = np.asarray(camera.position_mm), camera.rays[pixels]
    origins = np.broadcast_to(placement.to_object(origin[None]), rays.shape)
    detail_mm = float(np.linalg.norm(np.subtract(camera.target_mm, camera.position_mm))) / camera.focal_px
    hit = obj.body.cast(origins, rays @ placement.rotation(), detail_mm)
    visible = hit < distance[pixels]
    pixels, hit = pixels[visible], hit[visible]
    distance[pixels], points[pixels] = hit, origin + hit[:, None] * rays[visible]
    return CameraView(obj, placement, camera, detail_mm, distance, points, pixels)


# Photo ------------------------------------------------------------------------------------------------------


def photo(view: CameraView, lighting: Lighting, noise_seed: int) -> Picture:
    """Render the photo (px, px, 3), RGB uint8."""
    px = view.camera.px
    linear = radiance(*shading_inputs(view, lighting)).reshape(px, px, 3)
    linear = cv2.GaussianBlur(linear, (0, 0), _LENS_BLUR_PX)
    noise = NOISE * np.random.default_rng([72, noise_seed]).standard_normal(linear.shape)
    return develop(linear, noise)


def shading_inputs(view: CameraView, lighting: Lighting) -> tuple[GBuffer, Lamps]:
    """Return surface and light at each pixel, the inputs of `radiance`."""
    px = view.camera.px
    light = np.asarray(lighting.direction)
    # Average normals over about one pixel, so that finer relief does not flicker.
    own = view.obj.body.normals(view.object_points, 0.4 * view.detail_mm) @ view.placement.rotation().T
    normals = np.zeros((px * px, 3), np.float32)
    normals[:, 2], normals[view.pixels] = 1, own
    lamp_visibility = _lamp_visibility(view, own, light)
    occlusion = sky_occlusion(view.is_object.reshape(px, px))
    colour = _table(lighting.table_seed, view.camera)
    colour[view.pixels] = view.obj.appearance.albedo(view.object_points)
    surfaces = GBuffer(view.camera.rays, normals, view.is_object, lamp_visibility, occlusion.ravel(), colour)
    # The rougher the material, the wider and weaker its highlight.
    sharpness = 4.0 + 120.0 * (1.0 - view.obj.material.roughness) ** 2
    strength = (sharpness + 8.0) / 60.0
    lamp, sky = (lighting.exposure * np.array(colour) for colour in (lighting.lamp, lighting.sky))
    gloss = strength * view.obj.material.gloss, strength * _TABLE_GLOSS
    return surfaces, Lamps(light, lamp, sky, gloss, sharpness)


def _lamp_visibility(view: CameraView, own: Array, light: Array) -> Floats:
    """Return how much of the lamp each point receives, 0..1, with an edge softened as by a lamp of some size.

    `own` (n, 3) are the normals at the object's pixels, `light` is the unit direction to the lamp.
    """
    px, facing, table = view.camera.px, own @ light > 0, shadow_pixels(view, light)
    pixels, up = np.concatenate([view.pixels[facing], table]), np.broadcast_to([0.0, 0.0, 1.0], (len(table), 3))
    starts = view.placement.to_object(view.points[pixels] + _SHADOW_BIAS_MM * np.concatenate([own[facing], up]))
    towards = np.broadcast_to(light @ view.placement.rotation(), starts.shape)
    visibility = np.ones(px * px, np.float32)
    visibility[pixels] = ~view.obj.body.hit(starts, towards, _SHADOW_DETAIL * view.detail_mm)
    return np.asarray(cv2.GaussianBlur(visibility.reshape(px, px), (0, 0), _SHADOW_BLUR_PX)).ravel()


def shadow_pixels(view: CameraView, light: Array) -> Pixels:
    """Return the table pixels in the upright rectangle around the shadow of the object's bounding box."""
    corners, table = view.placement.corners(view.obj.body), view.camera.table
    fallen = corners - light * ((corners[:, 2:] - _SHADOW_BIAS_MM) / light[2])
    inside = ~view.is_object
    for axis in (0, 1):
        inside &= (table[:, axis] >= fallen[:, axis].min()) & (table[:, axis] <= fallen[:, axis].max())
    return np.flatnonzero(inside)


def sky_occlusion(is_object: npt.NDArray[np.bool_], steps: int = SKY_STEPS) -> Floats:
    """Return how much of the sky the object hides from the table near it, 0..1, (px, px).

    This is the object's mask (px, px), blurred on a coarse grid of `steps` per standard deviation.
    """
    px = len(is_object)
    width = _SKY_WIDTH * px
    coarse = min(px, max(1, round(px * steps / width)))
    coverage = cv2.resize(is_object.astype(np.float32), (coarse, coarse), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(coverage, (0, 0), width * coarse / px)
    return np.asarray(cv2.resize(blurred, (px, px), interpolation=cv2.INTER_CUBIC))


def _table(seed: int, camera: PinholeCamera) -> Floats:
    """Return the reflectance (px * px, 3) of the table top: weakly streaked like wood, or speckled."""
    rng = np.random.default_rng([71, seed])
    colour = np.clip(rng.uniform(0.35, 0.85) + rng.uniform(-0.08, 0.08, 3), 0, 1)
    streaks, strength = int(rng.choice([24, 64, 160])), rng.uniform(0.02, 0.09)
    grain = cv2.resize(rng.uniform(-1, 1, (160, streaks)).astype(np.float32), _TABLE_PX, interpolation=cv2.INTER_CUBIC)
    grain += 0.5 * cv2.resize(rng.uniform(-1, 1, (9, 9)).astype(np.float32), _TABLE_PX)
    shade = cv2.remap(grain, *_grain_coordinates(camera), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    # Colour and grain are grey levels. The power of a product is the product of powers; the grain's serves 3 channels.
    tone = cv2.pow(1 + np.float32(strength) * shade, GAMMA).reshape(-1, 1)
    return np.asarray(np.minimum(tone * (colour**GAMMA).astype(np.float32), 1))


@lru_cache(maxsize=4)
def _grain_coordinates(camera: PinholeCamera) -> tuple[Floats, Floats]:
    """Return column and row of the table's grain at each pixel, both (px, px)."""
    at = (camera.table[:, :2] * _TABLE_PX_PER_MM + [_TABLE_PX[0] / 2, 0.2 * _TABLE_PX[1]]).astype(np.float32)
    column, row = np.ascontiguousarray(at.T).reshape(2, camera.px, camera.px)
    return column, row


# Depth ------------------------------------------------------------------------------------------------------


def depth(view: CameraView, noise_seed: int) -> npt.NDArray[np.float32]:
    """Return the depth image (px, px), in metres along the camera's axis, NaN where the sensor has no reading.

    It has noise of 1.5 mm at 0.7 m that grows with the square of the distance, flying pixels between an edge and the
    surface behind it, holes at grazing angles and on glossy surfaces, and a resolution of 1 mm.
    """
    px = view.camera.px
    rng = np.random.default_rng([73, noise_seed])
    exact = (view.distance_mm * (view.camera.rays @ view.camera.to_rig[:3, 2])).reshape(px, px)
    # Next to an edge, some pixels mix the near and the far surface.
    near, far = cv2.erode(exact, np.ones((3, 3), np.uint8)), cv2.dilate(exact, np.ones((3, 3), np.uint8))
    mixed = near + rng.random(exact.shape) * (far - near)
    noisy = np.where((far - near > 12.0) & (rng.random(exact.shape) < 0.35), mixed, exact)
    noisy = noisy + 1.5 * rng.standard_normal(exact.shape) * (exact / 700.0) ** 2
    # No reading: steep surfaces, some glossy pixels, and single pixels anywhere.
    steep = np.hypot(cv2.Sobel(exact, cv2.CV_64F, 1, 0, scale=0.125), cv2.Sobel(exact, cv2.CV_64F, 0, 1, scale=0.125))
    gloss = np.where(view.is_object, view.obj.material.gloss, 0.0).reshape(px, px)
    noisy[rng.random(exact.shape) < 0.003 + 0.5 * (steep > 6.0) + 0.06 * gloss] = np.nan
    return (np.round(noisy) / 1000.0).astype(np.float32)
