"""An arm for the rosbridge emulator: seven joints; four move the hand and one turns it.

It is not a Sawyer: link lengths are rounded, right_j2 and right_j4 stay at zero, and only poses with the hand straight
down have an inverse. It has the properties that a driver depends on: joint names, joint speeds scaled by a ratio,
first-order motion towards the last command until a time-out, and kinematics that can fail. Lengths are in m, angles in
rad. It does not use the driver's mathematics, so the two can disagree.
"""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Joints = npt.NDArray[np.float64]

SHOULDER_M, UPPER_M, FORE_M, HAND_M = 0.32, 0.40, 0.40, 0.24
FASTEST_RAD_S = np.array([1.74, 1.33, 1.96, 1.96, 3.49, 3.49, 4.55])
LIMITS_RAD = np.array([3.05, 3.8, 3.04, 3.04, 2.98, 2.98, 4.71])
TAU_S = 0.03
READY = (0.0, 0.9, 0.0, -1.8, 0.0, -math.pi / 2 + 0.9, 0.0)
"""Hand down in front of the base: the angles of shoulder, elbow and wrist sum to -pi / 2."""


class SawyerModel:
    """Joints that move in time. `advance` gets the seconds since its last call."""

    def __init__(self, joints: Sequence[float] = READY) -> None:
        self.joints = np.array(joints, dtype=np.float64)
        self.velocity = np.zeros(7)
        self.enabled, self.stopped, self.error = True, False, False
        self.estop_button = self.estop_source = 0
        self.has_collided = False
        self.speed_ratio, self.command_timeout_s = 0.3, 0.2
        self._target: Joints | None = None
        self._command_age_s = 0.0

    def command(self, target: Sequence[float]) -> None:
        """Accept a command in position mode; it is valid until the time-out."""
        self._target, self._command_age_s = np.clip(np.array(target, dtype=np.float64), -LIMITS_RAD, LIMITS_RAD), 0.0

    def advance(self, seconds: float) -> None:
        """Move for this time, in steps much smaller than TAU_S."""
        steps = max(1, math.ceil(seconds / 0.005))
        before = self.joints.copy()
        for _ in range(steps):
            self._step(seconds / steps)
        self.velocity = (self.joints - before) / seconds if seconds > 0 else np.zeros(7)

    def _step(self, seconds: float) -> None:
        self._command_age_s += seconds
        if self._command_age_s > self.command_timeout_s or not self.enabled or self.stopped or self.error:
            self._target = None
        if self._target is None:
            return
        maximum = FASTEST_RAD_S * self.speed_ratio * seconds
        step = (self._target - self.joints) * (1.0 - math.exp(-seconds / TAU_S))
        self.joints = self.joints + np.clip(step, -maximum, maximum)


def forward(joints: Sequence[float] | Joints) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    """Return the position (m) of the tip and its quaternion (x, y, z, w)."""
    base, shoulder, elbow, wrist, turn = (float(joints[index]) for index in (0, 1, 3, 5, 6))
    lean = shoulder
    out, up = UPPER_M * math.cos(lean), SHOULDER_M + UPPER_M * math.sin(lean)
    lean += elbow
    out, up = out + FORE_M * math.cos(lean), up + FORE_M * math.sin(lean)
    lean += wrist
    out, up = out + HAND_M * math.cos(lean), up + HAND_M * math.sin(lean)
    position = (out * math.cos(base), out * math.sin(base), up)
    # The tip's z axis is the direction of the hand, tilted by pi / 2 - lean from vertical, about y.
    quaternion = _times(_times(_about(base, "z"), _about(math.pi / 2 - lean, "y")), _about(turn, "z"))
    return position, quaternion


def inverse(
    position: Sequence[float], quaternion: Sequence[float], seed: Sequence[float] | Joints
) -> tuple[float, ...] | None:
    """Return the joints nearest to the seed for a tip that points straight down; None if there are none."""
    x, y, z = position
    turned = np.array(quaternion, dtype=np.float64)
    norm = float(np.linalg.norm(turned))
    if not math.isfinite(norm) or abs(norm - 1.0) > 1e-2 or not all(map(math.isfinite, position)):
        return None
    qx, qy, qz, qw = turned / norm
    if 1 - 2 * (qx * qx + qy * qy) > -0.9999:  # z of the tip's z axis: it must point down
        return None
    base = math.atan2(y, x)
    heading = math.atan2(2 * (qx * qy + qz * qw), 1 - 2 * (qy * qy + qz * qz))
    chain = _two_links(math.hypot(x, y), z + HAND_M - SHOULDER_M, elbow_up=float(seed[3]) <= 0)
    if chain is None:
        return None
    shoulder, elbow = chain
    wrist = -math.pi / 2 - shoulder - elbow
    # With the tip down, its x axis points to base + pi - turn.
    found = np.array([base, shoulder, 0.0, elbow, 0.0, wrist, base + math.pi - heading])
    found[[0, 5, 6]] += _whole_turns(np.array(seed, dtype=np.float64)[[0, 5, 6]] - found[[0, 5, 6]])
    return tuple(found.tolist()) if (np.abs(found) <= LIMITS_RAD).all() else None


def _two_links(out: float, up: float, *, elbow_up: bool) -> tuple[float, float] | None:
    """Return angles of shoulder and elbow for a wrist at (out, up) from the shoulder; None if it is out of reach."""
    cosine = (out * out + up * up - UPPER_M**2 - FORE_M**2) / (2 * UPPER_M * FORE_M)
    if not -0.98 < cosine < 0.998:
        return None
    elbow = -math.acos(cosine) if elbow_up else math.acos(cosine)
    shoulder = math.atan2(up, out) - math.atan2(FORE_M * math.sin(elbow), UPPER_M + FORE_M * math.cos(elbow))
    return shoulder, elbow


def _whole_turns(difference: Joints) -> Joints:
    return math.tau * np.rint(difference / math.tau)


def _about(angle: float, axis: str) -> tuple[float, float, float, float]:
    sine, cosine = math.sin(angle / 2), math.cos(angle / 2)
    return (0.0, sine, 0.0, cosine) if axis == "y" else (0.0, 0.0, sine, cosine)


def _times(
    p: tuple[float, float, float, float], q: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """Return the product of two quaternions (x, y, z, w)."""
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return (
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    )
