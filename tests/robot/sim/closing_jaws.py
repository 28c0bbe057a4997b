"""Two force-controlled jaws close on an object that can shift between them: a stiff equation of motion.

    m s'' = F - c s' - N(depth)     for each jaw's travel s      depth_a = s_a - o - clearance_a
    M o'' = N_a - N_b - C o'        for the object's shift o     depth_b = s_b + o - clearance_b

A contact of k N/m between masses of m kg oscillates with sqrt(k/m): at 1e9 N/m ten thousand times faster than the jaws
close. An explicit method must resolve that oscillation or it diverges. The implicit method here is L-stable (Alexander
1977, SDIRK of order 2), so oscillations faster than the step are damped out. `settle` computes the end state alone,
without a step.

The simulated rig does not use it. A recording has no image from the closing motion, and at its end each finger carries
the commanded force, with which the rig presses at once (robot.sim.scene). This module is the reference: a test closes
jaws on the rig's own gels and compares the depths with the rig's.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from robot.sim.contact.layer import Layer, press

Floats = npt.NDArray[np.float64]

_GAMMA = 1.0 - math.sqrt(0.5)  # of the SDIRK method, which is L-stable and of order 2
_MM_PER_M = 1e3
_NEWTON_STEPS, _NEWTON_TOLERANCE = 25, 1e-12
_HALVINGS = 30
_START, _TRAVEL = (
    np.zeros(6),
    np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 1.0]]),
)  # coefficients of (s_a, s_b, o) in the depths


class ForceLaw(ABC):
    """Force of a finger against its depth in N and mm: 0 without contact, and never decreasing."""

    def __call__(self, depth_mm: float) -> tuple[float, float]:
        """Return the force in N and its slope in N/mm."""
        return (0.0, 0.0) if depth_mm <= 0.0 else self._force(depth_mm)

    @abstractmethod
    def _force(self, depth_mm: float) -> tuple[float, float]:
        """Return force and slope for a depth above 0."""

    def depth_at(self, force_n: float) -> float:
        """Return the depth in mm at which the finger pushes back with `force_n` >= 0."""
        if force_n <= 0.0:
            return 0.0
        deep = 1.0
        while self(deep)[0] < force_n:
            deep *= 2.0
        return float(brentq(lambda depth: self(depth)[0] - force_n, 0.0, deep, xtol=1e-300, rtol=1e-14))


@dataclass(frozen=True)
class LinearLaw(ForceLaw):
    """A spring of `stiffness_n_mm` N/mm."""

    stiffness_n_mm: float

    def _force(self, depth_mm: float) -> tuple[float, float]:
        return self.stiffness_n_mm * depth_mm, self.stiffness_n_mm


class TabulatedLaw(ForceLaw):
    """A smooth increasing curve through (0, 0) and `depths_mm`, `forces_n`; linear beyond the last."""

    def __init__(self, depths_mm: npt.ArrayLike, forces_n: npt.ArrayLike) -> None:
        depths, forces = (np.concatenate([[0.0], np.asarray(v, np.float64)]) for v in (depths_mm, forces_n))
        self._curve = PchipInterpolator(depths, forces)
        self._slope, self._last = self._curve.derivative(), float(depths[-1])

    def _force(self, depth_mm: float) -> tuple[float, float]:
        inside = min(depth_mm, self._last)
        slope = float(self._slope(inside))
        return float(self._curve(inside)) + slope * (depth_mm - inside), slope


def press_law(
    gap_mm: npt.ArrayLike, pixel_mm: float, layer: Layer, max_depth_mm: float, *, points: int = 8
) -> TabulatedLaw:
    """Return the law of a gel against a height map, from `points` presses down to `max_depth_mm` beyond first touch."""
    lowest = float(np.min(gap_mm))
    depths = max_depth_mm * np.linspace(0.0, 1.0, points + 1)[1:]
    return TabulatedLaw(depths, [press(gap_mm, pixel_mm, layer, depth_mm=lowest + d).force_n for d in depths])


@dataclass(frozen=True)
class Jaws:
    """Moving parts: `force_n` drives each jaw, viscous damping slows jaws and object."""

    force_n: float
    jaw_mass_kg: float = 0.3
    jaw_damping_n_s_mm: float = 0.1
    object_mass_kg: float = 0.2
    object_damping_n_s_mm: float = 0.02


@dataclass(frozen=True)
class Motion:
    """Equation of motion for a state (6,): travels s_a, s_b and shift o in mm, then their rates in mm/s."""

    jaws: Jaws
    laws: tuple[ForceLaw, ForceLaw]
    clearance_mm: tuple[float, float] = (0.0, 0.0)

    def rate(self, state: Floats) -> tuple[Floats, Floats]:
        """Return d state / dt (6,) and its Jacobian (6, 6)."""
        depths = _TRAVEL @ state[:3] - self.clearance_mm
        contacts = [law(float(depth)) for law, depth in zip(self.laws, depths, strict=True)]
        forces, slopes = np.array(contacts).T
        jaws = self.jaws
        masses = np.array([jaws.jaw_mass_kg, jaws.jaw_mass_kg, jaws.object_mass_kg]) / _MM_PER_M
        damping = np.array([jaws.jaw_damping_n_s_mm, jaws.jaw_damping_n_s_mm, jaws.object_damping_n_s_mm])
        driven = np.array([jaws.force_n, jaws.force_n, 0.0])
        acceleration = (driven - damping * state[3:] - _TRAVEL.T @ forces) / masses
        jacobian = np.zeros((6, 6))
        jacobian[:3, 3:] = np.eye(3)
        jacobian[3:, :3] = -(_TRAVEL.T * slopes) @ _TRAVEL / masses[:, None]
        jacobian[3:, 3:] = -np.diag(damping / masses)
        return np.concatenate([state[3:], acceleration]), jacobian

    def contact_forces(self, state: Floats) -> tuple[float, float]:
        """Return the forces of fingers a and b on the object in N."""
        depth_a, depth_b = _TRAVEL @ state[:3] - self.clearance_mm
        return self.laws[0](float(depth_a))[0], self.laws[1](float(depth_b))[0]

    def step(self, state: Floats, step_s: float) -> Floats | None:
        """Take one step of Alexander's method; return None if Newton's iteration does not converge."""
        first = self._stage(state, _GAMMA * step_s, state)
        if first is None:
            return None
        slope = (first - state) / (_GAMMA * step_s)
        return self._stage(state + (1.0 - _GAMMA) * step_s * slope, _GAMMA * step_s, first)

    def _stage(self, base: Floats, length: float, start: Floats) -> Floats | None:
        """Return y with y = base + length rate(y)."""
        state = start
        for _ in range(_NEWTON_STEPS):
            rate, jacobian = self.rate(state)
            change = np.linalg.solve(np.eye(6) - length * jacobian, base + length * rate - state)
            state = state + change
            if np.abs(change).max() <= _NEWTON_TOLERANCE * (1.0 + np.abs(state).max()):
                return state
        return None


def close(motion: Motion, duration_s: float, step_s: float, start: Floats = _START) -> tuple[Floats, Floats]:
    """Return times (n,) in s and states (n, 6) from `start` (default: at rest), n - 1 steps of about `step_s`."""
    times = np.linspace(0.0, duration_s, math.ceil(duration_s / step_s - 1e-9) + 1)
    states = [np.asarray(start, np.float64)]
    for length in np.diff(times):
        states.append(_advance(motion, states[-1], float(length), _HALVINGS))
    return times, np.array(states)


def _advance(motion: Motion, state: Floats, step_s: float, halvings: int) -> Floats:
    """Take one step, in halves if Newton's iteration does not converge (a kink of the force law)."""
    reached = motion.step(state, step_s)
    if reached is not None and np.isfinite(reached).all():
        return reached
    assert halvings > 0, f"Newton's iteration does not converge at a step of {step_s} s; use a smoother force law"
    middle = _advance(motion, state, step_s / 2.0, halvings - 1)
    return _advance(motion, middle, step_s / 2.0, halvings - 1)


def settle(motion: Motion) -> tuple[float, float]:
    """Return the depths of fingers a and b in mm at rest: each carries the commanded force, at any stiffness."""
    depth_a, depth_b = (law.depth_at(motion.jaws.force_n) for law in motion.laws)
    return depth_a, depth_b
