"""An .rrd file holds the flight, read back by rerun's reader; and a place or disk that cannot take it is told."""

import errno
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from steelnb.io.rrd import MAP_POINTS_MAX, SCAN_POINTS_MAX, Log, thinned

from steelnb.errors import OutputError
from steelnb.io import rrd
from steelnb.types import Array, Estimate, Flight, OdometryStep, Scan, Segments, Trajectory
from tests.io.samples import T_of, made_up

T_DRONE_SENSOR = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1.0]])
PERIOD_S = 0.5


def read_rrd(path: Path) -> dict[str, list[tuple[float | None, Any]]]:
    """By ``entity`` and component, as ``/world/scan:positions``: stamps (None: always) and values of each row."""
    from rerun.chunk import RrdReader

    rows: dict[str, list[tuple[float | None, Any]]] = defaultdict(list)
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        stamps: list[float | None] = [None] * chunk.num_rows
        if not chunk.is_static:
            stamps = (np.asarray(batch.column("stamp").cast("int64")) / 1e9).tolist()
        for name in batch.schema.names:
            if ":" in name:
                values = batch.column(name).to_pylist()
                rows[f"{chunk.entity_path}:{name.partition(':')[2]}"] += zip(stamps, values, strict=True)
    return {name: sorted(of, key=lambda row: (row[0] is not None, row[0])) for name, of in rows.items()}


def fly(path: Path, frames: int = 24, start: Array | None = None, begin_s: float = 0.0, true: bool = True) -> Path:
    """The drone goes along x at 1 m a frame and drifts along y by 1 cm; half of that is taken out."""
    start = np.eye(4) if start is None else start
    points = np.random.default_rng(3).uniform(-1, 1, (30, 40, 3))
    points[:, :7] = np.nan
    stamp_s = begin_s + PERIOD_S * np.arange(frames)
    truth, prior, corrected = (
        Trajectory(stamp_s, start @ np.array([T_of((k, off * k, 0)) for k in range(frames)]))
        for off in (0, 0.01, 0.005)
    )
    flight = Flight([Scan(float(s), points) for s in stamp_s], prior, T_DRONE_SENSOR, name="a flight")
    seconds = np.zeros(frames)
    with Log(path, flight) as log:
        for k, scan in enumerate(flight.scans):
            log.step(scan, OdometryStep(scan.stamp_s, corrected.T_world_drone[k], True, "", 7 * k, {}))
            if log.map_due(scan.stamp_s):
                end = start[:3, 3] + np.arange(3.0 * (k + 1)).reshape(-1, 3)
                bars = Segments(end, end + 2.0, np.full(k + 1, 9), np.full(k + 1, 0.01))
                log.map(scan.stamp_s, np.tile(start[:3, 3] + k, (4, 1)), bars)
        matches = 7 * np.arange(frames)
        found = Estimate(prior, corrected, points, Segments.empty(), matches, ("",) * frames, {}, seconds)
        log.finish(found, truth if true else None)
    return path


def moving(of: list[tuple[float | None, Any]]) -> tuple[Array, list[Any]]:
    kept = [(stamp, value) for stamp, value in of if stamp is not None and value is not None]
    return np.array([stamp for stamp, _ in kept]), [value for _, value in kept]


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[float | None, Any]]]:
    return read_rrd(fly(tmp_path_factory.mktemp("log") / "flight.rrd"))


def test_scans_lie_where_the_corrected_poses_put_them(rows):
    stamps, scans = moving(rows["/world/scan:positions"])
    assert stamps == pytest.approx(PERIOD_S * np.arange(24))
    scan = np.random.default_rng(3).uniform(-1, 1, (30, 40, 3))[:, 7:].reshape(-1, 3)
    for k in (0, 13):
        T_world_sensor = T_of((k, 0.005 * k, 0)) @ T_DRONE_SENSOR
        expected = scan @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3]
        assert np.array(scans[k]) == pytest.approx(expected, abs=1e-5)


def test_trajectories_errors_and_matches(rows):
    for name, drift in {"true": 0.0, "drifting": 0.01, "corrected": 0.005}.items():
        ((_, strips),) = rows[f"/world/{name}:strips"]
        expected = np.column_stack([np.arange(24), drift * np.arange(24), np.zeros(24)])
        assert np.array(strips[0]) == pytest.approx(expected, abs=1e-6)
        if name != "true":
            stamps, errors = moving(rows[f"/error/{name}:scalars"])
            assert stamps == pytest.approx(PERIOD_S * np.arange(24))
            assert np.ravel(errors) == pytest.approx(drift * np.arange(24), abs=1e-12)
    assert np.ravel(moving(rows["/matches:scalars"])[1]) == pytest.approx(7 * np.arange(24))


def test_maps_are_logged_every_five_seconds(rows):
    stamps, maps = moving(rows["/world/map:positions"])
    assert stamps.tolist() == [0.0, 5.0, 10.0]
    assert [points[0][0] for points in maps] == [0.0, 10.0, 20.0]
    assert [len(strips) for strips in moving(rows["/world/bars:strips"])[1]] == [1, 11, 21]


def test_without_truth_there_is_no_error(tmp_path):
    untrue = read_rrd(fly(tmp_path / "untrue.rrd", frames=3, true=False))
    assert not any(name.startswith("/error/") and name.endswith(":scalars") for name in untrue)
    assert "/world/true:strips" not in untrue


def test_coordinates_of_a_country_keep_their_centimetres(tmp_path):
    start = T_of((691_234.56, 5_334_567.89, 512.3))
    far = read_rrd(fly(tmp_path / "utm.rrd", frames=4, start=start, begin_s=1.7e9))
    stamps, maps = moving(far["/world/map:positions"])
    ((_, strips),) = far["/world/true:strips"]
    way = np.array(strips[0])
    assert stamps[0] == pytest.approx(1.7e9, abs=1e-6)
    assert np.abs(way).max() < 6
    assert np.diff(way[:, 0]) == pytest.approx(1.0, abs=1e-6)
    assert maps[0][0] == pytest.approx(way[0], abs=1e-5)


def test_points_are_thinned_evenly(tmp_path):
    points = np.random.default_rng(0).normal(size=(90_000, 3))
    with Log(tmp_path / "many.rrd", made_up()) as log:
        log.step(Scan(0.0, points), OdometryStep(0.0, np.eye(4), True, "", 0, {}))
        log.map(0.0, points, Segments.empty())
    many = read_rrd(tmp_path / "many.rrd")
    assert len(moving(many["/world/scan:positions"])[1][0]) == SCAN_POINTS_MAX
    assert len(moving(many["/world/map:positions"])[1][0]) == MAP_POINTS_MAX
    index = thinned(np.arange(43_200.0)[:, None], 2000)[:, 0]
    assert len(set(index)) == 2000
    assert np.histogram(index, bins=20)[0] == pytest.approx(100, abs=3)
    assert np.histogram(index % 180, bins=18)[0] == pytest.approx(2000 / 18, abs=25)  # not in step with a row


def test_a_place_or_a_disk_that_cannot_take_it_is_told(tmp_path, monkeypatch):
    with pytest.raises(OutputError, match=r"a\.rrd: cannot be written"), Log(tmp_path / "no" / "a.rrd", made_up()):
        pass

    def full(source: Any, target: Any, length: int) -> None:
        target.write(source.read(100))
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(rrd.shutil, "copyfileobj", full)
    with pytest.raises(OutputError, match=r"flight\.rrd: cannot be written: No space left on device"):
        fly(tmp_path / "flight.rrd")
