"""`steelnb info`: what a recording holds, on one screen."""

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.datatypes import Array, Trajectory
from steelnb.recordings.recording import GAP_MAX_S, Recording, interpolate, span
from steelnb.replay.course import check_gap
from steelnb.replay.offline import periods

LONG_GAP = 1.5
"""Of the usual time between two scans: longer is a gap."""
_SHOWN_ELSEWHERE = ("form", "scans", "poses", "truth", "imu", "pictures", "extrinsics")


def describe_recording(recording: Recording, *, quick: bool = False, gap_max_s: float = GAP_MAX_S) -> tuple[str, ...]:
    """What a recording holds, as lines of text. ``quick``: of the scans only the first that holds a point is read.

    Raises `SettingsError` for a gap that is not positive, and what reading the recording raises.
    """
    check_gap(gap_max_s)
    facts, stamp_s = recording.facts, recording.scans.stamp_s
    count, finite, scans, shape = 0, 0, 0, ""
    for scan in recording.scans.walk():
        scans += 1
        valid = int(np.isfinite(scan.points).all(axis=-1).sum())
        count, finite = count + scan.points.size // 3, finite + valid
        if valid and not shape:
            rows = scan.points.shape
            shape = f"{rows[1]} x {rows[0]} organised" if scan.points.ndim == 3 else f"{rows[0]} points, unorganised"
        if quick and valid:
            break
    covered = interpolate(recording.poses, stamp_s, gap_max_s)[1]
    returns = f"{100 * finite / count:.0f} % of the points valid" if count else "no point at all"
    skipped = [f"{number} {reason}" for reason, number in sorted(recording.skipped.items()) if number]
    lines = [
        f"recording {recording.path}: {facts.get('form', facts.get('format', 'unknown form'))}{_size(recording.path)}",
        f"duration  {np.ptp(stamp_s) if len(stamp_s) else 0.0:.1f} s, scans from {span(stamp_s)}",
        f"scans     {len(stamp_s)}{_rate(stamp_s)}, {shape or 'none with a point'}{_fact(facts, 'scans')}",
        f"          {returns}, in {scans} scans read",
        f"poses     {len(recording.poses)}{_rate(recording.poses.stamp_s)}, {_length(recording.poses)}"
        f"{_fact(facts, 'poses')}",
        f"gaps      scans: {_gaps(stamp_s, LONG_GAP * _period(stamp_s))}; "
        f"poses: {_gaps(recording.poses.stamp_s, gap_max_s)}",
        f"covered   {np.count_nonzero(covered)} of {len(covered)} scans have a pose"
        f"{'' if covered.all() else f'; the poses are from {span(recording.poses.stamp_s)}'}",
        f"truth     {_truth(recording)}{_fact(facts, 'truth')}",
        f"sensor    {_mount(recording.T_drone_sensor)}{_fact(facts, 'extrinsics')}",
    ]
    if recording.imu is not None:
        lines.append(f"imu       {len(recording.imu.stamp_s)}{_rate(recording.imu.stamp_s)}{_fact(facts, 'imu')}")
    if recording.pictures is not None:
        stamps = recording.pictures.stamp_s
        lines.append(f"pictures  {len(stamps)}{_rate(stamps)}{_fact(facts, 'pictures')}")
    lines += [f"{name:9} {value}" for name, value in facts.items() if name not in (*_SHOWN_ELSEWHERE, "format")]
    lines.append(f"skipped   {'; '.join(skipped) or 'nothing'}{', as far as read' if quick else ''}")
    return tuple(lines)


def _fact(facts: dict[str, str], name: str) -> str:
    return f" ({facts[name]})" if name in facts else ""


def _period(stamp_s: Array) -> float:
    return float(np.median(np.diff(stamp_s))) if len(stamp_s) > 1 else math.inf


def _rate(stamp_s: Array) -> str:
    return f" at {1 / _period(stamp_s):.4g} Hz" if len(stamp_s) > 1 else ""


def _gaps(stamp_s: Array, longest_s: float) -> str:
    gaps = periods(stamp_s)[:-1]
    if not len(gaps):
        return "none"
    number = np.count_nonzero(gaps > longest_s)
    return f"{number} longer than {longest_s:.3g} s" + (f", up to {gaps.max():.3g} s" if number else "")


def _length(poses: Trajectory) -> str:
    return f"{np.linalg.norm(np.diff(poses.position, axis=0), axis=1).sum():.1f} m long"


def _truth(recording: Recording) -> str:
    truth = recording.truth
    return "none" if truth is None else f"{len(truth)} poses{_rate(truth.stamp_s)}, {_length(truth)}"


def _mount(T_drone_sensor: Array) -> str:
    x, y, z = T_drone_sensor[:3, 3]
    yaw, pitch, roll = Rotation.from_matrix(T_drone_sensor[:3, :3]).as_euler("ZYX", degrees=True)
    return f"at x {x:.3f}, y {y:.3f}, z {z:.3f} m on the drone, roll {roll:.1f}, pitch {pitch:.1f}, yaw {yaw:.1f}°"


def _size(path: Path) -> str:
    files = [path] if path.is_file() else list(path.rglob("*")) if path.is_dir() else []
    size = sum(file.stat().st_size for file in files if file.is_file())
    return f", {size / 1e6:.1f} MB" if size else ""
