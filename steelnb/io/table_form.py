"""The form of a table in a text file: its separator, the names and units of its columns, its comments and titles."""

import re
from datetime import UTC, datetime
from pathlib import Path

from steelnb.core.checks import shown
from steelnb.io.encodings import decoded, plain_nan
from steelnb.io.text import Table, is_number, split_cells

HEAD_BYTES, COLUMNS_MAX = 1 << 16, 1000
"""The form of a table is found in its first bytes; no table of points or poses has so many columns."""
COMMENT = re.compile(rb"^[ \t]*(?://|%|#)", re.MULTILINE)
SEPARATOR_LINE = re.compile(rb"sep=.\r?\n", re.IGNORECASE)
FORTRAN = re.compile(rb"(?<=[\d.])[dD](?=[+-]?\d)")
TIME = re.compile(rb"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?(?:Z|[+-]\d\d:?\d\d)?")
LISTS = re.compile(rb"^#[ \t]*((?:\w+, *){3,})\w+\[\].*$", re.MULTILINE)
"""A first line of spreadsheets, exponents of Fortran, times of ISO 8601, and a comment of COLMAP, whose lines end in
lists of any length."""
UNITS = {
    "m": "m meter meters metre metres", "mm": "mm", "cm": "cm", "km": "km", "ft": "ft feet", "s": "s sec secs seconds",
    "ms": "ms msec msecs millisec milliseconds", "us": "us µs usec usecs microsec microseconds",
    "ns": "ns nsec nsecs nanosec nanosecs nanoseconds", "deg": "deg degree degrees °", "rad": "rad radian radians",
}  # fmt: skip
UNIT_OF = {word: unit for unit, words in UNITS.items() for word in words.split()}
QUOTED = re.compile('"[^"]*"')
DECIMAL_COMMA = re.compile(r"[+-]?\d+(?:,\d+)?(?:[eE][+-]?\d+)?")
PROSE = {"and", "down", "forward", "is", "left", "of", "right", "the", "to", "up"}
"""Words that no column is named by, but sentences on axes have."""
HEADING = re.compile(r"^(?:the\s+)?(?:columns?|fields?|format|names?|header)\s+(?:are\s+)?", re.IGNORECASE)


def read_table(path: Path) -> Table:
    """Find the form of the table in a file. Its separator is what stands in its first line of numbers.

    The names of the columns stand in a line before it, of the nearest that has as many words as there are numbers, or
    in a comment before (``#``, ``//``, ``%``); a line of units may follow. Other lines before are titles. A first line
    with one integer is a count, and one with 0, 1, 2, … numbers the columns. Times (ISO 8601) become Unix seconds, UTC
    if they name no zone. Raises ValueError.
    """
    data = _plain_numbers(plain_nan(decoded(path.read_bytes())))
    lines, content = _head(data)
    if not content:
        raise ValueError("no line of numbers")
    texts = [line.decode("utf-8", "replace").strip() for line in lines]
    comments = [text.lstrip("#").strip() for text in texts[: content[0]] if text.startswith("#")]
    bodies = [texts[k].partition("#")[0].strip() for k in content]
    declared = None
    # A first line with one integer is a count, unless the table has one column.
    if len(bodies) > 1 and re.fullmatch("[0-9]{1,18}", bodies[0]) and re.search(r"\S[\s,;]+\S", bodies[1]):
        declared = int(bodies[0])
        content, bodies = content[1:], bodies[1:]
    begin = next((k for k, body in enumerate(bodies) if _is_of_numbers(_cells_of(body))), len(bodies))
    heads, content, bodies = list(zip(content, bodies, strict=True))[:begin], content[begin:], bodies[begin:]
    if not bodies:
        raise ValueError(f"{shown(heads[0][1])} and no line of numbers after it")
    heading = _cells_of(bodies[0])
    is_index = len(bodies) > 1 and heading[0] == "" and _counts(heading[1:])  # as pandas writes it
    if not heads and (is_index or (_counts(heading) and "," in bodies[0] and "." in "".join(bodies[1:2]))):
        content, bodies = content[1:], bodies[1:]
    separator, decimal = _separator(bodies[0])
    if "\t" in bodies[0] and any("\t" in text for _, text in heads):
        separator = "\t"  # the words of a name, and missing numbers, are kept together
    decimal = "," if _has_decimal_commas(bodies, separator) else decimal
    cells = split_cells(bodies[0], separator)
    if len(cells) > COLUMNS_MAX:
        raise ValueError(f"line {content[0] + 1} has {len(cells)} numbers; expected those of one point or pose a line")
    is_open = len(cells) > 1 and not cells[-1]
    names, units = _names(heads, {len(cells), len(cells) - is_open}, content[0])
    said = [_words(comment) for comment in reversed(comments)]
    in_comment = next((words for words in said if len(words) == len(cells)), [])
    plain = [_plain(name) for name in (in_comment if names is None else names)]
    first = content[0] if names is None else heads[-1][0] + 1  # a label below it may look like a comment
    skipped = sum(map(len, lines[:first]))
    return Table(
        data[skipped:] if skipped else data, len(cells), separator, decimal, tuple(name for name, _ in plain),
        tuple(unit or more for (_, unit), more in zip(plain, units or [""] * len(plain), strict=True)),
        names is not None, declared, first + 1, tuple(range(is_index, len(cells) - is_open)),
        tuple(_plain(word)[0] for words in said for word in words),
    )  # fmt: skip


def _plain_numbers(data: bytes) -> bytes:
    """The same text with comments after ``#``, exponents of C, times in seconds, and without lists at the ends of
    lines."""
    data = SEPARATOR_LINE.sub(b"", data, count=1) if data[:4].lower() == b"sep=" else data
    if b"/" in data or b"%" in data:
        data = COMMENT.sub(b"#", data)
    head = data[:HEAD_BYTES]
    if re.search(rb"\d\.\d*[dD][+-]?\d", head):
        data = FORTRAN.sub(b"e", data)
    if TIME.search(head):
        data = TIME.sub(lambda time: b"%.9f" % _unix_s(time[0].decode()), data)
    if lists := LISTS.search(head):
        names = lists[1].strip(b", ")
        cut = rb"^((?:[^\s#]\S*[ \t]+){%d}\S+).*$" % names.count(b",")
        data = re.sub(cut, rb"\1", data.replace(lists[0], b"# " + names, 1), flags=re.MULTILINE)
    return data


def _unix_s(time: str) -> float:
    found = datetime.fromisoformat(time)
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()


def _head(data: bytes) -> tuple[list[bytes], list[int]]:
    """The first lines of a table, at least two with more than a comment, and the numbers of those."""
    size = HEAD_BYTES
    while True:
        lines = data[:size].splitlines(keepends=True)
        lines = lines[:-1] if len(data) > size and len(lines) > 1 else lines
        content = [k for k, line in enumerate(lines) if line.partition(b"#")[0].strip()]
        if len(content) > 1 or size >= len(data):
            return lines, content
        size *= 4


def _cells_of(line: str) -> list[str]:
    """The fields of a line whose separator is not known yet."""
    return split_cells(line, "\t" if "\t" in line else _separator(line)[0])


def _is_of_numbers(cells: list[str]) -> bool:
    """Whether these are the fields of a line of numbers, of which some may be labels; a title may hold a year."""
    numbers = sum(any(is_number(cell, decimal) for decimal in ".,") for cell in cells)
    return numbers > 2 or 2 * numbers > len(cells)


def _names(heads: list[tuple[int, str]], counts: set[int], begin: int) -> tuple[list[str] | None, list[str]]:
    """The names of columns among the numbered lines before the first of numbers, or None, and the units of a line after
    them, or none. Raises ValueError for other lines after the names, and for names that are too few or too many."""
    split = [_cells_of(text) for _, text in heads]
    has_x = [any(_plain(cell)[0].endswith("x") for cell in cells) for cells in split]
    fitting = [k for k, cells in enumerate(split) if len(cells) in counts]
    chosen = max([k for k in fitting if has_x[k]] or fitting, default=None)
    if chosen is None:
        if any(has_x):
            words = split[max(k for k, is_so in enumerate(has_x) if is_so)]
            raise ValueError(f"{len(words)} names of columns, but {max(counts)} fields in line {begin + 1}")
        return None, []
    units: list[str] = []
    for (number, text), cells in zip(heads[chosen + 1 :], split[chosen + 1 :], strict=True):
        plain = [cell.strip("[]() ").lower() for cell in cells]
        if len(plain) != len(split[chosen]) or not all(word in UNIT_OF or not word.strip("-") for word in plain):
            raise ValueError(f"line {number + 1}: {shown(text)}; expected numbers")
        units = [UNIT_OF.get(word, "") for word in plain]
    return split[chosen], units


def _counts(cells: list[str]) -> bool:
    """Whether these are 0, 1, 2, …: columns without names."""
    return len(cells) > 2 and cells == [str(k) for k in range(len(cells))]


def _has_decimal_commas(lines: list[str], separator: str) -> bool:
    """Whether numbers in these lines have commas instead of points: between other separators or in quotes."""
    pattern = r'"[+-]?\d+,\d+' if separator == "," else r"\d,\d"
    if not any(re.search(pattern, line) for line in lines) or any(re.search(r"\d\.\d", line) for line in lines):
        return False
    return separator != " " or all(DECIMAL_COMMA.fullmatch(word) for line in lines for word in line.split())


def _words(comment: str) -> list[str]:
    """The words of a comment that could be names of columns: one of them is an x; units stay with their names."""
    comment = HEADING.sub("", comment.rpartition(":")[2].replace("|", " ").strip())
    words = split_cells(re.sub(r"\s+([\[(])", r"\1", comment), _separator(comment)[0])
    plain = [_plain(word)[0] for word in words]
    return words if any(word.endswith("x") for word in plain) and PROSE.isdisjoint(plain) else []


def _plain(name: str) -> tuple[str, str]:
    """A column's name and unit: "p_RS_R_x [m]" → ("p_rs_r_x", "m"), "stamp_ns" → ("stamp", "ns"), "X" → ("x", "")."""
    name, _, rest = name.strip("\"' \t").lower().replace("(", "[").partition("[")
    bracket = rest.rstrip("]) ")
    words = [word for word in re.split(r"[\W_]+", name) if word]
    if bracket and not bracket.isdecimal():
        return "_".join(words), UNIT_OF.get(bracket.strip(), bracket)
    words += [bracket] if bracket else []
    unit = UNIT_OF.get(words[-1], "") if words else ""
    words = words[:-1] if unit else words
    return "_".join(words[:-1] if len(words) > 1 and unit and words[-1] == "in" else words), unit


def _separator(line: str) -> tuple[str, str]:
    """Separator and decimal sign of a line of numbers."""
    line = QUOTED.sub("0", line)
    if ";" in line:
        return ";", "."
    words = line.split()
    if "," in line and len(words) > 2 and all(DECIMAL_COMMA.fullmatch(word) for word in words):
        return " ", ","
    if "," in line:
        return ",", "."
    return " ", "."
