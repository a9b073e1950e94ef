"""The command `steelnb`: Ctrl-C is one line from the first import on."""

import os
import signal
import sys


def _leave(*_: object) -> None:
    os.write(2, b"steelnb: error: interrupted before anything was done\n")
    os._exit(130)


def main() -> int:
    """Run the command line; the exit code."""
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if ours:  # an exception in the middle of an import ends in a traceback, or is lost in it
        signal.signal(signal.SIGINT, _leave)
    from steelnb import cli

    if ours:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
