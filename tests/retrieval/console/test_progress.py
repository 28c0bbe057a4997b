"""The progress of long work: a line for each stage, and a bar on a terminal."""

from contextlib import suppress

import pytest

import retrieval
from retrieval.console import progress
from retrieval.console.progress import Bar, show_progress


@pytest.fixture(autouse=True)
def shown():
    show_progress()


@pytest.fixture
def clock(monkeypatch):
    """A fake clock; the test sets `clock[0]`."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


@pytest.fixture
def verbose(monkeypatch):
    monkeypatch.setattr(Bar, "is_verbose", True)


def work(clock, seconds=40):
    """Train for some seconds, with a stage within it."""
    with Bar("training", seconds, "steps") as bar:
        for _ in range(seconds):
            clock[0] += 1.0
            bar.advance(note="loss 0.5")
        with Bar("encoding", 4, "photos") as inner:
            clock[0] += 5.0
            inner.advance(4)


def test_a_long_stage_prints_a_line_every_fifteen_seconds_and_at_its_end(clock, capsys):
    work(clock)
    assert capsys.readouterr() == (
        "",
        "training: 16 of 40 steps, 24 s left\ntraining: 32 of 40 steps, 8 s left\ntraining: 40 steps in 45 s\n",
    )


def test_python_shows_progress_only_while_its_switch_is_on(clock, capsys):
    show_progress(False)
    work(clock)
    assert capsys.readouterr().err == ""
    retrieval.show_progress()
    work(clock)
    assert "training: 40 steps in 45 s\n" in capsys.readouterr().err


def test_a_verbose_command_shows_figures_and_the_stages_within_a_stage(clock, capsys, verbose):
    work(clock)
    assert capsys.readouterr().err.splitlines() == [
        "training: 16 of 40 steps, 24 s left (loss 0.5)",
        "training: 32 of 40 steps, 8 s left (loss 0.5)",
        "encoding: 4 photos in 5 s",
        "training: 40 steps in 45 s (loss 0.5)",
    ]


def test_a_stage_shows_its_progress_during_the_stages_within_it(clock, capsys):
    with Bar("evaluating", 3, "fits") as bar:
        clock[0] += 10.0
        bar.advance()
        with Bar("training", 2, "steps") as inner:
            clock[0] += 10.0
            inner.advance()
            clock[0] += 20.0
            inner.advance()
        bar.advance(2)
    assert capsys.readouterr().err.splitlines() == [
        "evaluating: 1 of 3 fits, 10 s left; training: 1 of 2 steps",
        "evaluating: 1 of 3 fits; training: 2 of 2 steps",  # the estimate has passed
        "evaluating: 3 fits in 40 s",
    ]


def test_a_short_stage_prints_nothing(clock, capsys):
    with Bar("encoding", 4, "photos") as bar:
        clock[0] += 1.9
        bar.advance(4)
    assert capsys.readouterr().err == ""


def test_the_time_left_is_shown_once_it_is_known(clock, capsys):
    with Bar("embedding", 100, "photos", done=60) as bar:
        clock[0] += 20.0
        bar.advance(0)
        clock[0] += 180.0
        bar.advance(10)
    assert capsys.readouterr().err.splitlines() == [
        "embedding: 60 of 100 photos",
        "embedding: 70 of 100 photos, 10 min left",
        "embedding: 10 photos in 3 min",
    ]


def test_the_first_call_of_show_states_the_total(clock, capsys):
    with Bar("collecting", 0, "grasps") as bar:
        clock[0] += 60.0  # what comes before the first call is not counted
        bar.show(2, 4)
        clock[0] += 4.0
        bar.show(4, 4)
    assert capsys.readouterr().err == "collecting: 2 grasps in 4 s\n"


def test_a_terminal_shows_a_bar_that_stops_even_after_an_error(monkeypatch, capsys):
    monkeypatch.setattr(progress.sys.stderr, "isatty", lambda: True, raising=False)
    with suppress(KeyError), Bar("training", 5, "steps", done=2) as bar:
        bar.advance()
        raise KeyError
    out, err = capsys.readouterr()
    assert out == ""
    assert all(words in err for words in ("training", "3/5"))
    assert not bar._rich.live.is_started
