"""A finished folder in place of an existing one."""

import os
from collections.abc import Sequence
from pathlib import Path

from steelnb.files import new_folder


def replace_files(folder: Path, target: Path, stale: Sequence[str]) -> None:
    """Move all files of a finished ``folder``, which is gone then, to an existing one on the same disk.

    Files there of the same names are replaced, those that match a pattern of ``stale`` removed, and all others stay.
    Raises `OutputError` as `new_folder`.
    """
    with new_folder(target, stale) as new:
        for file in folder.iterdir():
            os.replace(file, new / file.name)
        folder.rmdir()
