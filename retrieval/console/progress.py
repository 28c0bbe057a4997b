"""Progress on stderr: one line for each stage of a command, and the time left of a long one.

The command line shows progress; Python code does so after `show_progress` (`Bar.is_on`). A stage within another one,
and the figures of a stage, are shown with `--verbose` (`Bar.is_verbose`) only.
"""

import sys
import time
from typing import Any, ClassVar, Self

from retrieval.console.output import printable, say

_LINE_EVERY_S = 15.0
_SHORT_S = 2.0
"""A stage that ends sooner prints no line without `--verbose`."""


class Bar:
    """A stage of work, used as a context manager: a bar on a terminal while it runs, and a line at its end.

    Args:
        title: What the stage does, such as "embedding".
        total: Number of units of work; 0 if the first `show` states it.
        unit: Name of the units.
        done: Number of finished units; above 0 if work resumes.
    """

    is_on: ClassVar[bool] = False
    """Whether this process shows progress."""
    is_verbose: ClassVar[bool] = False
    """Whether every stage prints its lines and figures; there is then no bar."""
    _running: ClassVar["Bar | None"] = None
    """The innermost stage that is shown."""

    def __init__(self, title: str, total: int, unit: str, *, done: int = 0) -> None:
        self.title, self.total, self.unit, self.done, self.note = title, total, unit, done, ""
        self._first, self._start = done, time.monotonic()
        self._last_line = self._last_advance = self._start
        self._rich: Any = None
        self._outer = Bar._running
        self._is_shown = self.is_on and (self.is_verbose or not self._outer)

    def __enter__(self) -> Self:
        Bar._running = self if self._is_shown else self._outer
        if self.total and self._is_shown and not self.is_verbose and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
            from rich.table import Column

            # On a narrow terminal, shorten the bar; by default rich cuts the numbers first.
            self._rich = Progress(
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                MofNCompleteColumn(table_column=Column(no_wrap=True)),
                TextColumn(self.unit, markup=False),
                TimeRemainingColumn(table_column=Column(no_wrap=True)),
                console=Console(stderr=True),
                transient=True,
                refresh_per_second=2,  # commands measure times meanwhile
            )
            self._rich.start()
            self._task = self._rich.add_task(printable(self.title), total=self.total, completed=self.done)
        return self

    def advance(self, count: int = 1, note: str = "") -> None:
        """Add `count` finished units; `note` has the latest figures."""
        self.done, self.note = self.done + count, note
        if count:
            self._last_advance = time.monotonic()
        if self._outer and not self._is_shown:
            self._outer._show_part(f"; {self.title}: {self.done} of {self.total} {self.unit}")
        elif self._rich:
            self._rich.update(self._task, advance=count)
        else:
            self._show_part("")

    def _show_part(self, inner: str) -> None:
        """Print a line if the last one is old; `inner` is the progress of a stage within this one."""
        now = time.monotonic()
        if self._rich or not self._is_shown or now - self._last_line <= _LINE_EVERY_S or self.done >= self.total:
            return
        self._last_line, finished = now, self.done - self._first
        left_s = (self._last_advance - self._start) * (self.total - self.done) / max(finished, 1)
        left_s -= now - self._last_advance
        left = f", {_duration(left_s)} left" if finished and left_s > 0 else ""
        self._say(f"{self.done} of {self.total} {self.unit}{left}{inner}")

    def show(self, done: int, total: int, note: str = "") -> None:
        """Show `done` of `total` units; the bar begins at the first call."""
        if not self.total:
            self.total, self.done, self._first = total, done, done
            self._start = self._last_line = self._last_advance = time.monotonic()
            self.__enter__()
        self.advance(done - self.done, note)

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        Bar._running = self._outer
        if self._rich:
            self._rich.stop()
        took_s = time.monotonic() - self._start
        if (took_s >= _SHORT_S or self.is_verbose) and self._is_shown and not error and self.done > self._first:
            self._say(f"{self.done - self._first} {self.unit} in {_duration(took_s)}")

    def _say(self, text: str) -> None:
        say(f"{self.title}: {text}" + f" ({self.note})" * bool(self.note and self.is_verbose))


def show_progress(is_shown: bool = True) -> None:
    """Show the progress of long work, such as a training, on stderr from now on; the command line always shows it.

    Args:
        is_shown: False to show no progress from now on.

    >>> retrieval.show_progress()
    >>> report = retrieval.build_index("catalog", retrieval.load_checkpoint("model.safetensors"), "index")
    >>> retrieval.show_progress(False)
    """
    Bar.is_on = is_shown


def _duration(seconds: float) -> str:
    return f"{max(seconds, 1):.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
