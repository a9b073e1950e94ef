"""A flight in a cell: a frame on a page that is served as long as the kernel lives, and a figure that stays."""

import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from steelnb import viewer
from steelnb.datatypes import Segments, Trajectory
from steelnb.errors import FileMissingError
from steelnb.figures.scene import PLOTLY_TYPE, figure_recorded_scene
from tests.viewer.test_log import bars, fly


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    import IPython.display

    kept: list[Any] = []
    monkeypatch.setattr(IPython.display, "display", lambda each, **_: kept.append(each))
    return kept


def path(drift: float, count: int = 9) -> Trajectory:
    T_world_drone = np.tile(np.eye(4), (count, 1, 1))
    T_world_drone[:, 0, 3] = np.arange(count)
    T_world_drone[:, 1, 3] = drift * np.arange(count)
    return Trajectory(0.2 * np.arange(count) + 7.0, T_world_drone)


def test_a_frame_shows_the_served_file_and_one_server_does(tmp_path: Path, shown: list[Any]) -> None:
    rrd = fly(tmp_path / "flight.rrd", frames=3)
    figure = figure_recorded_scene(path(0.1), path(0.0), None, np.zeros((4, 3)), bars(2))
    viewer.inline(rrd, figure)
    viewer.inline(rrd)
    frame, bundle, again = shown
    assert frame.value == again.value
    address = frame.value.partition('src="')[2].partition('"')[0]
    assert address.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(f"{address}recording.rrd") as answer:
        assert answer.read() == rrd.read_bytes()
    assert [trace["name"] for trace in bundle[PLOTLY_TYPE]["data"]] == ["cloud", "bars found", "drifting", "corrected"]
    with pytest.raises(FileMissingError, match=r"none\.rrd"):
        viewer.inline(tmp_path / "none.rrd")


def test_the_scene_of_a_recording_has_errors_where_the_truth_is() -> None:
    prior, corrected, truth = path(0.1), path(0.02), path(0.0)
    some = Trajectory(truth.stamp_s[2:7], truth.T_world_drone[2:7])
    figure = figure_recorded_scene(prior, corrected, some, np.zeros((4, 3)), Segments.empty())
    curves = {trace.name: trace for trace in figure.data if trace.type == "scatter"}
    assert set(curves) == {"drifting", "corrected"}
    assert curves["drifting"].x == pytest.approx(0.2 * np.arange(5))
    assert curves["drifting"].y == pytest.approx(0.1 * np.arange(2, 7))
    assert curves["corrected"].y == pytest.approx(0.02 * np.arange(2, 7))
    assert "true" in {trace.name for trace in figure.data if trace.type == "scatter3d"}
