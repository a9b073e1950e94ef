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
LENGTH_UNITS = {"m", "mm", "cm", "km", "ft", "in"}
STATED = re.compile(
    r"(?:^\W*|,\s*(?=units(?::| are))|\b(?:length|linear|distance|coordinates?|xyz|map|model|points?|all|the|in)\s+)"
    r"units?\b(?:\s+(?:of\s+(?:length|measure\w*)|are|is|in)\b)*\W*(?:in\s+)?(?:(?:us|survey|international)[\s-]+)*"
    r"([a-zµ]+)\b(?!\s*[-/^])"
)
"""A unit in a sentence, where no word before it tells that it is one of ranges or times: "Units: US survey feet"."""
OF_OTHERS = re.compile(
    r"\b(?:range|intensity|resolution|spacing|voxel|sigma|scale|time)|\b(?:in|to) m(?:et(?:er|re)s)?\b"
)
"""Words of a line in which a unit is that of something else, or that names the metre, too."""
STAMPS = (
    "(?:.*_)?header_stamp", "(?:time_?)?stamp", "time|t", "(?:unix|epoch)_(?:time|stamp|timestamp)",
    "(?:.*_)?(?:time|stamp|timestamp)|",
)  # fmt: skip
"""Patterns of the names of stamps, the preferred first; "" stands for names that are units, such as sec and nsec."""
TUM = ("stamp", "x", "y", "z", "qx", "qy", "qz", "qw")
QUATERNION = TUM[4:]
ROLES = {
    axis: (axis, f"[pt]_?{axis}|pos_{axis}|p_.*_{axis}", f"(?:.*_)?(?:position|translation)_{axis}") for axis in "xyz"
} | {
    role: (f"q_?{role[1]}|q_.*_{role[1]}", f"(?:.*_)?(?:quat|quaternion|orientation|rotation)_{role[1]}")
    for role in QUATERNION
}
"""Patterns of the names of columns for each number of a pose, the preferred first."""
ROTATIONS = tuple(f"r{row}{column}" for row in "123" for column in "123")
SYNONYMS = {
    "q0 q1 q2 q3": "qw qx qy qz", "q_0 q_1 q_2 q_3": "qw qx qy qz", "qi qj qk qr": "qx qy qz qw",
    "rot_x rot_y rot_z rot_w": "qx qy qz qw", "rotx roty rotz rotw": "qx qy qz qw", "ox oy oz ow": "qx qy qz qw",
    "posx posy posz": "x y z", "position_0 position_1 position_2": "x y z", "t03 t13 t23": "x y z",
    "t00 t01 t02 t10 t11 t12 t20 t21 t22": " ".join(ROTATIONS),
}  # fmt: skip
"""Names of a rotation matrix, row by row, and names that stand for those of a pose if all of them are there."""


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


def known_names(given: Iterable[str]) -> tuple[str, ...]:
    """The names of columns, with `SYNONYMS` replaced where none of their like is there."""
    names = tuple(given)
    known: dict[str, str] = {}
    for words, others in SYNONYMS.items():
        if {*words.split()} <= {*names} and {*others.split()}.isdisjoint(names):
            known |= dict(zip(words.split(), others.split(), strict=True))
    return tuple(known.get(name, name) for name in names)


def check_stated(lines: Iterable[str]) -> None:
    """Raise ValueError if comments or titles state a unit of lengths, but not the metre."""
    told = [line for line in lines if not OF_OTHERS.search(line.lower())]
    stated = {UNIT_OF.get(word, ""): line for line in told for word in STATED.findall(line.lower())}
    other = [line for unit, line in stated.items() if unit in LENGTH_UNITS]
    if other and "m" not in stated:
        raise ValueError(f"{shown(other[0])} in its header; expected metres")
