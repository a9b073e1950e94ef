"""The stage that a command has reached, on stderr: on a terminal a line that moves, otherwise a line now and then."""

import contextlib
import sys
import time
from collections.abc import Iterator
from datetime import timedelta
from typing import Any

LINE_PERIOD_S = 10.0
REFRESH_HZ = 4.0


class Progress:
    """With ``bars``, rich's, one line of a terminal that a thread keeps moving and that is gone at the end; without
    them a line on stderr now and then, none in the first `LINE_PERIOD_S`: what is wrong at once is told in one line
    alone."""

    def __init__(self, bars: Any = None) -> None:
        self._bars, self._task = bars, bars.add_task("") if bars else None
        self._shown_s, self._stage, self._began_s = time.monotonic(), "", 0.0

    def show(self, stage: str, share: float | None = None) -> None:
        """Show a stage and, where it is known, the share of it that is done, 0 to 1."""
        now_s, text = time.monotonic(), stage
        if stage != self._stage:
            self._stage, self._began_s = stage, now_s
            if self._bars:  # a task that was done once stands still
                self._bars.remove_task(self._task)
                self._task = self._bars.add_task(stage, total=None)
        if share:
            left = timedelta(seconds=round((now_s - self._began_s) * (1 / share - 1)))
            text = f"{stage}: {share:.0%}, {left} left"
        if self._bars:
            total = None if share is None else 1.0  # without one, the bar pulses
            self._bars.update(self._task, description=text, total=total, completed=share or 0.0)
        elif now_s - self._shown_s >= LINE_PERIOD_S:
            self._shown_s = now_s
            self.say(text)

    def share(self, share: float) -> None:
        """Show how much of the stage shown last is done, 0 to 1."""
        self.show(self._stage, share)

    def say(self, line: str) -> None:
        """Print a line that stays to stderr."""
        if self._bars:
            self._bars.console.print(line, markup=False)
        else:
            print(line, file=sys.stderr, flush=True)


@contextlib.contextmanager
def progress(stage: str = "loading libraries") -> Iterator[Progress]:
    """Progress of a command; to be entered before anything is imported that takes long to load."""
    if not sys.stderr.isatty():
        yield Progress()
        return
    from rich.console import Console
    from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    columns = (SpinnerColumn(), TimeElapsedColumn(), BarColumn(), TextColumn("{task.description}", markup=False))
    console = Console(stderr=True, highlight=False)
    with Bars(*columns, console=console, transient=True, refresh_per_second=REFRESH_HZ) as bars:
        moving = Progress(bars)
        moving.show(stage)
        bars.refresh()
        yield moving
