"""Pickles that notice damage: changed bytes of an array or of machine code would load without an error."""

import hashlib
import pickle
from typing import Any


class Sealed:
    """Pickled ``data`` with its SHA-256. A pickle of it loads as the object in ``data``, or raises ValueError if a byte
    has changed."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def __reduce__(self) -> tuple[Any, ...]:
        return _opened, (self.data, hashlib.sha256(self.data).digest())


def _opened(data: bytes, digest: bytes) -> Any:
    if hashlib.sha256(data).digest() != digest:
        raise ValueError("damaged: its bytes are not those that were written")
    return pickle.loads(data)
