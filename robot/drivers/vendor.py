"""What drivers over a maker's package share: its exceptions, and starting again."""

import contextlib
from collections.abc import Callable, Iterator

from robot.errors import DeviceError


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
