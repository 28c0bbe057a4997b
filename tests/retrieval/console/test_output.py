"""Terminal output: control characters in names are escaped, on terminals, in pipes and on closed streams."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from retrieval.commands.main import main
from retrieval.console.output import print_json, printable, say, show

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("mug", "mug"),
        ("Tür 茶碗 ☕", "Tür 茶碗 ☕"),
        ("\x1b[31mred\x1b]0;title\x07", "\\x1b[31mred\\x1b]0;title\\x07"),
        ("a\u202etxt.gnp", "a\\u202etxt.gnp"),
        ("two\nlines\r\t", "two\\nlines\\r\\t"),
        ("line\u2028end", "line\\u2028end"),
        ("m\udcfcg", "m\\udcfcg"),
    ],
)
def test_control_characters_and_hidden_characters_are_escaped(name, shown):
    assert printable(name) == shown


def test_all_output_functions_escape_their_text(capsys):
    say("printed \x1b[1m")
    show("shown \x1b[1m")
    print_json({"exact": "\x1b[1m"})
    out, err = capsys.readouterr()
    assert err == "printed \\x1b[1m\n"
    assert out == 'shown \\x1b[1m\n{"exact": "\\u001b[1m"}\n'


def test_errors_of_commands_and_arguments_are_escaped(tmp_path, capsys):
    name = f"{tmp_path}/\x1b[2J\nretrieve check: 0 error(s)"
    assert main(["check", name]) == 2
    assert main(["check", name, "\x1b[31m"]) == 2
    assert main(["\x1b[31m"]) == 2
    assert main(["query", "--top", "\x1b[31m"]) == 2
    assert main(["train", "--task", "\x1b[31m"]) == 2
    err = capsys.readouterr().err
    assert "\x1b" not in err
    assert not any(line.startswith("retrieve check: 0 error(s)") for line in err.splitlines())


def test_an_ascii_terminal_gets_escapes_also_of_log_messages():
    code = "from retrieval.console.output import *; prepare_streams(); "
    code += r"show('T\xfcr \u2615'); logging.warning('\u8336\n')"
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, timeout=60, check=False
    )
    assert (done.stdout, done.stderr) == (b"T\\xfcr \\u2615\n", b"\\u8336\\n\n")


PRINTING = """
import sys
from retrieval.commands.main import main
from robot.drivers import discover
discover.find_cameras = lambda: [discover.DiscoveredCamera("/dev/x", "gel", "a = 1")]
sys.exit(main(["rig", "check"]))
"""
FOUND = "1 camera(s) found; copy the lines above into a rig file"


@pytest.mark.parametrize(
    ("streams", "code", "output"),
    [
        (">/dev/full", 1, "retrieve rig: Standard output cannot be written: No space left on device\n"),
        ("2>/dev/full", 0, "# gel\na = 1\n\n"),
        (">&-", 0, f"{FOUND}\n"),
        (">&- 2>&-", 0, ""),
    ],
)
def test_full_stdout_is_an_error_and_other_full_or_closed_streams_are_ignored(streams, code, output):
    command = f'"$0" -c "$1" {streams}'
    done = subprocess.run(
        ["sh", "-c", command, sys.executable, PRINTING], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout + done.stderr) == (code, output)
