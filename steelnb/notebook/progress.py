"""Progress of a notebook, for its reader and for the workflow."""

import math
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

PROGRESS_VARIABLE = "STEELNB_PROGRESS_FILE"
PROGRESS_PERIOD_S = 0.2
Item = TypeVar("Item")


class Progress:
    """Progress of a notebook over ``total`` runs of equal length; one object per notebook.

    `update` sets the completed fraction of the current run. Calling the object does the same, so it can be passed as a
    callback. `step` ends a run, and `each` ends one per item of a sequence. JupyterLab shows a bar; if the workflow
    sets ``STEELNB_PROGRESS_FILE``, the overall percentage is written to that file instead.
    """

    def __init__(self, total: int = 1, description: str = "progress") -> None:
        from tqdm.auto import tqdm

        self._total, self._done, self._shown_s = max(total, 1), 0, -math.inf
        self._file = os.environ.get(PROGRESS_VARIABLE)
        form = "{desc}: {percentage:3.0f}% |{bar}| {elapsed} < {remaining}"
        self._bar: Any = tqdm(total=1.0, desc=description, bar_format=form, disable=self._file is not None)

    def update(self, fraction: float) -> None:
        """Set the completed fraction of the current run, 0 to 1. It is shown at most five times per second."""
        whole = min((self._done + min(max(fraction, 0.0), 1.0)) / self._total, 1.0)
        now_s = time.monotonic()
        if whole < 1 and now_s - self._shown_s < PROGRESS_PERIOD_S:
            return
        self._shown_s = now_s
        if self._file:
            Path(self._file).write_text(f"{whole:.0%}", encoding="utf-8")
        self._bar.n = whole
        self._bar.refresh()
        if whole == 1:
            self._bar.close()

    __call__ = update

    def step(self) -> None:
        """End the current run; the next begins."""
        self._done += 1
        self.update(0.0)

    def each(self, items: Iterable[Item]) -> Iterator[Item]:
        """Yield the items one by one, each as one run."""
        for item in items:
            yield item
            self.step()
