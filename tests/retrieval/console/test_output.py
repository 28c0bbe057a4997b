"""What reaches a terminal: names of strangers never obeyed, never hidden, on any terminal and where none is."""

import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from retrieval.commands.main import main
from retrieval.console.output import PrintableFormatter, print_json, printable, say, show

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(
    ("name", "seen"),
    [
        ("mug", "mug"),
        ("Tür 茶碗 ☕", "Tür 茶碗 ☕"),
        ("wide\u3000space", "wide\u3000space"),
        ("\x1b[31mred\x1b]0;title\x07", "\\x1b[31mred\\x1b]0;title\\x07"),
        ("\x9b31m", "\\x9b31m"),  # the same in one character, C1
        ("a\u202etxt.gnp", "a\\u202etxt.gnp"),
        ("zero\u200bwidth\ufeff", "zero\\u200bwidth\\ufeff"),
        ("two\nlines\r\t", "two\\nlines\\r\\t"),
        ("line\u2028end", "line\\u2028end"),
        ("m\udcfcg", "m\\udcfcg"),
        ("\x7f", "\\x7f"),
    ],
)
def test_what_a_terminal_would_obey_or_hide_is_shown_as_an_escape(name, seen):
    assert printable(name) == seen


@given(st.text())
def test_what_is_printed_is_one_line_that_any_coding_of_unicode_holds(text):
    assert len(printable(text).splitlines()) <= 1
    printable(text).encode("utf-8")


def test_everything_that_is_said_goes_the_same_way(capsys):
    say("said \x1b[1m")
    show("shown \x1b[1m")
    print_json({"exact": "\x1b[1m"})
    record = logging.LogRecord("x", logging.WARNING, "", 0, "logged %s", ("\x1b[1m",), None)
    assert PrintableFormatter("%(message)s").format(record) == "logged \\x1b[1m"
    out, err = capsys.readouterr()
    assert err == "said \\x1b[1m\n"
    assert out == 'shown \\x1b[1m\n{"exact": "\\u001b[1m"}\n'


def test_errors_of_commands_and_of_their_words_are_escaped(tmp_path, capsys):
    name = f"{tmp_path}/\x1b[2J\nretrieve check: 0 error(s)"
    assert main(["check", name]) == 2
    assert main(["check", name, "\x1b[31m"]) == 2
    assert main(["\x1b[31m"]) == 2
    assert main(["query", "--top", "\x1b[31m"]) == 2
    assert main(["train", "--task", "\x1b[31m"]) == 2
    err = capsys.readouterr().err
    assert "\x1b" not in err
    assert not any(line.startswith("retrieve check: 0 error(s)") for line in err.splitlines())


def test_a_terminal_of_plain_ascii_is_shown_escapes():
    code = r"from retrieval.console.output import *; prepare_streams(); show('T\xfcr \u2615'); say('\u8336')"
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, timeout=60, check=False
    )
    assert (done.stdout, done.stderr) == (b"T\\xfcr \\u2615\n", b"\\u8336\n")


SPEAKING = """
import sys
from retrieval.commands.main import main
from retrieval.console.output import say
from robot.drivers import discover
discover.discover = lambda: say("said") or []
sys.exit(main(["rig", "check", "--json"]))
"""


@pytest.mark.parametrize(
    ("streams", "code", "said"),
    [
        (">/dev/full", 1, "said\nretrieve rig: standard output cannot be written: No space left on device\n"),
        ("2>/dev/full", 0, '{"found": []}\n'),
        (">&-", 0, "said\n"),
        (">&- 2>&-", 0, ""),
    ],
)
def test_streams_that_are_full_or_closed_are_told_or_fail_nothing(streams, code, said):
    command = f'"$0" -c "$1" {streams}'
    done = subprocess.run(
        ["sh", "-c", command, sys.executable, SPEAKING], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout + done.stderr) == (code, said)
