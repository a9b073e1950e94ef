"""A simulated flight as a recording: the experiment's scans and poses, the truth apart, range images as pictures."""

import numpy as np
import pytest

from steelnb import experiment
from steelnb.config import ExperimentSettings
from steelnb.errors import CollisionError, OutputError, SettingsError, UnsupportedFormatError
from steelnb.recordings.formats import open_recording
from steelnb.replay.simulated import record, simulated_recording
from tests.replay.flights import settings


@pytest.fixture(scope="module")
def recording():
    return simulated_recording(settings(duration_s=3.0), pictures=True)


def test_it_is_the_experiments_flight_to_the_bit(recording):
    flight, truth = experiment.simulate(settings(duration_s=3.0))
    found = recording.flight()
    np.testing.assert_array_equal(found.prior.stamp_s, flight.prior.stamp_s)
    np.testing.assert_array_equal(found.prior.T_world_drone, flight.prior.T_world_drone)
    np.testing.assert_array_equal(recording.truth.T_world_drone, truth.trajectory.T_world_drone)
    assert len(recording.poses) == len(truth.trajectory) == 376
    for mine, theirs in zip(found.scans, flight.scans, strict=True):
        assert mine.stamp_s == theirs.stamp_s
        np.testing.assert_array_equal(mine.points, theirs.points)


def test_some_scans_can_be_walked_alone(recording):
    wanted = np.zeros(15, dtype=bool)
    wanted[[2, 7]] = True
    assert [scan.stamp_s for scan in recording.scans.walk(wanted)] == recording.scans.stamp_s[[2, 7]].tolist()


def test_pictures_show_ranges(recording):
    pictures = list(recording.pictures.walk())
    assert [picture.stamp_s for picture in pictures] == pytest.approx([0.0, 1.0, 2.0])
    scans = list(recording.scans.walk())
    for picture, scan in zip(pictures, scans[::5], strict=True):
        distance = np.linalg.norm(scan.points, axis=2)
        seen = np.isfinite(distance)
        assert picture.pixels.dtype == np.uint8
        assert (picture.pixels[~seen] == 0).all()
        np.testing.assert_allclose(picture.pixels[seen], np.clip(255 - 254 * distance[seen] / 6.0, 1, 255), atol=0.51)


def test_what_is_recorded_is_read_again(tmp_path):
    said = []
    made = record(
        tmp_path / "deep" / "a.mcap", settings(duration_s=2.0), on_progress=lambda share, what: said.append(what)
    )
    found = open_recording(tmp_path / "deep" / "a.mcap")
    np.testing.assert_allclose(found.truth.T_world_drone, made.truth.T_world_drone, atol=1e-12)
    assert np.abs(found.poses.position - found.truth.position).max() > 0.01  # they drift
    assert said[0] == "flying 2 s"
    assert said[-1] == "writing"


def test_what_cannot_be_recorded_is_told_before_it_is_flown(tmp_path, monkeypatch):
    def fly(_):
        raise AssertionError("flown")

    monkeypatch.setattr(experiment, "simulate", fly)
    (tmp_path / "a.bag").write_text("old")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("old")
    for name, form, fault in (
        ("a.bag", None, OutputError),
        ("a.bag/b.bag", None, OutputError),
        ("full", None, OutputError),
        ("b.xyz", None, UnsupportedFormatError),
        ("b.bag", "mcap", UnsupportedFormatError),
    ):
        with pytest.raises(fault):
            record(tmp_path / name, settings(), form)
    with pytest.raises(SettingsError, match="at least 1 s"):
        record(tmp_path / "b.bag", settings(duration_s=0.5))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.bag", "full"]


def test_a_collision_leaves_nothing(tmp_path):
    close = ExperimentSettings.preset(duration_s=30.0, overrides={"flight.standoff_m": -0.05})
    with pytest.raises(CollisionError):
        record(tmp_path / "a.bag", close)
    assert list(tmp_path.iterdir()) == []
