"""The command line: its output, and that bad input gives one line, exit code 2 and no partial output."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh

import steelnb
from steelnb import cli, settings
from steelnb.io import read_flight, read_trajectory, read_truth, write_tum
from steelnb.settings import recording
from tests.io.samples import poses
from tests.lattice import lattice, scanned


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of three seconds, its truth, a complete and a truncated cloud, and files that are refused."""
    folder = tmp_path_factory.mktemp("recorded")
    small = [f"--set={each}" for each in ("tof.columns=90", "tof.rows=120")]
    assert cli.main(["record", str(folder / "a.mcap"), "--duration", "3", *small]) == 0
    points = np.round(scanned(lattice(8, 4, 2, 3), 40, 0.06, 0.01), 3)
    trimesh.PointCloud(points).export(folder / "tower.ply")
    whole = (folder / "tower.ply").read_bytes()
    (folder / "half.ply").write_bytes(whole[: len(whole) // 2])
    (folder / "kept_run").mkdir()
    (folder / "kept_run" / "notes.txt").write_text("mine")
    (folder / "mine.py").write_text(MINE)
    (folder / "syntax.py").write_text("class Mine:")
    shutil.copy(folder / "a.mcap", folder / "untrue.mcap")
    write_tum(folder / "theirs.tum", read_flight(folder / "a.mcap").prior)
    write_tum(folder / "late.tum", poses(5, begin_s=1e9))
    return folder


MINE = """
import steelnb

class Held:
    def update(self, scan, T_world_drone_prior):
        return steelnb.OdometryStep(scan.stamp_s, T_world_drone_prior)

class Mounted(Held):
    def __init__(self, T_drone_sensor, weight=1.0):
        assert T_drone_sensor.shape == (4, 4)

class Needy(Held):
    def __init__(self, leaf): ...

class Silent(Held):
    def update(self, scan, T_world_drone_prior): ...

class Empty: ...
"""


@pytest.fixture(scope="module")
def corrected(recorded: Path) -> Path:
    """The output of ``run`` for the bag."""
    assert cli.main(["run", str(recorded / "a.mcap"), "-o", str(recorded / "out")]) == 0
    return recorded / "out"


@pytest.fixture
def here(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(recorded)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # Python's own cache of the user's module is not ours
    return recorded


TWICE = "--set", "map_voxel_m=0.2", "--set", "odometry.map_voxel_m=0.3"
BAD = (
    (["run", "nothing.bag"], "nothing.bag: does not exist; expected a recording"),
    (["run", "long" * 99], "long: does not exist; expected a recording"),
    (["segment", "-o", ""], "an empty argument; expected a name or a value"),
    (["run", " "], "an empty argument; expected a name or a value"),
    (["study", "--output="], "an empty argument; expected a name or a value"),
    (["segment", "half.ply"], "half.ply: not a file of points: "),
    (["run", "a.mcap", "--odometry", "orb"], "a.mcap: no images for method 'orb'"),
    (["run", "a.mcap", "--set", "preproces.crop_m=1"], "preproces.crop_m = 1: unknown setting, did you mean"),
    (["run", "a.mcap", "--set", "method=gicp"], "method = 'gicp': this is 'best'"),
    (["run", "a.mcap", "--set", "voxels"], "--set voxels: expected TABLE.NAME=VALUE"),
    (["run", "a.mcap", "--set", "=5"], "--set =5: expected TABLE.NAME=VALUE"),
    (
        ["run", "a.mcap", *TWICE],
        "--set odometry.map_voxel_m=0.3: map_voxel_m is given twice, also by --set map_voxel_m",
    ),
    (["run", "a.mcap", "--smooth", "--set", "smooth=false"], "smooth is given twice, also by --smooth; expected one"),
    (
        ["run", "a.mcap", "--range-max=3", "--set", "preprocess={crop_m=5}"],
        "crop_m is given twice, also by --range",
    ),
    (["run", "a.mcap", "--set", "imu.gyro_noise=1e-4"], "as [imu] in a sensor's file"),
    (["run", "a.mcap", "--mount", "1,2"], "mount = (1.0, 2.0): expected 6 values"),
    (["run", "a.mcap", "--mount", "1,b"], "--mount 1,b: expected numbers"),
    (["run", "a.mcap", "--mount-sigma", "1"], "mount_sigma = (1.0,): expected 2 values"),
    (["run", "a.mcap", "--mount-sigma=-1,0.01", "--smooth"], "mount_sigma"),
    (["run", "a.mcap", "--mount-sigma", "11,0.01", "--smooth"], "expected at most 10°; state the mount instead"),
    (["run", "a.mcap", "--mount-sigma", "1,0.01"], "mount: only smoothing estimates it"),
    (["run", "a.mcap", "--odometry", "faces", "--clock-sigma", "0.02"], "mount: only smoothing estimates it"),
    (["run", "a.mcap", "--range", "-1"], "range = -1.0"),
    (["run", "a.mcap", "--poses", "/nothing"], "no topic '/nothing' of poses"),
    (["run", "a.mcap", "--clock", "sun"], "clock = 'sun'"),
    (["run", "a.mcap", "--optical", "maybe"], "--optical maybe: expected yes or no"),
    (["run", "a.mcap", "--unit", "parsec"], "unit = 'parsec'"),
    (["run", "a.mcap", "--time-offset", "5000"], "expected --time-offset SECONDS"),
    (["run", "a.mcap", "--truth", "nothing.tum"], "nothing.tum: no such file"),
    (["run", "a.mcap", "-o", "kept_run"], "kept_run: exists already; expected a new folder, or --force"),
    (["segment", "tower.ply", "-o", "kept_run"], "kept_run: exists already; expected a new folder, or --force"),
    (["run", "a.mcap", "--odometry", "nothing:Mine"], "nothing:Mine: module 'nothing' cannot be imported"),
    (["run", "a.mcap", "--odometry", "mine:Hed"], "did you mean 'Held'?"),
    (["run", "a.mcap", "--odometry", "mine:Empty"], "mine:Empty: no method 'update'; expected update(scan, T_world"),
    (["run", "a.mcap", "--odometry", "mine:Needy"], "mine:Needy: its constructor needs leaf; expected T_drone_sensor"),
    (["run", "a.mcap", "--odometry", "mine:Silent"], "Silent.update, scan 0: its result = None: expected OdometryStep"),
    (["run", "a.mcap", "--odometry", "syntax:Mine"], "syntax:Mine: module 'syntax' cannot be imported: "),
    (["run", "a.mcap", "--estimate", "nothing.tum"], "nothing.tum: does not exist; expected a trajectory"),
    (["run", "untrue.mcap", "--estimate", "theirs.tum"], "theirs.tum: untrue.mcap has no truth to score it against"),
    (["run", "a.mcap", "--estimate", "late.tum"], "late.tum: its poses at 1000000000.000 to "),
    (["record", "a.mcap"], "a.mcap: exists already; expected a new name, or --force"),
    (["record", "b.db3"], "b.db3: ending '.db3'; expected .bag or .mcap"),
    (["record", "b.bag", "--duration", "0"], "duration_s = 0.0"),
    (["record", "b.bag", "--seed", "3", "--set", "seed=7"], "seed = 3, and overrides with seed = 7"),
    (["record", "b.bag", "--seed", "1", "--set", "seed=7"], "seed = 1, and overrides with seed = 7"),
    (["record", "b.bag", "--set", "sensor=report"], "sensor = 'report': this is 'starling2'; choose it by its preset"),
    (
        ["record", "b.bag", "--duration", "5", "--set", "flight.duration_s=6"],
        "duration_s = 5.0, and overrides with flight.duration_s = 6",
    ),
    (["record", "b.bag", "--set", "preprocess.crop_m=3"], "preprocess.crop_m: a setting of the odometry"),
    (["run", "a.mcap", "--set", "tof.rate_hz=3"], "tof.rate_hz: a setting of simulated flights"),
    (["fly"], "No such command 'fly'"),
)


@pytest.mark.parametrize(("arguments", "words"), BAD, ids=lambda value: " ".join(value) if len(value) < 6 else None)
def test_bad_input_is_one_line_exit_2_and_writes_nothing(
    here: Path, capfd: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    before = sorted(here.rglob("*"))
    capfd.readouterr()
    assert cli.main(arguments) == 2
    shown = capfd.readouterr().err
    assert shown.startswith("steelnb: error: ")
    assert words in shown
    assert shown.count("\n") == 1
    assert sorted(here.rglob("*")) == before


def test_options_beside_a_recording_are_read_once(here: Path, tmp_path: Path, monkeypatch, capfd) -> None:
    shutil.copy(here / "a.mcap", tmp_path)
    (tmp_path / "recording.toml").write_text('truth = "late.tum"\n')
    times, read_toml = list[Path](), recording.read_toml
    monkeypatch.setattr(recording, "read_toml", lambda path, form: times.append(path) or read_toml(path, form))
    assert cli.main(["run", str(tmp_path / "a.mcap")]) == 2
    assert "late.tum: its poses at " in capfd.readouterr().err
    assert times == [tmp_path / "recording.toml"]


def test_a_flight_is_recorded_and_corrected(here: Path, corrected: Path) -> None:
    files = {path.name for path in corrected.iterdir()}
    assert files == {"corrected.tum", "segments.csv", "structure.json", "table.csv", "path.png", "map.png", "map.ply"}
    numbers = pd.read_csv(corrected / "table.csv", index_col="quantity")["value"]
    assert numbers["corrected_ate_rmse_m"] < 0.7 * numbers["prior_ate_rmse_m"]
    found, truth = read_trajectory(corrected / "corrected.tum"), read_truth(here / "a.mcap")
    assert truth is not None
    error_m = np.linalg.norm(found.position - truth.at(found.stamp_s).position, axis=1)
    assert np.sqrt((error_m**2).mean()) == pytest.approx(numbers["corrected_ate_rmse_m"], rel=1e-4)


@pytest.mark.parametrize("duration", ["flight.duration_s=1.0", "flight={duration_s=1.0}"])
def test_what_is_set_replaces_what_is_usual(tmp_path: Path, duration: str, capsys) -> None:
    changes = (duration, "noise_name=yaw-random-walk", "tof.rate_hz=4")
    target = str(tmp_path / "short.mcap")
    assert cli.main(["record", target, *(word for each in changes for word in ("--set", each))]) == 0
    assert "4 scans" in capsys.readouterr().out


@pytest.mark.parametrize(("odometry", "name"), [("none", "no"), ("mine:Mounted", "Mounted")])
def test_an_odometry_that_corrects_nothing_is_run(here: Path, tmp_path: Path, odometry: str, name: str, capsys) -> None:
    command = ["run", "a.mcap", "-o", str(tmp_path / "out"), "--estimate", "theirs.tum"]
    assert cli.main([*command, "--odometry", odometry]) == 0
    shown = capsys.readouterr()
    numbers = pd.read_csv(tmp_path / "out" / "table.csv", index_col="quantity")["value"]
    assert numbers["corrected_ate_rmse_m"] == numbers["prior_ate_rmse_m"] == numbers["estimate_ate_rmse_m"] > 0
    assert [line.split()[0] for line in shown.out.splitlines() if line.startswith("     ")] == [
        "drifting", name, "theirs.tum"
    ]  # fmt: skip
    assert shown.err == ""
    assert numbers["structure_bars"] > 5


def test_what_makes_a_run_worthless_is_a_warning(here: Path, tmp_path: Path, capsys) -> None:
    coarse_and_high = ["--set", "preprocess.voxel_leaf_m=50", "--set", "preprocess.floor_m=100"]
    assert cli.main(["run", "a.mcap", "-o", str(tmp_path / "run"), *coarse_and_high]) == 0
    said = capsys.readouterr().err
    for words in ("voxels of 50 m leave ", "no scan corrected a pose", "the map has no points"):
        assert f"steelnb: warning: {words}" in said
    assert cli.main(["segment", "tower.ply", "-o", str(tmp_path / "bars"), "--confidence", "1e6"]) == 0
    assert "steelnb: warning: no bar found" in capsys.readouterr().err


def test_a_folder_of_clouds_gives_the_same_result_as_its_bag(
    here: Path, corrected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("steelnb.recording.run.draw", lambda *_: None)  # pictures take as long as the rest
    flight = read_flight(here / "a.mcap")
    for k, scan in enumerate(flight.scans):
        np.save(tmp_path / f"{k}.npy", scan.points)
    write_tum(tmp_path / "poses.tum", flight.prior)
    target = tmp_path / "a"
    target.mkdir()
    (target / "corrected.tum").write_text("of an earlier run")
    assert cli.main(["run", str(tmp_path), "-o", str(target), "--mount", "0.06,0,0,0,0,0", "--force"]) == 0
    of_folder, of_bag = (read_trajectory(folder / "corrected.tum") for folder in (target, corrected))
    np.testing.assert_allclose(of_folder.T_world_drone, of_bag.T_world_drone, atol=1e-9)


def test_bars_of_a_cloud_are_found(here: Path) -> None:
    (here / "bars").mkdir()
    (here / "bars" / "notes.txt").write_text("mine")
    assert cli.main(["segment", "tower.ply", "-o", "bars", "--force"]) == 0
    assert len(pd.read_csv(here / "bars" / "segments.csv")) > 20
    assert {path.name for path in (here / "bars").iterdir()} == {"segments.csv", "segments.png", "notes.txt"}


def test_version_help_and_names(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"steelnb {steelnb.__version__}\n"
    assert cli.main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(command in shown for command in ("run", "record", "segment", "Exit codes"))
    assert cli.METHODS == settings.METHODS
    assert cli.TRAJECTORIES == settings.TRAJECTORIES


def test_a_help_text_that_nobody_reads_to_its_end_is_no_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-m", "steelnb", "run", "--help"], stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys\nfrom steelnb import cli\ntry:\n    cli.main([])\nfinally:\n    assert 'numpy' not in sys.modules"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


def test_ctrl_c_is_exit_130_and_leaves_nothing(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    before = sorted(here.rglob("*"))
    monkeypatch.setattr("steelnb.recording.run.correct_recording", interrupted)
    assert cli.main(["run", "a.mcap", "-o", "stopped"]) == 130
    assert sorted(here.rglob("*")) == before
