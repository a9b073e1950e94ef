"""Words of summaries and messages."""

import difflib
from collections.abc import Iterable


def counted(number: int | float, noun: str) -> str:
    """A number and its noun, which has an s unless there is one: ``1 scan``, ``2 scans``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def guess(name: str, known: Iterable[str]) -> str:
    """`, did you mean ...?` where a known name is near, else nothing."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f", did you mean {near[0]!r}?" if near else ""
