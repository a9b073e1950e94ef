"""Tables of a study from made-up rows."""

import errno
from pathlib import Path

import numpy as np
import pytest

from steelnb.errors import InputError, OutputError
from steelnb.settings import ExperimentSettings
from steelnb.study.plan import make_run
from steelnb.study.table import (
    ROWS,
    RUNS,
    TIMES,
    TIMING,
    append_row,
    locked,
    read_rows,
    read_study,
    stored_rows,
    write_tables,
)

PLAN = [
    make_run(
        ExperimentSettings.preset(seed=seed, duration_s=4.0, sensor="report-4cm", method=method), depends_on="code"
    )
    for seed in (1, 2, 3)
    for method in ("average", "icp")
]


def row(run, status="ok", **more):
    return {
        **run.case, "key": run.key, "status": status, "error": "" if status == "ok" else "Traceback\nValueError: no",
        "ate_rmse_m": run.settings.seed / 7, "curve_time_s": np.arange(5, dtype=np.float32) / 3,
        "curve_matches": np.arange(5, dtype=np.int32), "seconds": 1.5, "machine": "one", **more,
    }  # fmt: skip


def write(folder: Path, *rows, plan=PLAN) -> None:
    """What a study does with its rows."""
    with locked(folder):
        for each in rows:
            append_row(folder, each)
        write_tables(folder, plan, stored_rows(folder))


def test_the_table_is_the_same_however_its_rows_came(tmp_path):
    tables = []
    for k, order in enumerate(([[0, 1, 2, 3, 4, 5]], [[5], [0, 3], [1], [4, 2]])):
        folder = tmp_path / str(k)
        for batch in order:
            with locked(folder):
                for index in batch:
                    append_row(folder, row(PLAN[index], seconds=float(k)))
        write(folder)
        assert not (folder / ROWS).read_text()
        tables.append((folder / RUNS).read_bytes())
        times = (folder / TIMING).read_bytes()
        write(folder)  # from tables alone, as in a fresh clone
        assert ((folder / RUNS).read_bytes(), (folder / TIMING).read_bytes()) == (tables[-1], times)
    assert tables[0] == tables[1]
    rows = read_rows(folder / RUNS)
    assert not {*TIMES} & {*rows[0]}
    assert [(each["seed"], each["method"]) for each in rows] == [(s, m) for s in (1, 2, 3) for m in ("average", "icp")]
    frame = read_study(folder)
    assert (frame["seconds"] == 1.0).all()
    assert frame["ate_rmse_m"].tolist() == [1 / 7, 1 / 7, 2 / 7, 2 / 7, 3 / 7, 3 / 7]
    np.testing.assert_array_equal(frame["curve_time_s"][0], np.arange(5, dtype=np.float32) / 3)


def test_a_run_that_ended_well_stays_and_one_that_failed_gives_way(tmp_path):
    first, second, third = PLAN[:3]
    before = [row(first), row(second, "failed", error="one")]
    write(tmp_path, *before, row(third, "failed"), plan=PLAN[:3])
    after = [row(first, "failed"), row(second, "failed", error="two"), row(third)]
    write(tmp_path, *after, plan=PLAN[:3])
    frame = read_study(tmp_path).set_index("key")
    assert frame["status"].to_dict() == {first.key: "ok", second.key: "failed", third.key: "ok"}
    assert frame["error"][second.key] == "two"


def test_a_narrower_study_loses_no_row(tmp_path):
    write(tmp_path, *(row(run, slip_m=1.0) if run is PLAN[5] else row(run) for run in PLAN))
    whole = (tmp_path / RUNS).read_bytes(), (tmp_path / TIMING).read_bytes()
    write(tmp_path, plan=PLAN[:2])
    assert {each["key"] for each in read_rows(tmp_path / RUNS)} == {run.key for run in PLAN[:2]}
    assert "slip_m" not in read_study(tmp_path)  # a number of other runs alone
    assert stored_rows(tmp_path).keys() == {run.key for run in PLAN}
    write(tmp_path)
    assert ((tmp_path / RUNS).read_bytes(), (tmp_path / TIMING).read_bytes()) == whole


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_a_row_that_was_cut_off_costs_no_other(tmp_path, kept):
    with locked(tmp_path):
        append_row(tmp_path, row(PLAN[0]))
        whole = (tmp_path / ROWS).read_bytes()
        append_row(tmp_path, row(PLAN[1]))
        cut = (tmp_path / ROWS).read_bytes()
        (tmp_path / ROWS).write_bytes(cut[: len(whole) + round(kept * (len(cut) - len(whole)))])
        assert stored_rows(tmp_path).keys() == {PLAN[0].key}
        append_row(tmp_path, row(PLAN[2]))
    assert stored_rows(tmp_path).keys() == {PLAN[0].key, PLAN[2].key}


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "text"])
@pytest.mark.parametrize("file", [RUNS, TIMING])
def test_a_damaged_or_missing_table_is_one_line(tmp_path, damage, file):
    with pytest.raises(InputError, match="no such file"):
        read_study(tmp_path)
    write(tmp_path, *map(row, PLAN))
    content = bytearray((tmp_path / file).read_bytes())
    content[60] ^= 0xFF  # inside a page, where only its checksum tells
    damaged = {"cut": content[: len(content) // 2], "flipped": content, "empty": b""}.get(damage, b"hello")
    (tmp_path / file).write_bytes(damaged)
    for read in (read_study, stored_rows):
        with pytest.raises(InputError, match=f"{file}: damaged") as told:
            read(tmp_path)
        assert "\n" not in str(told.value)


def test_a_full_disk_is_one_line_and_leaves_the_tables(tmp_path, monkeypatch):
    write(tmp_path, row(PLAN[0]), plan=PLAN[:1])
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    def full(*_args, **_options):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("pyarrow.parquet.write_table", full)
        with pytest.raises(OutputError, match="No space left on device"):
            write_tables(tmp_path, PLAN[:1], stored_rows(tmp_path))
        patched.setattr(Path, "open", full)
        with pytest.raises(OutputError, match="No space left on device"):
            append_row(tmp_path, row(PLAN[1]))
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_two_studies_in_one_folder_are_refused(tmp_path):
    with locked(tmp_path), pytest.raises(OutputError, match="in use"), locked(tmp_path):
        pass
    with locked(tmp_path):  # free again
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"), locked(tmp_path / "file"):
        pass
