"""Segmentation methods on single frames: views of a tower, trials of a method on them, and their tables."""

import itertools
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from steelnb.core import rng
from steelnb.core.files import reading
from steelnb.core.types import Array, Segments
from steelnb.hough.alternatives.methods import find_bars_by
from steelnb.hough.lines import default_dx
from steelnb.metrics import SeenMembers, SegmentScore, score_segments, seen_members
from steelnb.settings import FlightSettings, TofSettings, TowerSettings
from steelnb.simulation import build_tower
from steelnb.simulation.paths import pose_on_path
from steelnb.simulation.tof import TofCamera, take_view

NOISE_M, CLUTTER = 0.02, 0.1
USUAL = {"noise_m": NOISE_M, "clutter": CLUTTER, "kept": 1.0}
"""The conditions at which the methods are compared."""
TRIAL_COLUMNS = ("scene", "noise_m", "clutter", "kept", "method")
MEASURES = ["recall", "precision", "duplicates", "angle_deg", "offset_m"]
ANGLE_MAX_RAD = math.radians(10)
"""Maximum angle of a right segment. Noise of 2 cm alone turns a bar of 30 cm with 30 points by 3° (1 sigma)."""
RECALL_MIN = 0.05
"""Below this recall, precision would rest on one or two segments."""
LEAN_SIGMA_RAD = math.radians(2)
Options = Mapping[str, Mapping[str, Any]]
"""Method → its options."""


@dataclass(frozen=True, eq=False)
class FrameScene:
    """A cloud ``points (N, 3)`` in the world frame, the members seen in it, and the conditions it was made under.

    ``noise_m`` is the range noise, ``clutter`` the share of points that are not on the tower, ``kept`` the share of the
    sensor's returns that was kept. ``across (3,)`` points to the right in the view.
    """

    seed: int
    noise_m: float
    clutter: float
    kept: float
    points: Array
    members: SeenMembers
    across: Array


@dataclass(frozen=True, eq=False)
class Trial:
    """The segments of one method in one scene, their score and the seconds they took."""

    method: str
    scene: FrameScene
    segments: Segments
    score: SegmentScore
    seconds: float


class Scenes:
    """Makes scenes of one tower with a Starling 2's sensor, whose range noise is the same at all ranges."""

    def __init__(self) -> None:
        self.tower = build_tower(TowerSettings.preset("slender"))
        self._camera = TofCamera(self.tower, TofSettings.preset("starling2"), seed=0)

    def frames(
        self, seed: int, count: int, noise_m: float = NOISE_M, clutter: float = CLUTTER, kept: float = 1.0
    ) -> list[FrameScene]:
        """Views from random places on the zigzag and the loops, alternating."""
        self._camera.settings = self._camera.settings.replace(sigma_floor_m=noise_m, sigma_relative=0.0)
        scenes = []
        for k in range(count):
            flight = FlightSettings.preset("loops" if k % 2 else "zigzag")
            share = rng.stream(seed, "place", k).random()
            lean = rng.stream(seed, "lean", k).normal(scale=LEAN_SIGMA_RAD, size=3)
            pose = pose_on_path(self.tower, flight, share, lean)
            view = take_view(self._camera, pose, rng.stream(seed, "tof", k))
            chosen = rng.stream(seed, "kept", k).random(len(view.points)) < kept
            members = seen_members(self.tower.axes, view.surface[chosen], view.member[chosen])
            points = _with_clutter(view.points[chosen], clutter, seed, k)
            scenes.append(FrameScene(seed, noise_m, clutter, kept, points, members, view.across))
        return scenes


def _with_clutter(points: Array, share: float, seed: int, k: int) -> Array:
    """Add uniform clutter in the bounding box of the points, until it is ``share`` of all points."""
    more = round(share / (1 - share) * len(points))
    random = rng.stream(seed, "clutter", k)
    return np.concatenate([points, random.uniform(points.min(axis=0), points.max(axis=0), (more, 3))])


def attempt(method: str, scene: FrameScene, **options: Any) -> Trial:
    """Segment a scene by one of `hough.alternatives.methods.FINDERS` with its own options, and score the result."""
    begin = time.perf_counter()
    segments = find_bars_by(method, scene.points, seed=scene.seed, **options)
    seconds = time.perf_counter() - begin
    members = scene.members
    score = score_segments(segments, members.axes, members.observed(), ANGLE_MAX_RAD, seen=members.seen)
    return Trial(method, scene, segments, score, seconds)


def warm_up(scene: FrameScene, methods: Iterable[str], options: Options) -> None:
    """Run each method once on part of a scene, so that measured times include no compilation or import."""
    few = replace(scene, points=scene.points[:: max(1, len(scene.points) // 1000)])
    for method in methods:
        attempt(method, few, **options.get(method, {}))


def trial_table(trials: Iterable[Trial]) -> pd.DataFrame:
    """One row for each scene name, noise, clutter, share kept, method and seed.

    ``recall``, ``precision``, ``duplicates``, ``points``, ``bars`` and ``segments`` are means over its frames; a frame
    without segments has precision 0. ``angle_deg`` and ``offset_m`` are medians over all right segments, NaN if none.
    """
    rows, by, errors = _rows(trials), [*TRIAL_COLUMNS, "seed"], ["angle_deg", "offset_m"]
    groups = rows.groupby(by, sort=False)
    means = groups[["points", "bars", "segments", "recall", "precision", "duplicates"]].mean()
    of_all = rows.explode(errors).astype(dict.fromkeys(errors, float)).groupby(by, sort=False)[errors].median()
    return groups.size().to_frame("frames").join([means, of_all]).reset_index()


def by_condition(table: pd.DataFrame) -> pd.DataFrame:
    """Means of `MEASURES` over the seeds of a `trial_table`, for each condition that varies alone: one row for each
    ``condition``, its ``level`` and method. Precision is NaN where recall is below `RECALL_MIN`."""
    usual = pd.Series(USUAL)
    cases = table.groupby([*USUAL, "method"], sort=False)[MEASURES].mean().reset_index()
    cases["precision"] = cases["precision"].where(cases["recall"] >= RECALL_MIN)
    alone = []
    for name in USUAL:
        fixed = usual.drop(name)
        rows = cases[(cases[fixed.index] == fixed).all(axis=1)]
        alone.append(rows.assign(condition=name, level=rows[name]))
    return pd.concat(alone)


def tuning_table(frames: Sequence[FrameScene], dx_m: Sequence[float], min_votes: Sequence[int]) -> pd.DataFrame:
    """Recall and precision of the Hough transform, means over the frames, with each ``dx`` and minimum number of votes.

    Beside the given ``dx_m``, ``dx (cm)`` names the default of `detect_segments` and that of the reference program.
    ``line`` is the same for all that are given, which a curve may connect.
    """
    rows = []
    for frame in frames:
        widths = {f"{100 * width:g}": width for width in dx_m} | {"from\npoints": default_dx(frame.points)}
        widths["diag.\n/ 64"] = float(np.linalg.norm(np.ptp(frame.points, axis=0))) / 64
        for votes, (name, width) in itertools.product(min_votes, widths.items()):
            score = attempt("hough", frame, points_min=votes, dx=width).score
            numbers = {"recall": score.recall, "precision": score.precision}
            rows.append({"votes": votes, "dx (cm)": name, "line": name if "\n" in name else "given", **numbers})
    each = pd.DataFrame(rows).fillna({"precision": 0.0})  # of no segment at all
    return each.groupby(["votes", "dx (cm)", "line"], sort=False).mean().reset_index()


def trial_timing(trials: Iterable[Trial]) -> pd.DataFrame:
    """Milliseconds per frame, median and 95th percentile, with the same rows as `trial_table`."""
    groups = _rows(trials).groupby([*TRIAL_COLUMNS, "seed"], sort=False)
    times = groups["ms"].quantile(np.array([0.5, 0.95])).unstack().set_axis(["median_ms", "p95_ms"], axis=1)
    return groups[["points"]].mean().join(times).reset_index()


def _rows(trials: Iterable[Trial]) -> pd.DataFrame:
    """One row per trial. The errors of its right segments are arrays."""
    return pd.DataFrame(
        {
            "scene": "frame",
            **{name: getattr(t.scene, name) for name in USUAL},
            "method": t.method,
            "seed": t.scene.seed,
            "points": len(t.scene.points),
            "bars": t.scene.members.observed().sum(),
            "segments": len(t.segments),
            "recall": t.score.recall,
            "precision": np.nan_to_num(t.score.precision),
            "duplicates": t.score.duplicates,
            "angle_deg": np.degrees(t.score.angle_rad),
            "offset_m": t.score.offset_m,
            "ms": 1e3 * t.seconds,
        }
        for t in trials
    )


def frame_runs(folder: Path) -> pd.DataFrame:
    """The results of the segmentation methods as runs, so that claims on single frames are judged like the others.

    Frames at the usual noise, clutter and density, one row per method and seed, as runs of the ``trajectory`` ``frame``
    without duration or noise. ``f1`` is the harmonic mean of recall and precision, ``frame_median_ms`` the time from
    ``timing.csv``. Raises `InputError`.
    """
    names = [*TRIAL_COLUMNS, "seed"]
    with reading(folder / "table.csv", "results of segmentation-seeds"):
        rows, times = (pd.read_csv(folder / name) for name in ("table.csv", "timing.csv"))
        times = times.rename(columns={"median_ms": "frame_median_ms"})[[*names, "frame_median_ms"]]
        rows = rows.merge(times, on=names, how="left", validate="one_to_one")
        usual = np.logical_and.reduce([rows[name] == value for name, value in USUAL.items()])
        rows = rows[(rows["scene"] == "frame") & usual].reset_index(drop=True)
        both = rows["recall"] + rows["precision"]
    f1 = 2 * rows["recall"] * rows["precision"] / both.where(both > 0, 1.0)
    case = {"sensor": "starling2", "trajectory": "frame", "noise": "", "duration_s": 0.0, "variant": "", "blind": ""}
    return rows.assign(f1=f1, status="ok", **case)
