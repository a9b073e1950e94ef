"""The runs of studies on disk: a Parquet dataset that grows part by part, and the compacted table of one study.

In a study's folder, ``parts/`` holds every run that was ever done there, and is not committed; ``runs.parquet`` is the
extract that a study asks for, the same byte for byte however it came about, and ``timing.parquet`` its measured times.
"""

import contextlib
import fcntl
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from steelnb.errors import FileMissingError, OutputError
from steelnb.study.plan import CASE, Run
from steelnb.study.row import OK

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

RUNS, TIMING = "runs.parquet", "timing.parquet"
TIMES = ("frame_median_ms", "frame_p95_ms", "seconds", "flight_seconds", "machine")
"""What differs from call to call: in `TIMING` alone, and in no comparison."""
CURVES = ("curve_time_s", "curve_raw_m", "curve_error_m", "curve_matches")
STATUS = ("key", "status", "error")


class Store:
    """The runs in ``folder``.

    ``rows`` has a row a key, of a run that went well before one that failed, as they were when the store was opened.
    ``notes`` names files that were damaged and, where ``aside``, are now called ``*.corrupt``. Raises `OutputError`.
    """

    def __init__(self, folder: Path, aside: bool = True) -> None:
        self.folder, self.parts, self._aside = folder, folder / "parts", aside
        self.notes: list[str] = []
        tables = [self._compacted(), *(self._read(path) for path in self._files())]
        self.rows = newest([table for table in tables if table is not None])
        self._fresh: list[pa.Table] = []

    def done(self) -> set[str]:
        """Keys of the runs that went well."""
        return {row["key"] for row in self.rows.select(["key", "status"]).to_pylist() if row["status"] == OK}

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write rows as a new part. All of them, or, where `OutputError` is raised, none of them, are there then."""
        table = to_table(rows)
        write_table(table, self._next())
        self._fresh.append(table)

    def compact(self, runs: Iterable[Run]) -> "pa.Table":
        """Write `RUNS` and `TIMING` with what is known of some runs, sorted by `CASE`, and join all parts into one."""
        import pyarrow as pa
        import pyarrow.compute as pc

        rows = newest([self.rows, *self._fresh])
        wanted = pa.array([run.key for run in runs], pa.string())
        table = rows.filter(pc.is_in(rows["key"], value_set=wanted)).sort_by([(name, "ascending") for name in CASE])
        # A number of other runs in the store alone is no column of these.
        table = table.select([name for name in table.column_names if table[name].null_count < max(len(table), 1)])
        write_table(table.select([name for name in table.column_names if name not in TIMES]), self.folder / RUNS)
        timed = (*CASE, "key", *TIMES)
        write_table(table.select([name for name in table.column_names if name in timed]), self.folder / TIMING)
        before = self._files()
        if len(before) > 1:
            write_table(rows, self._next())
            for path in before:
                path.unlink(missing_ok=True)
        self.rows, self._fresh = rows, []
        return table

    def _next(self) -> Path:
        return self.parts / f"{time.time_ns():020d}-{os.getpid()}.parquet"

    def _files(self) -> list[Path]:
        return sorted(path for path in self.parts.glob("*.parquet") if not path.name.startswith("."))

    def _compacted(self) -> "pa.Table | None":
        """The table of an earlier study with its times, so that a fresh clone need not run it again."""
        table, times = self._read(self.folder / RUNS), self._read(self.folder / TIMING)
        return table if table is None or times is None else beside(table, times)

    def _read(self, path: Path) -> "pa.Table | None":
        """A file's table; None where there is no file, or, with a note, where it is damaged."""
        if not path.is_file():
            return None
        try:
            return read_table(path)
        except ValueError as fault:
            aside = path.with_name(f"{path.name}.corrupt")
            if self._aside:
                with _told(path, "set aside"):
                    os.replace(path, aside)
            self.notes.append(f"{path}: {fault}; set aside as {aside.name}, and what it alone held is run again")
            return None


@contextlib.contextmanager
def holding(folder: Path) -> Iterator[None]:
    """Keep other studies out of a folder; the lock goes with the process. Raises `OutputError` if one is in it."""
    with _told(folder):
        (folder / "parts").mkdir(parents=True, exist_ok=True)
        file = (folder / "parts" / "lock").open("w")
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(f"{folder}: in use by another study; wait for its end or stop it") from None
        yield


def read_study(folder: Path) -> "pd.DataFrame":
    """The compacted table of a study with its times, a row a run. Raises `FileMissingError` if there is none."""
    if not (folder / RUNS).is_file():
        raise FileMissingError(f"{folder / RUNS}: no such file; expected the runs of a study, see `steelnb study`")
    try:
        table = read_table(folder / RUNS)
        return (beside(table, read_table(folder / TIMING)) if (folder / TIMING).is_file() else table).to_pandas()
    except ValueError as fault:
        raise FileMissingError(f"{folder}: {fault}; expected the runs of a study, see `steelnb study`") from None


def to_table(rows: Sequence[Mapping[str, Any]]) -> "pa.Table":
    """Rows as a table, columns in their order: case, key and status, numbers by name, curves."""
    import pyarrow as pa

    names = _ordered({*CASE, *STATUS}.union(*rows))
    return pa.table({name: pa.array([row.get(name) for row in rows], _kind(name)) for name in names})


def _ordered(names: Iterable[str]) -> list[str]:
    names, front, back = set(names), (*CASE, *STATUS), (*CURVES, *TIMES)
    return [*front, *sorted(names - {*front, *back}), *(name for name in back if name in names)]


def _kind(name: str) -> Any:
    import pyarrow as pa

    if name in CURVES:
        return pa.list_(pa.int32() if name == "curve_matches" else pa.float32())
    if name == "seed":
        return pa.int64()
    return pa.string() if name in (*CASE, *STATUS, "machine") and name != "duration_s" else pa.float64()


def newest(tables: "Sequence[pa.Table]") -> "pa.Table":
    """Tables joined, with a row a key: the last one that went well, else the last."""
    import pyarrow as pa

    rows = pa.concat_tables([to_table([]), *tables], promote_options="default")
    chosen: dict[str, int] = {}
    good: set[str] = set()
    for index, row in enumerate(rows.select(["key", "status"]).to_pylist()):
        if row["status"] == OK or row["key"] not in good:
            chosen[row["key"]] = index
        if row["status"] == OK:
            good.add(row["key"])
    return rows.select(_ordered(rows.column_names)).take(pa.array(sorted(chosen.values()), pa.int64())).combine_chunks()


def beside(table: "pa.Table", times: "pa.Table") -> "pa.Table":
    """A table of runs with the measured times of another, by key."""
    import pyarrow.compute as pc

    index = pc.index_in(table["key"], value_set=times["key"].combine_chunks())
    for name in times.column_names:
        if name in TIMES:
            table = table.append_column(name, times[name].take(index))
    return table


def read_table(path: Path) -> "pa.Table":
    """A table from a file, its checksums verified. Raises `OutputError`, and ValueError if it is damaged."""
    with _told(path, "read"):
        return parse_table(path.read_bytes())


def parse_table(content: bytes) -> "pa.Table":
    """A table from the content of a file. Raises ValueError if it is damaged."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        table = parquet.ParquetFile(pa.BufferReader(content), page_checksum_verification=True).read()
    except (pa.ArrowException, OSError) as fault:
        raise ValueError(f"damaged ({' '.join(str(fault).split())[:100]})") from None
    missing = [name for name in ("key", *CASE) if name not in table.column_names]
    if missing:
        raise ValueError(f"damaged (no column {missing[0]!r})")
    return table


def write_table(table: "pa.Table", path: Path) -> None:
    """Write a table to a file, beside it and then renamed. The same table, the same bytes. Raises `OutputError`."""
    import pyarrow as pa
    from pyarrow import parquet

    # What comes from a file has marks in its schema that a fresh table has not.
    schema = pa.schema([(name, _kind(name)) for name in table.column_names])
    content = pa.BufferOutputStream()
    parquet.write_table(
        table.cast(schema).combine_chunks(), content, compression="zstd", compression_level=9, write_page_checksum=True
    )
    fresh = path.with_name(f".{path.name}.new")
    with _told(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            fresh.write_bytes(content.getvalue())
            os.replace(fresh, path)
        finally:
            fresh.unlink(missing_ok=True)


@contextlib.contextmanager
def _told(path: Path, done: str = "written") -> Iterator[None]:
    try:
        yield
    except OSError as fault:
        raise OutputError(f"{path}: cannot be {done}: {fault.strerror or fault}") from None
