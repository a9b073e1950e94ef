"""Localisation in a known structure: scans registered to the front faces of its bars.

Where the flight begins is known to half a metre and five degrees. The first scan is tried at all places of a grid of
that extent (correlative scan matching: Olson, ICRA 2009); the best ones are refined, and the one stays in which most
points lie on front faces. From then on each scan starts at the last pose and the increment of the prior, and both count
by their information. Roll and pitch are the prior's, or corrected as well where these have a standard deviation.
"""

import time

import numpy as np
from numba import njit

from steelnb.errors import InputError
from steelnb.fusion.known import KnownBars
from steelnb.fusion.poses import POSE, moved_poses, pose_size
from steelnb.fusion.structure import Structure
from steelnb.odometry.base import nothing_left, scan_of
from steelnb.odometry.face_registration import POINTS_MIN, FaceRegistration, points_in_range
from steelnb.points import VoxelMap, voxel_grid
from steelnb.points.inputs import checked_pose
from steelnb.points.voxel_kernels import find, pack
from steelnb.settings import PreprocessSettings
from steelnb.types import Array, OdometryStep, Scan, Segments

START_M, START_RAD = 0.5, np.radians(5.0)
"""How far off the start may be along each axis, and in yaw."""
STEP_M, STEP_RAD, SEARCH_LEAF_M, SEARCH_POINTS_MAX = 0.1, np.radians(1.0), 0.1, 400
START_SIGMA = np.array([STEP_M] * 3 + [STEP_RAD])
REFINED = 8
"""Grid of the search, the voxels and the number of points that take part in it, and how many places are refined."""
FIRST_SCANS = 10
"""Scans with points after which a map that none of them matched is refused."""
LOST_M = 0.2
"""Standard deviation of the position beyond which the place is searched for again."""


class KnownStructureOdometry:
    """Corrects a drifting pose by a structure that an earlier flight has mapped.

    Parameters
    ----------
    structure : the map, in the world frame in which the poses are wanted; metres. Raises `InputError` for one
        without bars.
    T_drone_sensor : (4, 4), the mount of the sensor, default identity.
    preprocess : its ``crop_m``, the furthest range, and ``floor_m``, the height of the ground, are used.
    tilt_sigma_rad : standard deviation of the prior's roll and pitch; 0 keeps them.
    """

    def __init__(
        self, structure: Structure, T_drone_sensor: Array | None = None, preprocess: PreprocessSettings | None = None,
        tilt_sigma_rad: float = 0.0,
    ) -> None:  # fmt: skip
        self.structure = structure
        self.faces = FaceRegistration(KnownBars.of(structure), tilt_sigma_rad=tilt_sigma_rad)
        self._start_sigma = np.append(START_SIGMA, [tilt_sigma_rad] * (pose_size(tilt_sigma_rad) - POSE))
        self.T_drone_sensor = checked_pose(np.eye(4) if T_drone_sensor is None else T_drone_sensor, "T_drone_sensor")
        self.preprocess = preprocess or PreprocessSettings()
        self.map = VoxelMap(self.preprocess.voxel_leaf_m)
        self.located = False
        self._T_map_prior = np.eye(4)
        self._unmatched, self._bars_matched = 0, 0

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Register one scan to the structure; see `SegmentOdometry.update`.

        A scan that matches too little of the structure follows the prior's increment, and its ``reason`` says so.
        Raises `InputError` where none of the first `FIRST_SCANS` scans matches the structure.
        """
        scan, T_world_drone_prior = scan_of(scan), checked_pose(T_world_drone_prior, "T_world_drone_prior")
        begin = time.perf_counter()
        self.faces.predict(scan.stamp_s)
        T_init = self._T_map_prior @ T_world_drone_prior
        lost = not self.located or self.faces.variance[:3].max() > LOST_M**2
        T_sensor, floor_m = T_init @ self.T_drone_sensor, self.preprocess.floor_m + (START_M if lost else 0.0)
        points = points_in_range(scan, T_sensor, self.preprocess.crop_m, floor_m)
        searched = time.perf_counter()
        if len(points) < POINTS_MIN:
            reason = nothing_left(scan, self.preprocess.crop_m) or "too few points"
            return self._step(scan, T_init, reason, 0, (begin, searched))
        starts = _search(points, T_sensor, self.faces.known) if lost else [T_sensor]
        searched = time.perf_counter()
        fits = [self.faces.fit(points, start, self._start_sigma if lost else None) for start in starts]
        fit = max(fits, key=lambda each: (not each.reason, each.share))
        if fit.reason:
            if not self.located:
                self._refuse(fit.bars)
            return self._step(scan, T_init, fit.reason, fit.bars, (begin, searched))
        self.located = True
        self.faces.accept(fit)
        T_world_drone = fit.T_world_sensor @ np.linalg.inv(self.T_drone_sensor)
        self._T_map_prior = T_world_drone @ np.linalg.inv(T_world_drone_prior)
        self.map.insert(points @ fit.T_world_sensor[:3, :3].T + fit.T_world_sensor[:3, 3])
        return self._step(scan, T_world_drone, "", fit.bars, (begin, searched))

    def map_points(self) -> Array:
        """Means of the voxels of all registered scans, ``(N, 3)`` in the world frame."""
        return self.map.means()

    def map_segments(self) -> Segments:
        """The bars of the known structure."""
        return self.structure.segments

    def _refuse(self, bars: int) -> None:
        """Count a scan that did not match; raise `InputError` when it is one too many."""
        self._unmatched, self._bars_matched = self._unmatched + 1, max(self._bars_matched, bars)
        if self._unmatched >= FIRST_SCANS:
            raise InputError(
                f"{self._bars_matched} of {len(self.faces.known)} bars matched in the first {FIRST_SCANS} scans; "
                f"expected a map of this place and a start within {START_M:g} m and {np.degrees(START_RAD):g}° of it"
            )

    def _step(
        self, scan: Scan, T_world_drone: Array, reason: str, bars: int, clock: tuple[float, float]
    ) -> OdometryStep:
        seconds = {"search": clock[1] - clock[0], "register": time.perf_counter() - clock[1]}
        return OdometryStep(scan.stamp_s, T_world_drone, not reason, reason, bars, seconds)


def _search(points: Array, T_world_sensor: Array, known: KnownBars) -> list[Array]:
    """The poses of the sensor around a given one from which most of ``points (N, 3)``, sensor frame, lie near bars, no
    two of them neighbours on the grid; best first."""
    some = voxel_grid(points, SEARCH_LEAF_M)
    some = np.ascontiguousarray(some[:: max(1, len(some) // SEARCH_POINTS_MAX)] @ T_world_sensor[:3, :3].T)
    shift = np.arange(-START_M, START_M + 1e-9, STEP_M)
    yaw = np.arange(-START_RAD, START_RAD + 1e-9, STEP_RAD)
    score = _score(some, T_world_sensor[:3, 3], yaw, shift, *known.voxels)
    found: list[Array] = []
    while len(found) < REFINED and score.max() > 0:
        best = np.unravel_index(score.argmax(), score.shape)
        found.append(moved_poses(T_world_sensor[None], np.append(shift[list(best[1:])], yaw[best[0]])[None])[0])
        score[tuple(slice(max(0, i - 1), i + 2) for i in best)] = 0
    return found or [T_world_sensor]


@njit(cache=True)
def _score(points, position, yaw, shift, bar_of_voxel, voxel, table_key, table_slot):  # type: ignore[no-untyped-def]
    """Number of points near bars ``(Y, S, S, S)`` for each yaw and shift."""
    n = len(shift)
    score = np.zeros((len(yaw), n, n, n), np.int64)
    inverse = 1.0 / voxel
    for y in range(len(yaw)):
        c, s = np.cos(yaw[y]), np.sin(yaw[y])
        for p in range(len(points)):
            u = c * points[p, 0] - s * points[p, 1] + position[0]
            v = s * points[p, 0] + c * points[p, 1] + position[1]
            w = points[p, 2] + position[2]
            for i in range(n):
                a = np.int64(np.floor((u + shift[i]) * inverse))
                for j in range(n):
                    b = np.int64(np.floor((v + shift[j]) * inverse))
                    for k in range(n):
                        key = pack(a, b, np.int64(np.floor((w + shift[k]) * inverse)))
                        slot = find(key, table_key, table_slot)
                        score[y, i, j, k] += slot >= 0
    return score
