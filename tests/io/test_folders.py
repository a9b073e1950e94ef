"""Folders of clouds as flights."""

import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.io import read_flight, read_truth, write_tum
from tests.io.samples import poses
from tests.io.test_clouds import POINTS

UNIX_S = 1_700_000_000
DATES = "date and time, UTC"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Ten clouds, shifted by their numbers, and ten poses."""
    for k in range(10, 0, -1):
        np.save(tmp_path / f"scan{k}.npy", POINTS + k)
    write_tum(tmp_path / "trajectory.tum", poses(10))
    return tmp_path


def dated(ns: int, form: str) -> str:
    return datetime.fromtimestamp(ns / 1e9, UTC).strftime(form)


def renamed(folder: Path, name: Callable[[int], object]) -> None:
    for k in range(1, 11):
        (folder / f"scan{k}.npy").rename(folder / f"{name(k)}.npy")


def test_a_folder_of_clouds_is_sorted_by_the_numbers_in_the_names(folder: Path) -> None:
    write_tum(folder / "groundtruth.tum", poses(10, seed=5))
    flight = read_flight(folder)
    np.testing.assert_array_equal(flight.prior.stamp_s, poses(10).stamp_s)
    for k, scan in enumerate(flight.scans, 1):
        np.testing.assert_array_equal(scan.points, POINTS + k)
    np.testing.assert_allclose(read_truth(folder).T_world_drone, poses(10, seed=5).T_world_drone, atol=1e-12)
    assert read_truth(folder, truth="trajectory.tum") is not None


@pytest.mark.parametrize(
    ("begin_s", "name", "units"),
    [
        (0, lambda ns, k: f"scan_{ns / 1e9:.3f}", "s"),
        (0, lambda ns, k: f"{ns // 10**6}", "ms"),
        (0, lambda ns, k: f"{ns:019d}", "ns"),
        (50, lambda ns, k: f"{ns}", "ns"),
        (500, lambda ns, k: f"{ns // 1000}", "µs"),
        (UNIX_S, lambda ns, k: f"{ns / 1e9:.6f}", "s"),
        (UNIX_S, lambda ns, k: f"{ns / 1e9:.3f}_{k:04d}", "s"),
        (UNIX_S, lambda ns, k: f"{k}_{ns // 10**6}", "ms"),
        (UNIX_S, lambda ns, k: f"{ns // 1000}", "µs"),
        (UNIX_S, lambda ns, k: f"{ns}", "ns"),
        (UNIX_S, lambda ns, k: f"cloud_{ns // 10**9}_{ns % 10**9:09d}", "s and ns"),
        (UNIX_S, lambda ns, k: f"{ns // 10**9}_{ns % 10**9}_{k:06d}", "s and ns"),
        (UNIX_S, lambda ns, k: f"{k:06d}-{ns // 10**9}-{ns % 10**9 // 1000:06d}", "s and µs"),
        (UNIX_S + 39, lambda ns, k: dated(ns, "%Y-%m-%dT%H-%M-%S.%f"), DATES),
        (UNIX_S + 39, lambda ns, k: f"tof_{dated(ns, '%Y%m%d_%H%M%S_%f')[:-3]}", DATES),
        (UNIX_S + 39, lambda ns, k: f"{dated(ns, '%Y%m%d%H%M%S%f')[:-3]}_{k}", DATES),
        (UNIX_S + 39, lambda ns, k: f"{dated(ns, '%Y%m%d_%H%M%S')}_{ns // 10**6 % 1000}", DATES),
        (UNIX_S + 39, lambda ns, k: f"{dated(ns + 3_600 * 10**9, '%Y-%m-%dT%H:%M:%S.%f')}+01:00", DATES),
        (UNIX_S, lambda ns, k: f"rs_{ns / 1e6:.4f}", "ms"),
        (UNIX_S, lambda ns, k: f"{ns // 10**9}_{ns // 10**6 % 1000}", "s and ms"),
    ],
)
@pytest.mark.parametrize("step_s", [0.2, 0.05], ids=["a pose a scan", "more poses"])
def test_stamps_are_read_from_the_names(
    folder: Path, begin_s: int, name: Callable[[int, int], str], units: str, step_s: float
) -> None:
    renamed(folder, lambda k: name(begin_s * 10**9 + 200_000_000 * (k - 1), k))
    write_tum(folder / "trajectory.tum", poses(round(2 / step_s), step_s=step_s, begin_s=begin_s))
    flight = read_flight(folder)
    np.testing.assert_allclose(flight.prior.stamp_s, begin_s + 0.2 * np.arange(10), atol=1e-6)
    np.testing.assert_array_equal(flight.scans[9].points, POINTS + 10)
    assert flight.facts["scans"] == f"10 files, stamped by their names ({units})"


@pytest.mark.parametrize("count", ["{:04d}", "{:03d}", "{}", "{:06d}"])
@pytest.mark.parametrize("step", [1, 5])
def test_numbers_after_the_date_of_the_start_count(folder: Path, count: str, step: int) -> None:
    renamed(folder, lambda k: f"20231114_221320_{count.format(step * k + (k > 5))}")
    write_tum(folder / "trajectory.tum", poses(10, begin_s=UNIX_S))
    flight = read_flight(folder)
    assert flight.facts["scans"] == "10 files, in the order of their names"
    np.testing.assert_array_equal(flight.scans[9].points, POINTS + 10)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        (
            lambda k: dated(UNIX_S * 10**9 + k * 500_000_000, "%Y-%m-%d_%H-%M-%S.%f"),
            "dates of another time than the poses",
        ),
        (lambda k: f"{k:04d}_{20 + 0.1 * k:.1f}C", "no stamps in their names"),
    ],
)
def test_digits_of_dates_and_measures_are_no_stamps(folder: Path, name: Callable[[int], str], says: str) -> None:
    renamed(folder, name)
    write_tum(folder / "trajectory.tum", poses(300, step_s=0.1))
    with pytest.raises(InputError, match=f"10 clouds, {says}"):
        read_flight(folder)
    write_tum(folder / "trajectory.tum", poses(10))
    assert read_flight(folder).facts["scans"] == "10 files, in the order of their names"


def test_text_files_that_differ_in_numbers_are_clouds_and_bin_is_named(tmp_path: Path) -> None:
    write_tum(tmp_path / "poses.tum", poses(10))
    (tmp_path / "velodyne").mkdir()
    (tmp_path / "velodyne" / "000000.bin").write_bytes(bytes(32))
    with pytest.raises(InputError, match=r".bin files do not say what is in them; expected .npy"):
        read_flight(tmp_path)
    (tmp_path / "clouds").mkdir()
    for k in range(10):
        np.savetxt(tmp_path / "clouds" / f"{k}.txt", POINTS.reshape(-1, 3) + k)
    with pytest.raises(InputError, match="--scans clouds"):
        read_flight(tmp_path)
    np.testing.assert_allclose(read_flight(tmp_path, scans="clouds").scans[9].points, POINTS.reshape(-1, 3) + 9)


def test_decimals_without_the_zeros_before_them_are_nanoseconds(folder: Path) -> None:
    renamed(folder, lambda k: f"{UNIX_S}.{30_000_000 * (k - 1)}")
    write_tum(folder / "trajectory.tum", poses(10, step_s=0.03, begin_s=UNIX_S))
    flight = read_flight(folder)
    np.testing.assert_allclose(flight.prior.stamp_s, UNIX_S + 0.03 * np.arange(10), atol=1e-6)
    np.testing.assert_array_equal(flight.scans[9].points, POINTS + 10)


def test_poses_out_of_order_are_not_given_to_clouds_by_their_number(folder: Path) -> None:
    rows = (folder / "trajectory.tum").read_text().splitlines()
    (folder / "trajectory.tum").write_text("\n".join([*rows[3:], *rows[:3]]))
    with pytest.raises(InputError, match=r"10 poses in trajectory.tum, 1 of them out of order; expected"):
        read_flight(folder)


@pytest.mark.parametrize(
    "name",
    [
        "{0:03d}", "frame_{0:d}_2023", "{0:04d}0", "scan_v1.2_{0:03d}", "{0:04d}_r{1:.1f}m",
        "20231114T2213{0:02d}.{1:03.0f}",
    ],
)  # fmt: skip
def test_numbers_that_count_or_measure_are_no_stamps(folder: Path, name: str) -> None:
    renamed(folder, lambda k: name.format(k, 0.5 * k))
    flight = read_flight(folder)
    np.testing.assert_array_equal(flight.prior.stamp_s, poses(10).stamp_s)
    assert flight.facts["scans"] == "10 files, in the order of their names"
    if "{1" not in name:  # decimals are stamps where they order nothing
        write_tum(folder / "trajectory.tum", poses(100, step_s=0.04))
        with pytest.raises(InputError, match="10 clouds, no stamps in their names, and 100 poses"):
            read_flight(folder)


def test_a_cloud_that_is_set_aside_is_named_where_the_count_is_wrong(folder: Path) -> None:
    (folder / "scan1.npy").rename(folder / "scan.npy")
    with pytest.raises(InputError, match=r"9 clouds, .* 10 poses .*unlike scan2.npy \(scan.npy beside them\)"):
        read_flight(folder)


def test_other_files_beside_the_scans_are_named(folder: Path) -> None:
    np.save(folder / "map_2.npy", POINTS)
    (folder / "imu.csv").write_text("#timestamp [ns],w_x,w_y,w_z\n1,2,3,4\n")
    for name in (".DS_Store", "._scan1.npy", "README.txt", "calibration.txt"):
        (folder / name).write_text("1 0 0 0\n")
    flight = read_flight(folder)
    assert len(flight) == 10
    assert flight.skipped == {"cloud beside the scans (imu.csv, map_2.npy)": 2}
    for k in range(1, 11):
        np.save(folder / f"rear{k}.npy", POINTS)
    with pytest.raises(InputError, match=r"10 clouds such as rear1.npy, and 10 such as scan1.npy; expected names"):
        read_flight(folder)


def test_a_broken_file_is_a_scan_with_a_fault(folder: Path) -> None:
    (folder / "scan3.npy").write_bytes(b"broken")
    faults = [scan.fault for scan in read_flight(folder).scans]
    assert [k for k, fault in enumerate(faults) if fault] == [2]
    assert "scan3.npy: not a NPY file of points" in faults[2]


def test_folders_without_one_trajectory_or_clouds_are_refused(folder: Path) -> None:
    write_tum(folder / "other.tum", poses(3))
    with pytest.raises(InputError, match=r"other.tum, trajectory.tum; expected one TUM file"):
        read_flight(folder)
    with pytest.raises(InputError, match=r"10 clouds, no stamps in their names, and 3 poses in other.tum"):
        read_flight(folder, poses="other.tum")
    assert len(read_flight(folder, poses="trajectory.tum")) == 10
    (folder / "sub").mkdir()
    with pytest.raises(InputError, match=r"sub: no clouds in it"):
        read_flight(folder, scans="sub")


def save_named(folder: Path, *names: str, count: int | None = None) -> None:
    """Clouds, each shifted by its number, and as many poses, or ``count``."""
    for k, name in enumerate(names):
        np.save(folder / f"{name}.npy", POINTS + k)
    write_tum(folder / "trajectory.tum", poses(count or len(names)))


def test_names_that_differ_in_words_have_no_order(tmp_path: Path) -> None:
    save_named(tmp_path, "east2", "north1", "south0", "west5")
    with pytest.raises(InputError, match=r"clouds such as east2.npy and north1.npy have no order; expected names"):
        read_flight(tmp_path)
    for old, new in (("east2", "east0"), ("south0", "south2")):
        (tmp_path / f"{old}.npy").rename(tmp_path / f"{new}.npy")
    assert len(read_flight(tmp_path)) == 4


def test_what_a_folder_holds_instead_is_named(folder: Path) -> None:
    (folder / "inner").mkdir()
    for file in folder.glob("*.npy"):
        file.rename(folder / "inner" / file.name)
    with pytest.raises(InputError, match=r"no clouds in it, but .*\(--scans inner\)"):
        read_flight(folder)
    (folder / "a.e57").write_bytes(b"ASTM-E57\1")
    shutil.rmtree(folder / "inner")
    with pytest.raises(InputError, match=r"no clouds in it, but .*a.e57 is E57; expected PLY or LAS"):
        read_flight(folder)
    (folder / "trajectory.tum").unlink()
    np.save(folder / "map1.npy", POINTS)
    np.save(folder / "map2.npy", POINTS)
    (folder / "a.db3").write_bytes(b"SQLite format 3\0")
    with pytest.raises(InputError, match=r"clouds without a trajectory, and a.db3; expected one, or the bag itself"):
        read_flight(folder)


def test_numbers_before_words_are_an_order(tmp_path: Path) -> None:
    save_named(tmp_path, "9_a", "10_b", "11_c")
    assert [scan.points[0, 0] - POINTS[0, 0] for scan in read_flight(tmp_path).scans] == [0, 1, 2]


def test_other_tables_of_eight_numbers_are_no_trajectory(folder: Path) -> None:
    (folder / "calib.txt").write_text("Camera calibration\n" + "".join(f"{k} 1 2 3 0 0 0 1\n" for k in range(3)))
    assert len(read_flight(folder)) == 10


@pytest.mark.parametrize("options", [{"clock": "bag"}, {"imu": "/imu"}])
def test_what_only_a_bag_has_is_refused(folder: Path, options: dict) -> None:
    with pytest.raises(InputError, match=r"(clock 'bag'|IMU /imu); expected a bag"):
        read_flight(folder, **options)


def test_a_map_whose_number_is_between_those_of_scans_is_no_scan(tmp_path: Path) -> None:
    save_named(tmp_path, "1", "3", "5", "7", "6_map", count=4)
    flight = read_flight(tmp_path)
    assert len(flight) == 4
    assert "6_map.npy" in str(flight.skipped)


def test_scans_of_two_sensors_in_a_folder_are_refused(tmp_path: Path) -> None:
    save_named(tmp_path, "0_front", "1_rear", "2_front", "3_rear", "4_front", "5_rear")
    with pytest.raises(InputError, match="one kind"):
        read_flight(tmp_path)


def test_scans_of_another_ending_are_named(folder: Path) -> None:
    for k in (1, 2, 3, 4):
        (folder / f"scan{k}.npy").rename(folder / f"scan{k}.npy.gz")
    write_tum(folder / "trajectory.tum", poses(6))
    assert read_flight(folder).skipped == {"cloud beside the scans (scan1.npy.gz, scan2.npy.gz, scan3.npy.gz, …)": 4}
