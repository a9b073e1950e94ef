"""A flight from the disk is the flight that was flown, to the bit."""

from pathlib import Path

import numpy as np
import pytest

from steelnb import experiment
from steelnb.settings import ExperimentSettings
from steelnb.simulation import cache

SETTINGS = ExperimentSettings.preset("orbit", sensor="report", duration_s=4.0)


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
    monkeypatch.setattr(cache, "fly", None)
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
        ({"noise.random_walk_m": 0.5}, 1),
        ({"tof.sigma_floor_m": 0.5}, 2),
        ({"tof.blind_s": [[1.0, 2.0]]}, 2),
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
