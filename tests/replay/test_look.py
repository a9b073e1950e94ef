"""Whatever can be looked at becomes a file for the viewer, and nothing of it stays."""

from pathlib import Path

import numpy as np
import pytest

from steelnb.datatypes import Segments
from steelnb.errors import FileContentError, FileMissingError
from steelnb.exports import export_structure, orientation
from steelnb.fusion.structure import Structure
from steelnb.recordings import write_segments
from steelnb.recordings.formats import save_recording
from steelnb.recordings.recording import interpolate
from steelnb.replay.look import as_rrd
from steelnb.replay.simulated import simulated_recording
from tests.replay.flights import settings
from tests.viewer.read_rrd import read_rrd
from tests.viewer.test_log import moving

BARS = Segments(
    np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 3], [1, 0, 3]]), np.full(2, 40), np.full(2, 0.01)
)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("look") / "flight.bag"
    save_recording(path, simulated_recording(settings(duration_s=4.0), pictures=True))
    return path


def test_a_recording_is_shown_as_it_is(bag: Path) -> None:
    told = []
    with as_rrd(bag, on_progress=lambda share, what: told.append(share)) as rrd:
        rows = read_rrd(rrd)
    assert not rrd.exists()
    assert told[-1] == 1.0
    expected = simulated_recording(settings(duration_s=4.0))
    stamps, strips = moving(rows["/world/drifting:strips"])
    at_scans, _ = interpolate(expected.poses, expected.scans.stamp_s, 1.0)
    assert stamps == pytest.approx(expected.scans.stamp_s)
    assert np.array(strips)[:, 0, 1] == pytest.approx(at_scans[:, :3, 3], abs=1e-5)
    assert expected.truth is not None
    true, _ = interpolate(expected.truth, expected.scans.stamp_s, 1.0)
    _, errors = moving(rows["/error/drifting:scalars"])
    assert np.ravel(errors) == pytest.approx(np.linalg.norm(at_scans[:, :3, 3] - true[:, :3, 3], axis=1), abs=1e-6)
    assert "/world/corrected:strips" not in rows
    assert len(moving(rows["/camera:blob"])[0]) == 4


def test_an_rrd_file_and_a_folder_with_one_are_taken_as_they_are(bag: Path, tmp_path: Path) -> None:
    with as_rrd(bag) as made:
        content = made.read_bytes()
    (tmp_path / "recording.rrd").write_bytes(content)
    for path in (tmp_path, tmp_path / "recording.rrd"):
        with as_rrd(path) as rrd:
            assert rrd == tmp_path / "recording.rrd"
    assert (tmp_path / "recording.rrd").read_bytes() == content


def test_a_cloud_and_bars_are_shown_too(tmp_path: Path) -> None:
    cloud = np.random.default_rng(0).uniform(-2, 2, (500, 3)).round(4)
    np.savetxt(tmp_path / "cloud.xyz", cloud, fmt="%.4f")
    with as_rrd(tmp_path / "cloud.xyz") as rrd:
        assert np.array(moving(read_rrd(rrd)["/world/map:positions"])[1][0]) == pytest.approx(cloud, abs=1e-6)
    origin = np.array([600_000.0, 5_000_000.0, 0.0])
    write_segments(tmp_path, BARS, origin, orientation(BARS), {})
    joints = np.array([[0.0, 0, 1], [1, 0, 1]])
    none = np.full(2, np.nan)
    structure = Structure(BARS, none, np.ones(2, np.int64), none, joints, np.array([[0, 0], [1, 1]]))
    export_structure(structure, tmp_path / "structure.json")
    expected = np.stack([BARS.start, BARS.end], axis=1)
    for name in ("segments.json", "structure.json"):
        with as_rrd(tmp_path / name) as rrd:
            rows = read_rrd(rrd)
        assert np.array(moving(rows["/world/bars:strips"])[1][0]) == pytest.approx(expected, abs=1e-4), name
    assert np.array(moving(rows["/world/map:positions"])[1][0]) == pytest.approx(joints)


def test_what_is_not_there_or_not_rerun_s_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.rrd").write_bytes(b"RRF1 from long ago")
    with pytest.raises(FileContentError, match=r"a\.rrd"), as_rrd(tmp_path / "a.rrd"):
        pass
    with pytest.raises(FileMissingError, match="none"), as_rrd(tmp_path / "none"):
        pass
