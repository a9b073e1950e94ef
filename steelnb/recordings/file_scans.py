"""Scans and pictures that are a file each, read one at a time."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steelnb.datatypes import Array, Scan
from steelnb.errors import EmptyCloudError, RecordingError, SteelnbError
from steelnb.recordings.recording import Picture
from steelnb.recordings.stamps import rising


class FileScans:
    """Scans of which each is a file (`recording.ScanSource`).

    ``stamp_s (K,)`` rises strictly; ``load`` gives the points of a file. A file that is missing, broken or without a
    finite point is a scan without points, and is counted once, however often it is read; what was wrong with the
    first one goes into ``facts``.
    """

    def __init__(
        self, stamp_s: Array, files: Sequence[Path], load: Callable[[Path], Array], skipped: Counter[str],
        facts: dict[str, str],
    ) -> None:  # fmt: skip
        self.stamp_s, self.files = stamp_s, files
        self._load, self._skipped, self._facts = load, skipped, facts
        self._counted: set[int] = set()

    def walk(self, wanted: NDArray[np.bool_] | None = None) -> Iterator[Scan]:
        """All scans, or those of a mask ``(K,)``."""
        for k in range(len(self.stamp_s)) if wanted is None else np.flatnonzero(wanted).tolist():
            yield Scan(float(self.stamp_s[k]), self._points(k))

    def _points(self, k: int) -> Array:
        try:
            points = self._load(self.files[k])
        except FileNotFoundError:
            return self._none(k, "missing file", f"{self.files[k]}: does not exist")
        except OSError as fault:
            return self._none(k, "unreadable file", f"{self.files[k]}: {fault.strerror or fault}")
        except EmptyCloudError:
            return self._none(k, "empty cloud")
        except SteelnbError as fault:
            return self._none(k, "unreadable file", str(fault))
        if not points.size:
            return self._none(k, "empty cloud")
        if not np.isfinite(points).all(axis=-1).any():
            return self._none(k, "no finite point")
        return points

    def _none(self, k: int, reason: str, detail: str = "") -> Array:
        if k not in self._counted:
            self._counted.add(k)
            self._skipped[reason] += 1
            if detail:
                self._facts.setdefault(f"first {reason}", detail)
        return np.zeros((0, 3))


class FilePictures:
    """Pictures of which each is a file (`recording.PictureSource`); those that cannot be read are left out, counted."""

    def __init__(
        self, stamp_s: Array, files: Sequence[Path], load: Callable[[Path], NDArray[np.uint8]], skipped: Counter[str]
    ) -> None:
        self.stamp_s, self.files = stamp_s, files
        self._load, self._skipped = load, skipped
        self._counted: set[int] = set()

    def walk(self) -> Iterator[Picture]:
        """All pictures in the order of their stamps."""
        for k, (stamp_s, file) in enumerate(zip(self.stamp_s.tolist(), self.files, strict=True)):
            try:
                pixels = self._load(file)
            except (OSError, SteelnbError):
                self._skipped["unreadable picture"] += k not in self._counted
                self._counted.add(k)
                continue
            yield Picture(stamp_s, pixels)


def in_order(files: Sequence[Path]) -> list[Path]:
    """Files in the order of the numbers in their names: 9 before 10."""

    def key(file: Path) -> list[tuple[int, float, str]]:
        pieces = re.split(r"(\d+(?:\.\d+)?)", file.stem)
        return [(1, float(piece), piece) if k % 2 else (0, 0.0, piece) for k, piece in enumerate(pieces)]

    return sorted(files, key=key)


def chosen(path: Path, stamp_s: Array, files: Sequence[Path], skipped: Counter[str]) -> tuple[Array, list[Path]]:
    """Scans' stamps that rise strictly, and their files. Raises `RecordingError` where none is left."""
    kept = rising(stamp_s, skipped)
    if not kept.any():
        raise RecordingError(f"{path}: {len(files)} scans, none with a stamp of use; expected seconds that rise")
    return stamp_s[kept], [files[k] for k in np.flatnonzero(kept).tolist()]
