"""Names of columns and properties of points and poses, and the units that names, comments and titles state."""

import re
from collections.abc import Iterable

from steelnb.core.checks import shown

AXIS = ("(?:pos|position|point|coord|coordinate|p|points_m_xyz|cartesian)_?{}", "{}_?(?:coord|coordinate|pos)")
"""Patterns of the name of an axis around its letter, the preferred first."""
UNITS = {
    "": "utc unix", "m": "m meter meters metre metres", "mm": "mm millimeter millimeters millimetre millimetres",
    "cm": "cm centimeter centimeters centimetre centimetres", "km": "km kilometer kilometers kilometre kilometres",
    "ft": "ft foot feet usft ftus", "in": "inch inches", "s": "s sec secs seconds",
    "ms": "ms msec msecs millisec milliseconds", "us": "us µs usec usecs microsec microseconds",
    "ns": "ns nsec nsecs nanosec nanosecs nanoseconds", "deg": "deg degree degrees °", "rad": "rad radian radians",
}  # fmt: skip
"""Words for each unit; those for none say what a time counts from."""
UNIT_OF = {word: unit for unit, words in UNITS.items() for word in words.split()}
LENGTHS = {"m", "mm", "cm", "km", "ft", "in"}
STATED = re.compile(
    r"(?:^|[^\w\s]\s*|\b(?:length|linear|distance|coordinates?|xyz|map|model|points?|all|the|in)\s+)units?\b"
    r"(?:\s+(?:of\s+(?:length|measure\w*)|are|is|in)\b)*\W*(?:(?:us|survey|international)[\s-]+)*([a-zµ]+)"
)
"""A unit in a sentence, where no word before it tells that it is one of ranges or times: "Units: US survey feet"."""


def name_and_unit(name: str) -> tuple[str, str]:
    """A column's name and unit: "p_RS_R_x [m]" → ("p_rs_r_x", "m"), "stamp_ns" and "stampNs" → ("stamp", "ns"),
    "X" → ("x", "")."""
    name = name.strip("\"' \t")
    capital = re.fullmatch(r"(.*[a-z])([A-Z][A-Za-z]+)", name)
    name = f"{capital[1]}_{capital[2]}" if capital and UNIT_OF.get(capital[2].lower()) else name
    name, _, rest = name.lower().replace("(", "[").partition("[")
    bracket = rest.rstrip("]) ")
    words = [word for word in re.split(r"[\W_]+", name) if word]
    if bracket and not bracket.isdecimal():
        return "_".join(words), UNIT_OF.get(bracket.strip(), bracket)
    words += [bracket] if bracket else []
    unit = UNIT_OF.get(words[-1], "") if words else ""
    words = words[:-1] if unit else words
    return "_".join(words[:-1] if len(words) > 1 and unit and words[-1] == "in" else words), unit


def check_stated(lines: Iterable[str]) -> None:
    """Raise ValueError if comments or titles state a unit of lengths, but not the metre."""
    stated = {UNIT_OF.get(word, ""): line for line in lines for word in STATED.findall(line.lower())}
    other = [line for unit, line in stated.items() if unit in LENGTHS]
    if other and "m" not in stated:
        raise ValueError(f"{shown(other[0])} in its header; expected metres")
