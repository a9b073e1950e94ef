"""Made-up bars, structures and rigid motions."""

import functools
import math

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.core.types import Flight, Segments, Trajectory
from steelnb.fusion import Structure
from steelnb.fusion.adjustment.problem import Bars
from steelnb.fusion.point_to_bar import Observations
from steelnb.fusion.sections import shapes
from steelnb.settings import TofSettings, TowerSettings
from steelnb.simulation import build_tower, scan_flight


def bars_of(*axes, count=100, radius=0.01) -> Segments:
    axes = np.array(axes, dtype=float).reshape(-1, 2, 3)
    counts = np.full(len(axes), count) if np.isscalar(count) else np.array(count)
    return Segments(axes[:, 0], axes[:, 1], counts, np.full(len(axes), radius))


def structure_of_bars(axes, joint=(), tie=()) -> Structure:
    bars = bars_of(*axes)
    n = len(bars)
    return Structure(
        bars, np.full(n, 0.08), np.full(n, 5), np.full(n, 0.002), np.array(joint, dtype=float).reshape(-1, 3),
        np.array(tie, dtype=np.int64).reshape(-1, 2),
    )  # fmt: skip


def rigid(seed: int, reach_m: float = 10.0) -> np.ndarray:
    """A random rotation and a shift of up to ``reach_m`` per axis."""
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = np.random.default_rng(seed).uniform(-reach_m, reach_m, 3)
    return T


def random_bars(seed: int, n: int, reach_m: float = 2.0) -> Segments:
    ends = np.random.default_rng(seed).uniform(-reach_m, reach_m, (n, 2, 3))
    return bars_of(*ends)


def turned(bars: Segments, seed: int) -> Segments:
    """Some of the bars with their ends swapped."""
    swap = np.random.default_rng(seed).random(len(bars))[:, None] < 0.5
    return Segments(np.where(swap, bars.end, bars.start), np.where(swap, bars.start, bars.end), bars.count, bars.radius)


def distance_to_lines(points: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Distances ``(N, M)`` of points to infinite lines ``(M, 2, 3)``."""
    direction = axes[:, 1] - axes[:, 0]
    direction = direction / np.linalg.norm(direction, axis=1)[:, None]
    return np.linalg.norm(np.cross(points[:, None] - axes[:, 0], direction), axis=2)


def small_tower(leg_m=0.01, brace_m=0.006):
    """A tower without arms, 5 m high. By default, its sections are as thick as `fusion.sections` takes them to be."""
    sections_m = {"leg": (0.12, leg_m), "ring": (0.072, brace_m), "bracing": (0.072, brace_m)}
    return build_tower(TowerSettings(profile_m=((0.0, 2.4), (3.0, 1.8), (5.0, 1.4)), arms_m=(), sections_m=sections_m))


def around(tower, poses: int = 24, noise_m: float = 0.0, seed: int = 0, turn_rad: float = 0.9) -> Flight:
    """A flight on an arc in front of a tower at z = 0, with the true poses. The sensor frame is the drone's frame."""
    angle = np.linspace(-turn_rad, turn_rad, poses)
    T = np.tile(np.eye(4), (poses, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).as_matrix()
    T[:, :3, 3] = np.stack([-3.2 * np.cos(angle), -3.2 * np.sin(angle), np.linspace(1.2, 3.4, poses)], axis=1)
    path, tof = Trajectory(0.2 * np.arange(poses + 1), np.concatenate([T, T[-1:]])), TofSettings(
        columns=120, rows=120, fov_horizontal_rad=1.5, fov_vertical_rad=1.5, range_max_m=6.0, sigma_floor_m=noise_m,
        mount_m=(0.0, 0.0, 0.0),
    )  # fmt: skip
    scans, _ = scan_flight(tower, path, tof, seed)
    return Flight(scans, Trajectory(scans.stamp_s, T[: len(scans)]), np.eye(4))


@functools.cache
def made_up(seed: int, noise_m: float, tubes=(), scans: int = 40, thickness: float = shapes.THICKNESS):
    """Four posts and two beams of angle sections, some of them ``tubes``, around a sensor that slides past, with points
    on their near faces. Shared by tests, so it must not be changed."""
    rng = np.random.default_rng(seed)
    foot = np.array([(2, -1.5), (2, -0.5), (2.5, 0.5), (2, 1.5)])
    posts = [((x, y, -1.0), (x, y, 1.0)) for x, y in foot]
    ends = np.array([*posts, ((2, -1.5, 0.8), (2, 1.5, 0.8)), ((2.2, -1.5, -0.7), (2.2, 1.5, 0.3))])
    segments = Segments(ends[:, 0], ends[:, 1], np.full(6, 100), np.full(6, 0.02))
    across = shapes.frames(segments.direction)
    kind = np.full(6, shapes.ANGLE)
    bars = Bars(segments, across, kind, rng.uniform(-3, 3, 6), rng.uniform(0.06, 0.12, 6), thickness)
    bars.kind[list(tubes)], bars.turn[list(tubes)] = shapes.TUBE, np.nan
    corner = shapes.outlines(bars.kind, bars.turn, bars.flange, thickness)
    T = np.tile(np.eye(4), (scans, 1, 1))
    T[:, 1, 3], T[:, 2, 3] = np.linspace(-1, 1, scans), 0.2 * np.sin(np.arange(scans) / 6)
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(0.3 * np.sin(np.arange(scans) / 9), [0, 0, 1])).as_matrix()

    def scans_on_bars():
        for k, pose in enumerate(T):
            found, of = [], []
            for b in rng.integers(0, 6, 400).tolist():
                axis = segments.start[b] + rng.uniform(0.05, 0.95) * (segments.end[b] - segments.start[b])
                u, v = across[b] @ (pose[:3, 3] - axis)
                beside = rng.uniform(-0.6, 0.6) * bars.flange[b]
                towards = math.atan2(v, u) - math.asin(beside / math.hypot(u, v))
                cosine, sine = math.cos(towards), math.sin(towards)
                front, *_ = shapes.front_face(bars.kind[b], corner[b], cosine, sine, beside)
                if front < -1e8:
                    continue
                point = axis + across[b].T @ [cosine * front - sine * beside, sine * front + cosine * beside]
                ray = point - pose[:3, 3]
                ray = ray + noise_m * rng.standard_normal() * ray / np.linalg.norm(ray)
                found.append(ray @ pose[:3, :3])
                of.append(b)
            yield k, np.array(found), np.array(of)

    return T, bars, Observations.gathered(scans_on_bars())
