"""Influence of normal pressure on an elastic surface, in scaled units: the pixel is 1 long and E* = E/(1 - nu^2) is 1.

    half-space        Love (1929): a square pixel of uniform pressure, exact, not periodic
    bonded layer      half-space less a smooth correction C(r/h), the Hankel transform of 1 - S(qh); S is the
                      closed form of a layer on a rigid base (its limits are tested)
    thin layer        h below THIN_PIXELS: the closed form sampled in Fourier space, on a grid so wide that its
                      period has no effect; exact for pressure that is smooth on the scale of a pixel

An influence is a quadrant (rows, cols): entry (i, j) is the displacement i rows and j columns from a pixel of unit
pressure. It is even, so the quadrant is complete and any smaller window is a corner of it. Products use FFT with zero
padding to at least 2 n - 1, hence without wrap-around (Liu, Wang & Liu 2000).
"""

import copy
import functools
import math

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.interpolate import CubicHermiteSpline
from scipy.special import j0, j1

Floats = npt.NDArray[np.float64]
Quadrant = tuple[int, int]

THIN_PIXELS = 2.0  # the correction of a thinner layer is too sharp for pixels
REACH = 32.0  # in thicknesses: a bonded layer's influence falls faster than exp(-.739 r/h), 1e-10 here
_X_MAX, _X_PANELS, _PANEL_POINTS = 20.0, 32, 24  # 1 - S falls like x^2 exp(-2 x), 1e-14 at 20
_RHO_STEP = 0.0075  # of log(1 + rho): the correction is smoother where it is small
_PATCH_POINTS = 3  # Gauss points on a pixel's side; 1e-7 at THIN_PIXELS
_SERIES_BELOW = 0.5
_DEEP = 100.0  # S is 1 from here on in float64


def layer_symbol(x: Floats, poisson: float) -> Floats:
    """Return S(qh) of a layer bonded to a rigid base: u(q) = 2 S / (E* q) p(q); 1 for a half-space.

    S(x) = [(3-4v) sinh 2x - 2x] / [(3-4v) cosh 2x + 2x^2 + 5 - 12v + 8v^2]. Both are multiplied by exp(-2x) to avoid
    overflow, and the difference is written as (3-4v) (sinh 2x - 2x) + (2-4v) 2x to avoid cancellation.
    """
    x = np.minimum(x, _DEEP)
    y, decay, k = 2.0 * x, np.exp(-2.0 * x), 3.0 - 4.0 * poisson
    numerator = k * _scaled_sinh_less_argument(y) + (2.0 - 4.0 * poisson) * y * decay
    rest = 0.5 * y * y + 5.0 - 12.0 * poisson + 8.0 * poisson**2
    return np.asarray(numerator / (0.5 * k * (1.0 + decay * decay) + rest * decay))


def _scaled_sinh_less_argument(y: Floats) -> Floats:
    """Return (sinh y - y) exp(-y), by its series near 0, where the difference would cancel."""
    square = y * y
    series = 1.0 + square / 20 * (1.0 + square / 42 * (1.0 + square / 72 * (1.0 + square / 110 * (1.0 + square / 156))))
    near = y * square / 6.0 * series * np.exp(-y)
    return np.where(y < _SERIES_BELOW, near, 0.5 - np.exp(-y) * (0.5 * np.exp(-y) + y))


def layer_compliance(q: Floats, thickness: float, poisson: float) -> Floats:
    """Return u(q)/p(q) = 2 S(qh)/q at wave number q (radian per pixel).

    At q = 0 it is the limit h (1-2v)/(1-v)^2 = h E*/M. The mean displacement of a half-space (infinite thickness) is
    not defined: 0 at q = 0.
    """
    q = np.asarray(q, np.float64)
    mean = 0.0 if math.isinf(thickness) else thickness * (1.0 - 2.0 * poisson) / (1.0 - poisson) ** 2
    safe = np.where(q > 0.0, q, 1.0)
    symbol = np.ones_like(q) if math.isinf(thickness) else layer_symbol(safe * thickness, poisson)
    return np.where(q > 0.0, 2.0 * symbol / safe, mean)


def love_patch(shape: Quadrant) -> Floats:
    """Return the displacement (rows, cols) around a square pixel of uniform unit pressure on a half-space.

    Love's formula; in the first quadrant no logarithm's argument is a difference of near-equal numbers.
    """
    y, x = np.ogrid[0.0 : shape[0], 0.0 : shape[1]]
    left, right, up, down = x - 0.5, x + 0.5, y - 0.5, y + 0.5
    far_far, far_near = np.hypot(down, right), np.hypot(down, left)
    near_far, near_near = np.hypot(up, right), np.hypot(up, left)
    total = right * np.log((down + far_far) / (up + near_far)) + down * np.log((right + far_far) / (left + far_near))
    total += left * np.log((up + near_near) / (down + far_near)) + up * np.log((left + near_near) / (right + near_far))
    return np.asarray(total / np.pi)


@functools.lru_cache(maxsize=1024)
def layer_correction(poisson: float) -> CubicHermiteSpline:
    """Return C(rho) = integral of (1 - S(x)) J0(x rho) dx over x >= 0, for 0 <= rho <= REACH (+ a pixel).

    A point force F on a layer h thick displaces F (1/rho - C(rho)) / (pi E* h) at rho = r/h. Values and slopes are from
    Gauss-Legendre quadrature over x, at rho + 1 = exp(k _RHO_STEP).
    """
    nodes, weights = np.polynomial.legendre.leggauss(_PANEL_POINTS)
    edges = np.linspace(0.0, _X_MAX, _X_PANELS + 1)
    half = 0.5 * (edges[1] - edges[0])
    x = ((edges[:-1] + edges[1:])[:, None] * 0.5 + half * nodes).ravel()
    weight = np.tile(half * weights, _X_PANELS) * (1.0 - layer_symbol(x, poisson))
    rho = np.expm1(np.arange(0.0, math.log1p(REACH + 1.0) + _RHO_STEP, _RHO_STEP))
    angle = rho[:, None] * x
    return CubicHermiteSpline(rho, j0(angle) @ weight, -j1(angle) @ (weight * x))


@functools.lru_cache(maxsize=512)
def influence(shape: Quadrant, thickness: float, poisson: float) -> Floats:
    """Return the quadrant (rows, cols) of the influence of a layer `thickness` pixels thick; inf is the half-space."""
    if math.isinf(thickness):
        table = love_patch(shape)
    elif thickness < THIN_PIXELS:
        table = _sampled_influence(shape, thickness, poisson)
    else:
        table = _corrected_influence(shape, thickness, poisson)
    table.flags.writeable = False
    return table


def _corrected_influence(shape: Quadrant, thickness: float, poisson: float) -> Floats:
    """Return Love's patch less the correction integrated over the pixel; 0 beyond REACH thicknesses."""
    rows, cols = (min(n, math.ceil(REACH * thickness) + 1) for n in shape)
    nodes, weights = np.polynomial.legendre.leggauss(_PATCH_POINTS)
    correction, near = layer_correction(poisson), love_patch((rows, cols))
    y, x = np.ogrid[0.0:rows, 0.0:cols]
    for dy, wy in zip(0.5 * nodes, 0.5 * weights, strict=True):
        for dx, wx in zip(0.5 * nodes, 0.5 * weights, strict=True):
            rho = np.minimum(np.hypot(y + dy, x + dx) / thickness, REACH + 1.0)
            near -= wy * wx / (np.pi * thickness) * correction(rho)
    near[np.hypot(y, x) > REACH * thickness] = 0.0
    table = np.zeros(shape)
    table[:rows, :cols] = near
    return table


def _sampled_influence(shape: Quadrant, thickness: float, poisson: float) -> Floats:
    """Sample the closed form at the wave numbers of a grid twice as wide plus REACH thicknesses."""
    margin = math.ceil(REACH * thickness)
    size = tuple(2 * scipy.fft.next_fast_len(n + margin, real=True) for n in shape)
    q = 2.0 * np.pi * np.hypot(np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1]))
    table = scipy.fft.irfft2(layer_compliance(q, thickness, poisson), size)
    return np.ascontiguousarray(table[: shape[0], : shape[1]])


class Operator:
    """Displacement (rows, cols) of a pressure (rows, cols): one real FFT each way, skipping rows of zeros.

    Args:
        table: influence, a quadrant at least as large as `shape`.
        shape: rows and columns of the pressure.
        single_precision: whether the FFT is in float32, accurate to about 1e-7 of the largest displacement.

    Attributes:
        bound: an upper bound on the largest eigenvalue.
        peak: displacement of a loaded pixel itself.
        rounding: relative error of an energy.
    """

    def __init__(self, table: Floats, shape: Quadrant, *, single_precision: bool = False) -> None:
        self.shape, self.single_precision = shape, single_precision
        self.rounding = 1e-6 if single_precision else 1e-12
        self._size = tuple(scipy.fft.next_fast_len(2 * n - 1, real=True) for n in shape)
        # The quadrant laid out circularly; entries beyond shape - 1 multiply only zeros.
        rows, cols = (np.minimum(np.arange(period), period - np.arange(period)) for period in self._size)
        inside = (rows < shape[0])[:, None] & (cols < shape[1])
        corner = table[np.minimum(rows, shape[0] - 1)[:, None], np.minimum(cols, shape[1] - 1)]
        # The influence is even, so its transform is real.
        transform = np.ascontiguousarray(scipy.fft.rfft2(np.where(inside, corner, 0.0)).real)
        self._transform = transform.astype(np.float32) if single_precision else transform
        self.bound, self.peak = _largest(transform), float(table[0, 0])

    def plus(self, other: "Operator", weight: float) -> "Operator":
        """Return the sum of this and `weight` times another operator of the same shape."""
        both = copy.copy(self)
        both._transform = self._transform + weight * other._transform
        both.bound, both.peak = _largest(both._transform), self.peak + weight * other.peak
        return both

    def __call__(self, pressure: Floats) -> Floats:
        """Return the displacement (rows, cols), float64, of a pressure (rows, cols)."""
        (rows, cols), (high, wide) = self.shape, self._size
        values = pressure.astype(np.float32) if self.single_precision else pressure
        wave = scipy.fft.rfft(values, wide, axis=1)
        wave = scipy.fft.fft(wave, high, axis=0, overwrite_x=True)
        wave *= self._transform
        wave = scipy.fft.ifft(wave, axis=0, overwrite_x=True)[:rows]
        displacement = scipy.fft.irfft(wave, wide, axis=1)[:, :cols]
        return np.ascontiguousarray(displacement, np.float64)


def _largest(transform: npt.NDArray[np.floating]) -> float:
    """Return the largest eigenvalue, or 1 for a rigid surface, so that a step of 1/bound is finite."""
    return float(np.abs(transform).max()) or 1.0
