"""Bars of merged clouds of whole towers: clouds, what may be done to them, and trials of the methods."""

import itertools
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.core.geometry import transform_points
from steelnb.core.rng import stream
from steelnb.core.types import Array, Segments
from steelnb.fusion.structure import Structure
from steelnb.fusion.whole_cloud import bars_of_cloud
from steelnb.hough.alternatives.methods import find_bars_by
from steelnb.hough.lines import default_dx
from steelnb.hough.whole_structure.search import segment_structure
from steelnb.metrics.structure import Reference, reference, score_structure
from steelnb.notebook.cases import cloud_case
from steelnb.notebook.single_frames import Options
from steelnb.points import preprocess_scan, voxel_grid
from steelnb.simulation.truth import SLICE_M

SHARE = 10
"""One in this many points of a flight is taken, some 600,000 of two minutes."""
GROUND_M = 0.1
WALL_M, WALL_PER_M2, WALL_SIGMA_M = (10.0, 8.0), 3000, 0.01
"""Width and height of a wall 1 m behind the tower, its points per m² and their noise."""


def _noise(sigma_m: float) -> Callable[[Array, np.random.Generator], Array]:
    return lambda points, rng: points + rng.normal(scale=sigma_m, size=points.shape)


def _wall(points: Array, rng: np.random.Generator) -> Array:
    high = points[points[:, 2] > GROUND_M]
    count = int(WALL_M[0] * WALL_M[1] * WALL_PER_M2)
    along = rng.uniform(-0.5, 0.5, count) * WALL_M[0] + high[:, 1].mean()
    across = high[:, 0].max() + 1.0 + rng.normal(scale=WALL_SIGMA_M, size=count)
    return np.concatenate([points, np.column_stack([across, along, rng.uniform(0, WALL_M[1], count)])])


def _strays(points: Array, rng: np.random.Generator) -> Array:
    low, high = points.min(axis=0), points.max(axis=0)
    return np.concatenate([points, rng.uniform(low, high, (len(points) // 20, 3))])


CONDITIONS: dict[str, Callable[[Array, np.random.Generator], Array]] = {
    "with ground": lambda points, rng: points,
    "without ground": lambda points, rng: points[points[:, 2] > GROUND_M],
    "wall 1 m behind": _wall,
    "noise 1 cm": _noise(0.01),
    "noise 2 cm": _noise(0.02),
    "5 % stray points": _strays,
    "a quarter": lambda points, rng: points[: len(points) // 4],
    "a sixteenth": lambda points, rng: points[: len(points) // 16],
}
"""What may be done to a cloud in random order: points and a generator → points. Noise is added to all coordinates."""
CLOUD_MEASURES = ["recall", "precision", "duplicates", "length", "offset_m"]
CLOUD_METHODS = ("steelnb segment", "blocks", "hough", "ransac-lines", "dbscan", "gmm")
"""`bars_of_cloud`; `segment_structure`, on which it builds; and methods of `hough.alternatives`."""


def merged_cloud(tower: str, seed: int, duration_s: float) -> tuple[Array, Reference]:
    """Points ``(N, 3)`` of a flight in loops around a tower at the true poses, world frame, in random order, with the
    ground; and the true bars that it saw. Members in line are one bar."""
    settings = cloud_case(tower, seed, duration_s)
    flight, truth = experiment.simulate(settings)
    T = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    random, placed = stream(seed, "merged cloud"), []
    for k, scan in enumerate(flight.scans):
        points = preprocess_scan(scan, T[k], flight.T_drone_sensor, settings.odometry.preprocess)
        some = points[random.random(len(points)) < 1 / SHARE]
        placed.append(transform_points(T[k], some))
    return random.permutation(np.concatenate(placed)), reference(truth.tower, truth.visibility).joined()


def find_bars_in(method: str, points: Array, seed: int, **options: Any) -> Segments:
    """The bars of a cloud ``(N, 3)`` by one of `CLOUD_METHODS`, each with the defaults of its user."""
    if method == "steelnb segment":
        return bars_of_cloud(points).bars
    dx = default_dx(points)
    thinned = voxel_grid(points, dx / np.sqrt(3))
    return segment_structure(thinned, dx) if method == "blocks" else find_bars_by(method, thinned, seed, dx, **options)


def cloud_trial(
    method: str, condition: str, cloud: Array, truth: Reference, seed: int, **options: Any
) -> dict[str, Any]:
    """Find the bars of a cloud under one of `CONDITIONS` and score them: a row of a table.

    ``recall``, ``precision`` and ``duplicates`` as in `score_structure`; ``length`` of all bars as a share of the
    observed length of the observed members; ``offset_m``: median distance from the true axes.
    """
    points = CONDITIONS[condition](cloud, stream(seed, condition))
    began = time.perf_counter()
    bars = find_bars_in(method, points, seed, **options)
    seconds = time.perf_counter() - began
    score = score_structure(Structure.of(bars), truth).metrics
    seen_m = sum(SLICE_M * part.sum() for part, seen in zip(truth.slices, truth.observed, strict=True) if seen)
    return {
        "seed": seed, "condition": condition, "method": method, "points": len(points), "bars": len(bars),
        "observed": int(score["observed"]), "recall": score["recall"], "precision": score["precision"],
        "duplicates": int(score["duplicates"]), "length": bars.length.sum() / seen_m,
        "offset_m": score["offset_median_m"], "seconds": seconds,
    }  # fmt: skip


def cloud_trials(
    tower: str, seed: int, duration_s: float, conditions: Sequence[str] = tuple(CONDITIONS),
    methods: Sequence[str] = CLOUD_METHODS[:1], options: Options | None = None,
) -> pd.DataFrame:  # fmt: skip
    """Rows of one cloud: the first method under all conditions, the others with and without ground.

    ``options`` maps methods to their own ones.
    """
    cloud, truth = merged_cloud(tower, seed, duration_s)
    cases = [(methods[0], each) for each in conditions] + list(itertools.product(methods[1:], conditions[:2]))
    cases = list(dict.fromkeys(cases))
    chosen = options or {}
    rows = [cloud_trial(method, each, cloud, truth, seed, **chosen.get(method, {})) for method, each in cases]
    return pd.DataFrame(rows).assign(tower=tower)
