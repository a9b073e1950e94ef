"""Bytes of text files in the encodings of other programs → UTF-8."""

import codecs
import re

MARKS = {codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
WINDOWS_NAN = re.compile(rb"-?1\.#(?:IND|QNAN|SNAN|INF)\d*")
GZIP = b"\x1f\x8b"
FOREIGN = {
    GZIP: "compressed by gzip; expected plain text, or plain binary data (gunzip)",
    b"version https://git-lfs": "a pointer of git LFS; expected the file itself (git lfs pull)",
    b"<!doctype": "a web page; expected the file itself",
    b"<html": "a web page; expected the file itself",
    b"<?xml": "XML; expected another form",
}
"""Beginnings of files that are something else than their name says, in lower case, and what they are."""


def foreign(begin: bytes) -> str:
    """What a file that begins with these bytes is, if that is never a recording or a cloud, else ""."""
    return next((what for start, what in FOREIGN.items() if begin.lstrip().lower().startswith(start)), "")


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
    return data
