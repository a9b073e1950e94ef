"""What notebook 09 does with a recording that is somebody's own: no truth, no image, another place."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from steelnb.errors import EmptyCloudError, FileMissingError
from steelnb.own_recording import Recorded
from steelnb.recordings.formats import save_recording
from steelnb.replay.options import Options
from tests.replay.flights import lattice, made, settings
from tests.viewer.read_rrd import read_rrd


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of clouds, not organised, with poses and no truth."""
    rng = np.random.default_rng(5)
    path = tmp_path_factory.mktemp("own") / "site"
    save_recording(path, made(lambda k: lattice(rng), scans=8), "npy")
    return path


def test_a_folder_of_clouds_goes_through_without_a_truth(folder: Path) -> None:
    told: list[float] = []
    source = Recorded(str(folder), settings(), Options(floor_m=-5.0))
    assert source.settings is None
    facts = source.facts()["this recording"]
    assert facts["truth"].startswith("none")
    assert str(folder.parent) not in "".join(facts)
    assert len(source.figure_scan().axes) == 3
    done = source.run(told.append)
    assert told == pytest.approx(np.arange(1, 9) / 8)
    assert done.figure_errors() is None
    assert set(done.figures()) == {"map", "trajectories"}
    assert done.table().loc[0, "frames"] == 8
    metrics = done.metrics()
    assert metrics["frames"] == 8
    assert not any(name.endswith("_ms") or "ate" in name for name in metrics)
    assert json.dumps(done.provenance()).count(str(folder.parent)) == 0
    assert done.provenance()["simulated"] is None
    assert {"corrected.tum", "map.ply", "recording.rrd", "segments.csv"} <= set(done.files()["file"])
    assert len(read_rrd(done.rrd)["/world/scan:positions"]) == 8
    timing = done.timing(source.play(5.0))
    assert timing["stage"].tolist() == ["run", "play at 5 x"]
    assert (timing["median_ms"] > 0).all()


def test_without_a_name_a_bag_is_flown_and_opened(folder: Path) -> None:
    flown = settings(duration_s=3.0)
    source = Recorded("", flown, Options(method="gicp"))
    assert source.name == "flight.bag"
    assert source.recording.truth is not None
    assert source.settings == flown
    place = source.folder
    assert (place / "flight.truth.tum").is_file()
    source._folder.cleanup()
    assert not place.exists()


def test_a_recording_that_is_not_there_or_empty_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileMissingError, match="nowhere"):
        Recorded(str(tmp_path / "nowhere.bag"), settings(), Options())
    source = Recorded("", settings(duration_s=2.0), Options())
    empty = made(lambda k: np.full((5, 3), np.nan))
    source.recording = replace(source.recording, scans=empty.scans)
    with pytest.raises(EmptyCloudError, match=r"flight\.bag"):
        source.figure_scan()
