"""What drivers over a maker's package share: its exceptions, its numbers, waiting, and starting again."""

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator

from robot.drivers.frames import MOST_S
from robot.errors import DeviceError
from robot.settings import check_range

_MOST_WARMUP = 1000


def check_waits(warmup_frames: int, timeout_s: float) -> None:
    """Raise RobotConfigError for waits that never end or that the system cannot make."""
    check_range("warmup_frames", warmup_frames, 0, _MOST_WARMUP)
    check_range("timeout_s", timeout_s, 1e-3, MOST_S, "s")


def finite(what: str, numbers: Iterable[float]) -> list[float]:
    """What a camera says of itself. Raises DeviceError for NaN or infinity."""
    found = [float(each) for each in numbers]
    if not all(map(math.isfinite, found)):
        raise DeviceError(f"{what} must be finite numbers, got {found}; plug the camera in again")
    return found


@contextlib.contextmanager
def vendor_errors(failure: str) -> Iterator[None]:
    """A DeviceError that begins with `failure` for whatever a maker's package raises; OSError and ours pass."""
    try:
        yield
    except (DeviceError, OSError):
        raise
    except Exception as error:
        raise DeviceError(f"{failure}: {error or type(error).__name__}") from error


def start_again(close: Callable[[], None], connect: Callable[[], None]) -> None:
    """Close whatever can be closed, then connect whole or not at all. Raises what `connect` raises."""
    with contextlib.suppress(DeviceError, OSError):
        close()
    try:
        connect()
    except BaseException:
        with contextlib.suppress(DeviceError, OSError):
            close()
        raise
