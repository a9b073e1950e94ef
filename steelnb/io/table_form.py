"""The form of a table in a text file: its separator, the names and units of its columns, its comments and titles."""

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

from steelnb.core.checks import shown
from steelnb.io.column_names import LENGTH_UNITS, UNIT_OF, check_stated, known_names, name_and_unit
from steelnb.io.encodings import decoded, plain_nan
from steelnb.io.text import NOT_A_NUMBER, Table, is_number, split_cells

HEAD_BYTES, COLUMNS_MAX = 1 << 16, 1000
"""The form of a table is found in its first bytes; no table of points or poses has so many columns."""
COMMENT = re.compile(rb"^[ \t]*(?://|%|#)", re.MULTILINE)
SEPARATOR_LINE = re.compile(rb"sep=.\r?\n", re.IGNORECASE)
FORTRAN = re.compile(rb"(?<=[\d.])[dD](?=[+-]?\d)")
TIME, TIME_WITH_COMMA = (
    re.compile(rb"\d{4}-\d\d-\d\d[Tt ]\d\d:\d\d:\d\d(?:%s)?(?:[Zz]| UTC|[+-]\d\d(?::?\d\d)?)?(?![\d:])" % fraction)
    for fraction in (rb'\.\d+|,\d+(?=Z?")', rb"[.,]\d+")
)
BARS = re.compile(
    rb"^(?:[^\s#|,;]+[ \t]*\|)?%s(?:\|%s){2}(?:\|(?>%s(?=[|\r\n]|\Z)|[^|,;\n]*))*\r?$"
    % ((rb"[ \t]*[+-]?\d+(?:[.,]\d*)?(?:[eE][+-]?\d+)?[ \t]*",) * 3),
    re.MULTILINE,
)
LISTS = re.compile(rb"^#[ \t]*((?:\w+, *){3,})\w+\[\].*$", re.MULTILINE)
"""A first line of spreadsheets, exponents of Fortran, times of ISO 8601, also with commas where these do not separate,
numbers between bars, and a comment of COLMAP, whose lines end in lists of any length."""
QUOTED = re.compile('"[^"]*"')
DECIMAL = re.compile(r"[+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?")
COMMA, POINT = (re.compile(rf"[+-]?\d+{sign}\d+(?:[eE][+-]?\d+)?") for sign in (",", r"\."))
BRACKETED = re.compile(r"\s+([\[(])")
THOUSANDS, POINT_THOUSANDS = (re.compile(rf"[+-]?[1-9]\d{{0,2}}{sign}\d{{3}}") for sign in (",", r"\."))
PROSE = {"and", "down", "forward", "is", "left", "of", "right", "the", "to", "up"}
"""Words of sentences on axes. Columns with such names have x, y and z beside each other."""
KNOWN = {
    *("x", "y", "z", "e", "n", "h", "u", "east", "north", "up", "easting", "northing", "elevation", "elev", "height"),
    *("alt", "altitude", "ost", "nord", "hoehe", "höhe", "rechtswert", "hochwert", "lat", "lon", "latitude"),
    *("longitude", "stamp", "time", "timestamp", "qx", "qy", "qz", "qw", "q0", "q1", "q2", "q3"),
}
"""Names of columns, two of which tell a line of names from a title."""
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
    begin, before = 0, list[str]()
    while begin < len(bodies) and not _is_of_numbers(cells := _cells_of(bodies[begin]), before):
        begin, before = begin + 1, cells
    if begin and bodies[0].lower().startswith(("ncols", "nrows")):
        raise ValueError("a grid of heights; expected x, y and z in each line")
    heads, content, bodies = list(zip(content, bodies, strict=True))[:begin], content[begin:], bodies[begin:]
    if not bodies:
        unlike = f"; expected numbers without signs of thousands, unlike {shown(heads[-1][1])}"
        unlike = unlike if re.search(r"\d[,.]\d{3}[,.]\d", heads[-1][1]) else ""
        raise ValueError(f"{shown(heads[0][1])} and no line of numbers after it{unlike}")
    heading = _cells_of(bodies[0])
    is_index = len(bodies) > 1 and heading[0] == "" and _counts(heading[1:])  # as pandas writes it
    if not heads and (is_index or (_counts(heading) and "," in bodies[0] and "." in "".join(bodies[1:2]))):
        content, bodies = content[1:], bodies[1:]
    separator = _separator(bodies[0])
    if "\t" in bodies[0] and any("\t" in text for _, text in heads):
        separator = "\t"  # the words of a name, and missing numbers, are kept together
    if _has_decimal_commas(bodies, separator):
        data = re.sub(rb'("[+-]?\d+),(?=\d)', rb"\1.", data) if separator == "," else data.replace(b",", b".")
    cells = split_cells(bodies[0], separator)
    if len(cells) > COLUMNS_MAX:
        raise ValueError(f"line {content[0] + 1} has {len(cells)} numbers; expected those of one point or pose a line")
    is_open = len(cells) > 1 and not cells[-1]
    names, units = _names(heads, {len(cells), len(cells) - is_open}, content[0])
    said = [_words(comment, len(cells)) for comment in reversed(comments)]
    fitting = [words for words in said if len(words) == len(cells)]
    with_x = [words for words in fitting if any(name_and_unit(word)[0].endswith("x") for word in words)]
    in_comment = next(iter(with_x + fitting), [])
    plain = [name_and_unit(name) for name in (in_comment if names is None else names)]
    for (name, unit), more in zip(plain, units, strict=False):
        if unit and more and unit != more:
            raise ValueError(f"column {name} in {unit} by its name, and in {more} by the line below; expected one unit")
    if LENGTH_UNITS.isdisjoint([*units, *(unit for _, unit in plain)]):
        check_stated(text.lstrip("# ") for text in texts[: content[0]])
    first = content[0] if names is None else heads[-1][0] + 1  # a label below it may look like a comment
    skipped = sum(map(len, lines[:first]))
    return Table(
        data[skipped:] if skipped else data, len(cells), separator, known_names(name for name, _ in plain),
        tuple(unit or more for (_, unit), more in zip(plain, units or [""] * len(plain), strict=True)),
        names is not None, declared, first + 1, tuple(range(is_index, len(cells) - is_open)),
        tuple(name_and_unit(word)[0] for words in said for word in words), bool(heads) and names is None,
    )  # fmt: skip


def _plain_numbers(data: bytes) -> bytes:
    """The same text with comments after ``#``, exponents of C, times in seconds, and without lists at the ends of
    lines."""
    data = SEPARATOR_LINE.sub(b"", data, count=1) if data[:4].lower() == b"sep=" else data
    if b"/" in data or b"%" in data:
        data = COMMENT.sub(b"#", data)
    head = data[:HEAD_BYTES]
    if BARS.search(head) and b";" not in head:
        data, head = data.replace(b"|", b";"), head.replace(b"|", b";")
    if re.search(rb"\d\.\d*[dD][+-]?\d", head):
        data = FORTRAN.sub(b"e", data)
    lines = head.splitlines()[: -1 if len(data) > len(head) else None]
    if timed := [line for line in lines if TIME.search(line.partition(b"#")[0])]:
        line = timed[-1]  # those before may be titles
        others = TIME_WITH_COMMA.sub(b"0", line).decode("utf-8", "replace")
        form = TIME if _separator(others) == "," or not re.search(r"\S[\s;]+\S", others) else TIME_WITH_COMMA
        of_nine = [each for each in lines if len(each.strip(b"#/% \t").split()) == 9]  # or of eight, the first a time
        is_pose = line in of_nine and TIME.match(line.lstrip()) and all(map(TIME.search, of_nine))
        separated = is_pose or any(sign in others for sign in ",;\t")  # else date and time are columns
        data = form.sub(lambda each: _unix_s(each[0]) if separated or each[0][10:11] != b" " else each[0], data)
    lists = LISTS.search(head)
    if lists and not re.match(rb"[^\n]*[,;]", head[lists.end() :].lstrip()):
        names = lists[1].strip(b", ")
        cut = rb"^((?:[^\s#]\S*[ \t]+){%d}\S+).*$" % names.count(b",")
        data = re.sub(cut, rb"\1", data.replace(lists[0], b"# " + names, 1), flags=re.MULTILINE)
    return data


def _unix_s(time: bytes) -> bytes:
    """Unix seconds of a time, without a decimal sign, since the table may have another; the same text if it is none."""
    try:
        return b"%de-6" % unix_us(time.decode().upper().replace(" UTC", "Z"))
    except ValueError:
        return time


def unix_us(time: str) -> int:
    """Unix microseconds of a time (ISO 8601), UTC unless it names a zone. Raises ValueError if it is none."""
    found = datetime.fromisoformat(time)
    since = (found if found.tzinfo else found.replace(tzinfo=UTC)) - datetime(1970, 1, 1, tzinfo=UTC)
    return since // timedelta(microseconds=1)


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
    return split_cells(line, "\t" if "\t" in line else _separator(line))


def _is_of_numbers(cells: list[str], before: list[str]) -> bool:
    """Whether these are the fields of a line of numbers, of which some may be labels or missing; a title may hold a
    year. ``before``: the line before, which may have as many names."""
    missing, numbers = sum(cell in NOT_A_NUMBER for cell in cells), _numbers_in(cells)
    if sum(cell in NOT_A_NUMBER for cell in cells if cell) > 2:  # no names: a first scan may begin with invalid points
        return True
    if len(cells) == len(before) and not _numbers_in(before) and not all(cell in UNIT_OF for cell in cells if cell):
        return numbers > 0 or 2 * missing > len(cells)
    return numbers > 2 or 2 * numbers > len(cells) - missing


def _numbers_in(cells: list[str]) -> int:
    return sum(is_number(cell.replace(",", ".")) for cell in cells if cell not in NOT_A_NUMBER)


def _names(heads: list[tuple[int, str]], counts: set[int], begin: int) -> tuple[list[str] | None, list[str]]:
    """The names of columns among the numbered lines before the first of numbers, or None, and the units of a line after
    them, or none. Raises ValueError for other lines after the names, and for names that are too few or too many."""
    both = [[_cells_of(each) for each in (text, BRACKETED.sub(r"\1", text))] for _, text in heads]
    split = [next((cells for cells in each if len(cells) in counts), each[0]) for each in both]
    plain = [[name_and_unit(cell)[0] for cell in cells] for cells in split]
    are_names = [any(w.endswith("x") for w in words) or sum(w in KNOWN for w in words) > 1 for words in plain]
    fitting = [k for k, cells in enumerate(split) if len(cells) in counts]
    chosen = max([k for k in fitting if are_names[k]] or fitting, default=None)
    if chosen is None:
        if any(are_names):
            words = split[max(k for k, is_so in enumerate(are_names) if is_so)]
            raise ValueError(f"{len(words)} names of columns, but {max(counts)} fields in line {begin + 1}")
        return None, []
    units: list[str] = []
    for (number, text), cells in zip(heads[chosen + 1 :], split[chosen + 1 :], strict=True):
        below = [cell.strip("[]() ").lower() for cell in cells]
        if len(below) != len(split[chosen]) or 2 * sum(w in UNIT_OF or not w.strip("-") for w in below) < len(below):
            raise ValueError(f"line {number + 1}: {shown(text)}; expected numbers")
        units = [UNIT_OF.get(word, "") for word in below]
    return split[chosen], units


def _counts(cells: list[str]) -> bool:
    """Whether these are 0, 1, 2, …: columns without names."""
    return len(cells) > 2 and cells == [str(k) for k in range(len(cells))]


def _has_decimal_commas(lines: list[str], separator: str) -> bool:
    """Whether numbers in these lines have commas instead of points: between other separators or in quotes. Beside
    other columns with points, either sign may be that of thousands."""
    pattern = r'"[+-]?\d+,\d+' if separator == "," else r"\d,\d"
    if not any(re.search(pattern, line) for line in lines):
        return False
    lines = [QUOTED.sub("0", line) for line in lines] if separator == " " else lines
    columns = [*zip(*(split_cells(line, separator) for line in lines), strict=False)]
    with_comma, with_point = ([any(map(form.fullmatch, column)) for column in columns] for form in (COMMA, POINT))
    commas = [cell for column in columns for cell in column if "," in cell]
    numbers = [cell for cell in commas if COMMA.fullmatch(cell)]
    if any(map(all, zip(with_comma, with_point, strict=True))) or (separator == " " and len(numbers) < len(commas)):
        return False
    points = [cell for column in columns for cell in column if POINT.fullmatch(cell)]
    may_be_thousands = all(map(THOUSANDS.fullmatch, numbers)) or all(map(POINT_THOUSANDS.fullmatch, points))
    return bool(numbers) and not (points and may_be_thousands)


def _words(comment: str, count: int) -> list[str]:
    """The words of a comment that could be names of columns: one of them is an x, or all are `KNOWN`; units stay with
    their names. ``count``: of columns, which tells whether "name" or "field" is one of them."""
    comment = comment.rpartition(":")[2].replace("|", " ").strip()
    texts = (HEADING.sub("", comment), comment)
    both = [split_cells(BRACKETED.sub(r"\1", text), _separator(text)) for text in texts]
    words = next((words for words in both if len(words) == count), both[0])
    plain = [name_and_unit(word)[0] for word in words]
    beside = any([word[-1:] for word in plain[k : k + 3]] == ["x", "y", "z"] for k in range(len(plain)))
    is_of_survey = len(plain) == count > 2 and KNOWN.issuperset(plain)  # northing, easting, height
    is_named = any(word.endswith("x") for word in plain) or is_of_survey
    return words if is_named and (beside or PROSE.isdisjoint(plain)) else []


def _separator(line: str) -> str:
    """Separator of a line of numbers."""
    line = QUOTED.sub("0", line)
    words = line.split()
    numbers = [word for word in words if DECIMAL.fullmatch(word)]
    has_decimals = len(numbers) > 2 and not any("," in word for word in words if word not in numbers)
    return ";" if ";" in line else "," if "," in line and not has_decimals else " "
