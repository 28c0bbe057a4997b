"""Two force-controlled jaws close on an object that can shift between them: a stiff equation of motion.

    m s'' = F - c s' - N(depth)     for each jaw's travel s      depth_a = s_a - o - clearance_a
    M o'' = N_a - N_b - C o'        for the object's shift o     depth_b = s_b + o - clearance_b

A contact of k N/m between masses of m kg oscillates with sqrt(k/m): at 1e9 N/m ten thousand times faster than the jaws
close. An explicit method must resolve that oscillation or it diverges; the implicit Euler method damps it out.

The simulated rig does not use it. A recording has no image from the closing motion, and at its end each finger carries
the commanded force, with which the rig presses at once (robot.sim.scene). This module is the reference: a test closes
jaws on the rig's own gels and compares the depths with the rig's.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
ForceLaw = Callable[[float], tuple[float, float]]
"""Force of a finger in N and its slope in N/mm against its depth in mm, above 0; never decreasing."""


def spring(stiffness_n_mm: float, depth_mm: float) -> tuple[float, float]:
    """Return force and slope of a spring."""
    return stiffness_n_mm * depth_mm, stiffness_n_mm


_STEP_S = 0.01
_MM_PER_M = 1e3
_TRAVEL = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 1.0]])
"""Coefficients of (s_a, s_b, o) in the depths."""
_MASS_KG = np.array([0.3, 0.3, 0.2])
_DAMPING_N_S_MM = np.array([0.1, 0.1, 0.02])


@dataclass(frozen=True)
class Motion:
    """Equation of motion for a state (6,): travels s_a, s_b and shift o in mm, then their rates in mm/s."""

    force_n: float
    laws: tuple[ForceLaw, ForceLaw]
    clearance_mm: tuple[float, float] = (0.0, 0.0)

    def depths(self, state: Floats) -> Floats:
        """Return the depths of fingers a and b in mm."""
        return np.asarray(_TRAVEL @ state[:3] - self.clearance_mm)

    def contact_forces(self, state: Floats) -> tuple[Floats, Floats]:
        """Return the forces of fingers a and b on the object in N, and their slopes in N/mm."""
        pairs = zip(self.laws, self.depths(state), strict=True)
        forces, slopes = zip(*(law(depth) if depth > 0.0 else (0.0, 0.0) for law, depth in pairs), strict=True)
        return np.array(forces), np.array(slopes)

    def rate(self, state: Floats) -> tuple[Floats, Floats]:
        """Return d state / dt (6,) and its Jacobian (6, 6)."""
        (contact, slopes), masses = self.contact_forces(state), _MASS_KG / _MM_PER_M
        forces = np.array([self.force_n, self.force_n, 0.0]) - _DAMPING_N_S_MM * state[3:] - _TRAVEL.T @ contact
        stiffness, damping = (_TRAVEL.T * slopes) @ _TRAVEL / masses[:, None], np.diag(_DAMPING_N_S_MM / masses)
        jacobian = np.block([[np.zeros((3, 3)), np.eye(3)], [-stiffness, -damping]])
        return np.concatenate([state[3:], forces / masses]), jacobian


def close(motion: Motion, duration_s: float) -> Floats:
    """Return the state (6,) after closing from rest for this time, in implicit steps solved by Newton's method."""
    state = np.zeros(6)
    for _ in range(round(duration_s / _STEP_S)):
        base, change = state, np.inf
        for _ in range(50):
            rate, jacobian = motion.rate(state)
            change = np.linalg.solve(np.eye(6) - _STEP_S * jacobian, base + _STEP_S * rate - state)
            state = state + change
            if np.abs(change).max() <= 1e-12 * (1.0 + np.abs(state).max()):
                break
        else:
            raise AssertionError("Newton's method does not converge: use a smoother law or a shorter step")
    return state
