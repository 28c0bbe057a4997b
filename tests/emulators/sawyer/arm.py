"""An arm for the rosbridge emulator: seven joints; four move the hand and one turns it.

It is not a Sawyer: link lengths are rounded, right_j2 and right_j4 stay at zero, and only poses with the hand straight
down have an inverse. It has the properties that a driver depends on: joint names, joint speeds scaled by a ratio,
first-order motion towards the last command until a time-out, and kinematics that can fail. Lengths are in m, angles in
rad. It does not use the driver's mathematics, so the two can disagree.
"""

import math

import numpy as np
from scipy.spatial.transform import Rotation

SHOULDER_M, UPPER_M, FORE_M, HAND_M = 0.32, 0.40, 0.40, 0.24
FASTEST_RAD_S = np.array([1.74, 1.33, 1.96, 1.96, 3.49, 3.49, 4.55])
LIMITS_RAD = np.array([3.05, 3.8, 3.04, 3.04, 2.98, 2.98, 4.71])
TAU_S = 0.03
READY = (0.0, 0.9, 0.0, -1.8, 0.0, -math.pi / 2 + 0.9, 0.0)
"""Hand down in front of the base: the angles of shoulder, elbow and wrist sum to -pi / 2."""


class SawyerModel:
    """Joints that move in time. `advance` gets the seconds since its last call."""

    def __init__(self):
        self.joints, self.velocity = np.array(READY), np.zeros(7)
        self.enabled, self.stopped, self.error, self.has_collided = True, False, False, False
        self.estop_button = self.estop_source = 0
        self.speed_ratio, self.command_timeout_s = 0.3, 0.2
        self._target, self._command_age_s = None, 0.0

    def command(self, target):
        """Accept a command in position mode; it is valid until the time-out."""
        self._target, self._command_age_s = np.clip(target, -LIMITS_RAD, LIMITS_RAD), 0.0

    def advance(self, seconds):
        """Move for this time, in steps much smaller than TAU_S."""
        steps = max(1, math.ceil(seconds / 0.005))
        before = self.joints.copy()
        for _ in range(steps):
            self._step(seconds / steps)
        self.velocity = (self.joints - before) / seconds if seconds > 0 else np.zeros(7)

    def _step(self, seconds):
        self._command_age_s += seconds
        if self._command_age_s > self.command_timeout_s or not self.enabled or self.stopped or self.error:
            self._target = None
        if self._target is None:
            return
        maximum = FASTEST_RAD_S * self.speed_ratio * seconds
        step = (self._target - self.joints) * (1.0 - math.exp(-seconds / TAU_S))
        self.joints = self.joints + np.clip(step, -maximum, maximum)


def forward(joints):
    """Return the position (m) of the tip and its quaternion (x, y, z, w)."""
    base, shoulder, elbow, wrist, turn = (float(joints[index]) for index in (0, 1, 3, 5, 6))
    out, up, lean = 0.0, SHOULDER_M, 0.0
    for angle, length in ((shoulder, UPPER_M), (elbow, FORE_M), (wrist, HAND_M)):
        lean += angle
        out, up = out + length * math.cos(lean), up + length * math.sin(lean)
    # The tip's z axis is the direction of the hand, tilted by pi / 2 - lean from vertical, about y.
    turned = Rotation.from_euler("ZYZ", [base, math.pi / 2 - lean, turn]).as_quat()
    return (out * math.cos(base), out * math.sin(base), up), tuple(turned.tolist())


def inverse(position, quaternion, seed):
    """Return the joints nearest to the seed for a tip that points straight down; None if there are none."""
    x, y, z = position
    axes = Rotation.from_quat(quaternion).as_matrix()
    if axes[2, 2] > -0.9999:  # the tip's z axis must point down
        return None
    base, heading = math.atan2(y, x), math.atan2(axes[1, 0], axes[0, 0])
    out, up = math.hypot(x, y), z + HAND_M - SHOULDER_M
    cosine = (out * out + up * up - UPPER_M**2 - FORE_M**2) / (2 * UPPER_M * FORE_M)
    if not -0.98 < cosine < 0.998:  # the wrist is out of reach
        return None
    elbow = -math.acos(cosine) if seed[3] <= 0 else math.acos(cosine)
    shoulder = math.atan2(up, out) - math.atan2(FORE_M * math.sin(elbow), UPPER_M + FORE_M * math.cos(elbow))
    # With the tip down, its x axis points to base + pi - turn.
    wrist, turn = -math.pi / 2 - shoulder - elbow, base + math.pi - heading
    found = np.array([base, shoulder, 0.0, elbow, 0.0, wrist, turn])
    found[[0, 5, 6]] += math.tau * np.rint((np.array(seed)[[0, 5, 6]] - found[[0, 5, 6]]) / math.tau)
    return tuple(found.tolist()) if (np.abs(found) <= LIMITS_RAD).all() else None
