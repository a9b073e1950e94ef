"""Rerun's own window: it listens to this machine, reports to nobody, and writes nothing into the user's home."""

import json
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from steelnb.cli import main
from steelnb.viewer import native
from tests.viewer.test_log import fly


def test_no_display_is_told_before_anything_is_read(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in native.DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    assert main(["view", str(tmp_path / "missing.rrd")]) == 2
    assert "--web" in capsys.readouterr().err


def test_the_window_is_asked_for_with_nobodys_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    monkeypatch.setenv("no_proxy", "*")
    monkeypatch.setenv("HTTPS_PROXY", "http://proxy.example:3128")
    seen = native.quiet_environment(tmp_path)
    assert not {"FORCE_RERUN_ANALYTICS", "no_proxy", "NO_PROXY"} & set(seen)
    assert all("proxy.example" not in value for value in seen.values())
    config = json.loads((Path(seen["XDG_CONFIG_HOME"]) / "rerun" / "analytics.json").read_text())
    assert config["analytics_enabled"] is False
    assert native.window_command(tmp_path / "a.rrd")[-5:-3] == ["--bind", "127.0.0.1"]


def test_rerun_believes_that_it_must_not_report(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    seen = native.quiet_environment(tmp_path / "quiet") | {"HOME": str(home)}
    del seen["CI"]  # the file alone is enough
    command = [sys.executable, "-m", "rerun_cli", "analytics", "config"]
    said = subprocess.run(command, env=seen, capture_output=True, text=True, check=True).stdout
    assert json.loads(said[said.index("{") :])["analytics_enabled"] is False
    assert list(home.rglob("*")) == []
    assert list((tmp_path / "quiet").rglob("analytics/*")) == []


@pytest.mark.slow
def test_a_viewer_without_a_window_listens_to_this_machine_and_asks_nobody(tmp_path: Path) -> None:
    """The viewer draws nowhere here; where not even that goes, what it did until then is looked at."""
    rrd = fly(tmp_path / "flight.rrd", frames=4)
    home = tmp_path / "home"
    home.mkdir()
    seen = native.quiet_environment(tmp_path / "quiet") | {"HOME": str(home), "RUST_BACKTRACE": "0"}
    with (tmp_path / "log.txt").open("wb") as log:
        process = subprocess.Popen([*native.window_command(rrd), "--headless"], env=seen, stdout=log, stderr=log)
    met, places = set(), set()
    try:
        for _ in range(150):
            if process.poll() is not None:
                break
            with_children = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
            for each in with_children:
                for connection in each.net_connections("inet"):
                    places |= {connection.laddr.ip} if connection.status == "LISTEN" else set()
                    met |= {connection.raddr.ip} if connection.raddr else set()
            time.sleep(0.02)
    except psutil.Error:
        pass
    finally:
        for child in psutil.Process(process.pid).children(recursive=True) if process.poll() is None else ():
            child.kill()
        process.kill()
        process.wait()
    said = (tmp_path / "log.txt").read_text()
    assert "Listening for gRPC connections on 127.0.0.1:" in said
    assert places <= {"127.0.0.1"}
    assert met <= {"127.0.0.1"}
    assert list(home.rglob("*")) == []
