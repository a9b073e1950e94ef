"""Stamps of scans and poses from files of stamps, lists of files, and names of files."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steelnb.datatypes import Array
from steelnb.errors import FileContentError, FileMissingError

STAMP_FILES = ("timestamps.txt", "times.txt", "stamps.csv", "timestamps.csv", "times.csv")
NANO = 10**9
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?nan|[+-]?inf(?:inity)?", re.IGNORECASE)
_DATE = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(?:\.\d+)?")
_IN_NAME = re.compile(r"\d+(?:\.\d+)?")
_UNITS = ((10**17, NANO), (10**14, 10**6), (10**11, 10**3))
"""Whole numbers from the first on are in parts of a second, as many as the second: a clock's seconds since 1970 have
ten digits, and no flight takes a thousand years."""


def read_stamps(path: Path) -> Array:
    """The stamps of a file in its order, ``(N,)`` seconds: the first entry of each line, behind a header or none.

    Seconds, whole milli-, micro- or nanoseconds since 1970, told apart by their size, or dates (UTC). Raises
    `FileMissingError`, and `FileContentError` with the number of a line that does not begin with a stamp.
    """
    stamps = [stamp for stamp, _ in read_list(path)]
    if not stamps:
        raise FileContentError(f"{path}: no line with a stamp; expected one for each scan")
    return np.array(stamps)


def read_list(path: Path) -> list[tuple[float, str]]:
    """Stamp and what follows it, as in TUM's ``depth.txt``: ``1305031102.160407 depth/1305031102.160407.png``."""
    found: list[tuple[float, str]] = []
    for number, line in text_lines(path):
        date = _DATE.match(line)
        word = date[0] if date else re.split(r"[\s,;]", line, maxsplit=1)[0]
        try:
            found.append((_date(word) if date else seconds(word), line[len(word) :].strip(" ,;\t")))
        except ValueError:
            if found or word[:1].isdigit():
                shown = line if len(line) <= 60 else f"{line[:57]}..."
                raise FileContentError(f"{path}, line {number}: {shown!r}; expected a stamp in front") from None
    return found


def seconds(word: str) -> float:
    """A stamp in seconds from text. Raises ValueError where it is no number."""
    if not _NUMBER.fullmatch(word) or not word.isascii():
        raise ValueError(word)
    if len(word) < 40 and word.lstrip("+-").isdigit():
        whole = int(word)
        return whole / next((parts for least, parts in _UNITS if abs(whole) >= least), 1)
    return float(word)


def nanoseconds(stamp_s: float) -> int:
    """The nearest whole number of nanoseconds; a product of floating point numbers would miss it by a hundred."""
    return round(Decimal(stamp_s) * NANO)


def name_of(stamp_s: float) -> str:
    """A file's name for a stamp, which sorts by stamp and holds nanoseconds: ``0000000012.200000000``."""
    whole, rest = divmod(nanoseconds(stamp_s), NANO)
    return f"{whole:010d}.{rest:09d}"


def stamps_of_names(names: Sequence[str]) -> Array | None:
    """Stamps ``(N,)`` that are the last numbers of names without ending, or None where those only count the files.

    Numbers with a decimal point, or of the size of a clock's seconds since 1970 and their parts, are stamps.
    """
    words = [found[-1] if (found := _IN_NAME.findall(name)) else "" for name in names]
    if not words or not all("." in word or len(word.lstrip("0")) >= 10 for word in words):
        return None
    return np.array([seconds(word) for word in words])


def stamps_beside(path: Path) -> Path | None:
    """The file of stamps in a folder, or in that of a file."""
    folder = path if path.is_dir() else path.parent
    return next((folder / name for name in STAMP_FILES if (folder / name).is_file() and folder / name != path), None)


def rising(stamp_s: Array, skipped: Counter[str], what: str = "", missing: str = "") -> NDArray[np.bool_]:
    """Which stamps ``(N,)`` are later than all before them; the others are counted, ``what`` in front of the reason.

    ``missing`` is the whole reason of those that are not finite, if they have one of their own.
    """
    finite = np.isfinite(stamp_s)
    latest = np.maximum.accumulate(np.where(finite, stamp_s, -np.inf))
    before = np.concatenate([[-np.inf], latest[:-1]])
    reasons = {
        missing or f"{what}stamp not finite": ~finite,
        f"{what}duplicate stamp": finite & (stamp_s == before),
        f"{what}time ran backwards": finite & (stamp_s < before),
    }
    for reason, which in reasons.items():
        if which.any():
            skipped[reason] += int(which.sum())
    return np.asarray(finite & (stamp_s > before))


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Number and text of all lines but comments (``#``) and blank ones."""
    try:
        data = path.read_bytes()
    except OSError as fault:
        raise FileMissingError(f"{path}: {fault.strerror or fault}; expected a text file") from None
    if b"\0" in data:
        raise FileContentError(f"{path}: holds zero bytes; expected text")
    for number, line in enumerate(data.decode("utf-8-sig", errors="replace").split("\n"), start=1):
        text = line.partition("#")[0].strip()
        if text:
            yield number, text


def _date(word: str) -> float:
    whole, _, rest = word.partition(".")
    moment = datetime.fromisoformat(whole.replace(" ", "T")).replace(tzinfo=UTC)
    return float(Decimal(int(moment.timestamp())) + Decimal(f"0.{rest or 0}"))
