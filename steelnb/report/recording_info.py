"""A recording to look at: its content on one screen (`steelnb info`), and one that is simulated (notebook 09)."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb import experiment
from steelnb.io import write_flight
from steelnb.io.scans import described, rate, span
from steelnb.report.words import counted
from steelnb.settings import ExperimentSettings
from steelnb.types import Array, Flight, Trajectory

LONG_GAP = 1.5
"""Of the median time between two scans: longer is a gap."""
FAULTS_SHOWN = 10
_IN_PLACE = ("form", "scans", "poses", "extrinsics", "imu")


def given_or_flown(
    recording: str, folder: str, settings: ExperimentSettings, on_progress: Callable[[float], None] | None = None
) -> tuple[Path, ExperimentSettings | None]:
    """The path of a recording, or where none is named that of a bag in a folder, which is flown now, and its
    settings."""
    if recording:
        return Path(recording), None
    path = Path(folder, "flight.bag")
    flight, truth = experiment.simulate(settings)
    write_flight(path, flight, truth.trajectory, on_progress)
    return path, settings


def describe_flight(
    flight: Flight, truth: Trajectory | None = None, *, path: Path | None = None, quick: bool = False
) -> tuple[str, ...]:
    """Lines of text on a flight: scans, poses, truth, mount, IMU, gaps and faults; all scans are read.

    ``quick`` reads scans up to the first with a point. ``path`` adds the size of the files.
    """
    stamp_s, facts = flight.prior.stamp_s, flight.facts
    count, finite, read, shape = 0, 0, 0, "none with a point"
    faults: Counter[str] = Counter()
    for scan in flight.scans:
        read += 1
        valid = int(np.isfinite(scan.points).all(axis=-1).sum())
        count, finite = count + scan.points.size // 3, finite + valid
        faults.update([scan.fault] if scan.fault else [])
        if valid and not finite - valid:
            sides = scan.points.shape
            shape = f"{sides[1]} x {sides[0]} organised" if len(sides) == 3 else f"{sides[0]} points, unorganised"
        if quick and valid:
            break
    gaps = np.diff(stamp_s)
    long = gaps[gaps > LONG_GAP * np.median(gaps)] if len(gaps) else gaps
    valid_share = f"{finite / count:.0%} of the points valid" if count else "no point at all"
    lines = [
        f"recording {flight.name}: {facts.get('form', 'in memory')}{_size(path)}",
        f"duration  {np.ptp(stamp_s):.1f} s, scans from {span(stamp_s)}",
        f"scans     {len(stamp_s)} with a pose{rate(stamp_s)}, {shape}{_fact(flight, 'scans')}",
        f"          {valid_share} in {counted(read, 'scan')} read",
        f"gaps      {f'{len(long)} between scans, up to {long.max():.3g} s' if len(long) else 'none between scans'}",
        f"poses     {facts.get('poses') or described(flight.prior)}",
        f"truth     {'none' if truth is None else described(truth)}",
        f"sensor    {_mount(flight.T_drone_sensor)}{_fact(flight, 'extrinsics')}",
    ]
    if flight.imu is not None:
        lines.append(f"imu       {len(flight.imu.stamp_s)}{rate(flight.imu.stamp_s)}{_fact(flight, 'imu')}")
    lines += [f"{name:9} {value}" for name, value in facts.items() if name not in _IN_PLACE]
    skipped = [f"{number} {reason}" for reason, number in sorted(flight.skipped.items())]
    lines.append(f"skipped   {'; '.join(skipped) or 'nothing'}")
    lines += [f"fault     {number} {fault}" for fault, number in faults.most_common(FAULTS_SHOWN)]
    if len(faults) > FAULTS_SHOWN:
        lines.append(f"          and {len(faults) - FAULTS_SHOWN} others")
    return tuple(lines)


def _fact(flight: Flight, name: str) -> str:
    return f" ({flight.facts[name]})" if name in flight.facts else ""


def _mount(T_drone_sensor: Array) -> str:
    x, y, z = T_drone_sensor[:3, 3]
    yaw, pitch, roll = Rotation.from_matrix(T_drone_sensor[:3, :3]).as_euler("ZYX", degrees=True)
    return f"at x {x:.3f}, y {y:.3f}, z {z:.3f} m on the drone, roll {roll:.1f}, pitch {pitch:.1f}, yaw {yaw:.1f}°"


def _size(path: Path | None) -> str:
    if path is None:
        return ""
    files = [path] if path.is_file() else path.rglob("*")
    return f", {sum(file.stat().st_size for file in files if file.is_file()) / 1e6:.1f} MB"
