"""What a command tells its user on a terminal: progress and warnings."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


def warn(*messages: str) -> None:
    """Print warnings to stderr, one line each."""
    for message in messages:
        print("steelnb: warning:", message, file=sys.stderr)


@contextmanager
def progress() -> Iterator[tuple[Callable[[str], None], Callable[[float], None]]]:
    """A tqdm progress bar, on a terminal only. Yields two functions: one starts a stage by its name, the other sets the
    completed share of that stage, 0 to 1."""
    from tqdm import tqdm

    bar_format = "{desc}: {percentage:3.0f}% {elapsed}<{remaining}"
    with tqdm(total=1.0, desc="loading libraries", leave=False, disable=None, bar_format=bar_format) as bar:

        def on_stage(name: str) -> None:
            bar.set_description(name, refresh=False)
            bar.reset(total=1.0)

        yield on_stage, lambda share: bar.update(share - bar.n)
