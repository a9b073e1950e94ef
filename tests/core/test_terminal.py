"""What a command prints, whatever the terminal can show, and whether or not somebody reads it."""

import io
import os
import subprocess
import sys
import warnings

import pytest

from steelnb import cli
from steelnb.core.terminal import prepare_terminal, say


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "utf-8"])
def test_what_an_encoding_lacks_is_a_question_mark(monkeypatch, encoding):
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(io.BytesIO(), encoding))
    assert cli.main(["run", "90° → \udcff.bag"]) == 2
    say("90° → \udcff")
    for stream, after in ((sys.stdout, "\n"), (sys.stderr, ".bag: does not exist; expected a recording\n")):
        assert ("90° → \udcff" + after).encode(encoding, "replace") in stream.buffer.getvalue()


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["--version"]])
def test_a_help_text_without_room_is_one_line(arguments):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "steelnb", *arguments], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert done.returncode in (0, 2)
    assert done.stderr.count("\n") == 1
    assert "No space left on device" in done.stderr


@pytest.mark.parametrize(("name", "said"), [("pipe", ""), ("/dev/full", "stdout: No space left on device")])
def test_a_command_goes_on_if_nobody_reads(monkeypatch, capsys, name, said):
    if name == "pipe":
        reader, writer = os.pipe()
        os.close(reader)
    else:
        writer = os.open(name, os.O_WRONLY)
    with os.fdopen(writer, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        for _ in range(3):
            say("read")
        monkeypatch.undo()
    assert capsys.readouterr().err.count("\n") == bool(said)


def test_a_warning_is_one_line(capsys):
    prepare_terminal()
    warnings.warn("no\n place", stacklevel=1)
    assert capsys.readouterr().err == "steelnb: warning: no place\n"


@pytest.mark.parametrize("closed", [["stdout"], ["stderr"], ["stdout", "stderr"]])
def test_a_closed_stream_shows_nothing(monkeypatch, closed):
    for name in closed:
        monkeypatch.setattr(sys, name, None)
    assert cli.main(["run", "nowhere.bag"]) == 2
