"""Words of summaries and messages."""


def counted(number: int | float, noun: str) -> str:
    """A number and its noun, which has an s unless there is one: ``1 scan``, ``2 scans``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
