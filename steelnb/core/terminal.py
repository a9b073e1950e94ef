"""What a command tells its user on a terminal: errors, warnings and progress."""

import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from steelnb.core.errors import InputError, SteelnbError

if TYPE_CHECKING:
    import typer


def call(app: "typer.Typer", name: str, arguments: list[str] | None) -> int:
    """Run a command line and return the exit code. User errors go to stderr, in one line each."""
    import typer

    prepare_terminal()
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        if any(not each.strip() or (each.startswith("--") and each.endswith("=")) for each in arguments):
            raise InputError("an empty argument; expected a name or a value")  # as a path, it would be this folder
        code = app(arguments, prog_name=name, standalone_mode=False)
    except (SteelnbError, typer.TyperException) as fault:
        message = fault.format_message() if isinstance(fault, typer.TyperException) else str(fault)
        say(f"{name}: error: {' '.join(message.split())[:1000]}", sys.stderr)
        return 2
    except OSError as fault:
        words = filter(None, (fault.filename, fault.strerror or fault))
        say(f"{name}: error: {': '.join(map(str, words))}", sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except SystemExit as ended:  # 1: the reader of a help text has gone, as that of `| head -1`
        code = 0 if ended.code == 1 else ended.code
    return int(code or 0)


def prepare_terminal() -> None:
    """Show ``?`` for characters that the terminal's encoding lacks, and each warning of Python as one line."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it says that a home is read-only, where caches are kept
    warnings.showwarning = lambda message, *_: warn(str(message))


def say(text: str, file: TextIO | None = None) -> None:
    """Print text to stdout, or to another stream, at once. If its reader has gone, as that of ``| head -1``, the
    command goes on, and nothing more is printed."""
    stream = file or sys.stdout
    try:
        print(text, file=stream, flush=True)
    except BrokenPipeError:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def warn(*messages: str) -> None:
    """Print warnings to stderr, one line each."""
    for message in messages:
        say(f"steelnb: warning: {' '.join(message.split())}", sys.stderr)


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
