"""What a command prints, whatever the terminal can show, and whether or not somebody reads it."""

import io
import os
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


def test_a_command_goes_on_if_nobody_reads(monkeypatch, capsys):
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        for _ in range(3):
            say("read")
        monkeypatch.undo()
    assert not capsys.readouterr().err


def test_a_warning_is_one_line(capsys):
    prepare_terminal()
    warnings.warn("no\n place", stacklevel=1)
    assert capsys.readouterr().err == "steelnb: warning: no place\n"
