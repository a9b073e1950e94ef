"""The commands for recordings as a user types them: their output, and one line and exit 2 for bad input."""

import ctypes
import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from steelnb.io.calibration import read_correction

from steelnb import cli, experiment
from steelnb.io import read_flight, read_trajectory, read_truth, write_flight, write_structure
from steelnb.settings import ExperimentSettings
from tests.fusion.made import true_structure

SMALL = ["--set", "tof.columns=45", "--set", "tof.rows=60", "--duration", "3"]


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    """A simulated flight of 4 s."""
    small = {"tof.columns": 90, "tof.rows": 120}
    flight, truth = experiment.simulate(ExperimentSettings.preset(seed=3, duration_s=4.0, overrides=small))
    path = tmp_path_factory.mktemp("saved") / "a.bag"
    write_flight(path, flight, truth.trajectory)
    return path


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


def test_record_info_and_run(place, capfd):
    assert said(capfd, ["record", "a.mcap", *SMALL, "--seed", "4"]) == (
        "a.mcap written: 15 scans with drifting poses; the truth is a.truth.tum\n"
    )
    assert sorted(file.name for file in place.iterdir()) == ["a.mcap", "a.truth.tum"]
    shown = said(capfd, ["info", "a.mcap"])
    for words in ("15 with a pose at 5 Hz, 45 x 60 organised (/tof/points)", "truth     376 at 125 Hz",
                  "imu       376 at 125 Hz", "recording a.mcap: ROS 2 MCAP", "skipped   nothing"):  # fmt: skip
        assert words in shown
    assert "valid in 1 scan read" in said(capfd, ["info", "a.mcap", "--quick"])
    shown = said(capfd, ["run", "a.mcap"])
    assert "of the drift removed" in shown
    assert "% on time" in shown
    assert (place / "a_run" / "recording.rrd").read_bytes().startswith(b"RRF")
    shown = said(capfd, ["run", "a.mcap", "--odometry", "icp-3dof", "--noise", "constant-drift:0.0005", "--no-viewer",
                         "--no-structure", "-o", "b", "--gap", "0.3", "--range-max", "5", "--floor", "0.1",
                         "--set", "preprocess.voxel_leaf_m=0.08", "--seed", "9"])  # fmt: skip
    assert "written   b/: corrected.tum" in shown
    true, prior = read_truth("a.mcap"), read_trajectory("b/prior.tum")
    # 0.0005 m a step at 125 Hz, after the 2.8 s of the last scan
    drift_m = ((prior.position[-1] - true.at(prior.stamp_s).position[-1]) ** 2).sum() ** 0.5
    assert drift_m == pytest.approx(0.0005 * 125 * prior.stamp_s[-1], rel=1e-3)


def test_a_camera_is_recorded_and_the_flight_corrected_by_its_images(place, capfd):
    camera = ["--camera", "tracking", "--set", "camera.rate_hz=5", "--set", "camera.columns=320", "--set",
              "camera.rows=240", "--set", "camera.samples=1", "--set", "camera.mount_rpy_deg=[0, 0, 0]"]  # fmt: skip
    said(capfd, ["record", "a.mcap", "--duration", "2", *camera])
    shown = said(capfd, ["info", "a.mcap"])
    assert "images    11 at 5 Hz, 320 x 240 (/camera/image_raw, intrinsics /camera/camera_info, mount tf" in shown
    run = ["run", "a.mcap", "--odometry", "orb", "--no-viewer", "--no-structure"]
    assert "used      9 scans; not used: 1 first scan" in said(capfd, run)
    assert "no topic '/eye' for the images" in said(capfd, ["info", "a.mcap", "--images", "/eye"], code=2)
    said(capfd, ["record", "blind.mcap", "--duration", "2"])
    assert "blind.mcap: no images for method 'orb': none" in said(capfd, ["run", "blind.mcap", *run[2:]], code=2)
    assert "unknown 'foward', did you mean 'forward'" in said(capfd, ["record", "b.bag", "--camera", "foward"], code=2)


def test_calibrate_finds_a_mount_that_was_told_wrongly(place, capfd):
    said(capfd, ["record", "a.mcap", "--trajectory", "loops", "--duration", "8", "--seed", "4"])
    (place / "wrong.toml").write_text("[extrinsics]\ntranslation_m = [0.06, 0.0, 0.0]\nrotation_rpy_deg = [0, 1.5, 0]\n"
                                      "[errors]\nrange_scale = 0.01\nrange_offset_m = 0.02\n")  # fmt: skip
    shown = said(capfd, ["calibrate", "a.mcap", "--settings", "wrong.toml", "--set", "calibration.range_scale_sigma=0"])
    assert re.search(r"^mount pitch +-1\.[345]\d ± 0\.\d\d ° \(before: ± 1\.00\)$", shown, re.MULTILINE)
    assert re.search(r"^mount z .* not told by this flight$", shown, re.MULTILINE)
    assert re.search(r"^range scale +[+-]0\.00 ± 0\.00 % \(before: ± 0\.00\) known$", shown, re.MULTILINE)
    assert "written   a.calibration.toml: steelnb run RECORDING --settings a.calibration.toml" in shown
    errors = read_correction("a.calibration.toml")
    assert errors.range_scale == pytest.approx(0.01)  # as it was told
    assert abs(errors.range_offset_m) < 0.01  # 2 cm, of which nothing was true
    mount = read_flight("a.mcap", settings="a.calibration.toml").T_drone_sensor
    assert np.degrees(np.arccos(mount[0, 0])) < 0.3
    assert "exists already" in said(capfd, ["calibrate", "a.mcap"], code=2)


def test_the_readings_of_an_imu_tell_metres_where_the_sensor_s_preset_has_one(place, capfd):
    said(capfd, ["record", "a.mcap", "--trajectory", "loops", "--duration", "8", "--seed", "4"])
    sheet = "gyro_noise = 1.4e-4\naccelerometer_noise = 3.9e-3\ngyro_bias = 8.7e-4\naccelerometer_bias = 0.015\n"
    (place / "mine.toml").write_text(f'based_on = "starling2"\n[imu]\n{sheet}')
    sigma = []
    for sensor in ("starling2", "mine.toml"):
        shown = said(capfd, ["calibrate", "a.mcap", "--sensor", sensor, "-o", f"of-{sensor}.toml"])
        found = re.search(r"^range scale +[+-](\S+) ± (\S+) %", shown, re.MULTILINE)
        sigma.append(float(found[2]))
        assert float(found[1]) < 2 * sigma[-1]
    assert sigma[1] < 0.8 * sigma[0]


def test_scans_come_without_the_errors_that_a_settings_file_names(bag, place, capfd):
    (place / "sensor.toml").write_text("[errors]\nrange_scale = 0.02\nrange_offset_m = 0.01\ntime_offset_s = 0.02\n")
    flight, corrected = read_flight(bag), read_flight(bag, settings="sensor.toml")
    assert "ranges +10.0 mm and +2.00 % too long, taken +20.0 ms after the stamps" in said(
        capfd, ["info", str(bag), "--settings", "sensor.toml", "--quick"]
    )
    np.testing.assert_allclose(corrected.prior.stamp_s, flight.prior.stamp_s[: len(corrected)] + 0.02, atol=1e-9)
    range_m, true_m = (np.linalg.norm(each.scans[5].points, axis=-1) for each in (flight, corrected))
    np.testing.assert_allclose(1.02 * true_m + 0.01, range_m, rtol=1e-6)
    for bad, named in (("range_scal = 0.1", "errors.range_scal"), ("range_scale = 2.0", "errors.range_scale = 2.0")):
        (place / "sensor.toml").write_text(f"[errors]\n{bad}\n")
        assert named in said(capfd, ["info", str(bag), "--settings", "sensor.toml"], code=2)


BAD = [
    (["info", "nothing.bag"], ["nothing.bag", "does not exist"]),
    (["info", "file"], ["file", "expected .bag, .mcap, .db3"]),
    (["info", "{bag}", "--scans", "/nope"], ["'/nope'", "/tof/points"]),
    (["info", "{bag}", "--gap", "-1"], ["gap = -1"]),
    (["run", "{bag}", "--poses", "/nope"], ["'/nope'", "/odom"]),
    (["run", "{bag}", "--truth", "nope.tum"], ["nope.tum"]),
    (["run", "{bag}", "--settings", "nope.toml"], ["nope.toml", "expected a settings file"]),
    (
        ["run", "{bag}", "--odometry", "beest"],
        ["--odometry: unknown 'beest', did you mean 'best'?; expected one of 'none', 'average'"],
    ),
    (["calibrate", "{bag}", "--set", "calibration.mount_sigma=1"], ["calibration.mount_sigma"]),
    (["calibrate", "{bag}", "--set", "calibration.mount_sigma_m=-1"], ["mount_sigma_m = -1"]),
    (["calibrate", "{bag}", "--from", "9"], ["from 9 to inf s: no scan"]),
    (
        ["calibrate", "{bag}", "--set", "preprocess.floor_m=50", "-o", "new.toml"],
        ["a.bag: not calibrated: 20 scans without a return above the floor", "expected a flight along bars"],
    ),
    (["run", "{bag}", "--odometry", "segments", "--odometry", "least_squares"], ["'segments': given twice"]),
    (
        ["run", "{bag}", "--sensor", "lidar"],
        [
            "--sensor: unknown 'lidar'; expected one of",
            "'report', 'report-4cm', 'starling2', 'starling2-honest', or a file FILE.toml",
        ],
    ),
    (["run", "{bag}", "--sensor", "mine.toml"], ["mine.toml", "a sensor's preset"]),
    (["run", "{bag}", "--noise", "random-walk:0.1+yaw-walk"], ["did you mean 'yaw-random-walk'?"]),
    (["run", "{bag}", "--noise", "random-walk:much"], ["'much' is not a number"]),
    (["run", "{bag}", "--from", "9"], ["from 9 to inf s: no scan", "0 to 3.8 s"]),
    (["run", "{bag}", "--to", "nan"], ["from 0 to nan s"]),
    (["run", "{bag}", "--odometry", "best", "--odometry", "gicp", "--from", "9"], ["from 9 to inf s: no scan"]),
    (["run", "{bag}", "--range-max", "-1"], ["crop_m = -1"]),
    (["run", "{bag}", "--set", "preprocess"], ["--set preprocess", "NAME=VALUE"]),
    (["run", "{bag}", "--set", "preprocess.leaf=1"], ["preprocess.leaf"]),
    (["run", "{bag}", "--no-structure", "-o", "file"], ["file", "cannot be written"]),
    (["run", "{bag}", "--map", "nope.json"], ["nope.json", "a structure in JSON"]),
    (["run", "{bag}", "--map", "file", "--odometry", "best"], ["--map", "expected one of them"]),
    (["record", "b.bag", "--duration", "0"], ["duration = 0", "at least 1 s"]),
    (["record", "b.bag", "--duration", "1e18"], ["duration = 1e+18", "at most 14400 s"]),
    (["info", "n" * 300], ["nnn", "File name too long"]),
    (["run", "{bag}", "-o", "n" * 300], ["nnn", "File name too long"]),
    (["record", "b.ply", *SMALL], ["'.ply'", "expected .bag, .mcap, .db3 or a folder name for ROS 2"]),
    (["record", "file", *SMALL], ["file", "exists already", "--force"]),
    (["record", "file", *SMALL, "--force"], ["file", "no such recording"]),
    (["record", "file/b.bag", *SMALL], ["file/b.bag", "cannot be written"]),
    (["record", "b.bag", "--trajectory", "lops"], ["--trajectory: unknown 'lops', did you mean 'loops'?"]),
]


@pytest.mark.parametrize(("arguments", "words"), BAD, ids=lambda value: " ".join(value) if len(value) > 2 else None)
def test_bad_input_is_one_line_exit_2_and_nothing_left(bag, place, capfd, arguments, words):
    (place / "file").write_text("no recording")
    shown = said(capfd, [word.replace("{bag}", str(bag)) for word in arguments], 2)
    assert all(word in shown for word in words), shown
    assert [file.name for file in place.iterdir()] == ["file"]


def test_a_flight_is_localised_in_an_earlier_structure_and_compared_with_it(place, capfd):
    settings = ExperimentSettings.preset(seed=3, duration_s=6.0, overrides={"tof.columns": 120, "tof.rows": 160})
    flight, truth = experiment.simulate(settings)
    write_flight(place / "a.bag", flight, truth.trajectory)
    write_structure(true_structure(truth.tower), place / "known.json")
    shown = said(capfd, ["run", "a.bag", "--map", "known.json", "--no-viewer", "--no-structure"])
    assert "changes   224 bars of the map: " in shown
    assert " 0 missing, 0 moved" in shown
    rows = (place / "a_run" / "changes.csv").read_text().splitlines()
    assert rows[0].startswith("bar,kind,offset_m,sigma_m,significance,start_x_m")
    assert sum(",not seen," in row for row in rows) > 100
    assert (place / "a_run" / "changes.png").exists()
    found, true = read_trajectory("a_run/corrected.tum"), truth.trajectory
    assert np.linalg.norm(found.position - true.at(found.stamp_s).position, axis=1).max() < 0.01

    write_structure(true_structure(truth.tower).moved(np.array([90.0, 0, 0])), place / "elsewhere.json")
    before = sorted(place.iterdir())
    capfd.readouterr()
    assert cli.main(["run", "a.bag", "--map", "elsewhere.json", "-o", "out"]) == 2
    last = capfd.readouterr().err.splitlines()[-1]  # on a busy machine, lines of progress go before
    assert last.startswith("steelnb: error: 0 of 224 bars matched in the first 10 scans; expected a map of this place")
    assert sorted(place.iterdir()) == before


def test_a_run_overwrites_only_where_it_is_told_to_and_leaves_no_file_of_an_earlier_one(bag, place, capfd):
    run = ["run", str(bag), "-o", "out", "--no-viewer"]
    (place / "out").mkdir()  # empty, so that nothing is lost
    said(capfd, run)
    before = {file.name: file.read_bytes() for file in (place / "out").iterdir()}
    (place / "out" / "mine.txt").write_text("mine")
    assert said(capfd, [*run, "--odometry", "icp"], 2) == (
        "steelnb: error: out: exists already and is not empty; expected a new folder, or --force to overwrite\n"
    )
    assert {file.name: file.read_bytes() for file in (place / "out").iterdir()} == before | {"mine.txt": b"mine"}
    said(capfd, [*run, "--odometry", "icp", "--no-structure", "--force"])
    assert {file.name for file in (place / "out").iterdir()} == (before.keys() | {"mine.txt"}) - {"structure.json"}
    assert (place / "out" / "corrected.tum").read_bytes() != before["corrected.tum"]
    assert (place / "out" / "mine.txt").read_text() == "mine"


def test_a_flight_that_is_steered_is_recorded_for_run(place, capfd):
    shown = said(capfd, ["fly", "a.mcap", *SMALL, "--sensor", "report-4cm", "--planner", "whole"]).splitlines()
    assert shown[0].startswith("flown     ")
    assert shown[-1].startswith("a.mcap written: ")
    assert sorted(file.name for file in place.iterdir()) == ["a.mcap", "a.truth.tum"]
    assert said(capfd, ["info", "a.mcap"])
    assert "exists already" in said(capfd, ["fly", "a.mcap", *SMALL], 2)
    assert "did you mean 'whole'" in said(capfd, ["fly", "b.mcap", "--planner", "hole"], 2)


@pytest.mark.parametrize("name", ["a.mcap", "folder"])
def test_record_overwrites_only_where_it_is_told_to(place, capfd, name):
    said(capfd, ["record", name, *SMALL])
    truth = place / f"{Path(name).stem}.truth.tum"
    before, files = truth.read_bytes(), sorted(place.rglob("*"))
    assert "exists already" in said(capfd, ["record", name, *SMALL, "--trajectory", "loops"], 2)
    assert truth.read_bytes() == before
    shown = said(capfd, ["record", name, *SMALL[:-1], "2", "--force", "--trajectory", "loops"])
    assert shown.startswith(f"{name} written: 10 scans")
    assert sorted(place.rglob("*")) == files
    assert truth.read_bytes() != before
    assert len(read_flight(name)) == 10
    assert read_truth(name).position[0] == pytest.approx(read_flight(name).prior.position[0], abs=0.05)


def test_a_recording_of_another_ending_keeps_its_truth(place, capfd):
    said(capfd, ["record", "a.mcap", *SMALL])
    before = (place / "a.truth.tum").read_bytes()
    assert "holds another flight's truth" in said(capfd, ["record", "a.bag", *SMALL, "--seed", "2", "--force"], 2)
    assert (place / "a.truth.tum").read_bytes() == before


def test_several_odometries_are_compared_in_one_table(bag, place, capfd):
    run = ["run", str(bag), "-o", "out", "--no-viewer", "--no-structure", "--odometry", "best", "--odometry"]
    shown = said(capfd, [*run, "icp"])
    assert re.search(r"odometry +rms_m.*\n +drifting .*\n +best .*\n +icp ", shown)
    assert sorted(file.name for file in (place / "out").iterdir()) == [
        "best",
        "comparison.csv",
        "comparison.png",
        "icp",
    ]
    best = (place / "out" / "best" / "corrected.tum").read_bytes()
    said(capfd, [*run[:2], "-o", "alone", *run[4:6]])
    assert (place / "alone" / "corrected.tum").read_bytes() == best
    assert "exists already" in said(capfd, [*run, "segments"], 2)
    said(capfd, [*run, "segments", "--force", "--from", "1"])
    assert {file.name for file in (place / "out").iterdir()} == {
        "best", "comparison.csv", "comparison.png", "icp", "segments"
    }  # fmt: skip
    assert len(read_trajectory("out/best/corrected.tum")) == len(read_trajectory("out/segments/corrected.tum")) == 15
    assert list(place.rglob(".steelnb-*")) == []


@pytest.mark.parametrize("options", [[], ["--no-structure", "--no-viewer"]])
def test_where_files_may_not_grow_nothing_is_left(bag, place, options):
    """As on a full disk: writing fails in the middle, in another process, whose files may hold so many bytes."""
    shown = subprocess.run(
        [sys.executable, "-m", "steelnb.cli", "run", str(bag), "-o", "deep/out", *options],
        cwd=place,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},  # else libraries' compiled modules are cut off, for good
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
    )
    assert shown.returncode == 2, shown.stderr
    *stages, error = shown.stderr.splitlines()  # on a slow machine stages are told before
    assert error.startswith("steelnb: error: deep/out")
    assert "cannot be written" in error
    assert ".steelnb-" not in error  # the folder beside, which is gone
    assert not [line for line in stages if "rror" in line or "Traceback" in line], stages
    assert list(place.iterdir()) == []


TOGETHER = """
import sys, time
from pathlib import Path
from steelnb import cli, experiment, odometry
def met(first):
    def call(*given, **named):
        Path(f"here-{sys.argv[1]}").touch()
        while len(list(Path().glob("here-*"))) < 2:
            time.sleep(0.01)
        return first(*given, **named)
    return call
experiment.simulate_anew, odometry.run = met(experiment.simulate_anew), met(odometry.run)
sys.exit(cli.main(sys.argv[2:]))
"""
"""A command that waits for another one just before its work, when both have checked what they will write."""


def both(place: Path, *commands: list[str]) -> list[tuple[int, str]]:
    """Exit codes and errors of two commands, each in a process, neither of which is done before the other has begun."""
    given = {"cwd": place, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    started = [subprocess.Popen([sys.executable, "-c", TOGETHER, str(k), *c], **given) for k, c in enumerate(commands)]
    errors = [process.communicate(timeout=300)[1] for process in started]
    for file in place.glob("here-*"):
        file.unlink()
    return sorted((process.returncode, error) for process, error in zip(started, errors, strict=True))


def test_of_two_recordings_to_one_name_one_is_whole_and_one_is_refused(place):
    commands = [["record", "a.mcap", *SMALL, "--noise", "none", "--seed", seed] for seed in "45"]
    (code, _), (refused, error) = both(place, *commands)
    assert (code, refused) == (0, 2)
    *stages, error = error.splitlines()  # on a slow machine stages are told before
    assert re.fullmatch(r"steelnb: error: \S*a\.\S+: exists already; expected a new name, or .*", error)
    assert not [line for line in stages if "rror" in line or "Traceback" in line], stages
    assert sorted(file.name for file in place.iterdir()) == ["a.mcap", "a.truth.tum"]
    prior, truth = read_flight("a.mcap").prior, read_truth("a.mcap")
    np.testing.assert_allclose(prior.position, truth.at(prior.stamp_s).position, atol=1e-9)


@pytest.mark.parametrize("force", [True, False])
def test_of_two_runs_into_one_new_folder_the_files_are_those_of_one(bag, place, force):
    options = ["--no-viewer", "--no-structure", "--noise", "random-walk:0.01", *(["--force"] if force else [])]
    for seed in "45":
        assert cli.main(["run", str(bag), "-o", seed, "--seed", seed, *options]) == 0
    ended = both(place, *(["run", str(bag), "-o", "out", "--seed", seed, *options] for seed in "45"))
    assert [code for code, _ in ended] == [0, 0 if force else 2], ended
    assert sorted(file.name for file in place.iterdir()) == ["4", "5", "out"]
    assert os.listdir(place / "4") != []
    same = ["prior.tum", "corrected.tum", "map.ply", "trajectories.png"]
    sources = {
        seed
        for seed in "45"
        for name in same
        if (place / "out" / name).read_bytes() == (place / seed / name).read_bytes()
    }
    assert len(sources) == 1
    (seed,) = sources
    assert sorted(os.listdir(place / "out")) == sorted(os.listdir(place / seed))
    assert all((place / "out" / name).read_bytes() == (place / seed / name).read_bytes() for name in same)


def test_ctrl_c_is_exit_130_and_leaves_nothing(bag, place, capfd, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("steelnb.report.recording.measure_recording", interrupted)
    for several in ([], ["--odometry", "best", "--odometry", "icp"]):
        assert cli.main(["run", str(bag), "-o", "out", "--no-structure", *several]) == 130
        assert "interrupted" in capfd.readouterr().err
        assert list(place.iterdir()) == []


@pytest.mark.parametrize("module", ["steelnb.errors", "typer", "numba"])
def test_ctrl_c_while_a_library_is_looked_for_is_one_line_and_exit_130(bag, place, module):
    """In a process that is as the installed command makes it, from `steelnb.__main__` on."""
    code = f"""
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # which the caller of the tests may ignore
class CtrlC:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            print("pressed", flush=True)
            signal.raise_signal(signal.SIGINT)
import steelnb
sys.meta_path.insert(0, CtrlC())
from steelnb.__main__ import main
sys.exit(main())
"""
    command = [sys.executable, "-c", code, "run", str(bag), "-o", "out"]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
    assert (done.stdout, done.returncode) == ("pressed\n", 130)
    assert re.fullmatch(r"steelnb: error: interrupted[^\n]*\n", done.stderr)
    assert list(place.iterdir()) == []


def obey_permissions():
    """Let root write where the permissions allow it alone, as every other user: without CAP_DAC_OVERRIDE."""
    if os.getuid() == 0:
        assert ctypes.CDLL(None, use_errno=True).prctl(24, 1, 0, 0, 0) == 0  # PR_CAPBSET_DROP


@pytest.mark.skipif(sys.platform != "linux", reason="capabilities are Linux's")
def test_a_read_only_install_without_a_home_compiles_elsewhere(place):
    """As in a container whose files may not be changed, by a user whose home may not either."""
    shutil.copytree(
        Path(cli.__file__).parent, place / "install" / "steelnb", ignore=shutil.ignore_patterns("__pycache__")
    )
    (place / "home").mkdir()
    for folder in (place / "home", place / "install", *(f for f in (place / "install").rglob("*") if f.is_dir())):
        folder.chmod(0o555)
    code = (
        "import os, sys\nassert not any(os.access(place, os.W_OK) for place in sys.argv[1:])\n"
        "import steelnb, matplotlib\nfrom steelnb.points.voxel_kernels import pack\n"
        "assert steelnb.__file__.startswith(sys.argv[1])\npack(1, 2, 3)\n"
        "print(os.environ['NUMBA_CACHE_DIR'])\nprint(matplotlib.get_cachedir())"
    )
    own = place / f"steelnb-numba-{os.getuid()}"
    given = {name: value for name, value in os.environ.items() if name not in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR")}
    given |= {"TMPDIR": str(place), "HOME": str(place / "home"), "PYTHONPATH": str(place / "install")}
    given.pop("MPLCONFIGDIR", None)
    for kept in (True, False):
        if not kept:
            own.rename(place / "away")
            own.symlink_to(place / "away")  # somebody else's, maybe
        done = subprocess.run(
            [sys.executable, "-c", code, str(place / "install"), str(place / "home")],
            cwd=place, env=given, capture_output=True, text=True, check=False, preexec_fn=obey_permissions,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")
        compiled, drawn = map(Path, done.stdout.split())
        assert compiled == drawn
        assert (compiled == own) is kept
        assert compiled.parent == place
        assert compiled.name.startswith("steelnb-numba-")
        assert compiled.is_dir() is kept
        if kept:
            assert compiled.stat().st_mode & 0o777 == 0o700
            assert list(compiled.rglob("*.nbc")) != []
    assert list((place / "install").rglob("__pycache__")) == []


def test_help_names_the_tables_of_a_settings_file_and_loads_nothing_heavy():
    heavy = ("numpy", "scipy", "numba", "rosbags", "rerun", "laspy", "open3d", "evo", "matplotlib")
    code = f"import sys; from steelnb import cli; cli.main(['run', '--help']); print(set({heavy}) & set(sys.modules))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.splitlines()[-1] == "set()"
    assert "[extrinsics]" in shown
