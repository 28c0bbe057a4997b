"""What a Sawyer said lately, from the messages that came and when: no socket, no clock."""

import math
from collections.abc import Sequence

import numpy as np

from robot.drivers.sawyer import messages
from robot.drivers.sawyer.messages import Joints
from robot.drivers.sawyer.rosbridge import Arrival

STILL_RAD, STILL_S = 1e-3, 0.1
"""An arm stands when no joint has moved by more in so long."""


def newest_joints(arrivals: Sequence[Arrival]) -> tuple[Joints, float] | None:
    """The newest joints and since when they have been said: one repeated with its old time stamp is as old as its first
    copy. None where none came."""
    found, since_s = None, -math.inf
    for arrival in reversed(arrivals):
        if found is None:
            found = messages.joints_of(arrival.message)
            stamp = messages.stamp_of(arrival.message)
            since_s = arrival.time_s
        elif stamp is not None and messages.stamp_of(arrival.message) == stamp:
            since_s = arrival.time_s
        else:
            break
    return None if found is None else (found, since_s)


def stands(arrivals: Sequence[Arrival], since_s: float, now_s: float) -> bool:
    """Whether the joint states of the last STILL_S, none from before `since_s`, are of an arm that stands."""
    recent = [
        joints
        for arrival in arrivals
        if arrival.time_s >= max(since_s, now_s - STILL_S)
        and (joints := messages.joints_of(arrival.message)) is not None
    ]
    return now_s - since_s >= STILL_S and len(recent) >= 3 and float(np.ptp(recent, axis=0).max()) < STILL_RAD
