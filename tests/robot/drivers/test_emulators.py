"""The emulators run as programs, as the documentation says."""

import signal
import sys

import pytest

from tests.waiting import first_line, run_process


@pytest.mark.parametrize(
    ("arguments", "address"),
    [
        (["wsg50.server", "--port", "0", "--object-mm", "40"], "127.0.0.1:"),
        (["sawyer.server", "--port", "0"], "ws://127.0.0.1:"),
    ],
)
def test_an_emulator_prints_its_address_and_ends_with_ctrl_c(arguments, address):
    module, *options = arguments
    with run_process([sys.executable, "-m", f"tests.emulators.{module}", *options]) as process:
        assert first_line(process).startswith(address)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 0
