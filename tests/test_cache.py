"""What comes from the disk is what was computed, to the bit."""

from pathlib import Path

import numpy as np
import pytest

from steelnb import cache, experiment
from steelnb.odometry import cache as estimates
from steelnb.settings import ExperimentSettings
from steelnb.simulation import cache as flights

SETTINGS = ExperimentSettings.preset("loops", sensor="report-4cm", duration_s=4.0)


def arrays(settings: ExperimentSettings) -> list[np.ndarray]:
    flight, truth = experiment.simulate(settings)
    assert flight.imu is not None
    scans = flight.scans
    return [
        scans.range_m, scans.stamp_s, scans.ray, flight.prior.T_world_drone, flight.imu.specific_force,
        flight.imu.angular_rate, flight.imu.stamp_s, truth.trajectory.T_world_drone,
        *truth.visibility.slices,
    ]  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("STEELNB_CACHE", str(tmp_path / ".cache"))
    return tmp_path / ".cache" / "flights"


def test_a_kept_flight_is_the_same_to_the_bit(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = arrays(SETTINGS)
    monkeypatch.setattr(flights, "fly", None)
    again = arrays(SETTINGS)
    monkeypatch.undo()
    monkeypatch.delenv("STEELNB_CACHE", raising=False)
    for one, two, flown in zip(first, again, arrays(SETTINGS), strict=True):
        assert one.dtype == two.dtype
        assert one.strides == two.strides, "sums go in the same order"
        assert np.array_equal(one, two, equal_nan=True)
        assert np.array_equal(one, flown, equal_nan=True)


@pytest.mark.parametrize(
    ("changed", "count"),
    [
        ({"noise_name": "random-walk:0.5"}, 1),
        ({"tof.sigma_floor_m": 0.5}, 2),
        ({"tof.blind_s": [[1.0, 2.0]]}, 2),
        ({"tof.faults": ["footprint"]}, 2),
        ({"imu": {"gyro_noise": 1e-3}}, 1),
        ({"flight.gust_sigma_m_s": 0.01}, 2),
        ({"tower.base_width_m": 4.1}, 2),
    ],
)
def test_drift_shares_a_flight_and_what_is_flown_and_seen_does_not(folder: Path, changed: dict, count: int) -> None:
    arrays(SETTINGS)
    arrays(SETTINGS.override(changed))
    assert len(list(folder.iterdir())) == count


def test_code_counts_and_broken_files_are_flown_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = arrays(SETTINGS)
    (kept,) = folder.iterdir()
    whole = kept.read_bytes()
    for broken in (whole[: len(whole) // 2], b"", b"PK\x03\x04"):
        kept.write_bytes(broken)
        assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(first, arrays(SETTINGS), strict=True))
        assert kept.read_bytes() == whole
    monkeypatch.setattr(cache, "code_digest", lambda names: "other")
    arrays(SETTINGS)
    assert len(list(folder.iterdir())) == 2


def test_the_flights_used_longest_ago_go(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in (1, 2):
        arrays(SETTINGS.replace(seed=seed))
    first, second = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)
    arrays(SETTINGS.replace(seed=1))  # used again: younger than the second
    monkeypatch.setattr(cache, "BYTES_MAX", first.stat().st_size * 5 // 2)
    arrays(SETTINGS.replace(seed=3))
    assert first in folder.iterdir()
    assert second not in folder.iterdir()


def test_a_folder_that_cannot_be_written_costs_time_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("STEELNB_CACHE", str(tmp_path / "file"))
    assert len(arrays(SETTINGS)) > 8


@pytest.mark.parametrize("method", ["least_squares_yaw", "icp", "combined"])
def test_a_kept_estimate_is_the_same_to_the_bit(folder: Path, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    settings = ExperimentSettings.preset("loops", "random-walk", sensor="report-4cm", duration_s=4.0, method=method)
    seen: list[float] = []
    first = experiment.run(settings, seen.append)
    monkeypatch.setattr(estimates, "run_online", None)
    again = experiment.run(settings, seen.append)
    assert len(seen) > 2
    assert seen[-1] == 1.0
    assert again.metrics == first.metrics
    assert again.reason == first.reason
    assert list(again.seconds) == list(first.seconds)
    for one, two in (
        (first.corrected.T_world_drone, again.corrected.T_world_drone), (first.points, again.points),
        (first.segments.start, again.segments.start), (first.segments.count, again.segments.count),
        (first.matches, again.matches), (first.update_s, again.update_s),
        *zip(first.seconds.values(), again.seconds.values(), strict=True),
    ):  # fmt: skip
        assert one.dtype == two.dtype
        np.testing.assert_array_equal(one, two)


def test_an_estimate_belongs_to_the_prior_the_scans_and_the_settings(folder: Path) -> None:
    base = ExperimentSettings.preset("loops", "random-walk", sensor="report-4cm", duration_s=3.0, method="icp")
    for changed in (
        {},
        {"noise_name": "random-walk:0.5"},
        {"tof.blind_s": [[1.0, 2.0]]},
        {"clouds.max_correspondence_m": 0.3},
    ):
        experiment.run(base.override(changed))
        experiment.run(base.override(changed))
    assert len(list((folder.parent / "estimates").iterdir())) == 4


def test_a_smoothed_flight_starts_from_the_kept_estimate(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = ExperimentSettings.preset("loops", "random-walk", duration_s=6.0, method="combined")
    combined = experiment.run(settings)
    monkeypatch.setattr(estimates, "run_online", None)
    found = experiment.run(ExperimentSettings.preset("loops", "random-walk", duration_s=6.0, method="smoothed"))
    assert found.unsmoothed == ""
    assert not np.array_equal(found.corrected.T_world_drone, combined.corrected.T_world_drone)
    assert found.pose_covariance is not None
    assert combined.pose_covariance is None
    assert np.array_equal(found.update_s, combined.update_s)


def test_rules_of_segments_with_the_same_settings_are_kept_apart(folder: Path) -> None:
    for method in ("average", "least_squares"):
        experiment.run(ExperimentSettings.preset("loops", sensor="report-4cm", duration_s=2.0, method=method))
    assert len(list((folder.parent / "estimates").iterdir())) == 2
