"""Every error that `robot` raises on purpose.

A message says what must hold, what was got and what to do. The command line prints it on one line and
leaves with `exit_code`; anything that is not one of these errors is a bug.

    RobotError                 the job ran and failed (exit code 1)
    +-- DeviceError            a device is missing, went away, answers late, stale or out of range
    +-- PlanError              nothing to grasp is seen, or no grasp of it is possible
    |   +-- UngraspableError   no attempt at this object can succeed; the collection goes on with the next one
    +-- StorageError           a recording could not be written: disk full, no permission, folder in use
    +-- BadRobotInput          wrong use or bad input (exit code 2)
        +-- RecordingError     a recording is not usable. For example: a line that is not JSON
        +-- ImporterError      a data set to import is not what its importer reads
        +-- UnknownName        no driver or importer has this name
        +-- RobotConfigError   a setting is unknown or out of range
        +-- SceneError         a scene is impossible. For example: a mesh that is not closed
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
    """A device is missing, went away, or its answer is late, stale or out of range."""


class PlanError(RobotError):
    """Nothing to grasp is seen, or no grasp of it is possible with this gripper; another attempt may do better."""


class UngraspableError(PlanError):
    """The gripper cannot grasp this object at all, however often it is tried."""


class StorageError(RobotError):
    """A recording could not be written; what was appended before is whole."""


class BadRobotInput(RobotError):
    """Wrong use or bad input."""

    exit_code = 2


class RecordingError(BadRobotInput):
    """A recording is not usable, or does not fit what is to be appended."""


class ImporterError(BadRobotInput):
    """A data set to import is not what its importer reads."""


class UnknownName(BadRobotInput):
    """No driver or importer has this name; the message lists the known ones."""


class RobotConfigError(BadRobotInput):
    """A setting is unknown or out of range."""


class SceneError(BadRobotInput):
    """A scene is impossible: what is asked of the simulation cannot be on a rig."""
