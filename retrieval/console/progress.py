"""Progress of long work on stderr: a bar with the remaining time on a terminal, else a line every 15 s."""

import sys
import time
from typing import Any

from retrieval.console.output import printable, say


class Bar:
    """A progress bar, used as a context manager.

    Args:
        title: Name of the work.
        total: Number of units of work.
        unit: Name of the units.
        done: Number of finished units; above 0 if work resumes.
        quiet: Whether to print nothing.
    """

    _LINE_EVERY_S = 15.0

    def __init__(self, title: str, total: int, unit: str, *, done: int = 0, quiet: bool = False) -> None:
        self.title, self.total, self.unit, self.done = title, total, unit, done
        self._first, self._start, self._last_line = done, time.monotonic(), time.monotonic()
        self._rich: Any = None
        self._quiet = quiet

    def __enter__(self) -> "Bar":
        if sys.stderr.isatty() and not self._quiet:
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as RichProgress
            from rich.table import Column

            # On a narrow terminal, shorten the bar; by default rich cuts the numbers first.
            self._rich = RichProgress(
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                MofNCompleteColumn(table_column=Column(no_wrap=True)),
                TextColumn(f"{self.unit}  {{task.fields[note]}}", markup=False),
                TimeRemainingColumn(table_column=Column(no_wrap=True)),
                console=Console(stderr=True),
            )
            self._rich.start()
            self._task = self._rich.add_task(self.title, total=self.total, completed=self.done, note="")
        return self

    def advance(self, count: int = 1, note: str = "") -> None:
        """Add `count` finished units; `note` shows the latest figures."""
        self.done += count
        if self._rich:
            self._rich.update(self._task, advance=count, note=printable(note))
        elif not self._quiet and (time.monotonic() - self._last_line > self._LINE_EVERY_S or self.done == self.total):
            self._last_line = time.monotonic()
            rate = (self.done - self._first) / max(time.monotonic() - self._start, 1e-9)
            left_s = (self.total - self.done) / rate if rate else float("nan")
            text = f"{self.title}: {self.done}/{self.total} {self.unit}, {rate:.1f} per second, {left_s:.0f} s left"
            say(f"{text}  {note}".rstrip())

    def __exit__(self, *error: object) -> None:
        if self._rich:
            self._rich.stop()


class CountedBar:
    """A progress bar that is created at its first call.

    Args:
        title: Name of the work.
        unit: Name of the units.
    """

    def __init__(self, title: str, unit: str) -> None:
        self.title, self.unit = title, unit
        self._bar: Bar | None = None

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """Show `done` of `total` units; `note` shows the latest figures."""
        if self._bar is None:
            self._bar = Bar(self.title, total, self.unit, done=done).__enter__()
        self._bar.advance(done - self._bar.done, note)

    def __enter__(self) -> "CountedBar":
        return self

    def __exit__(self, *error: Any) -> None:
        if self._bar is not None:
            self._bar.__exit__(*error)
