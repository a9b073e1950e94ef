"""The server of the web viewer: what it answers, to whom, and where it listens."""

import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path

import psutil
import pytest

from steelnb.cli import main
from steelnb.errors import FileMissingError, SettingsError
from steelnb.viewer import web
from tests.viewer.test_log import fly


@pytest.fixture(scope="module")
def rrd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("web") / "flight.rrd", frames=4)


@pytest.fixture(scope="module")
def address(rrd: Path) -> Iterator[str]:
    with web.served(rrd) as address:
        yield address


def test_the_page_its_viewer_and_the_file_are_served(address: str, rrd: Path) -> None:
    for name, kind in {
        "": "text/html", "view.js": "text/javascript", "view.css": "text/css", "widget.js": "text/javascript",
        "widget.css": "text/css", "re_viewer_bg.wasm": "application/wasm",
    }.items():  # fmt: skip
        with urllib.request.urlopen(address + name) as answer:
            assert answer.headers["Content-Type"].startswith(kind), name
            assert len(answer.read()) == int(answer.headers["Content-Length"]) > 0
    with urllib.request.urlopen(f"{address}recording.rrd?again=1") as answer:
        assert answer.read() == rrd.read_bytes()
    request = urllib.request.Request(f"{address}recording.rrd", method="HEAD")
    with urllib.request.urlopen(request) as answer:
        assert answer.read() == b""
        assert int(answer.headers["Content-Length"]) == rrd.stat().st_size


def test_no_page_may_ask_another_address(address: str) -> None:
    for name in ("", "view.js", "widget.js", "recording.rrd"):
        with urllib.request.urlopen(address + name) as answer:
            policy = dict(part.split(" ", 1) for part in answer.headers["Content-Security-Policy"].split("; "))
        assert policy["default-src"] == "'none'"
        assert policy["connect-src"] == "'self'"
        assert not any("http" in sources or "*" in sources for sources in policy.values())


@pytest.mark.parametrize(
    "path", ["/../web.py", "/web.py", "/etc/passwd", "/recording.rrd.pipe", "/%2e%2e/log.py", "/recording.rrd/"]
)
def test_nothing_else_is_served(address: str, path: str) -> None:
    connection = HTTPConnection(address.removeprefix("http://").rstrip("/"))
    connection.request("GET", path)
    assert connection.getresponse().status == 404
    connection.close()


def test_another_sites_name_for_this_address_is_refused(address: str) -> None:
    for host, status in {"evil.example": 403, "evil.example:80": 403, "": 403}.items():
        request = urllib.request.Request(f"{address}recording.rrd", headers={"Host": host})
        with pytest.raises(urllib.error.HTTPError, match=str(status)):
            urllib.request.urlopen(request)
    port = address.rstrip("/").rpartition(":")[2]
    request = urllib.request.Request(f"{address}recording.rrd", headers={"Host": f"localhost:{port}"})
    with urllib.request.urlopen(request) as answer:
        assert answer.status == 200


def test_a_port_that_is_taken_and_a_file_that_is_missing_are_told(address: str, rrd: Path, tmp_path: Path) -> None:
    port = int(address.rstrip("/").rpartition(":")[2])
    with pytest.raises(SettingsError, match=f"port = {port}"):
        web.WebViewer(rrd, port)
    with pytest.raises(SettingsError, match="port = 70000"):
        web.WebViewer(rrd, 70_000)
    with pytest.raises(FileMissingError, match=r"none\.rrd"):
        web.serve_behind(tmp_path / "none.rrd")


def test_the_command_listens_to_this_machine_alone_until_it_is_stopped(rrd: Path) -> None:
    command = [sys.executable, "-m", "steelnb.cli", "view", str(rrd), "--web"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        address = next(word for word in line.split() if word.startswith("http://"))
        assert line.startswith("flight.rrd is at http://127.0.0.1:")
        with urllib.request.urlopen(address) as answer:
            assert b"view.js" in answer.read()
        family = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
        listening = [c.laddr for each in family for c in each.net_connections("inet") if c.status == "LISTEN"]
        assert [place.ip for place in listening] == ["127.0.0.1"]
        if shutil.which("ss"):
            sockets = subprocess.run(["ss", "-ltn"], capture_output=True, text=True, check=True).stdout
            port = address.rstrip("/").rpartition(":")[2]
            assert f"127.0.0.1:{port} " in sockets
            assert f"0.0.0.0:{port} " not in sockets
            assert f"*:{port} " not in sockets
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) in (0, 130)
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()
    finally:
        process.kill()
        process.wait()
    time.sleep(0.1)
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(address)


def test_what_cannot_be_shown_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.rrd").write_bytes(b"no such thing")
    (tmp_path / "a.json").write_text("{")
    (tmp_path / "b.json").write_text('{"format": "steelnb segments, version 1", "segments": [{}]}')
    (tmp_path / "a.txt.gz").touch()
    for name in ("a.rrd", "a.json", "b.json", "a.txt.gz", "none"):
        assert main(["view", str(tmp_path / name), "--web"]) == 2, name
        lines = capsys.readouterr().err.splitlines()
        assert len([line for line in lines if line.startswith("steelnb: error:")]) == 1
        assert name in lines[-1]
