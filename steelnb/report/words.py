"""Words of summaries and messages."""

UNITS = {"m": "m", "deg": "°", "s": "s"}
"""Last part of a column's name → its unit."""


def counted(number: int | float, noun: str) -> str:
    """A number and its noun, which has an s unless there is one: ``1 scan``, ``2 scans``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def worded(column: str) -> str:
    """The name of a column in words, its unit in brackets: *edge recall* for ``edge_recall``, *offset p90 (m)* for
    ``offset_p90_m``."""
    name, _, unit = column.rpartition("_")
    words = f"{name} ({UNITS[unit]})" if unit in UNITS else column
    return words.replace("_", " ").replace("ate rmse", "ATE")
