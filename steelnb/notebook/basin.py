"""The starts from which a registration finds a scan's true pose, its basin of convergence; and ICP step by step."""

import copy
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import seaborn as sns
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.files import reading
from steelnb.core.geometry import exp_about, transform_points
from steelnb.core.rng import stream
from steelnb.core.types import Array, Flight, IntArray
from steelnb.experiment import OnProgress, Result
from steelnb.metrics import WRONG_M, WRONG_SHARE, largest_slip, position_error_m
from steelnb.notebook.tables import table
from steelnb.odometry import CloudOdometry
from steelnb.plots import BLACK, COLOURS, GREY, ORANGE, Figure, gather_bar, gather_legend
from steelnb.points import preprocess_scan
from steelnb.points.covariances import neighbour_covariances, regularised
from steelnb.registration import FREE, AlignOptions, align, make_target
from steelnb.registration.icp import ERROR_OF
from steelnb.registration.pcl import least_squares_motion
from steelnb.settings import ExperimentSettings, PreprocessSettings
from steelnb.simulation import Truth

RIGHT_M = 0.1
"""Maximum error of a right result: the edge of the report's voxel."""
MAP_EVERY = 4
POOR_M, POOR_RAD = 1.0, math.radians(10)
"""Maximum errors of the start in `from_poor_starts`."""
POOR_CASES = (
    ("pairs as in the report", "icp", 0.5), ("pairs as in the report", "gicp", 0.3),
    ("pairs within 0.5 m", "icp", 0.5), ("pairs within 0.5 m", "gicp", 0.5),
)  # fmt: skip
"""Variant, method and maximum distance of a pair, metres."""
START_COLUMNS = ["variant", "method", "seed", "start_m", "start_deg", "error_m", "right"]
POINTS_MIN = 100
"""Minimum number of points of a scan in `from_poor_starts`; fewer may show one bar only."""


def find_basin(
    settings: ExperimentSettings,
    flight: Flight,
    truth: Truth,
    frame: int,
    offset_m: Array,
    on_progress: OnProgress | None = None,
) -> pd.DataFrame:
    """Register scan ``frame`` from starts that are off its true pose by ``offset_m (N, 3)``, one row per start. The map
    holds every `MAP_EVERY`-th scan at its true pose, without ``frame``.

    ``x_m``, ``y_m``, ``z_m``: the offset of the start; ``error_m``: position error of the result; ``refused``: the
    odometry did not use the scan. Other results are ``right`` within `RIGHT_M` of the truth, else ``wrong``. A wrong
    result has either ``stayed`` within `RIGHT_M` of its start, since the registration trusts its prior, or ``locked``
    onto something else. Raises `InputError` for an odometry without clouds.
    """
    true = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    odometry = _mapped(settings, flight, true, without=frame)
    odometry.map.index()  # once, not in each copy
    ends, used = [], []
    for k, offset in enumerate(offset_m):
        start = true[frame].copy()
        start[:3, 3] += offset
        step = copy.deepcopy(odometry).update(flight.scans[frame], start)
        ends.append(step.T_world_drone[:3, 3] - true[frame][:3, 3])
        used.append(bool(step.used))
        if on_progress:
            on_progress((k + 1) / len(offset_m))
    error, moved = np.linalg.norm(ends, axis=1), np.linalg.norm(np.array(ends) - offset_m, axis=1)
    taken, close = np.array(used), error <= RIGHT_M
    wrong, still = taken & ~close, moved <= RIGHT_M
    basin = pd.DataFrame(offset_m, columns=["x_m", "y_m", "z_m"])
    return basin.assign(
        error_m=error, right=taken & close, wrong=wrong, stayed=wrong & still, locked=wrong & ~still, refused=~taken
    )


def from_poor_starts(
    settings: ExperimentSettings,
    flight: Flight,
    truth: Truth,
    count: int,
    on_progress: OnProgress | None = None,
) -> pd.DataFrame:
    """Register ``count`` scans, spread over a flight, with ICP and GICP, six degrees of freedom, no odometry around it.
    Each starts off its true pose by a random shift up to `POOR_M` and rotation up to `POOR_RAD`, the same for all
    `POOR_CASES`. The map is that of `find_basin`, and holds none of these scans.

    One row per case and scan, as a run that claims can judge: ``variant`` and ``method`` of the case, ``seed``, the
    number of the scan, ``start_m`` and ``start_deg``, ``error_m`` at the middle of the scan, and ``right``, 1 if this
    is at most `RIGHT_M`, else 0. Raises `InputError` if fewer scans have `POINTS_MIN` points, and for an odometry
    without clouds.
    """
    true = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    random, rows = stream(settings.seed, "poor starts"), []
    points_there = _mapped(settings, flight, true).map_points()
    between = {
        k: transform_points(true[k], _preprocessed(settings, flight, true, k))
        for k in range(MAP_EVERY // 2, len(flight.scans), MAP_EVERY)
    }
    usable = [k for k, points in between.items() if len(points) >= POINTS_MIN]
    if not 0 < count <= len(usable):
        seen = f"{len(usable)} of {len(between)} scans between those of the map have {POINTS_MIN} points"
        raise InputError(f"poor_starts = {count}, but {seen}; expected no more starts, or more in view: {REACHING}")
    aims = {method: make_target(points_there, ERROR_OF[method]) for method in ("icp", "gicp")}
    for done, k in enumerate(np.linspace(0, len(usable) - 1, count).round().astype(int).tolist(), 1):
        scan = usable[k]
        points, axis = between[scan], random.normal(size=(2, 3))
        axis /= np.linalg.norm(axis, axis=1)[:, None]
        start_m, turn_rad = POOR_M * random.random() ** (1 / 3), POOR_RAD * random.random()
        middle = points.mean(axis=0)
        T_start = exp_about(middle, np.concatenate([turn_rad * axis[0], start_m * axis[1]]))
        covariance = regularised(neighbour_covariances(points))
        for variant, method, limit_m in POOR_CASES:
            options = AlignOptions(ERROR_OF[method], FREE["se3"], limit_m)
            T = align(points, aims[method], T_start, options, covariance).T_target_source
            error_m = float(np.linalg.norm(transform_points(T, middle[None])[0] - middle))
            rows.append((variant, method, scan, start_m, math.degrees(turn_rad), error_m, int(error_m <= RIGHT_M)))
        if on_progress:
            on_progress(done / count)
    return pd.DataFrame(rows, columns=START_COLUMNS)


def _mapped(settings: ExperimentSettings, flight: Flight, true: Array, without: int = -1) -> CloudOdometry:
    """An odometry whose map holds every `MAP_EVERY`-th scan at its true pose."""
    odometry = CloudOdometry(settings.odometry, flight.T_drone_sensor)
    for k in range(0, len(flight.scans), MAP_EVERY):
        if k != without:
            odometry.insert(_preprocessed(settings, flight, true, k), true[k])
    return odometry


def _preprocessed(settings: ExperimentSettings, flight: Flight, true: Array, k: int) -> Array:
    return preprocess_scan(flight.scans[k], true[k], flight.T_drone_sensor, settings.odometry.preprocess)


def figure_basin(basins: pd.DataFrame) -> Figure:
    """The errors of `find_basin` at its starts, one panel for each ``registration``, a column of ``basins``. A start
    that it refused has no dot."""
    refused = basins.groupby("registration", sort=False)["refused"].all()
    look = {"hue": "error_m", "hue_norm": (0, 1), "palette": "viridis", "s": 70, "lw": 0, "legend": False}
    facets = {"col": "registration", "col_order": list(refused.index), "height": 3.8}
    if refused.all():
        grid = sns.FacetGrid(basins, **facets)
    else:
        grid = sns.relplot(basins[~basins["refused"]], x="x_m", y="z_m", **look, **facets)
    for name in refused.index[refused]:
        panel = grid.axes_dict[name]
        panel.text(0.5, 0.5, "all refused", ha="center", va="center", transform=panel.transAxes)
    labels = {"xlabel": "start offset along x (m)", "ylabel": "start offset along z (m)"}
    grid.set(aspect="equal", **labels).set_titles("{col_name}")
    gather_bar(grid.figure, "error at the end (m)", 1)
    return grid.figure


def figure_starts(starts: pd.DataFrame) -> Figure:
    """The errors of `from_poor_starts` over those of their starts, one panel a variant; below the dashed line, at
    `RIGHT_M`, a scan has found its true place."""
    look = {"hue": "method", "palette": COLOURS, "height": 3.6}
    grid = sns.relplot(starts, x="start_m", y="error_m", col="variant", **look)
    grid.set(yscale="log", xlabel="start off (m)", ylabel="error at the end (m)").set_titles("{col_name}")
    grid.refline(y=RIGHT_M, color=BLACK)
    gather_legend(grid.figure, ncols=2)
    return grid.figure


def slip_table(cases: Sequence[ExperimentSettings], results: Sequence[Result]) -> pd.DataFrame:
    """One row per flight: its case, errors, correspondence distance and time without sight, the share of its registered
    scans more than `WRONG_M` off, its `largest_slip` with its time, and whether it went wrong (`WRONG_SHARE`)."""
    rows = table(results)[["trajectory", "noise", "method", "sensor", "seed", "ate_rmse_m", "error_final_m"]]
    errors = [position_error_m(each.corrected, each.truth.trajectory) for each in results]
    slips = [largest_slip(error_m, each.corrected.stamp_s) for each, error_m in zip(results, errors, strict=True)]
    # The report's program has 0.1 m.
    rows["max_correspondence_m"] = [getattr(case.odometry, "max_correspondence_m", 0.1) for case in cases]
    rows["blind_s"] = [sum(last - first for first, last in case.tof.blind_s) for case in cases]
    rows["wrong_share"] = [(e[each.matches > 0] > WRONG_M).mean() for each, e in zip(results, errors, strict=True)]
    rows["slip_m"] = [slip_m for _, slip_m in slips]
    rows["slip_s"] = [each.corrected.stamp_s[k] for each, (k, _) in zip(results, slips, strict=True)]
    rows["wrong"] = rows["wrong_share"] > WRONG_SHARE
    return rows


def start_runs(folder: Path) -> pd.DataFrame:
    """The rows of `from_poor_starts` that notebook 04 wrote, as runs of the report's vertical flight without duration
    or noise, so that claims on them are judged like the others. Raises `InputError`."""
    with reading(folder / "starts.csv", "registrations from poor starts, which notebook 04 writes"):
        rows = pd.read_csv(folder / "starts.csv", usecols=START_COLUMNS)
    case = {"sensor": "report", "trajectory": "vertical", "noise": "", "duration_s": 0.0, "blind": ""}
    return rows.assign(status="ok", **case)


LIMIT_M, EXTENT_M, PAIRS_SHOWN = 0.5, 1.6, 150
REACHING = "a longer tof.range_max_m and preprocess.crop_m, a lower preprocess.floor_m"
"""What lets a scan see more, for a message."""
START = np.eye(4)
"""Where the scan starts: turned by 8° about the line of sight and shifted by 30 cm."""
START[:3, :3] = Rotation.from_euler("x", 8, degrees=True).as_matrix()
START[:3, 3] = 0.0, -0.25, 0.17


class IcpStep(NamedTuple):
    """A source ``(N, 3)`` at one step, and the target points ``(K, 3)`` that ``paired (K,)`` rows of it have."""

    source: Array
    paired: IntArray
    matched: Array


def icp_steps(source: Array, target: Array, limit_m: float, rounds: int = 50) -> dict[str, IcpStep]:
    """Register a source ``(N, 3)`` to a target ``(M, 3)`` by point-to-point ICP (Besl, McKay 1992), with pairs up to
    ``limit_m`` apart. Returns the source with its pairs after each step of the first round, and after ``rounds``.
    Raises `InputError` without a pair.
    """
    tree, steps = KDTree(target), {}
    for k in range(rounds):
        distance_m, match = tree.query(source, distance_upper_bound=limit_m)
        paired = np.flatnonzero(np.isfinite(distance_m)).astype(np.int64)
        if not len(paired):
            raise InputError(f"no pair within {limit_m} m of {len(source)} and {len(target)} points")
        matched = target[match[paired]]
        motion = least_squares_motion(source[paired], matched)
        if k == 0:
            centred = source + (matched.mean(axis=0) - source[paired].mean(axis=0))
            steps["nearest points are paired"] = IcpStep(source, paired, matched)
            steps["the centres of the pairs coincide"] = IcpStep(centred, paired, matched)
        source = transform_points(motion, source)
        if k == 0:
            steps["rotated by the SVD"] = IcpStep(source, paired, matched)
    steps[f"after {rounds} rounds"] = IcpStep(source, paired, matched)
    return steps


def figure_icp_steps(flight: Flight, truth: Truth, frame: int, preprocess: PreprocessSettings) -> Figure:
    """Scan ``frame`` of a flight, turned and shifted by `START`, on its way to the scan before it: one panel for each
    of `icp_steps`, in the drone's frame, seen from the drone. Grey lines join pairs."""
    T_world_drone = truth.trajectory.at(flight.prior.stamp_s).T_world_drone[[frame, frame - 1]]
    scan, reference = (
        preprocess_scan(flight.scans[k], T, flight.T_drone_sensor, preprocess)
        for k, T in zip((frame, frame - 1), T_world_drone, strict=True)
    )
    reference = transform_points(np.linalg.inv(T_world_drone[0]) @ T_world_drone[1], reference)
    try:
        steps = icp_steps(transform_points(START, scan), reference, LIMIT_M)
    except InputError as fault:
        raise InputError(f"scans {frame} and {frame - 1}: {fault}; expected more in view: {REACHING}") from None
    figure = Figure(figsize=(13, 4.1), layout="constrained")
    for panel, (title, step) in zip(figure.subplots(1, len(steps), sharey=True), steps.items(), strict=True):
        shown = step.paired[:: max(1, len(step.paired) // PAIRS_SHOWN)]
        joined = np.isin(step.paired, shown)
        panel.plot(
            *np.stack([step.source[shown], step.matched[joined]])[..., 1:].transpose(2, 0, 1), color=GREY, lw=0.7
        )
        panel.scatter(*reference[:, 1:].T, s=3, color=BLACK, lw=0, label="reference cloud P, the scan before")
        panel.scatter(*step.source[:, 1:].T, s=3, color=ORANGE, lw=0, label="scan Q")
        panel.set(aspect="equal", xlabel="to the left (m)", xlim=(EXTENT_M, -EXTENT_M), ylim=(-EXTENT_M, EXTENT_M))
        panel.set_title(title, size=10)
    figure.axes[0].set_ylabel("up (m)")
    gather_legend(figure, ncols=2, markerscale=4)
    return figure
