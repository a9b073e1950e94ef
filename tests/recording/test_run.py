"""`run_recording`: the experiment's numbers through memory and files, and truth in other frames."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from steelnb import experiment
from steelnb.core.errors import InputError
from steelnb.core.estimates import MountEstimate, OdometryStep
from steelnb.core.open3d import import_open3d
from steelnb.core.types import Flight, Scan, Trajectory
from steelnb.io import read_flight, read_trajectory, read_truth, write_flight, write_tum
from steelnb.io.clouds import read_points
from steelnb.recording.evaluate import TIMES, at_scans, mount_numbers, truth_of
from steelnb.recording.run import FILES, run_recording
from steelnb.recording.settings import Scene, recording_settings
from steelnb.recording.summary import mount_lines, opened_lines
from steelnb.settings import ExperimentSettings, RecordingOptions
from tests.io.samples import POINTS, Bagged, poses

SCANS = 40


@pytest.fixture(scope="module")
def simulated():
    """A zigzag of 8 s with a quarter of the pixels: settings, flight and truth. Positions of the prior are multiples of
    2⁻²⁰ m, so that coordinates of a map can be added and taken off again without rounding: in a flight so short,
    rounding by 1e-9 m decides on some bars."""
    made = {"duration_s": 0.2 * SCANS, "overrides": {"tof.columns": 90, "tof.rows": 120}}
    settings = ExperimentSettings.preset("zigzag", "random-walk:0.002", method="best", seed=4, **made)
    flight, truth = experiment.simulate(settings)
    T = flight.prior.T_world_drone.copy()
    T[:, :3, 3] = np.round(T[:, :3, 3] * 2**20) / 2**20
    return settings, replace(flight, prior=Trajectory(flight.prior.stamp_s, T)), truth


@pytest.fixture
def undrawn(monkeypatch):
    """Runs without pictures, which take as long as the rest."""
    monkeypatch.setattr("steelnb.recording.run.draw", lambda *_: None)


@pytest.fixture(scope="module")
def report(simulated, tmp_path_factory):
    _, flight, truth = simulated
    seen = []
    flight = replace(flight, facts={"mount": "as simulated"})
    folder = tmp_path_factory.mktemp("run") / "out"
    found = run_recording(flight, folder, *recording_settings(), truth.trajectory, seen.append)
    assert seen == pytest.approx(np.arange(1, SCANS + 1) / SCANS)
    return found


def test_in_memory_a_run_is_the_experiments_to_the_bit(simulated, report):
    settings, flight, truth = simulated
    same = experiment.estimate(settings, flight, truth)
    np.testing.assert_array_equal(report.estimate.corrected.T_world_drone, same.corrected.T_world_drone)
    assert report.numbers["corrected_ate_rmse_m"] == same.metrics["ate_rmse_m"]
    assert report.numbers["prior_ate_rmse_m"] == same.metrics["raw_ate_rmse_m"]


def test_through_files_a_run_is_that_of_memory_and_is_judged_beside_another_program_as_by_evo(
    simulated, report, tmp_path
):
    from evo.core.metrics import APE, PoseRelation
    from evo.core.sync import associate_trajectories
    from evo.tools.file_interface import read_tum_trajectory_file

    _, flight, truth = simulated
    T = flight.prior.T_world_drone[5:].copy()
    T[:, :3, 3] += 0.05 * np.random.default_rng(1).standard_normal((len(T), 3))
    write_tum(tmp_path / "theirs.tum", Trajectory(flight.prior.stamp_s[5:], T))
    write_flight(tmp_path / "a.mcap", flight, truth.trajectory)
    other = "theirs.tum", read_trajectory(tmp_path / "theirs.tum")
    read = read_flight(tmp_path / "a.mcap")
    found = run_recording(read, tmp_path / "out", *recording_settings(), read_truth(tmp_path / "a.mcap"), other=other)
    apart = found.estimate.corrected.position - report.estimate.corrected.position
    assert np.abs(apart).max() < 1e-4  # points are written in single precision
    true = read_tum_trajectory_file(tmp_path / "a.truth.tum")
    for part, file in (("estimate", "theirs.tum"), ("corrected", "out/corrected.tum")):
        ape = APE(PoseRelation.translation_part)
        ape.process_data(associate_trajectories(true, read_tum_trajectory_file(tmp_path / file), max_diff=1e-4))
        error_m = ape.error[5 - SCANS :]  # theirs covers all scans but the first five
        assert found.numbers[f"{part}_ate_rmse_m"] == pytest.approx(np.sqrt((error_m**2).mean()), rel=1e-6)
        assert found.numbers[f"{part}_error_max_m"] == pytest.approx(error_m.max(), rel=1e-6)
    assert found.numbers["frames_with_truth"] == SCANS - 5
    assert any(f"theirs.tum covers {SCANS - 5} of {SCANS} scans" in line for line in found.summary)
    assert any(line.split()[0] == "theirs.tum" for line in found.summary)


def test_the_map_has_the_points_of_the_bars_for_other_programs(report):
    cloud = import_open3d().t.io.read_point_cloud(str(report.folder / "map.ply"))
    points, bar = cloud.point.positions.numpy(), cloud.point["bar"].numpy().ravel()
    assert points.dtype == np.float64
    np.testing.assert_array_equal(points, read_points(report.folder / "map.ply"))
    voxels = np.unique(np.floor(points / 0.04), axis=0)
    assert 1000 < len(points) == len(voxels), "one point a voxel"
    rows = pd.read_csv(report.folder / "segments.csv")
    start, end = (rows[[f"{side}_{axis}_m" for axis in "xyz"]].to_numpy() for side in ("start", "end"))
    assert set(bar) <= {-1, *range(len(rows))}
    assert (bar >= 0).mean() > 0.5
    along = end[bar] - start[bar]
    share = ((points - start[bar]) * along).sum(1) / (along**2).sum(1)
    apart = np.linalg.norm(start[bar] + np.clip(share, 0, 1)[:, None] * along - points, axis=1)
    assert apart[bar >= 0].max() < 0.25  # reach and margin of a bar, and half a voxel


def test_a_run_writes_what_it_says(report):
    assert {path.name for path in report.folder.iterdir()} == set(FILES)
    corrected = read_trajectory(report.folder / "corrected.tum")
    np.testing.assert_allclose(corrected.T_world_drone, report.estimate.corrected.T_world_drone, atol=1e-12)
    table = pd.read_csv(report.folder / "table.csv", index_col="quantity")["value"]
    assert table["frames"] == table["frames_with_truth"] == SCANS
    assert table["used"] == SCANS - 1
    assert table["not used: first scan"] == 1
    assert table["corrected_ate_rmse_m"] < 0.5 * table["prior_ate_rmse_m"]
    assert table["segments"] == len(pd.read_csv(report.folder / "segments.csv"))
    assert not set(TIMES) & set(report.metrics)
    assert set(report.times) == set(TIMES)


def test_a_smoothed_run_tells_the_uncertainty_of_its_bars(simulated, undrawn, tmp_path):
    _, flight, truth = simulated
    settings = recording_settings(overrides={"smooth": True})
    found = run_recording(replace(flight.first(20), facts={"mount": ""}), tmp_path, *settings, truth.trajectory)
    assert not found.estimate.unsmoothed
    sigma_mm = pd.read_csv(tmp_path / "segments.csv")[["sigma_start_mm", "sigma_end_mm"]]
    assert (sigma_mm > 0).all(axis=None)
    pose_sigma_m = np.sqrt(np.trace(found.estimate.pose_covariance[:, :3, :3], axis1=1, axis2=2))
    table = pd.read_csv(tmp_path / "table.csv", index_col="quantity")["value"].astype(float)
    told = table[["position_sigma_m", "position_sigma_max_m"]]
    np.testing.assert_allclose(told, [np.median(pose_sigma_m), pose_sigma_m.max()], rtol=1e-5)
    line = "sigma     of positions {:.3f} m (median), {:.3f} m at most, by the estimate's own covariances"
    assert line.format(*told) in found.summary
    assert found.numbers["corrected_ate_rmse_m"] < 0.5 * found.numbers["prior_ate_rmse_m"]


def test_poses_of_a_map_come_back_in_its_coordinates(simulated, report, undrawn, tmp_path):
    _, flight, truth = simulated
    far = np.array([299_100.0, 2_801_400.0, 0.0])
    moved = replace(flight, prior=flight.prior.moved(far), facts={"mount": ""})
    found = run_recording(moved, tmp_path, *recording_settings(), truth.trajectory.moved(far))
    apart = found.estimate.corrected.position - far - report.estimate.corrected.position
    assert np.abs(apart).max() < 1e-4
    assert found.numbers["corrected_ate_rmse_m"] == pytest.approx(report.numbers["corrected_ate_rmse_m"], abs=1e-4)
    np.testing.assert_allclose(found.segments.start - far, report.segments.start, atol=1e-2)
    low, low_far = (read_points(folder / "map.ply").min(axis=0) for folder in (report.folder, tmp_path))
    np.testing.assert_allclose(low_far - far, low, atol=1e-2)


def test_paths_of_one_name_have_a_row_each(simulated, undrawn, tmp_path):
    class drifting:  # noqa: N801
        def update(self, scan, T_world_drone_prior):
            return OdometryStep(scan.stamp_s, T_world_drone_prior)

    _, flight, truth = simulated
    given = replace(flight.first(5), facts={"mount": ""}), tmp_path, *recording_settings(), truth.trajectory
    found = run_recording(*given, own=drifting, other=("drifting", truth.trajectory))
    rows = [re.match(r"drifting(?: \(\d\))?", line[10:]) for line in found.summary]
    assert [row[0] for row in rows if row] == ["drifting", "drifting (2)", "drifting (3)"]


def test_scans_with_a_fault_and_no_structure_are_told(tmp_path):
    stamp_s = 0.2 * np.arange(4)
    T = np.tile(np.eye(4), (4, 1, 1))
    scans = [Scan(float(s), np.zeros((0, 3)), "unreadable scan: cut short") for s in stamp_s]
    flight = Flight(scans, Trajectory(stamp_s, T), np.eye(4), facts={"mount": ""})
    found = run_recording(flight, tmp_path, *recording_settings())
    assert found.numbers["not used: unreadable scan"] == 4
    assert "note      the first unreadable scan: cut short" in found.summary
    assert found.numbers["structure_bars"] == 0
    assert any(line.startswith("structure empty: ") for line in found.summary)
    assert any("no truth" in line for line in found.summary)


def test_a_trajectory_in_another_frame_is_moved_onto_the_first_pose():
    stamp_s = 0.2 * np.arange(20)
    T = np.tile(np.eye(4), (20, 1, 1))
    T[:, 0, 3] = stamp_s
    scans = Trajectory(stamp_s, T)
    T_other = np.eye(4)
    T_other[:3, :3], T_other[:3, 3] = Rotation.from_euler("z", 1.0).as_matrix(), [3.0, 4.0, 0.0]
    true, notes = at_scans(scans, Trajectory(stamp_s, T_other @ T), "the truth")
    assert true is not None
    np.testing.assert_allclose(true.T_world_drone, T, atol=1e-12)
    assert "5.00 m and 57.3° apart" in notes[0]
    part, notes = at_scans(scans, Trajectory(stamp_s[:10], T[:10]), "the truth")
    assert part is not None
    assert len(part) == 10
    assert "the truth covers 10 of 20 scans" in notes[0]


def test_no_line_on_what_was_read_has_brackets_in_brackets(tmp_path):
    bag = Bagged(tmp_path / "a.mcap").clouds().odometry().tf("base_link", "tof", np.eye(4)).write()
    folder = tmp_path / "clouds"
    folder.mkdir()
    for k in range(5):
        np.save(folder / f"{k}.npy", POINTS)
    write_tum(folder / "poses.tum", poses(5))
    for flight in (read_flight(bag), read_flight(folder), read_flight(folder, mount=(0, 0, 1, 0, 0, 0))):
        lines = opened_lines(flight, Scene.of(flight))
        assert any(line.startswith("mount") for line in lines)
        assert not any(re.search(r"\([^)]*\(", line) for line in lines)


def test_a_truth_of_another_time_is_refused_if_it_was_named(tmp_path):
    path = Bagged(tmp_path / "a.mcap").clouds().odometry().tf("base_link", "tof", np.eye(4)).write()
    flight, prior = read_flight(path), poses(5)
    write_tum(tmp_path / "late.tum", Trajectory(prior.stamp_s + 1000, prior.T_world_drone))
    with pytest.raises(InputError, match=r"late.tum: its poses at 100.* match fewer than two scans, at "):
        truth_of(flight, path, RecordingOptions(truth=str(tmp_path / "late.tum")))
    assert truth_of(flight, path, RecordingOptions()) is None
    (tmp_path / "late.tum").rename(tmp_path / "a.truth.tum")
    assert len(truth_of(flight, path, RecordingOptions())) == 5
    write_tum(tmp_path / "right.tum", prior)
    assert len(truth_of(flight, path, RecordingOptions(truth=str(tmp_path / "right.tum")))) == 5


def test_a_mount_that_is_not_known_is_estimated_and_used(simulated, undrawn, tmp_path):
    flight, truth = simulated[1].first(20), simulated[2]
    sigmas = {"smooth": True, "mount.rotation_sigma_deg": 1.0, "mount.time_sigma_s": 0.02}
    settings = recording_settings(overrides=sigmas)
    shares = []
    report = run_recording(replace(flight, facts={"mount": ""}), tmp_path, *settings, truth.trajectory, shares.append)
    assert shares[len(flight) - 1] == 0.5  # two passes
    assert shares[-1] == 1
    assert any(line.startswith("mount     turned by") for line in report.summary)
    found, by = report.estimate, np.array([1.0, 2.0, 3.0])
    mount = found.mount
    assert np.abs(mount.step[:3]).max() < np.radians(3)
    np.testing.assert_array_equal(mount.step[3:6], 0)
    np.testing.assert_array_equal(np.diag(mount.covariance) > 0, [1, 1, 1, 0, 0, 0, 1])
    moved = found.moved(by, flight.prior.moved(by)).sensor_poses(flight.T_drone_sensor)
    np.testing.assert_allclose(moved[:, :3, 3] - mount.T_world_sensor[:, :3, 3], np.tile(by, (len(flight), 1)))


def test_the_summary_says_what_a_mount_costs_what_it_is_and_what_stays_open():
    costs = {f"mount_cost_{axis}_deg_m": 0.01 * k for k, axis in enumerate(("roll", "pitch", "yaw"), 1)}
    costs |= {f"mount_cost_{axis}_cm_m": 0.001 * k for k, axis in enumerate("xyz", 1)}
    (line,) = mount_lines(costs)
    assert "1° of roll, pitch, yaw moves poses by 10, 20, 30 mm, 1 cm of x, y, z by 1, 2, 3 mm" in line
    covariance = np.diag(np.square([*np.radians([0.1, 0.2, 0.8]), 0.002, 0.003, 0.004, 0.0005]))
    step = np.array([*np.radians([0.5, -1.0, 2.0]), 0.01, -0.02, 0.03, 0.02])
    found = mount_numbers(MountEstimate(np.eye(4), 0.02, step, covariance, np.zeros((0, 4, 4))))
    said, _, left = mount_lines(costs | found)
    assert "turned by (0.50, -1.00, 2.00)° ± (0.10, 0.20, 0.80)°, moved by (10, -20, 30) mm ± (2, 3, 4) mm" in said
    assert "stamps 0.0200 ± 0.0005 s late" in said
    assert "left open: yaw, 24 mm:" in left
    assert mount_lines({}) == []
