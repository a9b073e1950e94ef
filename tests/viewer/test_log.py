"""A log holds what was given to it, read back by rerun's reader; and what happens where it cannot be written."""

import errno
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from steelnb.datatypes import Array, OdometryStep, Segments
from steelnb.errors import OutputError
from steelnb.recordings.recording import Picture
from steelnb.viewer import Log, drain
from steelnb.viewer.log import MAP_PERIOD_S, MAP_POINTS_MAX, SCAN_POINTS_MAX, thinned
from tests.viewer.read_rrd import read_rrd

T_DRONE_SENSOR = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1.0]])
PERIOD_S = 0.5


def pose(x: float, y: float = 0.0, z: float = 0.0) -> Array:
    T_world_drone = np.eye(4)
    T_world_drone[:3, 3] = x, y, z
    return T_world_drone


def bars(count: int) -> Segments:
    start = np.arange(3.0 * count).reshape(count, 3)
    return Segments(start, start + np.array([0, 0, 2.0]), np.full(count, 9), np.full(count, 0.01))


def fly(path: Path, frames: int = 24, start: Array | None = None, begin_s: float = 0.0, true: bool = True) -> Path:
    """The drone goes along x at 1 m a frame and drifts along y by 1 cm; half of that is taken out."""
    start = pose(0.0) if start is None else start
    rng = np.random.default_rng(3)
    scan = rng.uniform(-1, 1, (30, 40, 3))
    scan[:, :7] = np.nan
    with Log(path, "a flight", T_DRONE_SENSOR) as log:
        for k in range(frames):
            stamp_s = begin_s + PERIOD_S * k
            step = OdometryStep(stamp_s, start @ pose(k, 0.005 * k), True, "", 7 * k, {})
            log.frame(
                stamp_s,
                scan,
                step,
                start @ pose(k, 0.01 * k),
                start @ pose(k) if true else None,
                map_points=np.tile(start[:3, 3] + k, (4, 1)),
                segments=bars(k + 1),
                picture=Picture(stamp_s - 0.1, np.full((8, 6, 3), 10 * k, np.uint8)) if k % 4 == 0 else None,
            )
    return path


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[float | None, Any]]]:
    return read_rrd(fly(tmp_path_factory.mktemp("log") / "new" / "flight.rrd"))


def moving(of: list[tuple[float | None, Any]]) -> tuple[Array, list[Any]]:
    kept = [(stamp, value) for stamp, value in of if stamp is not None and value is not None]
    return np.array([stamp for stamp, _ in kept]), [value for _, value in kept]


def test_every_frame_is_on_the_timeline(rows: dict) -> None:
    for name in ("scan:positions", "drone:translation", "true:strips", "drifting:strips", "corrected:strips"):
        stamps, _ = moving(rows[f"/world/{name}"])
        assert stamps == pytest.approx(PERIOD_S * np.arange(24)), name


def test_a_scan_lies_where_the_corrected_pose_puts_it(rows: dict) -> None:
    _, scans = moving(rows["/world/scan:positions"])
    scan = np.random.default_rng(3).uniform(-1, 1, (30, 40, 3))[:, 7:].reshape(-1, 3)
    for k in (0, 13):
        T_world_sensor = pose(k, 0.005 * k) @ T_DRONE_SENSOR
        expected = scan @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3]
        assert np.array(scans[k]) == pytest.approx(expected, abs=1e-5)


def test_trajectories_join_and_errors_are_their_distance(rows: dict) -> None:
    for name, drift in {"true": 0.0, "drifting": 0.01, "corrected": 0.005}.items():
        _, strips = moving(rows[f"/world/{name}:strips"])
        ways = np.array(strips)[:, 0]  # (frames, 2, 3)
        assert ways[1:, 0] == pytest.approx(ways[:-1, 1])
        assert ways[:, 1] == pytest.approx(np.column_stack([np.arange(24), drift * np.arange(24), np.zeros(24)]))
        if name != "true":
            _, errors = moving(rows[f"/error/{name}:scalars"])
            assert np.ravel(errors) == pytest.approx(drift * np.arange(24), abs=1e-12)
    _, matches = moving(rows["/matches:scalars"])
    assert np.ravel(matches) == pytest.approx(7 * np.arange(24))


def test_a_map_is_logged_now_and_then_and_at_the_end(rows: dict) -> None:
    stamps, maps = moving(rows["/world/map:positions"])
    assert stamps.tolist() == [0.0, MAP_PERIOD_S, 2 * MAP_PERIOD_S, 23 * PERIOD_S]
    assert [points[0][0] for points in maps] == [0.0, 10.0, 20.0, 23.0]
    _, logged = moving(rows["/world/bars:strips"])
    assert [len(strips) for strips in logged] == [1, 11, 21, 24]
    last = bars(24)
    assert np.array(logged[-1]) == pytest.approx(np.stack([last.start, last.end], axis=1))


def test_pictures_have_their_own_stamps_and_the_scan_is_one_too(rows: dict) -> None:
    import io

    from PIL import Image

    stamps, blobs = moving(rows["/camera:blob"])
    assert stamps == pytest.approx(PERIOD_S * np.arange(0, 24, 4) - 0.1)
    stamps, ranges = moving(rows["/range:blob"])
    assert len(stamps) == 24
    with Image.open(io.BytesIO(np.array(blobs[2][0], np.uint8).tobytes())) as picture:
        assert picture.size == (6, 8)
        assert np.asarray(picture) == pytest.approx(80, abs=2)
    with Image.open(io.BytesIO(np.array(ranges[0][0], np.uint8).tobytes())) as picture:
        grey = np.asarray(picture.convert("L"), dtype=float)
    assert grey.shape == (30, 40)
    assert grey[:, :5].mean() < 20
    assert grey[:, 12:].mean() > 60


def test_colours_are_those_of_the_figures(rows: dict) -> None:
    from steelnb.figures.scene import TRACKS

    for name, colour in TRACKS.items():
        (_, [packed]), *_ = rows[f"/world/{name}:colors"]
        assert f"#{packed >> 8:06x}" == colour.lower()


def test_without_truth_there_is_no_error_and_without_odometry_no_correction(tmp_path: Path) -> None:
    untrue = read_rrd(fly(tmp_path / "untrue.rrd", frames=3, true=False))
    assert not any(name.startswith("/error/") and name.endswith(":scalars") for name in untrue)
    assert "/world/true:strips" not in untrue
    with Log(tmp_path / "raw.rrd", "raw", T_DRONE_SENSOR) as log:
        log.frame(0.0, np.ones((5, 3)), None, pose(2.0))
    raw = read_rrd(tmp_path / "raw.rrd")
    assert "/world/corrected:strips" not in raw
    assert "/matches:scalars" not in raw
    assert "/range:blob" not in raw
    assert moving(raw["/world/scan:positions"])[1][0][0] == pytest.approx([2.0 + 0.1 - 1.0, 1.0, 1.2])


def test_coordinates_of_a_country_keep_their_centimetres(tmp_path: Path) -> None:
    start = pose(691_234.56, 5_334_567.89, 512.3)
    far = read_rrd(fly(tmp_path / "utm.rrd", frames=4, start=start, begin_s=1.7e9))
    stamps, strips = moving(far["/world/true:strips"])
    assert stamps[1] - stamps[0] == pytest.approx(PERIOD_S, abs=1e-6)
    ways = np.array(strips)[:, 0, 1]
    assert np.abs(ways).max() < 5
    assert np.diff(ways[:, 0]) == pytest.approx(1.0, abs=1e-6)
    _, maps = moving(far["/world/map:positions"])
    assert maps[0][0] == pytest.approx(ways[0], abs=1e-5)


def test_points_are_thinned_evenly_and_the_file_stays_small(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(90_000, 3))
    with Log(tmp_path / "many.rrd", "many", np.eye(4)) as log:
        log.frame(0.0, points, None, pose(0.0), map_points=points)
    many = read_rrd(tmp_path / "many.rrd")
    assert len(moving(many["/world/scan:positions"])[1][0]) == SCAN_POINTS_MAX
    assert len(moving(many["/world/map:positions"])[1][0]) == MAP_POINTS_MAX
    index = thinned(np.arange(43_200.0)[:, None], 2000)[:, 0]
    assert len(set(index)) == 2000
    assert np.histogram(index, bins=20)[0] == pytest.approx(100, abs=3)
    assert np.histogram(index % 180, bins=18)[0] == pytest.approx(2000 / 18, abs=25)  # not in step with a row


def test_rerun_finds_nothing_wrong_with_the_file(tmp_path: Path) -> None:
    from steelnb.viewer.native import quiet_environment

    path = fly(tmp_path / "flight.rrd")
    command = [sys.executable, "-m", "rerun_cli", "rrd", "verify", str(path)]
    done = subprocess.run(command, env=quiet_environment(tmp_path / "home"), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [entry.name for entry in tmp_path.iterdir() if entry.name != "home"] == ["flight.rrd"]


def test_an_error_in_between_leaves_no_file_and_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "flight.rrd"
    path.write_bytes(b"old")
    for scan, fault in ((np.ones((5, 2)), ValueError), (None, AttributeError)):
        with pytest.raises(fault), Log(path, "broken", np.eye(4)) as log:
            log.frame(0.0, scan, None, pose(0.0))  # type: ignore[arg-type]
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="file"), Log(tmp_path / "file" / "a.rrd", "no", np.eye(4)):
        pass
    (tmp_path / "taken.rrd").mkdir()
    with pytest.raises(OutputError, match=r"taken\.rrd: .*folder"), Log(tmp_path / "taken.rrd", "no", np.eye(4)):
        pass


def test_a_full_disk_is_told_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(source: Any, target: Any, length: int) -> None:
        target.write(source.read(100))
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(drain.shutil, "copyfileobj", full)
    with pytest.raises(OutputError, match="No space left on device"):
        fly(tmp_path / "flight.rrd")
    assert list(tmp_path.iterdir()) == []


def test_memory_does_not_grow_with_the_flight(tmp_path: Path) -> None:
    scan = np.random.default_rng(0).uniform(-1, 1, (180, 240, 3))
    used = []
    with Log(tmp_path / "long.rrd", "long", np.eye(4)) as log:
        for k in range(600):
            whole = scan.reshape(-1, 3) if log.map_due(0.2 * k) else None
            log.frame(0.2 * k, scan, None, pose(0.01 * k), map_points=whole)
            if k in (200, 599):
                used.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    assert (tmp_path / "long.rrd").stat().st_size > 15e6
    assert used[1] - used[0] < 8_000  # kB; what was logged in between is 12 MB
