"""What a recording of a flight is, whatever its files: scans that stream, poses, extrinsics, and the truth apart."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from steelnb.datatypes import Array, Flight, Imu, Scan, Trajectory
from steelnb.errors import RecordingError

GAP_MAX_S = 0.5
"""Poses further apart than this are not interpolated between: a drone turns and stops within it."""


class ScanSource(Protocol):
    """The scans of a recording in the order of their stamps; every walk reads the files anew, one scan at a time.

    ``stamp_s (K,)`` rises strictly. A walk gives `Scan` K times: one that cannot be read comes out without points,
    ``(0, 3)``, and is counted in the recording's ``skipped``, so that scans and stamps stay in step.
    """

    stamp_s: Array

    def walk(self, wanted: NDArray[np.bool_] | None = None) -> Iterator[Scan]:
        """All scans, or those of a mask ``(K,)``; what is not wanted is not decoded."""


@dataclass(frozen=True)
class Picture:
    """One camera image ``(H, W, 3)`` uint8 RGB, or ``(H, W)`` uint8."""

    stamp_s: float
    pixels: NDArray[np.uint8]


class PictureSource(Protocol):
    """The images of a recording's camera, as `ScanSource`."""

    stamp_s: Array

    def walk(self) -> Iterator[Picture]:
        """All images in the order of their stamps."""


@dataclass(frozen=True)
class Recording:
    """A recorded flight.

    ``poses`` are the drone's as recorded, drifting, at their own stamps; ``truth`` is for judging alone, and None where
    there is none. ``skipped`` counts what was left out, by reason; it grows while scans are read. ``facts`` is what
    `steelnb info` shows beyond that: format, topics chosen, sensor size.
    """

    path: Path
    scans: ScanSource
    poses: Trajectory
    T_drone_sensor: Array
    imu: Imu | None = None
    truth: Trajectory | None = None
    pictures: PictureSource | None = None
    skipped: Counter[str] = field(default_factory=Counter)
    facts: dict[str, str] = field(default_factory=dict)

    def flight(self, gap_max_s: float = GAP_MAX_S) -> Flight:
        """The flight as an estimator sees it: poses at scan stamps, scans without a pose left out and counted.

        Raises `RecordingError` where no scan has a pose.
        """
        stamp_s = self.scans.stamp_s
        T_world_drone, covered = interpolate(self.poses, stamp_s, gap_max_s)
        self.skipped["no pose within the gap"] = int((~covered).sum())
        if not covered.any():
            raise RecordingError(
                f"{self.path}: no pose at any scan: {span(stamp_s)} of scans, {span(self.poses.stamp_s)} of poses"
            )
        none = Imu(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
        prior = Trajectory(stamp_s[covered], T_world_drone[covered])
        return Flight(StreamedScans(self.scans, covered), prior, self.imu or none, self.T_drone_sensor)


class StreamedScans(Sequence[Scan]):
    """The wanted scans of a source, read one by one: walk through them; picking single ones walks there."""

    def __init__(self, source: ScanSource, wanted: NDArray[np.bool_]) -> None:
        self._source, self._wanted = source, wanted
        self.stamp_s = source.stamp_s[wanted]

    def __len__(self) -> int:
        return len(self.stamp_s)

    def __iter__(self) -> Iterator[Scan]:
        return self._source.walk(self._wanted)

    def __getitem__(self, index):  # type: ignore[no-untyped-def, override]
        chosen = np.flatnonzero(self._wanted)[index]
        wanted = np.zeros_like(self._wanted)
        wanted[chosen] = True
        return StreamedScans(self._source, wanted) if isinstance(index, slice) else next(self._source.walk(wanted))


def interpolate(trajectory: Trajectory, stamp_s: Array, gap_max_s: float) -> tuple[Array, NDArray[np.bool_]]:
    """Poses ``(K, 4, 4)`` at some stamps, and where ``(K,)`` they are known: between poses at most ``gap_max_s`` apart.

    Positions linearly, rotations by slerp. At a pose's own stamp it is that pose.
    """
    own = trajectory.stamp_s
    result = np.tile(np.eye(4), (len(stamp_s), 1, 1))
    if not len(own) or not len(stamp_s):
        return result, np.zeros(len(stamp_s), dtype=bool)
    after = np.clip(np.searchsorted(own, stamp_s), 0, len(own) - 1)
    before = np.maximum(after - 1, 0)
    for nearest in (before, after):  # stamps that went through text or integers may miss by rounding
        exact = np.abs(own[nearest] - stamp_s) < 1e-6
        before, after = np.where(exact, nearest, before), np.where(exact, nearest, after)
    exact = before == after
    exact &= np.abs(own[after] - stamp_s) < 1e-6
    covered = exact | ((own[before] <= stamp_s) & (stamp_s <= own[after]) & (own[after] - own[before] <= gap_max_s))
    if len(own) > 1:
        inside = np.clip(stamp_s, own[0], own[-1])
        rotation = Rotation.from_matrix(trajectory.T_world_drone[:, :3, :3])
        result[:, :3, :3] = Slerp(own, rotation)(inside).as_matrix()
        for axis in range(3):
            result[:, axis, 3] = np.interp(inside, own, trajectory.position[:, axis])
    result[exact] = trajectory.T_world_drone[after[exact]]
    return result, covered


def span(stamp_s: Array) -> str:
    """From when to when, for a message."""
    return f"{stamp_s[0]:.3f} to {stamp_s[-1]:.3f} s" if len(stamp_s) else "nothing"
