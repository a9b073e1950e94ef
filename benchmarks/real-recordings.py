"""Recordings that others made: what comes out of them, how fast, and what a user has to set.

    .venv/bin/python benchmarks/real-recordings.py FOLDER > benchmarks/real-recordings.md

FOLDER holds clones, by their own names, of the repositories in the tables; nothing of them is copied into this one.
--only CLONE ... leaves the others out. Every row is a process of its own on one pinned core, so its memory is its own;
times are those of the process, not of the clock.
"""

# ruff: noqa: E402 - libraries count their threads when they are imported, so the core is pinned before
import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from steelnb.report.recording_truth import truth_at_scans, with_drift

from shared import command, in_own_process, peak_bytes
from steelnb import odometry, rng
from steelnb.errors import SteelnbError
from steelnb.hough.blocks import within
from steelnb.io import read_cloud, read_flight, read_truth, write_flight, write_tum
from steelnb.io.trajectories import matrices
from steelnb.metrics import score_trajectory
from steelnb.report.cloud import segment_file
from steelnb.report.recording_settings import Scene, recording_settings
from steelnb.report.results import machine
from steelnb.settings import NoiseSettings
from steelnb.types import Array, Trajectory

NOTES = """We found no public recording of a drone before a steel tower with its true poses, so these are of other
sensors and scenes. They show that files from elsewhere are read, and what the presets, made for a Time-of-Flight camera
2 m from a lattice, are worth there. Nothing of the data is in this repository: where no licence is named they were used
here, not copied. Looked for and not found with its data: a ROS 2 bag (SQLite or MCAP) with PointCloud2 and poses, and a
LAZ file of a power line. So a ROS 1 bag is written as MCAP and SQLite here, and one serialised message of ROS 2 is put
into an MCAP file as it is.

To have the data, clone the repositories side by side into one folder, `git clone https://github.com/REPOSITORY`; all
files used are in the commits named, none in Git LFS. BALM has 0.5 GB. legature-gabbiatrice-3d carries its libraries:
`git clone --depth 1 --filter=blob:none --sparse` and `git sparse-checkout set data` leave them out. The script makes of
them what `steelnb` reads: BALM's poses are in `alidarPose.csv`, as 4 × 4 matrices with the stamp in place of the last
1, and go to `trajectory.txt` beside its clouds; libpointmatcher's CSV and VTK files are written as NPY.
"""
DRIFT = "random-walk:0.002"


class Options(NamedTuple):
    """The arguments of `recording_settings`, and the noise to add."""

    method: str = "best"
    noise: str | None = None
    range_max_m: float | None = None


NO_FLAGS = Options(noise=DRIFT)
UNKNOWN = Options(method="gicp")
"""For poses that say nothing: all six degrees of freedom from the scans."""
JITTER_TUBES = 4.0
"""The control of `bars` moves points by up to this many tubes along each axis."""
COLUMNS = f"""
What a user would type is behind `steelnb`; the numbers are from the same objects in a process of its own. *ATE*: root
mean square error of the positions, of the poses with their drift (seed 1) → corrected; where a recording has no truth,
how far its points lie from the scan before, with poses that stand still → corrected. *Control*: the same of points
moved by up to {JITTER_TUBES:g} tubes along each axis, which is what bars anywhere would
explain; lengths and tubes are in the units of the file. Milliseconds are medians on one core: *read*
from file to points (processor time), then the odometry (wall time), or for a single cloud the whole of `segment`
without its structure. *Peak* is that of the process, with all libraries."""
SETTINGS = """
## What a user has to set

Floor, range, voxels and gaps follow from the first scans and from the poses; no row sets them but one. Before, the walk
came out worse than its drift without them (0.335 → 0.408 m), and no scan of the truck was registered after the second.

- **Floor.** Where points lie below the world's zero, nothing is cut off. Else what lies below 0.3 m is.
- **Range.** `--range-max 6` on the walk is what the drone's preset would see of it: mostly flat ground, along which the
  prior is followed. What lies behind the sensor is kept: of a spinning LiDAR that is half.
- **Axes.** `[extrinsics]` where the sensor's x is not forward: the truck's LiDAR has its y forward.
- **Method.** `best` and `combined` take roll and pitch from the poses, as an IMU gives them. Where poses say nothing,
  `--odometry gicp` solves for all six degrees of freedom. In the kitchen `gicp`, as the report set it, is worse than
  the drift.
- **Structure.** `--no-structure` where there are no bars: on the walk it takes minutes and 2 GB to say that most lines
  run in surfaces.
- **Peers.** On the walk small_gicp's VGICP, scan to model, begun at the prior's motion, with voxels of 18 cm, comes out
  at 0.107 m where `best` has 0.112; on the first hundred images of the kitchen both at 0.013 m, KISS-ICP 1.3 at 0.023
  without a prior. KISS-ICP loses the walk (8.3 m), whose sweeps come at 2 Hz; done by hand, not by this script.
- **Images.** On the kitchen's colour images `orb` hardly corrects the drift (0.151 → 0.147 m; without drift it errs by
  0.134 m itself), with intrinsics and mount of the depth images: the data set has none of the colour camera. With a
  focal length of 525 pixels instead of 585, TUM RGB-D's default for such cameras, it has 0.076 m, where `best` has
  0.080; on the first hundred images it is the other way round, 0.024 m with 585 and 0.037 with 525, of a drift of
  0.036. Done by hand, but for the row: a camera without a calibration cannot tell what `orb` is worth on real images.
- **Units and dx.** Files are taken to be in metres; in millimetres all lengths, `--dx` too, are millimetres. On a cloud
  full of surfaces the default dx is the spacing of the points, and surfaces come out as sheaves of short bars: the
  share explained then says little. For the cage a tube that holds a rod (12 mm) is better.
- **Pixels.** Eight by eight are too few: no scan has the 100 points from which on it is registered, and the poses are
  the prior's, which the summary says. Registered all the same, as before, these flights came out 1.2 to 16 times as
  far off as their drift: a map of the few points that the sensor saw holds the drone where it was.
- **Smoothing.** `--smooth` needs bars with known sections; in a kitchen and outdoors most lines lie in surfaces, which
  the summary says, and the odometry's poses stay, without σ.

## What the numbers say

In the kitchen and on the walk the corrected error is the same whether there was no drift, the report's, or more: it is
not what is left of the drift, but how far this odometry and the given poses differ on these data. Those poses were not
measured by other means; they come from registration too (KinectFusion, a LiDAR's own), in the kitchen with a depth
camera that was not calibrated. Registration of every sixth image of the kitchen to its own map by Open3D, done by hand
(point to plane, 2 cm, begun at the given poses), differs from them by 0.10 m as well. Which of the two is wrong these
rows cannot say, and of a drift below that difference not whether it was removed.

Of the rods that stand free in the cage, seen by eye, the four upright ones come out as one bar each and the two bent
ones that tie them in two pieces each; one bar is a rod far behind, the others are short lines along the rods' edges.
The rest of that frame is a machine, plates and cables, where lines are found but mean nothing.
"""


class Source(NamedTuple):
    """A repository and the commit that was read, the licence of its data as far as it says, and what they are."""

    at: str
    licence: str
    what: str

    @property
    def repository(self) -> str:
        return self.at.partition("@")[0]

    def clone(self, folder: Path) -> Path:
        """Where it is among the clones in a folder."""
        return folder / self.repository.split("/")[1]


class Case(NamedTuple):
    """A row: whose data, what a user would type, and what does the same: clone, scratch folder → numbers."""

    source: str
    said: str
    run: Callable[[Path, Path], dict]


def corrected(path: Path, options: Options, true: str | None = None) -> dict:
    """A recording through an odometry, as `steelnb run` would; without a truth, how well the scans lie on each other.

    That is the median distance of a scan's points to the nearest of the scan before.
    """
    flight, truth = read_flight(path, truth=true), read_truth(path, truth=true)
    settings, _ = recording_settings(options.method, scene=Scene.of(flight), range_max_m=options.range_max_m)
    if options.noise is not None:
        flight, truth = with_drift(flight, truth, NoiseSettings.parse(options.noise), 1, None)
    truth, _ = truth_at_scans(flight, truth, None)
    prior, mount = flight.prior, flight.T_drone_sensor
    reading, clouds, began = [], [], time.process_time()
    for scan in flight.scans:
        reading.append(time.process_time() - began)
        if truth is None:
            points = scan.points.reshape(-1, 3)
            clouds.append(points[np.isfinite(points).all(axis=1)])
        began = time.process_time()
    odometry.run(flight.first(3), odometry.make_odometry(settings.odometry, mount, images=flight.images))
    found = odometry.run(flight, odometry.make_odometry(settings.odometry, mount, images=flight.images))
    estimate = found.corrected
    if truth is not None:
        before, after = (score_trajectory(one.at(truth.stamp_s), truth)["ate_rmse_m"] for one in (prior, estimate))
        outcome = f"ATE {before:.3f} → {after:.3f} m"
    else:
        before, after = (apart(clouds, one.T_world_drone @ mount) for one in (prior, estimate))
        moved = np.linalg.norm(np.diff(estimate.position, axis=0), axis=1).mean()
        outcome = (
            f"no truth; a scan lies {before:.2f} → {after:.2f} m from the one before, {moved:.2f} m of motion each"
        )
    followed = int((found.unobserved > 0).sum())
    if followed:
        outcome += f"; {followed} say nothing of a direction"
    if settings.odometry.smooth:
        sigma_m = (
            None if found.pose_covariance is None else np.sqrt(found.pose_covariance[:, :3, :3].trace(axis1=1, axis2=2))
        )
        outcome += "; smoothed" if not found.unsmoothed else f"; not smoothed: {found.unsmoothed}"
        outcome += "" if sigma_m is None else f", σ {1e3 * float(np.median(sigma_m)):.0f} mm (median)"
    lost = sum(reason not in ("", "first scan") for reason in found.reason)
    lost_text = f"; {lost} not registered" if lost else ""
    return {
        "frames": len(prior), "ate_m": (before, after), "outcome": outcome + lost_text,
        "read_ms": 1e3 * float(np.median(reading)), "ms": 1e3 * float(np.median(found.update_s[1:])),
    }  # fmt: skip


def apart(scans: list[Array], T_world_sensor: Array) -> float:
    """Median distance of points to the nearest of the scan before, metres."""
    placed = [scan @ T[:3, :3].T + T[:3, 3] for scan, T in zip(scans, T_world_sensor, strict=True)]
    return float(np.median([np.median(cKDTree(a).query(b[::5])[0]) for a, b in pairwise(placed)]))


def bars(
    file: Path, work: Path, dx_m: float | None = None, box: Callable[[Array], NDArray[np.bool_]] | None = None
) -> dict:
    """A cloud's bars, as `steelnb segment` would find them, and what bars as many explain of points moved at random."""
    if box is not None:
        points = read_cloud(file).points
        np.savetxt(work / "part.xyz", points[box(points)], fmt="%.6f")
        file = work / "part.xyz"
    points = read_cloud(file).points
    began = time.process_time()
    report = segment_file(file, work / "bars", dx_m=dx_m, structure=False)
    ms = 1e3 * (time.process_time() - began)
    move = JITTER_TUBES * report.dx_m * rng.stream(1, "control").uniform(-1, 1, points.shape)
    found = report.segments.transformed(shift(-read_cloud(file).origin))
    control = float(within(points + move, found, report.dx_m).mean())
    return {
        "frames": 1, "ms": ms, "outcome": f"{len(points)} points: {len(report.segments)} bars, "
        f"{report.segments.length.sum():.1f} long in all, tube {report.dx_m:.3g}; "
        f"{100 * report.explained:.0f} % of the points within it (control: {100 * control:.0f} %)",
    }  # fmt: skip


def shift(by: Array) -> Array:
    """The transform that moves by a vector ``(3,)``."""
    result = np.eye(4)
    result[:3, 3] = by
    return result


def standing(stamp_s: Array) -> Trajectory:
    """Poses of who does not know that he moves."""
    return Trajectory(stamp_s, np.tile(np.eye(4), (len(stamp_s), 1, 1)))


def folder_of(work: Path, scans: list[Array], stamp_s: Array, poses: Trajectory | None = None) -> Path:
    """A folder of NPY clouds as `steelnb` reads it."""
    folder = work / "scans"
    folder.mkdir()
    for k, scan in enumerate(scans):
        np.save(folder / f"{k:06d}.npy", scan)
    write_tum(folder / "trajectory.txt", poses or standing(stamp_s))
    return folder


def walk_outdoors(data: Path, work: Path) -> Path:
    """BALM's clouds, with the 4 × 4 matrices of its CSV, whose last number is the stamp, as a trajectory."""
    rows = np.loadtxt(data / "alidarPose.csv", delimiter=",", usecols=range(4)).reshape(-1, 4, 4)
    stamp_s = rows[:, 3, 3].copy()
    rows[:, 3, 3] = 1
    folder = work / "scans"
    folder.mkdir()
    for k in range(len(rows)):
        (folder / f"full{k}.pcd").symlink_to((data / f"full{k}.pcd").absolute())
    write_tum(folder / "trajectory.txt", Trajectory(stamp_s, rows))
    return folder


def car_pair(data: Path, work: Path) -> dict:
    """Two sweeps of which the second lies askew, with the transform that libpointmatcher's list says is true."""
    rows = [line.split(",") for line in (data / "carCloudList.csv").read_text().splitlines()[1:] if line.strip()]
    true = np.array([row[1:] for row in rows], dtype=float).reshape(-1, 4, 4)
    stamp_s = np.arange(len(rows)) / 10
    folder = folder_of(work, [read_cloud(data / row[0]).points for row in rows], stamp_s)
    write_tum(work / "true.tum", Trajectory(stamp_s, true))
    return corrected(folder, UNKNOWN, str(work / "true.tum"))


def nano_flights(data: Path, work: Path) -> dict:
    """Every flight with motion capture, its truth, and drift added to that: errors before and after."""
    rows = []
    for k, file in enumerate(sorted(data.glob("*/*/state_Vicon.csv"))):
        table = pd.read_csv(file)
        poses = table[(table["name"] == "Drone") & (table[["qw", "qx", "qy", "qz"]].abs().sum(axis=1) > 0)]
        poses = poses.groupby("timeStamp").last()
        if len(poses) < 100:
            continue
        place, turn = poses[["posx", "posy", "posz"]].to_numpy(), poses[["qx", "qy", "qz", "qw"]].to_numpy()
        stamp_s, T = poses.index.to_numpy() / 1e3, matrices(place, turn)
        frames = np.loadtxt(file.with_name("state_ToF.csv"), delimiter=",")
        frames = frames[: len(frames) // 65 * 65].reshape(-1, 65, 3)
        seen_s, away, state = frames[:, 0, 0] / 1e3, frames[:, 1:, 0] / 1e3, frames[:, 1:, 2]
        high = np.interp(seen_s, stamp_s, T[:, 2, 3]) > T[:, 2, 3].min() + 0.15
        near = np.abs(seen_s[:, None] - stamp_s).min(axis=1) < 0.1
        chosen = np.flatnonzero(high & near)
        step = np.tan(np.pi / 4 / 8 * (3.5 - np.arange(8)))
        ray = np.stack([np.ones((8, 8)), *np.meshgrid(step, step)], axis=-1).reshape(64, 3)
        away = np.where(np.isin(state, (5, 9)) & (away > 0.05) & (away < 4), away, np.nan)
        part = work / str(k)
        part.mkdir()
        folder = folder_of(part, [away[one, :, None] * ray for one in chosen], seen_s[chosen])
        write_tum(folder / "trajectory.txt", Trajectory(stamp_s, T))
        np.savetxt(folder / "timestamps.txt", seen_s[chosen], "%.6f")
        rows.append(corrected(folder, NO_FLAGS._replace(method="faces")))
    before, after = np.array([row["ate_m"] for row in rows]).T
    return {
        "frames": sum(row["frames"] for row in rows), "ms": float(np.median([row["ms"] for row in rows])),
        "outcome": f"{len(rows)} flights: ATE {before.min():.3f}–{before.max():.3f} → {after.min():.3f}–"
        f"{after.max():.3f} m, {(after / before).max():.2f} of the prior's at most; no scan has 100 points",
    }  # fmt: skip


def vtk_points(file: Path) -> Array:
    """The points of a VTK file in text."""
    lines = iter(file.read_text().splitlines())
    count = next(int(line.split()[1]) for line in lines if line.startswith("POINTS"))
    numbers: list[str] = []
    while len(numbers) < 3 * count:
        numbers += next(lines).split()
    return np.array(numbers[: 3 * count], dtype=float).reshape(-1, 3)


def car_three(data: Path, work: Path) -> dict:
    scans = [vtk_points(data / f"cloud.0000{k}.vtk") for k in range(3)]
    return corrected(folder_of(work, scans, np.arange(3) / 10), UNKNOWN)


def bag_in_all_forms(bag: Path, work: Path) -> dict:
    """A bag, its poses replaced by ones that stand still, written in all forms of bags and compared to the bit."""
    write_tum(work / "still.tum", standing(np.array([0.0, 2e9])))  # stamps of scans and of the file differ by years
    (work / "settings.toml").write_text("[extrinsics]\nrotation_rpy_deg = [0.0, 0.0, -90.0]\n")  # its y is forward
    still = read_flight(bag, poses=str(work / "still.tum"), settings=work / "settings.toml", gap_max_s=2e9)
    same = []
    for name in ("copy.mcap", "copy.db3", "copy.bag"):
        write_flight(work / name, still)
        pairs = zip(still.scans, read_flight(work / name).scans, strict=True)
        same.append(all(np.array_equal(a.points, b.points, equal_nan=True) for a, b in pairs))
    row = corrected(work / "copy.mcap", UNKNOWN)
    as_told = "the same to the bit" if all(same) else "NOT the same"
    return row | {"outcome": f"{row['outcome']}; as MCAP, SQLite and bag again {as_told}"}


def message(file: Path, work: Path) -> dict:
    """One serialised PointCloud2 put into an MCAP file as it is, and read."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    raw = file.read_bytes()
    cloud: Any = store.deserialize_cdr(raw, "sensor_msgs/msg/PointCloud2")  # its class is made from the definition
    stamp = cloud.header.stamp
    stamp_ns = stamp.sec * 10**9 + stamp.nanosec
    with Writer(work / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=store)
        writer.write(topic, stamp_ns, raw)
    write_tum(work / "still.tum", standing(np.array([stamp_ns / 1e9])))
    flight = read_flight(work / "bag", poses=str(work / "still.tum"))
    began = time.process_time()
    points = flight.scans[0].points
    ms = 1e3 * (time.process_time() - began)
    finite = np.isfinite(points).all(axis=-1)
    return {
        "frames": 1, "read_ms": ms, "outcome": f"{finite.size} points read, {finite.sum()} finite, "
        f"{np.linalg.norm(points[finite], axis=1).max():.0f} m away at most; {sum(flight.skipped.values())} skipped",
    }  # fmt: skip


def refused(path: Path, work: Path) -> dict:
    """What cannot be a flight has to be refused in one line."""
    try:
        read_flight(path)
    except SteelnbError as fault:
        return {"frames": 0, "outcome": f"refused: {str(fault).replace(str(path), path.name)}"}
    return {"frames": 0, "outcome": "NOT refused"}


SOURCES = {
    "kitchen": Source(
        "andyzeng/tsdf-fusion-python@3f22a94",
        "BSD-2-Clause; the data are of 7-Scenes: not for commercial use",
        "RGB-D: a Kinect in the hand in a kitchen, 640 × 480, 33 s at 30 Hz, poses by KinectFusion",
    ),
    "walk": Source(
        "hku-mars/BALM@5dc1bf9",
        "GPL-2.0",
        "LiDAR: a walk outdoors, 75 m in 88 s, 80,000 points at 2 Hz, poses from which a bundle adjustment starts",
    ),
    "nano": Source(
        "ETH-PBL/Matrix_ToF_Drones@3924acd",
        "GPL-3.0 (programs), none named for the data",
        "ToF: flights of a nano-drone in a hall, 8 × 8 pixels at 15 Hz, with motion capture",
    ),
    "car": Source("norlab-ulaval/libpointmatcher@c44ce31", "BSD-3-Clause", "LiDAR: sweeps of a car, each laid askew"),
    "bag": Source("embarktrucks/embag@74c0b5f", "MIT", "ROS 1 bag: a truck's LiDAR, PointCloud2 at 10 Hz"),
    "message": Source(
        "facontidavide/cloudini@d202e52", "Apache-2.0", "ROS 2: one PointCloud2 as it went over the wire"
    ),
    "cage": Source(
        "MattiaGasperoni/legature-gabbiatrice-3d@1761cc6",
        "none named",
        "ToF: a frame of a steel cage by a SICK Visionary-T Mini, 512 × 424, in millimetres",
    ),
    "pylon": Source(
        "HyperLambdaX/Insulator-PowerGrid-Extractor@ffe02d1", "none named", "LiDAR from the air: a lattice pylon"
    ),
    "autzen": Source(
        "laspy/laspy@fbc5b37",
        "BSD-2-Clause",
        "LAZ from the air: streets by a stadium, in feet; there are no bars to find",
    ),
    "scan": Source("minhphongvn/lidarme@5736c73", "none named", "ROS 1 bag: a planar laser"),
    "images": Source("MGLF/tum2klg@8876b8b", "none named", "TUM RGB-D layout: 18 depth images without poses"),
    "clouds": Source(
        "udacity/SFND_Lidar_Obstacle_Detection@ef15da2", "none named", "LiDAR: 22 PCD sweeps without poses"
    ),
}
KITCHEN, CAR, CAGE = "data", "examples/data", "data/Gabbiatrice.pcd"
WALK = "datas/benchmark_realworld"
CASES = {
    "kitchen": Case("kitchen", f"run data --noise {DRIFT}", lambda at, work: corrected(at / KITCHEN, NO_FLAGS)),
    "kitchen-no-drift": Case("kitchen", "run data --noise none: its own error, without drift",
                          lambda at, work: corrected(at / KITCHEN, NO_FLAGS._replace(noise="none"))),
    "kitchen-more-drift": Case("kitchen", "run data --noise random-walk:0.005",
                            lambda at, work: corrected(at / KITCHEN, NO_FLAGS._replace(noise="random-walk:0.005"))),
    "kitchen-smoothed": Case("kitchen", f"run data --noise {DRIFT} --smooth",
                          lambda at, work: corrected(at / KITCHEN, NO_FLAGS._replace(method="smoothed"))),
    "kitchen-gicp": Case("kitchen", f"run data --noise {DRIFT} --odometry gicp",
                      lambda at, work: corrected(at / KITCHEN, NO_FLAGS._replace(method="gicp"))),
    "kitchen-orb": Case("kitchen", f"run data --noise {DRIFT} --odometry orb",
                        lambda at, work: corrected(at / KITCHEN, Options(method="orb", noise=DRIFT))),
    "kitchen-loam": Case("kitchen", f"run data --noise {DRIFT} --odometry loam",
                      lambda at, work: corrected(at / KITCHEN, NO_FLAGS._replace(method="loam"))),
    "walk": Case("walk", f"run scans --noise {DRIFT}",
                 lambda at, work: corrected(walk_outdoors(at / WALK, work), NO_FLAGS)),
    "walk-gicp": Case("walk", f"run scans --noise {DRIFT} --odometry gicp",
                      lambda at, work: corrected(walk_outdoors(at / WALK, work), NO_FLAGS._replace(method="gicp"))),
    "walk-loam": Case("walk", f"run scans --noise {DRIFT} --odometry loam",
                      lambda at, work: corrected(walk_outdoors(at / WALK, work), NO_FLAGS._replace(method="loam"))),
    "walk-no-drift": Case("walk", "run scans --noise none: its own error, without drift",
                          lambda at, work: corrected(walk_outdoors(at / WALK, work), NO_FLAGS._replace(noise="none"))),
    "walk-as-drone": Case("walk", f"run scans --noise {DRIFT} --range-max 6",
                          lambda at, work: corrected(walk_outdoors(at / WALK, work),
                                                     NO_FLAGS._replace(range_max_m=6.0))),
    "nano": Case("nano", f"run scans --noise {DRIFT} --odometry faces",
                 lambda at, work: nano_flights(at / "Flight DataSet", work)),
    "car-pair": Case("car", "run scans --odometry gicp --truth true.tum",
                     lambda at, work: car_pair(at / CAR, work)),
    "car-three": Case("car", "run scans --odometry gicp", lambda at, work: car_three(at / CAR, work)),
    "bag": Case("bag", "run test.bag --poses still.tum --settings turned.toml --odometry gicp",
                lambda at, work: bag_in_all_forms(at / "test/test.bag", work)),
    "bag-own-poses": Case("bag", "run test.bag", lambda at, work: refused(at / "test/test.bag", work)),
    "message": Case("message", "(an MCAP file around it, read)",
                    lambda at, work: message(at / "cloudini_lib/samples/dds_message.bin", work)),
    "scan": Case("scan", "run lidar.bag", lambda at, work: refused(at / "lidar.bag", work)),
    "images": Case("images", "run rgbd_dataset_freiburg1_xyz",
                   lambda at, work: refused(at / "rgbd_dataset_freiburg1_xyz", work)),
    "clouds": Case("clouds", "run data_1", lambda at, work: refused(at / "src/sensors/data/pcd/data_1", work)),
    "cage": Case("cage", "segment Gabbiatrice.pcd", lambda at, work: bars(at / CAGE, work)),
    "cage-12mm": Case("cage", "segment Gabbiatrice.pcd --dx 12", lambda at, work: bars(at / CAGE, work, 12.0)),
    "cage-rods": Case("cage", "… its rods alone (x > 180, y > 20)",
                      lambda at, work: bars(at / CAGE, work, 12.0, lambda p: (p[:, 0] > 180) & (p[:, 1] > 20))),
    "pylon": Case("pylon", "segment 001Tower.txt", lambda at, work: bars(at / "data/001Tower.txt", work)),
    "autzen": Case("autzen", "segment autzen_trim.laz", lambda at, work: bars(at / "tests/data/autzen_trim.laz", work)),
}  # fmt: skip


def measure(name: str, clones: Path) -> dict:
    """A case's numbers, and the peak of this process."""
    case = CASES[name]
    clone = SOURCES[case.source].clone(clones)
    with tempfile.TemporaryDirectory() as work:
        row = case.run(clone, Path(work))
    return row | {"peak_gb": peak_bytes() / 1e9}


def cell(row: dict, name: str, form: str) -> str:
    return format(row[name], form) if name in row else "–"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clones", type=Path, metavar="FOLDER", help="folder with the clones")
    parser.add_argument("--only", nargs="+", choices=SOURCES, default=list(SOURCES), help="whose data to take")
    parser.add_argument("--case", choices=CASES, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.case:
        print(json.dumps(measure(given.case, given.clones)))
        return
    for source in given.only:
        clone = SOURCES[source].clone(given.clones)
        if not clone.is_dir():
            parser.error(
                f"{clone}: no such folder; expected a clone of {SOURCES[source].repository} (or leave it out by --only)"
            )
    print(f"# Recordings that others made\n\n{machine()}. `{command(__doc__)}`\n\n{NOTES}")
    print("| data | repository | licence | what |\n|---|---|---|---|")
    for source in given.only:
        whose = SOURCES[source]
        print(f"| {source} | {whose.at} | {whose.licence} | {whose.what} |")
    print(f"\n{COLUMNS}\n\n| data | `steelnb …` | frames | outcome | read (ms a frame) | ms a frame | peak (GB) |")
    print(f"{'|---' * 7}|")
    for name, case in CASES.items():
        if case.source not in given.only:
            continue
        row = in_own_process(__file__, str(given.clones), "--case", name)
        print(
            f"| {case.source} | {case.said} | {row['frames']} | {row['outcome']} | {cell(row, 'read_ms', '.1f')} "
            f"| {cell(row, 'ms', '.0f')} | {row['peak_gb']:.2f} |", flush=True,
        )  # fmt: skip
    print(SETTINGS, end="")


if __name__ == "__main__":
    main()
