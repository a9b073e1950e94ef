"""What of each member a flight has seen: the truth about visibility, for metrics."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steelnb.datatypes import Array, IntArray, RangeScans, Trajectory
from steelnb.simulation.tof import SCANS_AT_ONCE, _cast, _scene
from steelnb.simulation.tower import Tower

SLICE_M = 0.05


@dataclass(frozen=True)
class Visibility:
    """``slices``: for each of the M members the returns in slices of 5 cm along its axis, from its first joint."""

    slices: tuple[IntArray, ...]

    @property
    def hits(self) -> IntArray:
        """Returns of each member ``(M,)``."""
        return np.array([part.sum() for part in self.slices], dtype=np.int64)

    @property
    def length_m(self) -> Array:
        """Length seen of each member ``(M,)``: that of all slices with a return."""
        return np.array([SLICE_M * np.count_nonzero(part) for part in self.slices])

    def seen(self, hits_min: int = 100, length_min_m: float = 0.3) -> NDArray[np.bool_]:
        """The members observed ``(M,)``: enough returns, over enough of their length."""
        return (self.hits >= hits_min) & (self.length_m >= length_min_m - 1e-9)


def see(tower: Tower, trajectory: Trajectory, T_drone_sensor: Array, scans: RangeScans) -> Visibility:
    """Cast the rays of the returns again, from the true poses, to learn which member gave each and where."""
    axes = tower.axes
    length = np.linalg.norm(axes[:, 1] - axes[:, 0], axis=1)
    axis = (axes[:, 1] - axes[:, 0]) / length[:, None]
    size = np.ceil(length / SLICE_M - 1e-9).astype(np.int64)
    first = np.concatenate([[0], np.cumsum(size)])
    counts = np.zeros(first[-1], dtype=np.int64)
    owner = np.append(tower.triangle_member, [-1, -1])  # the ground's two triangles come last
    scene = _scene(tower)
    T_world_sensor = trajectory.at(scans.stamp_s).T_world_drone @ T_drone_sensor
    for begin in range(0, len(scans), SCANS_AT_ONCE):
        some = slice(begin, begin + SCANS_AT_ONCE)
        exact, triangle = _cast(scene, T_world_sensor[some], scans.ray)
        for k, T in enumerate(T_world_sensor[some]):
            returned = np.isfinite(scans.range_m[begin + k]) & np.isfinite(exact[k])
            member = owner[triangle[k][returned].astype(np.int64)]
            ray, distance = scans.ray[returned][member >= 0], exact[k][returned][member >= 0]
            member = member[member >= 0]
            point = T[:3, 3] + distance[:, None] * (ray @ T[:3, :3].T)
            along = ((point - axes[member, 0]) * axis[member]).sum(axis=1)
            place = np.clip((along / SLICE_M).astype(np.int64), 0, size[member] - 1)
            counts += np.bincount(first[member] + place, minlength=len(counts))
    return Visibility(tuple(np.split(counts, first[1:-1])))
