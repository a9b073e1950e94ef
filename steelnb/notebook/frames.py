"""What is found in single frames and in clouds of whole towers: trials of segmentation methods, and matched images."""

import itertools
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from steelnb import experiment
from steelnb.core import rng
from steelnb.core.errors import InputError
from steelnb.core.files import reading
from steelnb.core.geometry import transform_points
from steelnb.core.rng import stream
from steelnb.core.types import Array, CameraImages, Flight, GreyImage, Segments, project, unproject
from steelnb.fusion.cloud_bars import bars_of_cloud
from steelnb.fusion.structure import Structure
from steelnb.hough.alternatives import find_bars_by
from steelnb.hough.lines import default_dx
from steelnb.metrics import SeenMembers, SegmentScore, score_segments, seen_members
from steelnb.metrics.structure import Reference, reference, score_structure
from steelnb.notebook.cases import cloud_case
from steelnb.odometry.orb_features import features_with_depth, match
from steelnb.points import preprocess_scan, voxel_grid
from steelnb.settings import FlightSettings, TofSettings, TowerSettings
from steelnb.simulation import Truth, build_tower
from steelnb.simulation.flight import pose_on_path
from steelnb.simulation.tof import TofCamera, take_view
from steelnb.simulation.truth import SLICE_M

USUAL = {"noise_m": 0.02, "clutter": 0.1, "kept": 1.0}
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
        self,
        seed: int,
        count: int,
        noise_m: float = USUAL["noise_m"],
        clutter: float = USUAL["clutter"],
        kept: float = USUAL["kept"],
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
    """Segment a scene by one of `hough.alternatives.FINDERS` with its own options, and score the result."""
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
CLOUD_METHODS = ("steelnb segment", "hough", "ransac-lines", "dbscan", "gmm")
"""`bars_of_cloud`, and methods of `hough.alternatives`."""


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
    return find_bars_by(method, voxel_grid(points, dx / np.sqrt(3)), seed, dx, **options)


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


FEATURES, HAMMING_MAX, RATIO = 400, 60, 0.8
"""Features of an image, and the limits of a match (`match`)."""


class ImageMatches(NamedTuple):
    """N matches: the two images ``(H, W)``, the number of features in each, the pixels of the matched ones ``(N, 2)``
    in the first and in the second image, and their distances ``apart_px (N,)`` from where the true motion takes the
    features of the first image; NaN where its scan has no depth."""

    images: tuple[GreyImage, GreyImage]
    features: tuple[int, int]
    first: Array
    second: Array
    apart_px: Array


def _image_at(camera: CameraImages, stamp_s: float) -> GreyImage:
    number = camera.at(stamp_s)
    image = None if number is None else camera.images[number]
    if image is None:
        raise InputError(f"no image at {stamp_s:.2f} s; expected one at each of the two scans")
    return image


def match_images(flight: Flight, truth: Truth, first: int, second: int) -> ImageMatches:
    """Match the features of the images at two scans by their descriptors alone (Lowe's ratio test, IJCV 2004); each
    feature is matched once. Raises `InputError` for scans without an image."""
    camera, stamp_s = flight.images, flight.prior.stamp_s[[first, second]]
    if camera is None:
        raise InputError("the flight has no images; expected one with a camera, such as that of a preset for orb")
    one, other = (_image_at(camera, at_s) for at_s in stamp_s)
    T_camera_sensor = np.linalg.inv(camera.T_drone_camera) @ flight.T_drone_sensor
    a, b = (
        features_with_depth(image, flight.scans[scan].points, T_camera_sensor, camera.K, FEATURES)
        for image, scan in ((one, first), (other, second))
    )
    anywhere, unknown = np.inf, np.full(len(a.pixel), np.nan)
    features = (b.pixel, b.octave, b.descriptor, b.depth)
    found = match(*features, a.pixel, a.octave, unknown, a.descriptor, anywhere, HAMMING_MAX, RATIO)
    T_world_camera = truth.trajectory.at(stamp_s).T_world_drone @ camera.T_drone_camera
    T_b_a = np.linalg.inv(T_world_camera[1]) @ T_world_camera[0]
    points = (a.depth[:, None] * unproject(a.pixel, camera.K)) @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    matched = np.flatnonzero(found >= 0)
    pixel, expected = b.pixel[found[matched]], project(points[matched], camera.K)
    apart_px = np.linalg.norm(pixel - expected, axis=1)
    return ImageMatches((one, other), (len(a.pixel), len(b.pixel)), a.pixel[matched], pixel, apart_px)
