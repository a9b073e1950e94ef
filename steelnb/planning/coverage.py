"""What of a structure has been seen from which sides, and from where to look next.

The next best view (Connolly, "The determination of next best views", ICRA 1985) among viewpoints around what is mapped,
by the gain in a second, as planners of exploration choose it (Bircher et al., "Receding horizon next-best-view planner
for 3D exploration", ICRA 2016). A voxel counts once for each new side; and a view of which little is mapped is expected
to hold as many voxels as is usual.
"""

from typing import NamedTuple

import numpy as np

from steelnb.planning.bearings import turn_to
from steelnb.planning.outlook import Camera, into_view
from steelnb.points import VoxelMap
from steelnb.types import Array, IntArray

SECTORS = 8
"""Sides, by the azimuth from which a voxel is seen."""
ABOVE, BELOW = 1 << SECTORS, 1 << (SECTORS + 1)
"""And seen from a camera more than `LEVEL_M` above or below it."""
LEVEL_M = 0.3
PAIRS = [1 << k | 1 << (k + apart) % SECTORS for k in range(SECTORS) for apart in range(2, SECTORS - 1)]
TWO_SIDES = np.array([any(sides & pair == pair for pair in PAIRS) for sides in range(1 << SECTORS)])
"""Whether a set of sectors has two that are at least one sector apart, so that their middles are 90° apart or more."""
VIEWPOINTS, RISE_M = 12, 0.6
"""Viewpoints in a round, and between rounds."""
WEDGE_RAD = np.radians(30.0)
"""Steel within this of a viewpoint's azimuth says how far out the structure reaches there."""
NEAR = 30
"""Viewpoints compared at first, those on the shortest way; the others where none of them is worth it."""
VOXELS_MAX = 400
"""Voxels by which viewpoints are compared; of more, every second, third, … is taken."""
SCANS_MIN = 5
"""Scans that a voxel is in before it counts: noise fills others for once."""
GAIN_MIN = 0.05
"""A viewpoint is worth flying to that shows so much new, as a share of the voxels that a scan usually has."""
SETTLE_S = 2.0
"""Beside the time to get there: turning and braking."""
PASSED_M = np.array([0.6, 0.6, 0.35])
"""Half-widths of the box around a viewpoint in which the drone has been there."""
STUCK_S, STUCK_M = 4.0, 0.2
"""A viewpoint to which the way does not become shorter by that much in that time is out of reach."""
REACHED_M, REACHED_RAD = 0.25, 0.15
"""Height and azimuth within which a viewpoint is reached."""


class Viewpoint(NamedTuple):
    """Where to look from: ``position (3,)``, and its ``azimuth`` about the ``middle (2,)`` of the structure."""

    position: Array
    azimuth: float
    middle: Array

    def turn(self, position: Array) -> float:
        """The way around the middle that is left from a position, radians, counter-clockwise."""
        arm = position[:2] - self.middle
        return turn_to(self.azimuth - float(np.arctan2(arm[1], arm[0])))


class Coverage:
    """Sides from which each voxel of a map was seen, and the viewpoints still worth flying to.

    ``standoff_m``, ``speed_m_s`` and ``heights`` (least and largest) are those of the flight.
    """

    def __init__(self, camera: Camera, standoff_m: float, speed_m_s: float, heights: tuple[float, float]) -> None:
        self._camera, self._standoff_m, self._speed_m_s = camera, standoff_m, speed_m_s
        self._levels = np.linspace(*heights, 2 + int((heights[1] - heights[0]) / RISE_M))
        self._sides, self._scans = np.zeros((2, 0), dtype=np.int64)
        self._passed: list[Array] = []
        self._usual: list[int] = []
        self._least_m, self._since_s = np.inf, 0.0  # of the way to the target
        self.target: Viewpoint | None = None
        self.out_of_reach: list[Array] = []
        """Viewpoints that the drone could not get to."""

    def add(self, voxels: VoxelMap, slots: IntArray, position: Array) -> None:
        """Note that the voxels ``slots`` of a map were seen from a position ``(3,)``."""
        fresh = np.zeros(len(voxels) - len(self._sides), dtype=np.int64)
        self._sides, self._scans = np.append(self._sides, fresh), np.append(self._scans, fresh)
        self._sides[slots] |= _side(position - voxels.means(slots))
        self._scans[slots] += 1
        self._usual.append(int((self._scans[slots] >= SCANS_MIN).sum()))
        if not self._passed or np.linalg.norm(self._passed[-1] - position) > 0.2:
            self._passed.append(position.copy())

    def share(self) -> float:
        """Share of the mapped voxels seen from two sides."""
        steel = self._sides[self._scans >= SCANS_MIN]
        return float(TWO_SIDES[steel & (ABOVE - 1)].mean()) if len(steel) else 0.0

    def summary(self) -> str:
        """How much was seen from two sides, and the viewpoints that were out of reach."""
        text = f"{self.share():.0%} of what is mapped was seen from two sides"
        if self.out_of_reach:
            places = "; ".join(", ".join(f"{x:.1f}" for x in place) for place in self.out_of_reach)
            text += f"; viewpoints out of reach at (m): {places}"
        return text

    def update(self, stamp_s: float, voxels: VoxelMap, position: Array) -> Viewpoint | None:
        """The viewpoint to fly to, the same until the drone has been there; None where none is worth it."""
        if self.target is not None:
            turn, up_m = self.target.turn(position), abs(float(position[2] - self.target.position[2]))
            if up_m > REACHED_M or abs(turn) > REACHED_RAD:
                left_m = up_m + abs(turn) * float(np.hypot(*(position[:2] - self.target.middle)))
                if left_m < self._least_m - STUCK_M:
                    self._least_m, self._since_s = left_m, stamp_s
                if stamp_s - self._since_s < STUCK_S:
                    return self.target
                self.out_of_reach.append(self.target.position)
            self._passed.append(self.target.position)
        self.target = self._best(voxels, position)
        self._least_m, self._since_s = np.inf, stamp_s
        return self.target

    def _best(self, voxels: VoxelMap, position: Array) -> Viewpoint | None:
        steel = np.flatnonzero(self._scans >= SCANS_MIN) if (self._scans >= SCANS_MIN).any() else np.arange(len(voxels))
        every = 1 + len(steel) // VOXELS_MAX
        points, sides = voxels.means(steel[::every]), self._sides[steel[::every]]
        middle = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
        places, azimuth = self._viewpoints(points, middle)
        passed = np.array(self._passed)
        fresh = [not (np.abs(passed - place) < PASSED_M).all(axis=1).any() for place in places]
        places, azimuth = places[fresh], azimuth[fresh]
        arm = position[:2] - middle
        turn = np.array([turn_to(each) for each in azimuth - np.arctan2(arm[1], arm[0])])
        way_m = np.maximum(np.abs(turn) * np.hypot(*arm), np.abs(places[:, 2] - position[2]))
        order, usual = np.argsort(way_m, kind="stable"), float(np.median(self._usual)) / every
        for some in (order[:NEAR], order[NEAR:]):
            if len(some):
                gain = self._gain(points, sides, places[some], azimuth[some], usual)
                took_s = way_m[some] / self._speed_m_s + SETTLE_S
                rate = np.where(gain > GAIN_MIN * usual, gain / took_s, 0.0)
                k = int(np.argmax(rate))
                if rate[k] > 0:
                    return Viewpoint(places[some[k]], float(azimuth[some[k]]), middle)
        return None

    def _viewpoints(self, points: Array, middle: Array) -> tuple[Array, Array]:
        """Places ``(K, 3)`` at the standoff from what is mapped at their height, and their azimuths ``(K,)``."""
        arm, azimuth = points[:, :2] - middle, 2 * np.pi * np.arange(VIEWPOINTS) / VIEWPOINTS
        out = np.column_stack([np.cos(azimuth), np.sin(azimuth)])
        reach = arm @ out.T
        wedge = reach > np.cos(WEDGE_RAD) * np.hypot(*arm.T)[:, None]
        places = []
        for height in self._levels:
            level = np.abs(points[:, 2] - height) < 1.0
            level = level if level.any() else np.ones(len(points), dtype=bool)
            farthest = np.where(wedge[level], reach[level], 0.0).max(axis=0)
            farthest = np.where(wedge[level].any(axis=0), farthest, np.maximum(reach[level].max(axis=0), 0.0))
            level_out = middle + (farthest + self._standoff_m)[:, None] * out
            places.append(np.column_stack([level_out, np.full(VIEWPOINTS, height)]))
        return np.concatenate(places), np.tile(azimuth, len(self._levels))

    def _gain(self, points: Array, sides: IntArray, places: Array, azimuth: Array, usual: float) -> Array:
        """Voxels ``(K,)`` that a look towards the middle from each place would show from a new side, or at all."""
        poses = np.tile(np.eye(4), (len(places), 1, 1))
        c, s = -np.cos(azimuth), -np.sin(azimuth)
        poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = c, -s, s, c
        poses[:, :3, 3] = places
        inside = into_view(points, poses @ self._camera.T_drone_sensor, self._camera).inside
        side = _side(places[:, None] - points[None])
        around, height = side & (ABOVE - 1), side & ~(ABOVE - 1)
        done = TWO_SIDES[sides & (ABOVE - 1)]
        new = (~done & (around & sides == 0)).astype(float) + 0.5 * ((height != 0) & (height & sides == 0))
        return np.asarray((inside * new).sum(axis=1) + np.maximum(usual - inside.sum(axis=1), 0.0))


def _side(arm: Array) -> IntArray:
    """The side from which a voxel is seen, as bits, of arms ``(…, 3)`` from the voxel to the camera."""
    sector = np.floor((np.arctan2(arm[..., 1], arm[..., 0]) / (2 * np.pi) % 1.0) * SECTORS).astype(np.int64) % SECTORS
    above, below = arm[..., 2] > LEVEL_M, arm[..., 2] < -LEVEL_M
    return np.asarray((1 << sector) | above * ABOVE | below * BELOW)
