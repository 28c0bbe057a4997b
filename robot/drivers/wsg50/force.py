"""What a force of the WSG-50 is: the one place where its forces are turned into those of the contract, and back.

The contract's force is the one on each finger (robot.devices). The gripper's force limit is the sum over both fingers:
SCHUNK's manual of its fieldbus interface says of the register FORCELIMIT that "the grasping force is twice the nominal
force that is applied to the part to be grasped", and SCHUNK rates its grippers by the sum over the jaws. So an object
gripped with a limit of 40 N is pushed with 20 N by each finger: FINGER_SHARE of it. A user of the open simulator Drake
found their own controller off by this very factor (its pull request 9950).

Not certain: that the force which the gripper reports (45h) counts as its limit does, which is assumed here; and how
near the true force is, for without force-measuring fingers the gripper knows its motor's current only. Whoever has
a force gauge sets the driver's `finger_share` to what is measured on one finger, over the limit set.
"""

FINGER_SHARE = 0.5


def on_finger(gripper_n: float, share: float = FINGER_SHARE) -> float:
    """Force on each finger (N) where the gripper counts `gripper_n`."""
    return gripper_n * share


def of_gripper(finger_n: float, share: float = FINGER_SHARE) -> float:
    """What the gripper must count (N) for `finger_n` on each finger."""
    return finger_n / share
