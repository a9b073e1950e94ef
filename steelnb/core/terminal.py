"""What a command tells its user on a terminal: progress and warnings."""

import io
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO


def prepare_terminal() -> None:
    """Show ``?`` for characters that the terminal's encoding lacks, and each warning of Python as one line. Nothing is
    shown on a stream that is closed, as by ``2>&-``."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 kept until the command ends
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    warnings.showwarning = lambda message, *_: warn(str(message))


def say(text: str, file: TextIO | None = None) -> None:
    """Print text to stdout, or to another stream, at once. If that fails, nothing more is printed and the command goes
    on; a reader that has gone, as that of ``| head -1``, is no fault."""
    stream = file or sys.stdout
    try:
        print(text, file=stream, flush=True)
    except OSError as fault:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())  # what is still in the buffer goes there
        os.close(null)
        if not isinstance(fault, BrokenPipeError):
            warn(f"stdout: {fault.strerror}; what follows is not printed")


def warn(*messages: str) -> None:
    """Print warnings to stderr, one line each."""
    for message in messages:
        say(f"steelnb: warning: {message}", sys.stderr)


@contextmanager
def progress() -> Iterator[tuple[Callable[[str], None], Callable[[float], None]]]:
    """A tqdm progress bar, on a terminal only. Yields two functions: one starts a stage by its name, the other sets the
    completed share of that stage, 0 to 1."""
    from tqdm import tqdm

    bar_format = "{desc}: {percentage:3.0f}% {elapsed}<{remaining}"
    with tqdm(total=1.0, desc="loading libraries", leave=False, disable=None, bar_format=bar_format) as bar:

        def on_stage(name: str) -> None:
            bar.set_description_str(name, refresh=False)
            bar.reset(total=1.0)

        yield on_stage, lambda share: bar.update(share - bar.n)
