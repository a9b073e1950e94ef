"""Words of tables."""

UNITS = {"m": "m", "deg": "°", "s": "s"}
"""Last part of a column's name → its unit."""


def worded(column: str) -> str:
    """The name of a column in words, its unit in brackets: *edge recall* for ``edge_recall``, *offset p90 (m)* for
    ``offset_p90_m``."""
    name, _, unit = column.rpartition("_")
    words = f"{name} ({UNITS[unit]})" if unit in UNITS else column
    return words.replace("_", " ").replace("ate rmse", "ATE")
