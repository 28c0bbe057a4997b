"""Compiled loops over the pixels of a gel image: light of the LEDs, and camera noise."""

import numpy as np
from numpy.typing import NDArray

from robot.sim.jit import jit

Array = NDArray[np.float32]


@jit
def shade_by_bars(slopes, leds, strengths, axes, shades, mix, ambient, backdrop, out):  # type: ignore[no-untyped-def]
    """Write the picture (rows, cols, 3) of LedOptics into `out`; all arrays are float32.

    Args:
        slopes: (2, rows, cols) slopes of the surface.
        leds: (bars, points, 3) places of the LEDs, mm.
        strengths: (bars, points, rows, cols); an LED contributes its strength times (normal . vector to it), or 0.
        axes: x (cols,) and y (rows,) of the pixels in mm.
        shades: (bars, rows, cols) fraction of a bar's light that reaches a pixel.
        mix: (3, bars) contribution of each bar to each channel.
        ambient: fraction of the light from all directions.
        backdrop: (rows, cols, 3) picture of the flat gel.
        out: (rows, cols, 3) result.
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
def add_camera_noise(clean, tile, place, read, shot, out):  # type: ignore[no-untyped-def]
    """Write rounded grey levels with noise of variance read^2 + shot * level into `out`.

    Args:
        clean: (rows, n) grey levels; n is the number of columns times 3.
        tile: (tile rows, tile n) noise of variance 1.
        place: first row, step from row to row (1 or -1), and first value of a row in the tile; then the noise's sign.
        read: standard deviation of the read noise.
        shot: variance of the shot noise per grey level.
        out: (rows, n) uint8 result.
    """
    square = read * read
    first_row, step, first, sign = place
    for row in range(out.shape[0]):
        levels, greys = clean[row], out[row]  # slices of one row are faster than two indices
        noise = tile[first_row + step * row, first : first + len(greys)]
        for i in range(len(greys)):
            level = levels[i]
            spread = np.float32(sign) * np.sqrt((level if level > 0 else np.float32(0)) * shot + square)
            grey = np.rint(level + spread * noise[i])
            grey = grey if grey > 0 else np.float32(0)
            greys[i] = np.int32(grey if grey < 255 else np.float32(255))
