"""`run_recording`: the experiment's numbers, files that hold them, drift and truth, and nothing left on an error."""

import csv
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation
from steelnb.io.transforms import interpolate
from steelnb.report.recording_comparison import compare_recording
from steelnb.report.recording_info import describe_flight
from steelnb.report.recording_truth import STEP_S, drifted, part_of, truth_at_scans, with_drift

from steelnb import experiment
from steelnb.errors import InputError
from steelnb.fusion.uncertainty import axis_sigma_m
from steelnb.io import read_cloud, read_flight, read_structure, read_trajectory, scans, write_flight
from steelnb.io.trajectories import write_sigma
from steelnb.noise import drifting
from steelnb.report.recording import FILES, run_recording
from steelnb.report.recording_settings import recording_settings
from steelnb.settings import ExperimentSettings, NoiseSettings, StructureSettings
from steelnb.types import Flight, Scan, Trajectory

ALL = {
    "corrected.tum", "errors.png", "frames.csv", "map.ply", "map.png", "prior.tum", "recording.rrd", "segments.csv",
    "segments.json", "segments.obj", "segments.ply", "structure.json", "table.csv", "trajectories.png",
}  # fmt: skip
WALK = NoiseSettings.parse("random-walk:0.002")


@pytest.fixture(scope="module")
def simulated():
    """A zigzag of 8 s with a quarter of the pixels: settings, flight and truth."""
    small = {"tof.columns": 90, "tof.rows": 120}
    settings = ExperimentSettings.preset(
        "zigzag", "random-walk:0.002", sensor="starling2", method="best", seed=4, duration_s=8.0, overrides=small
    )
    return settings, *experiment.simulate(settings)


@pytest.fixture(scope="module")
def report(simulated, tmp_path_factory):
    _, flight, truth = simulated
    seen = []
    found = run_recording(
        flight, tmp_path_factory.mktemp("run") / "out", truth=truth.trajectory, structure=StructureSettings(),
        on_progress=seen.append,
    )  # fmt: skip
    assert seen == pytest.approx(np.arange(1, 41) / 40)
    return found


def straight(stamp_s, speed_m_s: float = 0.25) -> Trajectory:
    """Level flight along x, 2 m above the ground."""
    T = np.tile(np.eye(4), (len(stamp_s), 1, 1))
    T[:, 0, 3], T[:, 2, 3] = speed_m_s * stamp_s, 2.0
    return Trajectory(stamp_s, T)


def made(points, scans: int = 8, **more) -> Flight:
    """A flight of ``points(k)`` at 5 Hz on a straight line."""
    stamp_s = 0.2 * np.arange(scans)
    held = [Scan(float(s), np.asarray(points(k), dtype=float)) for k, s in enumerate(stamp_s)]
    return Flight(held, straight(stamp_s), np.eye(4), **{"name": "made.bag", **more})


def lattice(k: int, x_m: float = 2.5) -> np.ndarray:
    """Points on a few bars ahead of the sensor, with 1 cm of noise."""
    along = np.linspace(-1.2, 1.2, 150)
    zero, x = np.zeros_like(along), np.full_like(along, x_m)
    bars = [np.c_[x, along, zero + h] for h in (-0.6, 0.5)] + [np.c_[x, zero + y, along] for y in (-0.8, 0.7)]
    bars.append(np.c_[x + 0.3 * along, along, along])
    return np.concatenate(bars) + 0.01 * np.random.default_rng(k).standard_normal((5 * len(along), 3))


def test_in_memory_a_run_is_the_experiments_to_the_bit(simulated, report):
    settings, flight, truth = simulated
    expected = experiment.estimate(settings, flight, truth)
    np.testing.assert_array_equal(report.estimate.corrected.T_world_drone, expected.corrected.T_world_drone)
    np.testing.assert_array_equal(report.estimate.points, expected.points)
    assert report.estimate.reason == expected.reason
    for name in ("ate_rmse_m", "error_max_m", "rpe_rmse_m"):
        assert report.numbers[f"corrected_{name}"] == expected.metrics[name]
    assert report.numbers["prior_ate_rmse_m"] == expected.metrics["raw_ate_rmse_m"]


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "folder"])
def test_through_files_a_run_is_that_of_memory(simulated, report, name, tmp_path):
    _, flight, truth = simulated
    write_flight(tmp_path / name, flight, truth.trajectory)
    found = run_recording(tmp_path / name, tmp_path / "out", rrd=False)
    np.testing.assert_allclose(found.estimate.prior.T_world_drone, flight.prior.T_world_drone, atol=1e-12)
    # Files hold float32 points: micrometres, which a registration may turn into a tenth of a millimetre.
    assert np.abs(found.estimate.corrected.position - report.estimate.corrected.position).max() < 2e-4
    assert found.estimate.reason == report.estimate.reason
    assert found.numbers["prior_ate_rmse_m"] == pytest.approx(report.numbers["prior_ate_rmse_m"], rel=1e-9)


def test_a_run_writes_everything_it_says(report):
    assert {file.name for file in report.folder.iterdir()} == ALL
    assert set(FILES) >= ALL, "or one would stay beside the files of a later run"
    assert all(name in report.summary[-1] for name in ALL)
    assert list(report.folder.parent.iterdir()) == [report.folder]
    for name, expected in (("corrected", report.estimate.corrected), ("prior", report.estimate.prior)):
        found = read_trajectory(report.folder / f"{name}.tum")
        np.testing.assert_array_equal(found.stamp_s, expected.stamp_s)
        np.testing.assert_allclose(found.T_world_drone, expected.T_world_drone, atol=1e-12)
    np.testing.assert_array_equal(read_cloud(report.folder / "map.ply").points, report.estimate.points)
    assert len(read_structure(report.folder / "structure.json")) == len(report.structure) > 3
    with (report.folder / "segments.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(report.structure)  # the map of `best` is a cloud


def test_tables_hold_the_numbers(report):
    with (report.folder / "table.csv").open() as file:
        rows = {row["quantity"]: row["value"] for row in csv.DictReader(file)}
    assert (rows["frames"], rows["used"], rows["not used: first scan"]) == ("40", "39", "1")
    assert float(rows["corrected_ate_rmse_m"]) < 0.3 * float(rows["prior_ate_rmse_m"])
    assert float(rows["drift_removed_percent"]) > 70
    times = [float(rows[f"frame_{name}_ms"]) for name in ("median", "p95", "p99", "max")]
    assert times == sorted(times)
    assert times[-1] == pytest.approx(1e3 * report.estimate.update_s.max(), rel=1e-5)
    share = np.mean(report.estimate.update_s[:-1] <= np.diff(report.flight.prior.stamp_s))
    assert float(rows["on_time_share"]) == pytest.approx(share, abs=1 / 40)
    with (report.folder / "frames.csv").open() as file:
        frames = list(csv.DictReader(file))
    assert [row["not_used"] for row in frames] == ["first scan"] + [""] * 39
    error = np.array([float(row["corrected_error_m"]) for row in frames])
    assert np.sqrt((error**2).mean()) == pytest.approx(float(rows["corrected_ate_rmse_m"]), abs=1e-4)


def test_methods_by_segments_write_their_own_map_and_nothing_is_said_without_truth(simulated, tmp_path):
    settings, structure = recording_settings("segments")
    assert structure.adjust
    report = run_recording(simulated[1], tmp_path / "out", settings, rrd=False)
    assert {file.name for file in report.folder.iterdir()} == ALL - {"recording.rrd", "structure.json", "errors.png"}
    with (report.folder / "segments.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(report.estimate.segments) > 0
    assert not any("ate" in name for name in report.metrics)
    assert "no truth" in "\n".join(report.summary)
    assert (report.folder / "frames.csv").read_text().splitlines()[1].endswith(",,")


def test_a_smoothed_run_writes_its_uncertainty(simulated, tmp_path):
    settings, structure = recording_settings("best", overrides={"smooth": True})
    report = run_recording(simulated[1], tmp_path / "out", settings, structure=structure, rrd=False)
    estimate = report.estimate
    assert estimate.unsmoothed == estimate.unsure == ""
    sigma = pd.read_csv(report.folder / "corrected_sigma.csv")
    assert list(sigma) == [
        "stamp_s", "sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_roll_deg", "sigma_pitch_deg", "sigma_yaw_deg",
    ]  # fmt: skip
    stated = np.sqrt(np.diagonal(estimate.pose_covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(sigma["sigma_y_m"], stated[:, 1], atol=1e-6)
    np.testing.assert_allclose(sigma["sigma_yaw_deg"], np.degrees(stated[:, 5]), atol=1e-6)
    assert not sigma.iloc[0, 1:].any()
    assert (sigma.iloc[1:, 1:] > 0).all(axis=None)
    bars = pd.read_csv(report.folder / "segments.csv")
    assert len(bars) == len(estimate.axis_covariance)
    assert ((bars["sigma_start_mm"] > 1) & (bars["sigma_end_mm"] > 1)).all()
    # bars of the structure that lie on smoothed ones have their standard deviation, not that of their own fit
    apart = np.linalg.norm(report.structure.segments.middle[:, None] - estimate.segments.middle, axis=2)
    bar, on = np.unravel_index(np.argmin(apart), apart.shape)
    middle_m = axis_sigma_m(estimate.axis_covariance[[on]], np.zeros(1))[0]
    assert report.structure.sigma_m[bar] == pytest.approx(middle_m, rel=0.2)


def test_covariances_that_are_none_are_not_written(tmp_path):
    covariance = np.tile(1e-4 * np.eye(6), (3, 1, 1))
    covariance[2, 2, 2] = -1e-4
    with pytest.raises(InputError, match=r"pose 2 is not positive definite along 1\.00 z"):
        write_sigma(tmp_path / "corrected_sigma.csv", np.arange(3.0), covariance)
    assert not list(tmp_path.iterdir())


def test_scans_with_a_fault_and_no_structure_are_told(tmp_path):
    flight = made(lambda k: np.full((24, 18, 3), np.nan), skipped={"no pose within the gap": 2})
    faulty = [Scan(scan.stamp_s, np.zeros((0, 3)), f"unreadable scan: {k}") for k, scan in enumerate(flight.scans)]
    report = run_recording(replace(flight, scans=faulty), tmp_path / "out", structure=StructureSettings())
    assert "without a return above the floor" in read_structure(report.folder / "structure.json").reason
    text = "\n".join(report.summary)
    assert "structure empty: 8 scans without a return" in text
    assert "skipped   2 no pose within the gap" in text
    assert report.numbers["not used: unreadable scan"] == 8
    assert "unreadable scan: 7" in (report.folder / "frames.csv").read_text()
    assert "map.png" not in {file.name for file in report.folder.iterdir()}
    shown = "\n".join(describe_flight(replace(flight, scans=faulty)))
    assert "fault     1 unreadable scan: 0" in shown
    assert "no point at all in 8 scans read" in shown


def test_a_lone_scan_is_a_run(tmp_path):
    report = run_recording(made(lattice, scans=1), tmp_path / "out", added_noise="random-walk")
    assert report.numbers["frames"] == 1
    assert report.summary[0] == "read      made.bag: 1 scan with a pose over 0.0 s"
    assert "covers 1 scan:" in "\n".join(report.summary)


def test_range_and_floor_reach_odometry_and_structure(tmp_path):
    settings, structure = recording_settings(range_max_m=20.0, floor_m=-3.0, overrides={"preprocess.voxel_leaf_m": 0.2})
    crop = settings.odometry.preprocess
    assert (crop.crop_m, crop.floor_m, crop.voxel_leaf_m) == (20, -3, 0.2)
    assert (structure.range_max_m, structure.floor_m) == (20, -3)
    assert recording_settings("none")[1].adjust is False
    for given, used in ((recording_settings()[0], 0), (settings, 7), (None, 7)):
        report = run_recording(made(lambda k: lattice(k, 12.0)), tmp_path / "out", given, rrd=False)
        assert report.numbers["used"] == used


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"method": "bset"}, "odometry = 'bset', did you mean 'best'"), ({"sensor": "lidar"}, "sensor = 'lidar'"),
        ({"seed": -1}, "seed = -1"), ({"range_max_m": -1.0}, "crop_m = -1.0"),
        ({"overrides": {"preprocess.leaf": 1}}, "unknown setting 'preprocess.leaf'"),
    ],
)  # fmt: skip
def test_wrong_settings_are_refused(options, words):
    with pytest.raises(InputError, match=words):
        recording_settings(**options)


class Failing(list):
    """Scans of which the eleventh cannot be reached."""

    fault: BaseException

    def __iter__(self):
        yield from self[:10]
        raise self.fault


@pytest.mark.parametrize("fault", [InputError("gone"), KeyboardInterrupt()])
def test_a_run_that_fails_leaves_what_was_there(simulated, tmp_path, fault):
    scans = Failing(list(simulated[1].scans))
    scans.fault = fault
    failing = replace(simulated[1], scans=scans)
    with pytest.raises(type(fault)):
        run_recording(failing, tmp_path / "deep" / "out", structure=StructureSettings())
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "corrected.tum").write_text("old")
    with pytest.raises(type(fault)):
        run_recording(failing, tmp_path / "out", rrd=False)
    assert [file.read_text() for file in (tmp_path / "out").iterdir()] == ["old"]


def test_drift_at_the_simulators_rate_is_the_simulators_to_the_bit():
    true = straight(np.arange(501) * STEP_S)
    np.testing.assert_array_equal(drifted(true, WALK, 7).T_world_drone, drifting(true, WALK, 7).T_world_drone)
    with pytest.raises(InputError, match="less than four hours"):
        drifted(straight(np.array([0.0, 1e9])), WALK, 7)


@pytest.mark.parametrize("rate_hz", [5.0, 30.0, 200.0])
def test_the_same_noise_is_the_same_drift_at_every_rate(rate_hz):
    fine = straight(np.arange(1001) * STEP_S)
    coarse = straight(np.arange(round(8.0 * rate_hz) + 1) / rate_hz)
    at_s = np.arange(0, 8.0, 0.2)
    expected, found = (interpolate(drifted(t, WALK, 7), at_s, 0.5)[0] for t in (fine, coarse))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.abs(found[-1, :3, 3] - straight(at_s).position[-1]).max() > 0.01


@pytest.mark.parametrize("count", range(36, 48))
def test_drift_on_stamps_since_1970(count):
    """They resolve a quarter of a microsecond: the last step of 8 ms may come out as none."""
    true = straight(0.2 * np.arange(count))
    found = drifted(Trajectory(1.7e9 + true.stamp_s, true.T_world_drone), WALK, 7)
    assert (np.diff(found.stamp_s) > 1e-6).all()
    assert len(found) == 25 * (count - 1) + 1
    np.testing.assert_allclose(found.T_world_drone, drifted(true, WALK, 7).T_world_drone, atol=1e-6)


def test_poses_of_a_map_come_back_in_its_coordinates(simulated, tmp_path):
    _, flight, truth = simulated
    utm = np.array([399_100.0, 5_801_400.0, 0.0])
    flight = flight.first(12)
    flight = replace(flight, prior=flight.prior.moved(utm).moved(-utm))  # both in steps of 0.1 µm
    far = replace(flight, prior=flight.prior.moved(utm))
    reports = {
        name: run_recording(each, tmp_path / name, truth=true, structure=StructureSettings())
        for name, each, true in (("near", flight, truth.trajectory), ("far", far, truth.trajectory.moved(utm)))
    }
    near, found = reports["near"], reports["far"]
    assert near.numbers["used"] == found.numbers["used"] == 11
    np.testing.assert_allclose(found.estimate.corrected.position - utm, near.estimate.corrected.position, atol=1e-6)
    np.testing.assert_array_equal(read_cloud(tmp_path / "far" / "map.ply").origin, utm)
    assert len(found.segments) == len(near.segments) == len(found.structure) > 0
    np.testing.assert_allclose(found.segments.middle - utm, near.segments.middle, atol=1e-6)
    assert found.numbers["corrected_ate_rmse_m"] == pytest.approx(near.numbers["corrected_ate_rmse_m"], abs=1e-4)
    written = read_structure(tmp_path / "far" / "structure.json")
    np.testing.assert_array_equal(written.segments.start, found.structure.segments.start)
    np.testing.assert_allclose(read_trajectory(tmp_path / "far" / "prior.tum").position, far.prior.position)


def test_noise_goes_onto_the_truth_and_not_onto_drifting_poses():
    flight, truth = made(lattice), straight(0.2 * np.arange(8), speed_m_s=0.4)
    found, true = with_drift(flight, truth, NoiseSettings(), 1, 0.5)
    np.testing.assert_allclose(found.prior.position, truth.position, atol=1e-9)
    assert true is truth
    found, true = with_drift(flight, None, WALK, 2, 0.5)
    np.testing.assert_array_equal(true.T_world_drone, flight.prior.T_world_drone)
    assert np.linalg.norm(found.prior.position[-1] - true.position[-1]) > 0.005
    # where the truth has a gap there is nothing to add noise to
    gap = Trajectory(truth.stamp_s[[0, 1, 6, 7]], truth.T_world_drone[[0, 1, 6, 7]])
    found, _ = with_drift(flight, gap, WALK, 2, 0.5)
    assert (
        [scan.stamp_s for scan in found.scans] == found.prior.stamp_s.tolist() == truth.stamp_s[[0, 1, 6, 7]].tolist()
    )
    assert found.skipped == {"no true pose within the gap": 4}


def test_a_part_of_a_flight_keeps_its_poses_and_errors_begin_at_its_first():
    flight, truth = made(lattice, scans=21), straight(0.008 * np.arange(501), speed_m_s=0.3)
    found, true, notes = part_of(flight, truth, (1.0, 2.0), 0.5)
    assert [scan.stamp_s for scan in found.scans] == found.prior.stamp_s.tolist() == flight.prior.stamp_s[5:11].tolist()
    np.testing.assert_array_equal(found.prior.T_world_drone, flight.prior.T_world_drone[5:11])
    assert notes[0] == "only the scans from 1.0 to 2.0 s of 4.0 s"
    assert "moved by 0.050 m onto the first pose" in notes[1]
    at, remarks = truth_at_scans(found, true, 0.5)
    assert remarks == ()
    np.testing.assert_allclose(at.position[0], found.prior.position[0], atol=1e-9)
    np.testing.assert_allclose(at.position[-1] - found.prior.position[-1], (0.05, 0, 0), atol=1e-9)
    # the drift that is added begins with the part, too
    drifts, _ = with_drift(found, true, NoiseSettings.parse("constant-drift:0.001"), 1, 0.5)
    off_m = np.linalg.norm(drifts.prior.position - at.position, axis=1)
    np.testing.assert_allclose(off_m, 0.125 * np.arange(0, 1.1, 0.2), atol=0.002)


def test_a_part_from_the_start_leaves_the_truth_where_it_is():
    flight, truth = made(lattice), straight(0.2 * np.arange(8), speed_m_s=0.4)
    found, true, notes = part_of(flight, truth, (0.0, 0.7), 0.5)
    assert len(found) == 4
    assert len(notes) == 1
    np.testing.assert_array_equal(true.T_world_drone, truth.T_world_drone[:4])
    assert part_of(flight, None, (0.3, np.inf), 0.5)[1] is None
    late = Trajectory(truth.stamp_s + 100, truth.T_world_drone)
    assert truth_at_scans(found, part_of(flight, late, (0.3, 0.7), 0.5)[1], 0.5)[0] is None


@pytest.mark.parametrize("part_s", [(2.0, 3.0), (-1.0, 3.0), (1.0, 0.5), (np.nan, 1.0), (0.0, np.nan)])
def test_a_part_without_a_scan_is_refused_with_the_length(part_s):
    with pytest.raises(InputError, match=r"from \S+ to \S+ s: no scan; expected a part of the recording, 0 to 1.4 s"):
        part_of(made(lattice), None, part_s, 0.5)


def test_no_scan_outside_of_a_part_is_read(tmp_path, monkeypatch):
    flight, read, decoded = made(lattice), [], scans._scan
    write_flight(tmp_path / "a.mcap", flight)
    monkeypatch.setattr(scans, "_scan", lambda stamp_s, decode: read.append(stamp_s) or decoded(stamp_s, decode))
    report = run_recording(tmp_path / "a.mcap", tmp_path / "out", rrd=False, part_s=(0.8, 1.3))
    assert {round(stamp_s, 1) for stamp_s in read} == {0.8, 1.0, 1.2}
    assert len(report.estimate.corrected) == 3
    assert "note      only the scans from 0.8 to 1.2 s of 1.4 s" in report.summary


def test_odometries_are_compared_with_the_numbers_of_their_runs(simulated, report, tmp_path):
    _, flight, truth = simulated
    chosen = {name: recording_settings(name, seed=3) for name in ("best", "segments")}
    stages, shares = [], []
    found = compare_recording(
        flight, tmp_path / "out", chosen, truth=truth.trajectory, rrd=False, on_stage=stages.append,
        on_progress=shares.append,
    )  # fmt: skip
    table = found.table.set_index("odometry")
    assert list(table.index) == ["drifting", "best", "segments"]
    for name in ("ate_rmse_m", "error_max_m", "error_final_m"):
        assert table[name]["drifting"] == pytest.approx(report.numbers[f"prior_{name}"], rel=1e-12)
        assert table[name]["best"] == pytest.approx(report.numbers[f"corrected_{name}"], rel=1e-12)
    assert (table["used"]["best"], table["structure_bars"]["best"]) == (39, len(report.structure))
    assert len(shares) == 80
    assert [stage for stage in stages if "correcting" in stage] == [f"{name}: correcting the poses" for name in chosen]
    over_time, taken = found.figure.axes
    labels = [line.get_label().partition(":")[0] for line in over_time.lines]
    assert labels == ["drifting", "best", "least squares"]
    assert [text.get_text() for text in taken.get_yticklabels()] == ["best", "least squares"]
    with (tmp_path / "out" / "comparison.csv").open() as file:
        rows = {row["odometry"]: row for row in csv.DictReader(file)}
    assert float(rows["segments"]["ate_rmse_m"]) == pytest.approx(table["ate_rmse_m"]["segments"], rel=1e-5)
    assert {file.name for file in (tmp_path / "out" / "best").iterdir()} == ALL - {"recording.rrd"}


def test_without_truth_odometries_are_compared_by_their_distance_from_the_recorded_poses(simulated, tmp_path):
    chosen = {name: (recording_settings(name)[0], None) for name in ("none", "best")}
    found = compare_recording(simulated[1].first(12), tmp_path / "out", chosen, rrd=False)
    table = found.table.set_index("odometry")
    assert list(table.index) == ["none", "best"]
    assert table["moved_max_m"]["none"] == 0
    path = read_trajectory(tmp_path / "out" / "best" / "corrected.tum").position
    moved_m = np.linalg.norm(path - simulated[1].prior.position[:12], axis=1)
    assert table["moved_rms_m"]["best"] == pytest.approx(np.sqrt((moved_m**2).mean()))
    assert table["moved_final_m"]["best"] == pytest.approx(moved_m[-1])
    assert "ate_rmse_m" not in table
    assert "metres are distances from the recorded poses" in "\n".join(found.summary)


def test_one_scan_can_be_compared(tmp_path):
    chosen = {name: (recording_settings(name)[0], None) for name in ("none", "best")}
    found = compare_recording(made(lattice, scans=1), tmp_path / "out", chosen, rrd=False)
    assert found.table["moved_max_m"].tolist() == [0, 0]


def test_where_one_of_several_odometries_fails_nothing_is_left(simulated, tmp_path):
    chosen = {name: (recording_settings(name)[0], None) for name in ("none", "best")}

    def fail(stage: str) -> None:
        if stage.startswith("best"):
            raise InputError("gone")

    (tmp_path / "old" / "none").mkdir(parents=True)
    (tmp_path / "old" / "none" / "corrected.tum").write_text("old")
    for name, files in (("new", []), ("old", ["old"])):
        with pytest.raises(InputError):
            compare_recording(simulated[1].first(5), tmp_path / name, chosen, rrd=False, on_stage=fail)
        assert [file.read_text() for file in (tmp_path / name).rglob("*.*")] == files


def test_truth_in_another_frame_is_moved_onto_the_first_pose():
    flight = made(lattice)
    T_other = np.eye(4)
    T_other[:3, :3], T_other[:3, 3] = Rotation.from_euler("z", 40, degrees=True).as_matrix(), (100, 0, 0)
    other = Trajectory(flight.prior.stamp_s, T_other @ flight.prior.T_world_drone)
    true, notes = truth_at_scans(flight, other, 0.5)
    np.testing.assert_allclose(true.T_world_drone, flight.prior.T_world_drone, atol=1e-9)
    assert "different frames" in notes[0]
    near = Trajectory(flight.prior.stamp_s[2:6], flight.prior.T_world_drone[2:6])
    true, notes = truth_at_scans(flight, near, 0.5)
    np.testing.assert_array_equal(true.T_world_drone, near.T_world_drone)
    assert notes == ("the truth covers 4 of 8 scans; errors are those there",)
    assert truth_at_scans(flight, None, 0.5) == (None, ("no truth: nothing is said of errors",))


def test_scans_of_a_run_are_read_one_at_a_time(tmp_path):
    """A folder whose files are removed behind the reader, as it goes."""
    (tmp_path / "a").mkdir()
    for k in range(8):
        np.save(tmp_path / "a" / f"{k}.npy", lattice(k))
    flight = made(lattice)
    (tmp_path / "a" / "trajectory.txt").write_text(
        "\n".join(
            f"{s} {x} 0 2 0 0 0 1" for s, x in zip(flight.prior.stamp_s, flight.prior.position[:, 0], strict=True)
        )
    )
    read = read_flight(tmp_path / "a")
    report = run_recording(
        read, tmp_path / "out", rrd=False,
        on_progress=lambda share: (tmp_path / "a" / f"{min(round(8 * share) + 1, 7)}.npy").unlink(missing_ok=True),
    )  # fmt: skip
    assert report.estimate.reason[:2] == ("first scan", "")
    assert [reason.partition(":")[0] for reason in report.estimate.reason[2:]] == ["missing file"] * 6
