"""Made-up bars, structures and rigid motions."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.fusion import Structure
from steelnb.types import Segments


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
    """A random rotation and a shift of up to ``reach_m`` an axis."""
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


def changed(structure: Structure, bar: int, start=(0, 0, 0), end=(0, 0, 0)) -> Structure:
    s = structure.segments
    starts, ends = s.start.copy(), s.end.copy()
    starts[bar] += start
    ends[bar] += end
    return replace(structure, segments=Segments(starts, ends, s.count, s.radius))


def ladder(steps: int = 6) -> Structure:
    """Two posts 1 m apart, and rungs between them 0.5 m apart, each tied to both posts."""
    top = 0.5 * (steps + 1)
    posts = [[[0, 0, 0], [0, 0, top]], [[1, 0, 0], [1, 0, top]]]
    rungs = [[[0, 0, 0.5 * k], [1, 0, 0.5 * k]] for k in range(1, steps + 1)]
    joint = [[x, 0, 0.5 * k] for k in range(1, steps + 1) for x in (0, 1)]
    tie = [row for k in range(steps) for row in ((2 * k, 0), (2 * k, 2 + k), (2 * k + 1, 1), (2 * k + 1, 2 + k))]
    return structure_of_bars(posts + rungs, joint, tie)
