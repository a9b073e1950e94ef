"""Notebook 05: basins of convergence of a registration, and flights that converge to a wrong bar (Figure 3.10)."""

import copy
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.colors import ListedColormap
from matplotlib.patches import Circle

from steelnb import experiment, rng
from steelnb.experiment import Result
from steelnb.metrics import basin_radius_m, largest_slip, position_error_m
from steelnb.odometry import CloudOdometry
from steelnb.odometry.report_clouds import PROGRAMS
from steelnb.points import preprocess_scan
from steelnb.report.batch import caption, case_of, make_cases
from steelnb.report.style import BLACK, COLOURS, GREY, LABELS, Figure, draw_legend, style
from steelnb.row import WRONG_M, paired_clouds
from steelnb.settings import ExperimentSettings, ReportCloudSettings, TrajectoryName
from steelnb.simulation import Truth
from steelnb.types import Array, Flight

WRONG_SHARE_MAX = 0.05
"""A flight in which more of the scans with pairs ended farther than `WRONG_M` from the truth has converged wrongly."""
RIGHT_M = 0.1
"""An end within this distance of the truth is right: the edge of the report's voxel."""
MAP_EVERY = 4


def basin_cases(
    trajectory: TrajectoryName,
    sensor: str,
    noise: str,
    correspondence_m: Sequence[float],
    seed: rng.Seed,
    duration_s: float,
    overrides: dict[str, Any],
) -> dict[str, ExperimentSettings]:
    """The registrations whose basins are compared, by label: 3-DoF ICP with each largest distance, GICP, ``best``."""
    methods: list[str | tuple[str, dict[str, Any]]] = [*narrowed(correspondence_m), "gicp", "best"]
    cases = make_cases([trajectory], sensor, [noise], methods, seed, duration_s, overrides)
    return {label(case): case for case in cases}


def search_cases(
    trajectory: Sequence[TrajectoryName],
    sensor: str,
    noise: Sequence[str],
    correspondence_m: Sequence[float],
    seed: Sequence[rng.Seed],
    duration_s: float,
    blind_s: Sequence[Sequence[float]],
    overrides: dict[str, Any],
) -> list[ExperimentSettings]:
    """3-DoF ICP with each largest distance and the report's program for it, on every seed, flight and noise, with the
    tower in sight all the time and with the gaps ``blind_s`` that end before the flight does."""
    gaps = [list(gap) for gap in blind_s if gap[1] < duration_s]
    methods: list[str | tuple[str, dict[str, Any]]] = [*narrowed(correspondence_m), "report-icp-3dof"]
    return [
        case
        for one, flight, sight in itertools.product(seed, trajectory, ({}, {"tof.blind_s": gaps}))
        for case in make_cases([flight], sensor, noise, methods, one, duration_s, {**overrides, **sight})
    ]


def narrowed(correspondence_m: Sequence[float]) -> list[tuple[str, dict[str, Any]]]:
    """3-DoF ICP with each of some largest distances of a pair, as `batch.make_cases` takes it."""
    return [("icp-3dof", {"clouds.max_correspondence_m": distance}) for distance in correspondence_m]


def label(settings: ExperimentSettings) -> str:
    """Name of a registration, with its largest distance of a pair but for ``best``."""
    method = settings.odometry.method
    return method if method == "best" else f"{LABELS[method]}, {_reach_m(settings):g} m"


def _reach_m(settings: ExperimentSettings) -> float:
    chosen = settings.odometry
    if isinstance(chosen, ReportCloudSettings):
        return PROGRAMS[chosen.program].max_correspondence_m
    return float(getattr(chosen, "max_correspondence_m", np.nan))


def beside_best(result: Result, overrides: dict[str, Any]) -> tuple[dict[str, Result], dict[str, tuple[Array, Array]]]:
    """A run of 3-DoF ICP and one of ``best`` on the same scans, by label, and the built and the true cloud of each.

    ``overrides`` are those of the run, but for its method and its gaps.
    """
    case = result.settings
    more = {**overrides, "tof.blind_s": [list(gap) for gap in case.tof.blind_s]}
    (best,) = make_cases(
        [case.flight.trajectory], case.sensor, [case.noise_name], ["best"], case.seed, case.flight.duration_s, more
    )
    flight, truth = experiment.simulate(case)
    pair = {label(case): result, "best": experiment.estimate(best, experiment.redrift(best, flight, truth), truth)}
    return pair, {name: paired_clouds(flight, run, every=2) for name, run in pair.items()}


def find_basin(
    settings: ExperimentSettings,
    flight: Flight,
    truth: Truth,
    frame: int,
    offset_m: Array,
    on_progress: Callable[[float], None] | None = None,
) -> pd.DataFrame:
    """Basin of convergence: register scan ``frame`` from starts ``offset_m (N, 3)`` beside its true pose, to a map of
    one in `MAP_EVERY` of the other scans at their true poses; a row a start.

    ``x_m``, ``y_m``, ``z_m`` of the start and ``error_m`` of the end from the truth; ``refused`` by the odometry; else
    ``right`` within `RIGHT_M`, or ``wrong``, of which those ``stayed`` that hardly left their start, since the
    registration trusts its prior, while the others ``locked`` onto something else.
    Raises `InputError` for an odometry without clouds.
    """
    odometry = CloudOdometry(settings.odometry, flight.T_drone_sensor)
    true = truth.trajectory.at(flight.prior.stamp_s).T_world_drone
    for k in range(0, len(flight.scans), MAP_EVERY):
        if k != frame:
            points = preprocess_scan(flight.scans[k], true[k], flight.T_drone_sensor, settings.odometry.preprocess)
            odometry.insert(points, true[k])
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


def offset_grid(reach_m: float, step_m: float) -> Array:
    """Offsets ``(N, 3)`` along x and z from −``reach_m`` to ``reach_m``, rows of z, in steps of about ``step_m``."""
    side = np.linspace(-reach_m, reach_m, 2 * round(reach_m / step_m) + 1)
    x, z = np.meshgrid(side, side)
    return np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()])


def basin_table(basins: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """One row a registration: the radius of its basin, within which all starts end right, and the share of its starts
    that did, ended wrong, stayed, locked, or were refused."""
    kinds = ["right", "wrong", "stayed", "locked", "refused"]
    table = pd.DataFrame({label: basin[kinds].mean().add_suffix("_share") for label, basin in basins.items()}).T
    radii = [
        basin_radius_m(basin[["x_m", "y_m", "z_m"]].to_numpy(), basin["right"].to_numpy()) for basin in basins.values()
    ]
    table.insert(0, "radius_m", radii)
    return table


@style()
def figure_basins(
    basins: Mapping[str, pd.DataFrame], table: pd.DataFrame, settings: ExperimentSettings, frame: int
) -> Figure:
    """The final error of each start beside the true pose, a panel for each registration, with its `basin_table`;
    ``settings`` and ``frame`` name the scan.

    Dark is right, light ended elsewhere or, with a dot, stayed, since the registration trusts its prior; grey is
    refused by the odometry. The dashed circle is the largest within which every start converged to the truth.
    """
    figure = Figure(figsize=(4.0 * len(basins) + 0.9, 5.8))
    panels = figure.subplots(1, len(basins), squeeze=False, sharey=True)[0]
    for panel, (label, basin) in zip(panels, basins.items(), strict=True):
        grid = basin.assign(error_m=basin["error_m"].mask(basin["refused"])).pivot(index="z_m", columns="x_m")
        error, refused = grid["error_m"], grid["refused"].astype(float).replace(0.0, np.nan)
        image = panel.pcolormesh(error.columns, error.index, error, cmap="viridis", vmin=0, vmax=1.0, shading="nearest")
        grey = ListedColormap([COLOURS["refused"]])
        panel.pcolormesh(error.columns, error.index, refused, cmap=grey, shading="nearest")
        stayed = basin[basin["stayed"]]
        panel.plot(stayed["x_m"], stayed["z_m"], ".", color=BLACK, markersize=2.5)
        numbers = table.loc[label].to_dict()
        radius = numbers["radius_m"]
        panel.add_patch(Circle((0, 0), radius, fill=False, color="white", linestyle="--", linewidth=1.8))
        panel.plot(0, 0, "+", color="white", markersize=9)
        panel.set(aspect="equal", xlabel="start off along x (m)")
        panel.set_title(
            f"{label}: radius {radius:.2f} m\nlocked onto something else {numbers['locked_share']:.0%},\n"
            f"stayed {numbers['stayed_share']:.0%}, refused {numbers['refused_share']:.0%}",
            fontsize=11,
        )
        panel.grid(False)
    panels[0].set_ylabel("start off along z (m)")
    bar = figure.colorbar(image, ax=list(panels), shrink=0.75, extend="max")
    bar.set_label(f"error at the end (m); right below {RIGHT_M:g}")
    dot: dict[str, Any] = {"color": BLACK, "marker": ".", "ls": "", "ms": 5}
    keys = {
        "refused: the odometry keeps the prior": {"fc": COLOURS["refused"]},
        "stayed at its start: it trusts its prior": dot,
        "basin: all starts within converge to the truth": {"color": GREY, "ls": "--"},
    }
    draw_legend(figure, keys, ncols=2)
    figure.suptitle(f"Scan {frame} of {caption(pd.DataFrame([case_of(settings)]))}")
    return figure


def find_slips(results: Sequence[Result]) -> pd.DataFrame:
    """False convergence in flight, a row a run.

    ``wrong_share`` of the scans that had pairs ended farther than `WRONG_M` from the truth; ``slip_m`` is the largest
    growth of the error within a second over such scans, at ``slip_s``. More than `WRONG_SHARE_MAX` is ``wrong``.
    """
    rows = []
    for result in results:
        settings = result.settings
        error = position_error_m(result.corrected, result.truth.trajectory)
        paired = result.matches > 0
        scan, slip = largest_slip(error, max(1, round(settings.tof.rate_hz)))
        rows.append(
            {
                **case_of(settings),
                "max_correspondence_m": _reach_m(settings),
                "blind_s": sum(last - first for first, last in settings.tof.blind_s),
                "ate_rmse_m": result.metrics["ate_rmse_m"],
                "error_final_m": result.metrics["error_final_m"],
                "wrong_share": float((error[paired] > WRONG_M).mean()) if paired.any() else 0.0,
                "slip_m": slip,
                "slip_s": float(result.corrected.stamp_s[scan]),
            }
        )
    slips = pd.DataFrame(rows)
    return slips.assign(wrong=slips["wrong_share"] > WRONG_SHARE_MAX)
