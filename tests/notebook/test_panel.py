import json
from unittest.mock import Mock

import ipywidgets
import numpy as np
import pytest
from IPython.core.interactiveshell import InteractiveShell

from steelnb.core.errors import CollisionError
from steelnb.notebook import panel
from steelnb.notebook.panel import Panel
from steelnb.plots.scene3d import PLOTLY_TYPE
from steelnb.settings import Noise

SHORT = {"tof.rate_hz": 2.5}
FIRST = {"trajectory": "loops", "noise": "random-walk", "level": 1.0}
FIRST |= {"sensor": "report-4cm", "method": "icp-3dof", "seed": 1}


def make_panel(**other: object) -> Panel:
    return Panel(**{**FIRST, "tower": None, "duration_s": 6.0, "overrides": SHORT, **other})


@pytest.fixture(scope="module")
def view() -> panel.ShownFlight:
    return make_panel().show()


@pytest.mark.parametrize(
    ("noise", "level", "walk_m", "turn_rad"),
    [
        ("random-walk:0.004", 0.5, 0.002, 0.0),
        ("random-walk + yaw-random-walk", 2.0, 0.004, 0.001),
        ("random-walk", 0.0, 0.0, 0.0),
        ("none", 3.0, 0.0, 0.0),
    ],
)
def test_a_level_multiplies_every_noise(noise: str, level: float, walk_m: float, turn_rad: float) -> None:
    settings = Noise.parse(panel.at_level(noise, level))
    assert settings.random_walk_m == pytest.approx(walk_m)
    assert settings.yaw_random_walk_rad == pytest.approx(turn_rad)


def test_the_cloud_lies_on_the_steel_and_is_light(view: panel.ShownFlight) -> None:
    assert 1000 < len(view.cloud) <= panel.POINTS_MAX
    lowest = view.cloud[:, 2].min() + view.result.metrics["error_max_m"]
    assert lowest >= view.result.settings.odometry.preprocess.floor_m
    axes = view.result.truth.tower.axes
    start, along = axes[:, 0], axes[:, 1] - axes[:, 0]
    share = np.einsum("nmk,mk->nm", view.cloud[::10, None] - start, along) / (along**2).sum(axis=1)
    foot = start + np.clip(share, 0, 1)[..., None] * along
    off_m = np.linalg.norm(view.cloud[::10, None] - foot, axis=2).min(axis=1)
    assert np.median(off_m) < 0.1


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, dict]]:
    """What is displayed in a notebook: kind of message and data, in order."""
    seen: list[tuple[str, dict]] = []
    InteractiveShell.clear_instance()
    shell = InteractiveShell.instance()
    monkeypatch.setattr(
        shell.display_pub,
        "publish",
        lambda data, *_, update=False, **__: seen.append(("update" if update else "display", data)),
    )
    yield seen
    InteractiveShell.clear_instance()


def names(figure: dict) -> set[str]:
    return {trace["name"] for trace in figure["data"]}


def test_the_panel_shows_the_drift_first_then_the_correction_and_redraws_when_a_control_moves(
    shown: list, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel = make_panel()
    said: list[str] = []
    panel.status.observe(lambda change: said.append(change["new"]), "value")
    view = panel.show()
    assert view is panel.view
    assert said[0].startswith("flying")
    assert any(text.endswith("correcting it: 100 %") for text in said)
    assert said[-1].startswith("computed in")
    (first,) = (data[PLOTLY_TYPE] for kind, data in shown if kind == "display" and PLOTLY_TYPE in data)
    assert names(first) == {"true members", "true", "drifting"}
    drawn = shown[-1][1][PLOTLY_TYPE]
    assert names(drawn) == names(first) | {"cloud", "bars found", "corrected"}
    assert len(json.dumps(drawn)) < 1_000_000
    del shown[:]
    assert isinstance(panel.controls["level"], ipywidgets.FloatSlider)
    panel.controls["level"].value = 3.0
    assert panel.view.result.truth is view.result.truth, "the flight is kept"
    assert panel.view.result.settings.noise.random_walk_m == pytest.approx(0.006)
    assert panel.view.result.settings.tof.rate_hz == 2.5
    assert panel.view.result.metrics["raw_ate_rmse_m"] == pytest.approx(3 * view.result.metrics["raw_ate_rmse_m"])
    assert [kind for kind, _ in shown] == ["update"] * len(shown)
    assert shown[-1][1][PLOTLY_TYPE] != drawn
    panel.controls["method"].value = "least_squares"
    assert panel.view.result.settings.odometry.method == "least_squares"
    assert panel.status.value.startswith("computed in")
    panel.controls["sensor"].value = "starling2"
    assert panel.view.result.truth is not view.result.truth
    # A flight that fails is told, and the picture stays.
    view = panel.view
    del shown[:]
    monkeypatch.setattr("steelnb.experiment.simulate", Mock(side_effect=CollisionError("the drone touched the tower")))
    panel.controls["seed"].value = 7
    assert panel.status.value == "the drone touched the tower"
    assert panel.view is view
    assert not [data for _, data in shown if PLOTLY_TYPE in data]
