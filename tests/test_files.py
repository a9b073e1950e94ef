"""Atomic output: all of it or nothing, and messages that name the path that the user gave."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from steelnb.errors import InputError, OutputError
from steelnb.files import new_file, new_folder


def files_below(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() if path.is_file() else "" for path in folder.rglob("*")}


def test_files_appear_together_and_others_stay_unless_stale(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "out"
    with new_folder(target) as folder:
        (folder / "a").write_text("1")
        (folder / "fig_a").write_text("1")
        assert not target.exists()
    assert target.stat().st_mode & 0o777 == 0o777 & ~umask()
    (target / "notes").write_text("mine")
    with new_folder(target, stale=("fig_*",)) as folder:
        (folder / "a").write_text("2")
        (folder / "fig_b").write_text("2")
        assert files_below(target) | {"a": "", "fig_a": "", "notes": ""} != files_below(target)
        assert (target / "a").read_text() == "1"
    assert files_below(target) == {"a": "2", "fig_b": "2", "notes": "mine"}
    with new_file(target / "a") as path:
        path.write_text("3")
        assert (target / "a").read_text() == "2"
    with new_file(tmp_path / "new" / "b") as path:
        path.write_text("4")
    assert files_below(target)["a"] == "3"
    assert files_below(tmp_path / "new") == {"b": "4"}


def test_of_two_runs_into_one_new_folder_both_are_kept(tmp_path: Path) -> None:
    with new_folder(tmp_path / "out") as first:
        (first / "a").write_text("1")
        with new_folder(tmp_path / "out") as second:
            (second / "a").write_text("2")
            (second / "b").write_text("2")
    assert files_below(tmp_path / "out") == {"a": "1", "b": "2"}


def written(target: Path, names: str, text: str, overwrite: bool, meanwhile: Callable[[], None] | None = None) -> None:
    with new_folder(target, overwrite=overwrite) as folder:
        for name in names:
            (folder / name).write_text(text)
        if meanwhile is not None:
            meanwhile()


def test_without_overwriting_the_second_of_two_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="out/b: exists already"):
        written(tmp_path / "out", "ab", "1", False, lambda: written(tmp_path / "out", "bc", "2", False))
    assert files_below(tmp_path / "out") == {"b": "2", "c": "2"}


def test_a_folder_in_the_place_of_a_file_keeps_all_others(tmp_path: Path) -> None:
    (tmp_path / "out" / "b").mkdir(parents=True)
    (tmp_path / "out" / "a").write_text("earlier")
    with pytest.raises(OutputError, match="out/b: exists already"):
        written(tmp_path / "out", "abc", "new", True)
    assert files_below(tmp_path / "out") == {"a": "earlier", "b": ""}


def test_names_too_long_are_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="File name too long"), new_folder(tmp_path / ("n" * 300)):
        pytest.fail("work was begun")
    assert list(tmp_path.iterdir()) == []


def umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@pytest.mark.parametrize("fault", [KeyboardInterrupt(), OSError(28, "No space left on device"), SystemExit(1)])
@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize("of_file", [False, True])
def test_an_interruption_changes_nothing(tmp_path: Path, fault: BaseException, exists: bool, of_file: bool) -> None:
    target = tmp_path / "deep" / "out"
    if exists:
        target.mkdir(parents=True)
        (target / "a").write_text("earlier")
    before = files_below(tmp_path)

    def interrupted() -> None:
        with new_file(target / "a") if of_file else new_folder(target) as path:
            (path if of_file else path / "a").write_text("half")
            raise fault

    with pytest.raises((type(fault), OutputError)):
        interrupted()
    assert files_below(tmp_path) == before


def test_messages_name_the_path_that_was_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    for target in ("file", "file/below", "/proc/steelnb"):
        with pytest.raises(OutputError, match=f"^{target}: cannot be written: "), new_folder(target):
            pytest.fail("work was begun")
        with pytest.raises(OutputError, match=f"^{target}/a: cannot be written: "), new_file(f"{target}/a"):
            pytest.fail("work was begun")
    with pytest.raises(InputError, match=r"^out/a: bad$"), new_folder("out") as folder:
        raise InputError(f"{folder / 'a'}: bad")
    assert sorted(os.listdir()) == ["file"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_a_signal_leaves_nothing_behind_for_long(tmp_path: Path, number: signal.Signals) -> None:
    code = (
        "import signal, sys, time\nfrom steelnb.cli import exit_on_signals\nfrom steelnb.files import new_folder\n"
        "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"  # which the caller of the tests may ignore, as nohup does
        "exit_on_signals()\n"
        "with new_folder(sys.argv[1]) as folder:\n (folder / 'a').write_text('half')\n time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "out")]) as process:
        for _ in range(600):
            if any(name.endswith("/a") for name in files_below(tmp_path)):
                break
            time.sleep(0.1)
        with new_folder(tmp_path / "other"):
            pass
        assert any(name.endswith("/a") for name in files_below(tmp_path))  # of a process that still writes
        process.send_signal(number)
        assert process.wait(timeout=60) == (-number if number == signal.SIGKILL else 128 + number)
    if number == signal.SIGKILL:
        assert any(name.startswith(".steelnb-") for name in os.listdir(tmp_path))
        with new_folder(tmp_path / "out") as folder:
            (folder / "a").write_text("whole")
    assert {name for name in files_below(tmp_path) if "other" not in name} == {
        *(["out", "out/a"] if number == signal.SIGKILL else [])
    }
