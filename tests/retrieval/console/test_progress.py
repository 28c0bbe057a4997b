"""The progress of long work: lines in a pipe, a bar on a terminal."""

from contextlib import suppress

import pytest

from retrieval.console import progress
from retrieval.console.progress import Bar


@pytest.fixture
def clock(monkeypatch):
    """A fake clock; the test sets `clock[0]`."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_line_comes_every_fifteen_seconds_and_at_the_end(clock, capsys):
    with Bar("train", 40, "steps") as bar:
        for _ in range(40):
            clock[0] += 1.0
            bar.advance(note="loss 0.5")
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [
        "train: 16/40 steps, 1.0 per second, 24 s left  loss 0.5",
        "train: 32/40 steps, 1.0 per second, 8 s left  loss 0.5",
        "train: 40/40 steps, 1.0 per second, 0 s left  loss 0.5",
    ]


def test_resumed_work_is_counted_in_full_and_timed_from_its_resumption(clock, capsys):
    with Bar("embed", 100, "photos", done=60) as bar:
        clock[0] += 20.0
        bar.advance(10)
    assert capsys.readouterr().err == "embed: 70/100 photos, 0.5 per second, 60 s left\n"


def test_the_first_call_of_show_states_the_total(clock, capsys):
    with Bar("collect", 0, "grasps") as bar:
        clock[0] += 60.0  # what comes before the first call is not counted
        bar.show(2, 4)
        clock[0] += 4.0
        bar.show(4, 4, "held")
    assert capsys.readouterr().err == "collect: 4/4 grasps, 0.5 per second, 0 s left  held\n"


def test_a_terminal_shows_a_bar_that_stops_even_after_an_error(monkeypatch, capsys):
    monkeypatch.setattr(progress.sys.stderr, "isatty", lambda: True, raising=False)
    with suppress(KeyError), Bar("train", 5, "steps", done=2) as bar:
        bar.advance(note="loss 0.25")
        raise KeyError
    out, err = capsys.readouterr()
    assert out == ""
    assert all(words in err for words in ("train", "3/5", "loss 0.25"))
    assert not bar._rich.live.is_started
