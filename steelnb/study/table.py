"""Rows of a study on disk.

A folder holds `RUNS`, the table that a study asks for, the same bytes however its rows came about, and `TIMING`, the
measured times. `ROWS` takes a row as its run ends, so that a killed study loses none; at the end of a study only rows
of other studies that were run in the folder stay there.
"""

import contextlib
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from steelnb.errors import InputError, OutputError
from steelnb.files import new_folder
from steelnb.study.plan import CASE, Run
from steelnb.study.row import OK

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

RUNS, TIMING, ROWS = "runs.parquet", "timing.parquet", "parts/rows.jsonl"
STATUS = ("key", "status", "error")
CURVES = ("curve_time_s", "curve_raw_m", "curve_error_m", "curve_matches")
TIMES = ("frame_median_ms", "frame_p95_ms", "seconds", "flight_seconds", "machine")
"""Columns of `TIMING` alone: they differ from call to call, and no comparison looks at them."""

Row = dict[str, Any]


def read_study(folder: Path) -> "pd.DataFrame":
    """Table of a study with its measured times, a row a run.

    Columns are `CASE`, ``key``, ``status``, ``error``, the numbers of `steelnb.study.row.numbers`, `CURVES` (arrays)
    and `TIMES`. Raises `InputError` if there is none or it is damaged.
    """
    frame = _read(folder / RUNS).to_pandas()
    if not (folder / TIMING).is_file():
        return frame
    times = _read(folder / TIMING).to_pandas()
    return frame.merge(times[["key", *(name for name in TIMES if name in times)]], on="key", how="left")


def read_rows(path: Path) -> list[Row]:
    """Rows of one of the two tables, without empty cells. Raises what `read_study` raises."""
    return [{name: value for name, value in row.items() if value is not None} for row in _read(path).to_pylist()]


def _read(path: Path) -> "pa.Table":
    import pyarrow as pa
    from pyarrow import parquet

    try:
        return parquet.read_table(path, page_checksum_verification=True)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected the table of a study, see `steelnb study`") from None
    except (pa.ArrowException, OSError) as fault:
        reason = " ".join(str(fault).split())[:100]
        raise InputError(f"{path}: damaged ({reason}); restore it, or remove it to run its runs again") from None


def stored_rows(folder: Path) -> dict[str, Row]:
    """Rows in a folder by key: of a run that ended well the last such row, else the last. Raises `InputError`."""
    times = {row["key"]: row for row in read_rows(folder / TIMING)} if (folder / TIMING).is_file() else {}
    rows = [times.get(row["key"], {}) | row for row in read_rows(folder / RUNS)] if (folder / RUNS).is_file() else []
    found: dict[str, Row] = {}
    for row in [*rows, *_unfinished(folder / ROWS)]:
        if row["status"] == OK or found.get(row["key"], row)["status"] != OK:
            found[row["key"]] = row
    return found


def _unfinished(path: Path) -> Iterator[Row]:
    if path.is_file():
        with path.open(encoding="utf-8") as file:
            for line in file:
                # A line that a kill or a full disk cut off is no JSON; its run is run again.
                with contextlib.suppress(ValueError):
                    yield json.loads(line)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other studies out of a folder until the end of the context or of the process. Raises `OutputError`."""
    import fcntl  # not on Windows, where tables can be read all the same

    with _writing(folder):
        (folder / ROWS).parent.mkdir(parents=True, exist_ok=True)
        lock = (folder / ROWS).with_name("lock").open("w")
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(f"{folder}: in use by another study; wait for its end or stop it") from None
        yield


def append_row(folder: Path, row: Row) -> None:
    """Append a row to `ROWS`. Raises `OutputError`."""
    with _writing(folder), (folder / ROWS).open("a", encoding="utf-8") as file:
        # Each line begins with its own line feed, since the one before may have been cut off.
        file.write("\n" + _json(row))


@contextlib.contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as fault:
        raise OutputError(f"{folder}: cannot be written: {fault.strerror or fault}") from None


def write_tables(folder: Path, runs: Iterable[Run], rows: Mapping[str, Row]) -> None:
    """Write `RUNS` and `TIMING` of some runs, sorted by `CASE`, and leave the other rows in `ROWS`. Raises
    `OutputError`."""
    import pyarrow as pa
    from pyarrow import parquet

    keys = {run.key for run in runs}
    chosen = sorted((rows[key] for key in keys), key=lambda row: [row[name] for name in CASE])
    names = set().union(*chosen)
    numbers = sorted(names - {*CASE, *STATUS, *CURVES, *TIMES})
    with new_folder(folder) as new:
        for file, columns in ((TIMING, (*CASE, "key", *TIMES)), (RUNS, (*CASE, *STATUS, *numbers, *CURVES))):
            schema = pa.schema([(name, _kind(name)) for name in columns if name in names])
            parquet.write_table(
                pa.Table.from_pylist(chosen, schema), new / file, compression="zstd", compression_level=9,
                write_page_checksum=True,
            )  # fmt: skip
    left = "\n".join(_json(row) for key, row in rows.items() if key not in keys)
    with new_folder((folder / ROWS).parent) as new:
        (new / Path(ROWS).name).write_text(left, encoding="utf-8")


def _kind(name: str) -> Any:
    import pyarrow as pa

    if name in CURVES:
        return pa.list_(pa.int32() if name == "curve_matches" else pa.float32())
    if name == "seed":
        return pa.int64()
    return pa.string() if name in (*CASE, *STATUS, "machine") and name != "duration_s" else pa.float64()


def _json(row: Row) -> str:
    return json.dumps(row, default=np.ndarray.tolist)
