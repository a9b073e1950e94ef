"""The commands for recordings as a user types them: what they print, and one line and exit 2 for bad input."""

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from steelnb import cli
from steelnb.datatypes import Trajectory
from steelnb.recordings.formats import open_recording, save_recording
from steelnb.recordings.trajectories import read_tum, write_tum
from steelnb.replay.run import run_recording
from steelnb.replay.simulated import simulated_recording
from tests.replay.flights import settings

FORMS = {"ros1": "a.bag", "mcap": "a.mcap", "sqlite": "a.db3", "npy": "a"}
SMALL = ["--set", "tof.columns=45", "--set", "tof.rows=60", "--duration", "3"]


@pytest.fixture(scope="module")
def simulated():
    return simulated_recording(settings(duration_s=4.0))


@pytest.fixture(scope="module")
def saved(simulated, tmp_path_factory):
    """The same flight in every form, by form."""
    folder = tmp_path_factory.mktemp("saved")
    for form, name in FORMS.items():
        (folder / form).mkdir()
        save_recording(folder / form / name, simulated, form)
    return {form: folder / form / name for form, name in FORMS.items()}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def said(capfd: pytest.CaptureFixture[str], arguments: list[str], code: int = 0) -> str:
    """What a command prints; on an error the one line."""
    capfd.readouterr()
    assert cli.main(arguments) == code, capfd.readouterr().err
    shown = capfd.readouterr()
    if code == 2:
        assert shown.out == ""
        assert shown.err.startswith("steelnb: error: ")
        assert shown.err.count("\n") == 1, shown.err
        return shown.err
    return shown.out


def test_record_run_info_and_play(place, capfd):
    assert said(capfd, ["record", "a.mcap", *SMALL, "--seed", "4", "--pictures"]) == (
        "a.mcap written: 15 scans, 376 drifting poses; the truth is a.truth.tum\n"
    )
    assert sorted(file.name for file in place.iterdir()) == ["a.mcap", "a.truth.tum"]
    shown = said(capfd, ["info", "a.mcap"])
    assert "15 at 5 Hz, 45 x 60 organised" in shown
    assert "pictures  3 at 1 Hz" in shown
    shown = said(capfd, ["run", "a.mcap"])
    assert "of the drift removed" in shown
    assert (place / "a_run" / "recording.rrd").stat().st_size > 0
    shown = said(capfd, ["run", "a.mcap", "--odometry", "icp-3dof", "--noise", "constant-drift:0.0005", "--no-viewer",
                         "--no-structure", "-o", "b", "--gap", "0.3", "--range-max", "5", "--floor", "0.1",
                         "--set", "preprocess.voxel_leaf_m=0.08", "--seed", "9"])  # fmt: skip
    assert "written   b/: corrected.tum" in shown
    shown = said(capfd, ["play", "a.mcap", "--rate", "20", "--odometry", "segments"])
    assert "15 scans at 20 x" in shown
    assert "through segments" in shown


@pytest.mark.parametrize("form", FORMS)
def test_through_files_a_run_is_the_run_of_the_simulation(simulated, saved, form, tmp_path):
    expected = run_recording(simulated, tmp_path / "memory", structure=False, viewer=False).replayed
    found = run_recording(open_recording(saved[form]), tmp_path / "files", structure=False, viewer=False).replayed
    # Files hold float32 points, and quaternions: micrometres, which a registration may turn into a tenth of a mm.
    np.testing.assert_allclose(found.prior.T_world_drone, expected.prior.T_world_drone, atol=1e-12)
    assert np.abs(found.corrected.position - expected.corrected.position).max() < 2e-4
    assert found.reason == expected.reason


@pytest.mark.parametrize("form", ["ros1", "mcap", "sqlite"])
def test_truncated_bags_are_one_line_or_a_counted_skip(saved, form, place, capfd):
    whole = saved[form].read_bytes()
    for tenth in range(10):
        cut = place / f"cut{saved[form].suffix}"
        cut.write_bytes(whole[: len(whole) * tenth // 10])
        for command in (["info", str(cut)], ["run", str(cut), "--no-structure", "--no-viewer", "-o", "out"]):
            capfd.readouterr()
            code = cli.main(command)
            shown = capfd.readouterr()
            assert code == 2, (tenth, shown.out)
            assert shown.err.startswith("steelnb: error: ")
            assert shown.err.count("\n") == 1
            assert cut.name in shown.err
        assert [file.name for file in place.iterdir()] == [cut.name]


BAD = [
    (["info", "nothing.bag"], ["nothing.bag", "does not exist"]),
    (["info", "{bag}", "--scans", "/nope"], ["'/nope'", "/tof/points"]),
    (["info", "{bag}", "--scans", "/imu"], ["/imu"]),
    (["info", "{bag}", "--gap", "-1"], ["gap = -1"]),
    (["run", "{bag}", "--poses", "/nope"], ["'/nope'", "/odom"]),
    (["run", "{bag}", "--truth", "nope.tum"], ["nope.tum"]),
    (["run", "{bag}", "--settings", "nope.toml"], ["nope.toml"]),
    (["run", "{bag}", "--odometry", "bset"], ["'bset'", "'best'", "'segments'"]),
    (["run", "{bag}", "--noise", "walk"], ["'walk'", "random-walk"]),
    (["run", "{bag}", "--noise", "random-walk:x"], ["'x' is not a number"]),
    (["run", "{bag}", "--sensor", "lidar"], ["'lidar'", "starling2"]),
    (["run", "{bag}", "--seed", "-1"], ["seed = -1"]),
    (["run", "{bag}", "--range-max", "0"], ["x_max_m = 0"]),
    (["run", "{bag}", "--floor", "nan"], ["floor_m"]),
    (["run", "{bag}", "--set", "leaf"], ["ROOM.NAME=VALUE"]),
    (["run", "{bag}", "--set", "preprocess.leaf=1"], ["preprocess.leaf"]),
    (["run", "{bag}", "-o", "file/out"], ["file/out", "cannot be written"]),
    (["run", "{bag}", "-o", "file"], ["file", "cannot be written"]),
    (["run", "file"], ["file", "expected .bag"]),
    (["play", "{bag}", "--rate", "0"], ["rate = 0"]),
    (["play", "{bag}", "--rate", "fast"], ["'fast'", "max"]),
    (["play", "{bag}", "--rate", "max"], ["20 scans", "at least 100"]),
    (["record", "file"], ["file", "exists already"]),
    (["record", "b.xyz"], ["b.xyz", "mcap"]),
    (["record", "b.bag", "--form", "mcap"], ["form mcap", "'.bag'"]),
    (["record", "file/b.bag"], ["file/b.bag", "cannot be written"]),
    (["record", "b.bag", "--duration", "0"], ["duration_s = 0"]),
    (["record", "b.bag", "--duration", "0.5"], ["duration = 0.5", "at least 1 s"]),
    (["record", "b.bag", "--trajectory", "loop"], ["'loop'", "orbit"]),
    (["record", "b.bag", "--noise", "walk"], ["'walk'"]),
    (["convert", "nothing", "b.mcap"], ["nothing", "does not exist"]),
    (["convert", "{bag}", "file"], ["file", "exists already"]),
    (["convert", "{bag}", "b.xyz"], ["b.xyz"]),
]


@pytest.mark.parametrize(("arguments", "words"), BAD, ids=lambda value: " ".join(value) if len(value) > 2 else None)
def test_bad_input_is_one_line_exit_2_and_nothing_left(saved, place, capfd, arguments, words):
    (place / "file").write_text("no recording")
    shown = said(capfd, [word.replace("{bag}", str(saved["ros1"])) for word in arguments], 2)
    assert all(word in shown for word in words), shown
    assert [file.name for file in place.iterdir()] == ["file"]


def test_poses_from_a_file_that_do_not_cover_the_scans(saved, place, capfd):
    poses = open_recording(saved["ros1"]).poses
    write_tum(place / "late.tum", Trajectory(poses.stamp_s + 1000.0, poses.T_world_drone))
    shown = said(capfd, ["run", str(saved["ros1"]), "--poses", "late.tum", "-o", "out"], 2)
    assert "no pose at any scan: 0.000 to 3.800 s of scans, 1000.000 to 1004.000 s of poses" in shown
    write_tum(place / "half.tum", Trajectory(poses.stamp_s[:251], poses.T_world_drone[:251]))
    shown = said(capfd, ["run", str(saved["ros1"]), "--poses", "half.tum", "-o", "out", "--no-viewer"])
    assert "11 scans with a pose" in shown
    assert "9 no pose within the gap" in shown
    assert len(read_tum(place / "out" / "corrected.tum")) == 11


@pytest.mark.parametrize(
    ("arguments", "limit"),
    [
        ("run {bag} -o deep/out", 20_000),
        ("run {bag} -o deep/out --no-structure", 20_000),
        ("run {bag} -o deep/out --no-structure --no-viewer", 20_000),
        ("convert {bag} deep/b.mcap", 300_000),
        ("record deep/b.mcap --duration 1", 300_000),
    ],
)
def test_where_files_may_not_grow_nothing_is_left(saved, place, arguments, limit):
    """As on a full disk: writing fails in the middle, in another process, whose files may hold so many bytes."""
    given = [word.replace("{bag}", str(saved["ros1"])) for word in arguments.split()]
    shown = subprocess.run(
        [sys.executable, "-m", "steelnb.cli", *given],
        cwd=place,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    assert shown.returncode == 2, shown.stderr
    assert shown.stderr.startswith("steelnb: error: ")
    assert shown.stderr.count("\n") == 1, shown.stderr
    assert "deep" in shown.stderr
    assert ".steelnb-" not in shown.stderr  # the folder beside, which is gone
    assert "cannot be written" in shown.stderr
    assert list(place.iterdir()) == []


def test_ctrl_c_is_exit_130_and_leaves_nothing(saved, place, capfd, monkeypatch):
    from steelnb.replay import run

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "replay", interrupted)
    assert cli.main(["run", str(saved["ros1"]), "-o", "out"]) == 130
    assert "interrupted" in capfd.readouterr().err
    assert list(place.iterdir()) == []


def test_help_names_the_tables_of_a_settings_file(capfd):
    assert cli.main(["run", "--help"]) == 0
    assert "[extrinsics]" in capfd.readouterr().out


def test_asking_for_help_loads_nothing_heavy():
    heavy = ("numpy", "scipy", "numba", "rosbags", "rerun", "laspy", "open3d", "evo", "matplotlib")
    code = f"import sys; from steelnb import cli; cli.main(['run', '--help']); print(set({heavy}) & set(sys.modules))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.splitlines()[-1] == "set()"
