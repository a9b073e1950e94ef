"""The Parquet dataset of a study, with made-up rows."""

import errno
import itertools
from pathlib import Path

import numpy as np
import pytest

from steelnb.errors import FileMissingError, OutputError
from steelnb.study.plan import Block, make_runs
from steelnb.study.store import RUNS, TIMES, TIMING, Store, holding, read_study, read_table

RUNS_OF = make_runs(
    {
        "a": Block(
            seeds=[1, 2, 3], trajectories=["vertical"], noises=["random-walk"], sensors=["report"],
            methods=["average", "icp"], duration_s=4.0,
        )
    },
    None,
)  # fmt: skip


def row(run, status="ok", **more):
    return {
        **run.case, "key": run.key, "status": status, "error": "" if status == "ok" else "Traceback\nValueError: no",
        "ate_rmse_m": run.settings.seed / 7, "curve_time_s": np.arange(5, dtype=np.float32),
        "curve_matches": np.arange(5, dtype=np.int32), "seconds": 1.5, "machine": "one", **more,
    }  # fmt: skip


def parts(folder: Path) -> list[Path]:
    return sorted((folder / "parts").glob("*.parquet"))


def test_the_table_is_the_same_however_its_rows_came(tmp_path):
    orders = ([[0, 1, 2, 3, 4, 5]], [[5], [0, 3], [1], [4, 2]], [[k] for k in (3, 1, 5, 0, 2, 4)])
    tables = []
    for k, order in enumerate(orders):
        folder = tmp_path / str(k)
        for batch in order:
            # Some in a store of their own, as after a restart; times and machines differ.
            store = Store(folder)
            store.add([row(RUNS_OF[j], seconds=float(k), machine=str(k)) for j in batch])
        Store(folder).compact(RUNS_OF)
        tables.append((folder / RUNS).read_bytes())
        assert len(parts(folder)) == 1
    assert tables[0] == tables[1] == tables[2]
    table = read_table(tmp_path / "0" / RUNS)
    assert not {*TIMES} & {*table.column_names}
    assert table["seed"].to_pylist() == [1, 1, 2, 2, 3, 3]
    assert table["method"].to_pylist() == ["average", "icp"] * 3
    frame = read_study(tmp_path / "1")
    assert (frame["seconds"] == 1.0).all()
    np.testing.assert_array_equal(frame["curve_time_s"][0], np.arange(5))


def test_a_run_that_went_well_stays_and_one_that_failed_gives_way(tmp_path):
    first, second, third = RUNS_OF[:3]
    store = Store(tmp_path)
    store.add([row(first), row(second, "failed", error="first")])
    store.add([row(first, "failed"), row(second, "failed", error="last"), row(third, "failed")])
    store.add([row(third)])
    table = Store(tmp_path).compact(RUNS_OF[:3]).to_pandas().set_index("key")
    assert table["status"].to_dict() == {first.key: "ok", second.key: "failed", third.key: "ok"}
    assert table["error"][second.key] == "last"
    assert Store(tmp_path).done() == {first.key, third.key}


def test_a_narrower_study_loses_nothing_and_a_clone_needs_no_parts(tmp_path):
    store = Store(tmp_path)
    store.add([row(run) for run in RUNS_OF])
    assert store.compact(RUNS_OF[:2]).num_rows == 2
    assert Store(tmp_path).done() == {run.key for run in RUNS_OF}
    store.compact(RUNS_OF)
    for path in parts(tmp_path):
        path.unlink()
    cloned = Store(tmp_path)
    assert cloned.done() == {run.key for run in RUNS_OF}
    before = (tmp_path / RUNS).read_bytes(), (tmp_path / TIMING).read_bytes()
    cloned.compact(RUNS_OF)
    assert ((tmp_path / RUNS).read_bytes(), (tmp_path / TIMING).read_bytes()) == before


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "text"])
def test_a_damaged_part_is_set_aside_and_nothing_else_is_lost(tmp_path, damage):
    store = Store(tmp_path)
    for run in RUNS_OF[:3]:
        store.add([row(run)])
    victim = parts(tmp_path)[1]
    content = bytearray(victim.read_bytes())
    if damage == "flipped":  # inside a page, where only its checksum tells
        content[60] ^= 0xFF
    victim.write_bytes({"cut": content[: len(content) // 2], "flipped": content, "empty": b""}.get(damage, b"hello"))
    looked = Store(tmp_path, aside=False)
    assert looked.done() == {RUNS_OF[0].key, RUNS_OF[2].key}
    assert victim.exists()
    opened = Store(tmp_path)
    assert opened.done() == {RUNS_OF[0].key, RUNS_OF[2].key}
    assert len(opened.notes) == 1
    assert all(word in opened.notes[0] for word in (str(victim), "damaged", ".corrupt", "run again"))
    assert "\n" not in opened.notes[0]
    assert not victim.exists()
    assert victim.with_name(f"{victim.name}.corrupt").exists()
    opened.add([row(RUNS_OF[1])])
    assert opened.compact(RUNS_OF).num_rows == 3
    assert not Store(tmp_path).notes


def test_a_damaged_table_is_rebuilt_from_its_parts(tmp_path):
    store = Store(tmp_path)
    store.add([row(run) for run in RUNS_OF])
    store.compact(RUNS_OF)
    good = (tmp_path / RUNS).read_bytes()
    (tmp_path / RUNS).write_bytes(good[:100])
    with pytest.raises(FileMissingError, match="damaged"):
        read_study(tmp_path)
    again = Store(tmp_path)
    assert len(again.notes) == 1
    again.compact(RUNS_OF)
    assert (tmp_path / RUNS).read_bytes() == good


def test_a_full_disk_is_one_line_and_leaves_what_was_there(tmp_path, monkeypatch):
    store = Store(tmp_path)
    store.add([row(RUNS_OF[0])])
    store.compact(RUNS_OF)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    whole = Path.write_bytes

    def full(path: Path, content) -> int:
        whole(path, bytes(content)[:50])  # what a disk that fills up leaves
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    for act in (lambda: store.add([row(RUNS_OF[1])]), lambda: store.compact(RUNS_OF)):
        with pytest.raises(OutputError, match="No space left on device") as told:
            act()
        assert "\n" not in str(told.value)
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_two_studies_in_one_folder_are_refused(tmp_path):
    with holding(tmp_path), pytest.raises(OutputError, match="in use"), holding(tmp_path):
        pass
    with holding(tmp_path):  # free again
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"), holding(tmp_path / "file"):
        pass


def test_other_columns_of_an_older_part_are_filled_with_nothing(tmp_path):
    store = Store(tmp_path)
    store.add([row(RUNS_OF[0], bend_deg=1.0)])
    store.add([row(RUNS_OF[1], slip_m=2.0)])
    frame = Store(tmp_path).compact(RUNS_OF).to_pandas()
    for name, k in itertools.product(("bend_deg", "slip_m"), (0, 1)):
        assert np.isnan(frame[name][k]) == ((name == "bend_deg") == (k == 1))
    only = Store(tmp_path).compact(RUNS_OF[:1])
    assert "slip_m" not in only.column_names
