"""Methods of segmentation on views of a tower: scenes, trials, tables."""

import itertools
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from steelnb import rng
from steelnb.config import FlightSettings, SegmentationSettings, TofSettings, TowerSettings, TrajectoryName
from steelnb.datatypes import Array, Segments
from steelnb.hough import suggest_dx
from steelnb.metrics import SeenMembers, SegmentScore, score_segments, seen_members
from steelnb.preprocess import voxel_grid
from steelnb.segmentation import METHODS
from steelnb.simulation import build_tower
from steelnb.simulation.views import View, Viewer, pose_on_path

NOISE_M, CLUTTER = 0.02, 0.1
ANGLE_MAX_RAD = math.radians(10)
"""A segment is right up to this angle. The 2 cm of noise alone turn a bar of 30 cm and 30 points by 3° (1 sigma)."""
LEAN_SIGMA_RAD = math.radians(2)
TOWER = TowerSettings(
    leg_section_m=(0.100, 0.008),
    ring_section_m=(0.070, 0.006),
    bracing_section_m=(0.060, 0.006),
    arm_section_m=(0.050, 0.005),
)
"""The tower of the report in angle sections of 5 to 10 cm."""


@dataclass(frozen=True)
class Scene:
    """A cloud ``points (N, 3)`` in the world frame, what it can show, and how it was made.

    ``noise_m`` is the range noise, ``clutter`` the share of points that are none of the tower's, ``kept`` the share of
    the sensor's returns that was kept. ``across (3,)`` points to the right in the first view.
    """

    name: str
    seed: int
    noise_m: float
    clutter: float
    kept: float
    points: Array
    members: SeenMembers
    across: Array


@dataclass(frozen=True)
class Trial:
    """What one method made of one scene, and the seconds it took."""

    method: str
    scene: Scene
    segments: Segments
    score: SegmentScore
    seconds: float


class Scenes:
    """Makes scenes of one tower with a Starling 2's sensor, whose range noise is the same at all ranges."""

    def __init__(self, tower: TowerSettings | None = None) -> None:
        self.tower = build_tower(tower or TOWER)
        self._viewer = Viewer(self.tower, TofSettings.preset("starling2"))

    def frames(
        self, seed: int, count: int, noise_m: float = NOISE_M, clutter: float = CLUTTER, kept: float = 1.0
    ) -> list[Scene]:
        """Views from random places on the paths of the two flights, in turn."""
        scenes = []
        for k in range(count):
            place = rng.stream(seed, "place", k)
            flight = FlightSettings.preset(("vertical", "orbit")[k % 2])  # type: ignore[arg-type]
            view = self._view(seed, k, flight, place.random(), noise_m)
            scenes.append(self._scene("frame", seed, k, [view], noise_m, clutter, kept))
        return scenes

    def sequence(
        self, seed: int, count: int, trajectory: TrajectoryName = "vertical", first: float = 0.0, last: float = 1.0
    ) -> list[Scene]:
        """Views one after the other from a share ``first`` to a share ``last`` of the path of a flight."""
        flight = FlightSettings.preset(trajectory)
        shares = np.linspace(first, last, count)
        views = [self._view(seed, k, flight, float(share), NOISE_M) for k, share in enumerate(shares)]
        return [self._scene("sequence", seed, k, [view], NOISE_M, CLUTTER, 1.0) for k, view in enumerate(views)]

    def whole(self, seed: int, count: int, leaf_m: float = 0.04) -> Scene:
        """``count`` views along both flights, placed at their true poses, voxel-filtered, with clutter."""
        flights = [FlightSettings.preset("vertical"), FlightSettings.preset("orbit").but(height_max_m=15.0, levels=10)]
        views = [
            self._view(seed, k, flights[k % 2], (k // 2 + 0.5) / math.ceil(count / 2), NOISE_M) for k in range(count)
        ]
        return self._scene("tower", seed, 0, views, NOISE_M, CLUTTER, 1.0, leaf_m)

    def _view(self, seed: int, k: int, flight: FlightSettings, share: float, noise_m: float) -> View:
        lean = rng.stream(seed, "lean", k).normal(scale=LEAN_SIGMA_RAD, size=3)
        self._viewer.tof = self._viewer.tof.but(sigma_floor_m=noise_m, sigma_relative=0.0)
        return self._viewer.view(pose_on_path(self.tower, flight, share, lean), rng.stream(seed, "tof", k))

    def _scene(
        self, name: str, seed: int, k: int, views: Sequence[View], noise_m: float, clutter: float, kept: float,
        leaf_m: float | None = None,
    ) -> Scene:  # fmt: skip
        points, surface = np.concatenate([v.points for v in views]), np.concatenate([v.surface for v in views])
        member = np.concatenate([v.member for v in views])
        if kept < 1:
            chosen = rng.stream(seed, "kept", k).random(len(points)) < kept
            points, surface, member = points[chosen], surface[chosen], member[chosen]
        members = seen_members(self.tower.axes, surface, member)
        if leaf_m is not None:
            points = voxel_grid(points, leaf_m)
        points = _with_clutter(points, clutter, seed, k)
        return Scene(name, seed, noise_m, clutter, kept, points, members, views[0].across)


def _with_clutter(points: Array, share: float, seed: int, k: int) -> Array:
    """The points and, evenly in the box around them, so many others that these are ``share`` of all."""
    more = round(share / (1 - share) * len(points))
    random = rng.stream(seed, "clutter", k)
    return np.concatenate([points, random.uniform(points.min(axis=0), points.max(axis=0), (more, 3))])


def attempt(method: str, scene: Scene, label: str | None = None, **options: Any) -> Trial:
    """Segment a scene by one of `steelnb.segmentation.METHODS` with options of its own, and score it.

    ``label`` names the method in tables, by default as it is called.
    """
    begin = time.perf_counter()
    segments = METHODS[method](scene.points, seed=scene.seed, **options)
    seconds = time.perf_counter() - begin
    score = score_segments(
        segments, scene.members.axes, scene.members.observed(), ANGLE_MAX_RAD, seen=scene.members.seen
    )
    return Trial(label or method, scene, segments, score, seconds)


def warm_up(scene: Scene, methods: Iterable[str], options: Mapping[str, Mapping[str, Any]]) -> None:
    """Run each method once on a part of a scene, so that no time holds a compilation or an import."""
    few = replace(scene, points=scene.points[:: max(1, len(scene.points) // 1000)])
    for method in methods:
        attempt(method, few, **options.get(method, {}))


def trial_table(trials: Iterable[Trial]) -> pd.DataFrame:
    """One row for each scene name, noise, clutter, share kept, method and seed.

    ``recall``, ``precision``, ``duplicates``, ``points`` and ``segments`` are means over its frames, a frame without
    segments has precision 0; ``angle_deg`` and ``offset_m`` are medians over all right segments, NaN without any.
    """
    rows = []
    for key, some in _by_case(trials, lambda trial: (trial.scene.seed,)):
        angle, offset = (np.concatenate([getattr(t.score, name) for t in some]) for name in ("angle_rad", "offset_m"))
        rows.append(
            {
                **dict(zip((*CASE, "seed"), key, strict=True)),
                "frames": len(some),
                "points": float(np.mean([len(t.scene.points) for t in some])),
                "bars": float(np.mean([t.scene.members.observed().sum() for t in some])),
                "segments": float(np.mean([len(t.segments) for t in some])),
                "recall": float(np.mean([t.score.recall for t in some])),
                "precision": float(np.mean([np.nan_to_num(t.score.precision) for t in some])),
                "duplicates": float(np.mean([t.score.duplicates for t in some])),
                "angle_deg": float(np.degrees(np.median(angle))) if len(angle) else math.nan,
                "offset_m": float(np.median(offset)) if len(offset) else math.nan,
            }
        )
    return pd.DataFrame(rows)


def trial_timing(trials: Iterable[Trial], by_seed: bool = False) -> pd.DataFrame:
    """Milliseconds a frame, median and 95th percentile, a row for each case of `trial_table`, with or without seeds."""
    rows = []
    names = (*CASE, "seed") if by_seed else CASE
    for key, some in _by_case(trials, lambda trial: (trial.scene.seed,) if by_seed else ()):
        median, p95 = np.percentile([1e3 * t.seconds for t in some], [50, 95])
        points = float(np.mean([len(t.scene.points) for t in some]))
        rows.append({**dict(zip(names, key, strict=True)), "points": points, "median_ms": median, "p95_ms": p95})
    return pd.DataFrame(rows)


CASE = ("scene", "noise_m", "clutter", "kept", "method")


def _by_case(
    trials: Iterable[Trial], more: Callable[[Trial], tuple[Any, ...]]
) -> list[tuple[tuple[Any, ...], list[Trial]]]:
    groups: dict[tuple[Any, ...], list[Trial]] = {}
    for trial in trials:
        scene = trial.scene
        key = (scene.name, scene.noise_m, scene.clutter, scene.kept, trial.method, *more(trial))
        groups.setdefault(key, []).append(trial)
    return list(groups.items())


def over_cases(rows: pd.DataFrame) -> pd.DataFrame:
    """Means over the seeds of `trial_table`, a row a case."""
    numbers = ["points", "bars", "segments", "recall", "precision", "duplicates", "angle_deg", "offset_m"]
    return rows.groupby(list(CASE), sort=False)[numbers].mean().reset_index()


def segmentation_metrics(rows: pd.DataFrame) -> dict[str, float]:
    """The finite means over the seeds at the usual noise, clutter and density, ``<scene>.<method>.<metric>``."""
    usual = over_cases(rows[(rows["noise_m"] == NOISE_M) & (rows["clutter"] == CLUTTER) & (rows["kept"] == 1.0)])
    return {
        f"{row['scene']}.{row['method']}.{name}": float(row[name])
        for row in usual.to_dict("records")
        for name in ("recall", "precision", "duplicates", "angle_deg", "offset_m")
        if np.isfinite(row[name])
    }


FIXED, CHOSEN, REFERENCE = "fixed", "from the points", "diagonal/64"
"""Where a dx of `tuning_map` comes from: given, `steelnb.hough.suggest_dx`, or the reference program's default."""


def tuning_map(
    scenes: Mapping[float, Sequence[Scene]],
    dx: Sequence[float],
    min_votes: Sequence[int],
    on_progress: Callable[[float], None] | None = None,
) -> pd.DataFrame:
    """Hough on the scenes of each noise with every dx × every least number of votes: means over all frames, a row each.

    The two rules for dx that need no tuning are tried too; ``dx_m`` is then their mean, and ``rule`` says which.
    """
    widths: list[tuple[str, float]] = [(FIXED, width) for width in dx]
    cases = list(itertools.product(scenes, [*widths, (CHOSEN, math.nan), (REFERENCE, math.nan)], min_votes))
    rows = []
    for k, (noise_m, (rule, width), votes) in enumerate(cases):
        settings = SegmentationSettings(points_min=votes)
        own = [_dx(rule, width, scene.points) for scene in scenes[noise_m]]
        trials = [
            attempt("hough", scene, settings=settings, dx=each)
            for scene, each in zip(scenes[noise_m], own, strict=True)
        ]
        row = over_cases(trial_table(trials)).iloc[0]
        rows.append(
            {"noise_m": noise_m, "rule": rule, "dx_m": float(np.mean(own)), "min_votes": votes}
            | {name: float(row[name]) for name in ("recall", "precision", "duplicates", "angle_deg", "offset_m")}
        )
        if on_progress:
            on_progress((k + 1) / len(cases))
    return pd.DataFrame(rows)


def _dx(rule: str, width: float, points: Array) -> float:
    if rule == CHOSEN:
        return suggest_dx(points)
    return width if rule == FIXED else float(np.linalg.norm(np.ptp(points, axis=0))) / 64


def cost_of_rules(tuning: pd.DataFrame) -> pd.DataFrame:
    """What each rule for dx loses against the best fixed dx of each noise and least number of votes.

    The best has the largest mean of recall and precision. Columns: ``best_dx_m``, ``dx_m`` of the rule, and how much
    ``recall`` and ``precision`` are below the best one's.
    """
    rows = []
    for (noise_m, votes), some in tuning.groupby(["noise_m", "min_votes"], sort=False):
        fixed = some[some["rule"] == FIXED]
        best = fixed.iloc[int((fixed["recall"] + fixed["precision"]).to_numpy().argmax())]
        for row in some[some["rule"] != FIXED].to_dict("records"):
            rows.append(
                {"noise_m": noise_m, "min_votes": votes, "rule": row["rule"], "best_dx_m": best["dx_m"]}
                | {"dx_m": row["dx_m"]}
                | {f"{name}_lost": best[name] - row[name] for name in ("recall", "precision")}
            )
    return pd.DataFrame(rows)
