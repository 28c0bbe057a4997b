"""What is done to every pixel of a gel image, compiled: light of the LEDs, and the camera's noise."""

import numpy as np
from numpy.typing import NDArray

from robot.sim.jit import jit

Array = NDArray[np.float32]


@jit
def shade_by_bars(slopes, leds, strengths, axes, shades, mix, ambient, backdrop, out):  # type: ignore[no-untyped-def]
    """The picture (rows, cols, 3) of LedOptics into `out`, which is of float32 as everything here.

    slopes: of the surface, (2, rows, cols). leds (bars, points, 3) mm and strengths (bars, points, rows, cols): what an
    LED gives is its strength times the product of the normal and the way to it, or 0. axes: x (cols,) and y (rows,)
    of the pixels in mm. shades: (bars, rows, cols) share of a bar's light that a pixel gets. mix (3, bars).
    """
    bars, points = leds.shape[0], leds.shape[1]
    rows, cols = slopes.shape[1], slopes.shape[2]
    x, y = axes
    light, steep, one = np.empty((bars, cols), np.float32), np.empty(cols, np.float32), np.float32(1)
    for row in range(rows):
        for i in range(cols):
            s, t = slopes[0, row, i], slopes[1, row, i]
            steep[i] = one / np.sqrt(one + s * s + t * t)
        for bar in range(bars):
            for i in range(cols):
                light[bar, i] = 0
            for point in range(points):
                led_x, led_y, led_z = leds[bar, point, 0], leds[bar, point, 1] - y[row], leds[bar, point, 2]
                for i in range(cols):
                    towards = led_z - slopes[0, row, i] * (led_x - x[i]) - slopes[1, row, i] * led_y
                    light[bar, i] += strengths[bar, point, row, i] * (towards if towards > 0 else np.float32(0))
            for i in range(cols):
                light[bar, i] *= steep[i] * shades[bar, row, i]
        for channel in range(3):
            for i in range(cols):
                mixed = np.float32(0)
                for bar in range(bars):
                    mixed += mix[channel, bar] * light[bar, i]
                out[row, i, channel] = backdrop[row, i, channel] * (ambient + (one - ambient) * mixed)


@jit
def add_camera_noise(clean, noise, read, shot, out):  # type: ignore[no-untyped-def]
    """Grey levels (rows, cols, 3) plus noise, given with variance 1, of variance read^2 + shot * level; rounded."""
    square = read * read
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            for channel in range(3):
                level = clean[row, column, channel]
                spread = np.sqrt((level if level > 0 else np.float32(0)) * shot + square)
                grey = np.rint(level + spread * noise[row, column, channel])
                out[row, column, channel] = np.uint8(min(max(grey, np.float32(0)), np.float32(255)))
