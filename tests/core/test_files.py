"""Output is complete or absent, and any error while reading becomes one line."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from steelnb.core.errors import InputError, OutputError
from steelnb.core.files import check_folder, check_writable, new_file, new_folder, reading


def files_below(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() if path.is_file() else "" for path in folder.rglob("*")}


def test_files_appear_together_and_others_stay_unless_stale(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "out"
    with new_folder(target) as folder:
        (folder / "a").write_text("1")
        (folder / "fig_a").write_text("1")
        assert not target.exists()
    (tmp_path / "usual").mkdir()
    assert target.stat().st_mode == (tmp_path / "usual").stat().st_mode
    (target / "notes").write_text("mine")
    with new_folder(target, stale=("fig_*", "fig_a")) as folder:
        (folder / "a").write_text("2")
        (folder / "fig_b").write_text("2")
        assert files_below(target) | {"a": "", "fig_a": "", "notes": ""} != files_below(target)
        assert (target / "a").read_text() == "1"
    assert files_below(target) == {"a": "2", "fig_b": "2", "notes": "mine"}


@pytest.mark.parametrize("fault", [KeyboardInterrupt(), OSError(28, "No space left on device"), SystemExit(1)])
@pytest.mark.parametrize("exists", [False, True])
def test_an_interruption_changes_nothing(tmp_path: Path, fault: BaseException, exists: bool) -> None:
    target = tmp_path / "deep" / "out"
    if exists:
        target.mkdir(parents=True)
        (target / "a").write_text("1")
    before = files_below(tmp_path)
    kind = OutputError if isinstance(fault, OSError) else type(fault)
    with pytest.raises(kind), new_folder(target) as folder:  # noqa: PT012
        (folder / "a").write_text("half")
        raise fault
    assert files_below(tmp_path) == before


def test_an_unwritable_folder_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("1")
    with (
        pytest.raises(OutputError, match=r"file/out: cannot be written: Not a directory"),
        new_folder(tmp_path / "file" / "out"),
    ):
        pytest.fail("the place is refused before any work")
    with pytest.raises(OutputError, match=r"file/out: cannot be written"):
        check_writable(tmp_path / "file" / "out")
    check_writable(tmp_path / "new" / "folder")
    with pytest.raises(OutputError, match=r"file: cannot be written: "), new_folder(tmp_path / "file") as folder:
        (folder / "a").write_text("2")
    assert files_below(tmp_path) == {"file": "1"}


def test_a_killed_process_leaves_nothing_half_written(tmp_path: Path) -> None:
    code = (
        "import sys, time\nfrom steelnb.core.files import new_folder\n"
        "with new_folder(sys.argv[1]) as folder:\n (folder / 'a').write_text('half')\n print(flush=True)\n"
        " time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "out")], stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("fault", [ValueError("two\nlines"), KeyError("x"), OSError(5, "Input/output error")])
def test_any_exception_of_a_reader_is_one_line_with_the_name(tmp_path: Path, fault: Exception) -> None:
    (tmp_path / "a.ply").write_text("")
    with pytest.raises(InputError, match=r"a.ply: not a PLY file: ") as told, reading(tmp_path / "a.ply", "a PLY file"):
        raise fault
    assert "\n" not in str(told.value)
    with pytest.raises(InputError, match=r"a: does not exist"), reading(tmp_path / "a", "a PLY file"):
        pass
    with pytest.raises(InputError, match=r": a folder; expected a PLY file"), reading(tmp_path, "a PLY file"):
        pass


@pytest.mark.parametrize("fault", [None, KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_a_file_is_written_whole_or_not_at_all_and_its_folder_is_made(
    tmp_path: Path, fault: BaseException | None
) -> None:
    old, new, link = tmp_path / "old.csv", tmp_path / "deep" / "er" / "new.csv", tmp_path / "link.csv"
    old.write_text("1")
    link.symlink_to(old)
    before = files_below(tmp_path)
    for target in (new, link):
        kind = OutputError if isinstance(fault, OSError) else type(fault)
        with contextlib.nullcontext() if fault is None else pytest.raises(kind), new_file(target) as file:
            file.write_text("2")
            if fault:
                raise fault
    if fault:
        assert files_below(tmp_path) == before
    else:
        assert link.is_symlink()
        assert old.read_text() == new.read_text() == "2"


def test_a_folder_is_no_file_and_a_device_is_written_to(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="a folder; expected the name of a file"), new_file(tmp_path):
        pass
    with pytest.raises(OutputError, match="cannot be written"), new_file(tmp_path / "file" / "x"):
        (tmp_path / "file").write_text("")
    with new_file(os.devnull) as file:
        assert file == Path(os.devnull)


def test_a_folder_that_is_read_is_not_written_to(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path, target_is_directory=True)
    for target in (tmp_path, tmp_path / "link", tmp_path / "link" / ".." / tmp_path.name):
        with pytest.raises(OutputError, match="is what is read; expected another folder"):
            check_folder(target, True, tmp_path)
    check_folder(tmp_path / "inner", True, tmp_path)
