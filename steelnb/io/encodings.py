"""Bytes of text files in the encodings of other programs → UTF-8."""

import codecs
import re
from pathlib import Path

MARKS = {codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
WINDOWS_NAN = re.compile(rb"-?1\.#[A-Z]+\d*")
"""NaN and infinity as Windows wrote them, also if the decimals cut them: 1.#QNAN, 1.#J, -1.#IO."""
REPLAYED = "expected clouds (PointCloud2), which the sensor's driver records when it replays them"
PACKETS = f"packets of a network (pcap); {REPLAYED}"
WEB_PAGE = "a web page; expected the file itself"
FOREIGN = {
    rb"\s*\x1f\x8b": "compressed by gzip; expected plain text, or plain binary data (gunzip)",
    rb"\s*version https://git-lfs": "a pointer of git LFS; expected the file itself (git lfs pull)",
    rb"\s*<!doctype": WEB_PAGE,
    rb"\s*<html": WEB_PAGE,
    rb"\s*<\?xml": "XML; expected another form",
    rb"\s*astm-e57": "E57; expected PLY or LAS (`pdal translate FILE.e57 FILE.las`, or CloudCompare)",
    rb"\s*\xd4\xc3\xb2\xa1": PACKETS,
    rb"\s*ulog\x01\x12\x35": "a log of PX4, without scans; expected a recording of the sensor",
    rb"\s*\x89hdf": "HDF5; expected arrays of numpy.save, or another form",
    rb"\s*pk\x03\x04": "a zip archive; expected the files in it (unzip)",
    rb"\s*%pdf": "a document; expected numbers",
    rb"\s*\x89png": "a picture; expected numbers",
    rb"\s*\xfd7zxz": "compressed by xz; expected plain data (unxz)",
    rb"\n\r\r\n(?s:.{4})(?:\x1a\x2b\x3c\x4d|\x4d\x3c\x2b\x1a)": PACKETS,
    rb"(?-i:BZh[1-9]1AY&SY)": "compressed by bzip2; expected plain data (bunzip2)",
    rb"(?-i:OFF\r?\n)": "OFF; expected PLY or another form of points",
}
"""Beginnings of files that are something else than their name says, as patterns, and what they are. Case matters where
fewer letters may begin a text."""


def foreign(begin: bytes) -> str:
    """What a file that begins with these bytes is, if that is never a recording or a cloud, else ""."""
    return next((what for form, what in FOREIGN.items() if re.match(form, begin, re.IGNORECASE)), "")


def foreign_file(path: Path) -> str:
    """What a file is, if that is never a recording or a cloud, else ""."""
    with path.open("rb") as file:
        return foreign(file.read(32))


def rewritten(data: bytes | memoryview) -> str:
    """Words on binary data in which a carriage return stands before each line feed, else ""."""
    data = bytes(data)
    words = ", and a carriage return before each line feed, as after a transfer as text (FTP); expected a binary one"
    return words if data.count(b"\n") == data.count(b"\r\n") > 1 else ""


def plain_nan(data: bytes) -> bytes:
    """The same text, with ``nan`` for what programs for Windows write as ``1.#QNAN`` or ``1.#INF``."""
    return WINDOWS_NAN.sub(b"nan", data) if b"#" in data else data


def decoded(data: bytes) -> bytes:
    """Text in UTF-8, without a mark. Raises ValueError for bytes that are no text."""
    for mark, encoding in MARKS.items():
        if data.startswith(mark):
            data = data.removeprefix(mark)
            return data if encoding == "utf-8" else data.decode(encoding, "replace").encode()
    for first, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):  # of digits, every other byte is zero
        if len(data) > 1 and not data[first:64:2].strip(b"\0"):
            return data.decode(encoding, "replace").encode()
    if what := foreign(data[:32]):
        raise ValueError(what)
    if (at := data.find(b"\0")) >= 0:
        raise ValueError(f"byte {at} is zero; expected plain text")
    if _is_utf8(data):
        return data
    lines = data.split(b"\n")  # some programs copy labels in other encodings
    return b"\n".join(line if _is_utf8(line) else line.decode("cp1252", "replace").encode() for line in lines)


def _is_utf8(data: bytes) -> bool:
    try:
        return data.isascii() or bool(data.decode())
    except UnicodeDecodeError:
        return False
