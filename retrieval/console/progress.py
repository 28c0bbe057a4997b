"""Progress of long work on stderr: a bar with the remaining time on a terminal, else a line every 15 s."""

import sys
import time
from typing import Any

from retrieval.console.output import printable, say

_LINE_EVERY_S = 15.0


class Bar:
    """A progress bar, used as a context manager.

    Args:
        title: Name of the work.
        total: Number of units of work; 0 if the first `show` states it.
        unit: Name of the units.
        done: Number of finished units; above 0 if work resumes.
        quiet: Whether to print nothing.
    """

    def __init__(self, title: str, total: int, unit: str, *, done: int = 0, quiet: bool = False) -> None:
        self.title, self.total, self.unit, self.done = title, total, unit, done
        self._first, self._start, self._last_line = done, time.monotonic(), time.monotonic()
        self._rich: Any = None
        self._quiet = quiet

    def __enter__(self) -> "Bar":
        if self.total and not self._quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
            from rich.table import Column

            # On a narrow terminal, shorten the bar; by default rich cuts the numbers first.
            self._rich = Progress(
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
        elif not self._quiet and (time.monotonic() - self._last_line > _LINE_EVERY_S or self.done == self.total):
            self._last_line = time.monotonic()
            rate = (self.done - self._first) / max(time.monotonic() - self._start, 1e-9)
            left_s = (self.total - self.done) / rate if rate else float("nan")
            text = f"{self.title}: {self.done}/{self.total} {self.unit}, {rate:.1f} per second, {left_s:.0f} s left"
            say(f"{text}  {note}".rstrip())

    def show(self, done: int, total: int, note: str = "") -> None:
        """Show `done` of `total` units; the bar begins at the first call."""
        if not self.total:
            self.total, self.done, self._first = total, done, done
            self._start = self._last_line = time.monotonic()
            self.__enter__()
        self.advance(done - self.done, note)

    def __exit__(self, *error: object) -> None:
        if self._rich:
            self._rich.stop()
