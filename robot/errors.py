"""Every error that `robot` raises on purpose.

A message names the requirement, the actual value and the remedy. The command line prints it on one line and
exits with `exit_code`: 1, or 2 for wrong use and bad input. Any other exception is a bug.
"""


class RobotError(Exception):
    """The job ran and failed.

    >>> try:
    ...     robot.load_rig("missing.toml", seed=0)
    ... except robot.RobotError as error:
    ...     print(error.exit_code, error)
    2 missing.toml ...
    """

    exit_code = 1


class DeviceError(RobotError):
    """A device is missing or disconnected, or its answer is late, stale or out of range."""


class PlanError(RobotError):
    """No object is visible, or this gripper cannot grasp it in this pose. Another attempt may succeed."""


class UngraspableError(PlanError):
    """The gripper cannot grasp this object in any attempt."""


class StorageError(RobotError):
    """A recording could not be written. The grasps appended before are complete."""


class BadRobotInput(RobotError):
    """Wrong use or bad input."""

    exit_code = 2


class RecordingError(BadRobotInput):
    """A recording is not usable, or the data to append does not fit it."""


class ImporterError(BadRobotInput):
    """A data set does not have the layout that its importer reads."""


class UnknownName(BadRobotInput):
    """No driver or importer has this name; the message lists the known ones."""


class RobotConfigError(BadRobotInput):
    """A setting is unknown or out of range."""


class SceneError(BadRobotInput):
    """A scene is impossible: no real rig could contain it."""
