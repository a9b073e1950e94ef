"""Notebooks 11, 15 and 17: the runs of a study that are compared, their means over the seeds, and a dot for each."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from steelnb.report.batch import caption
from steelnb.report.style import BLACK, COLOURS, GREY, LABELS, Figure, draw_legend, draw_sample, style
from steelnb.settings import FlightSettings

FLIGHT_S = 200.0
USUAL_WORLD = "as preset"
HONEST = "a sensor with all faults of real ones"
TILTED, UPRIGHTED = "roll and pitch off by 1°", "roll and pitch off by 1°, estimated"
WORLDS = {
    "tower.base_width_m=1.6": "tower 1.6 m wide at the base",
    "tower.base_width_m=6.0": "tower 6 m wide at the base",
    "tower.bracing_section_m": "legs of 20 cm, bracing of 4.5 cm",
    "flight.gust_sigma_m_s=1.0": "gusts of 1 m/s, 1.5 × the speed",
}
"""Variant of a study's run, or its beginning, and what to call it; stand-offs are named by what they add."""
SENSORS = {"report-4cm": "the report's sensor", "starling2-honest": HONEST}
OURS = ("least_squares_yaw", "best", "combined", "faces", "smoothed")
"""Methods whose settings were chosen here, by segments and by all points: notebook 17 compares the others."""
MARKERS = "o^sDv"


def whole_flights(study: pd.DataFrame, **wanted: Sequence[str]) -> pd.DataFrame:
    """The runs of a study over `FLIGHT_S` that ended well and saw the tower all the time, whose columns have one of the
    values ``wanted``; in the order of these, the last column changing first, and of the seeds."""
    chosen = (study["status"] == "ok") & (study["blind"] == "") & (study["duration_s"] == FLIGHT_S)
    for name, values in wanted.items():
        chosen &= study[name].isin(values)
    runs = study[chosen]
    ranks = [runs[name].map(list(values).index).to_numpy() for name, values in reversed(wanted.items())]
    return runs.iloc[np.lexsort(np.array([runs["seed"].to_numpy(), *ranks]))]


def over_seeds(runs: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """A row for each value of the columns ``by``: the number of seeds, mean and worst ATE, and that of the drift,
    metres."""
    groups = runs.groupby(list(by), sort=False, observed=True)
    return groups.agg(
        seeds=("seed", "nunique"), ate_mean_m=("ate_rmse_m", "mean"), ate_worst_m=("ate_rmse_m", "max"),
        drift_mean_m=("raw_ate_rmse_m", "mean"),
    ).reset_index()  # fmt: skip


def world_of(variant: str, noise: str, sensor: str, trajectory: str) -> str:
    """The name of the world of a run: its variant, the tilt of its prior, or its sensor."""
    if "tilt" in noise:
        return UPRIGHTED if variant.startswith("tilt_sigma_rad=") else TILTED
    if not variant and sensor in SENSORS:
        return SENSORS[sensor]
    if variant.startswith("flight.standoff_m="):
        more = float(variant.partition("=")[2]) - FlightSettings.preset(trajectory).standoff_m  # type: ignore[arg-type]
        return f"stand-off + {more:g} m"
    return next((name for start, name in WORLDS.items() if variant.startswith(start)), variant or USUAL_WORLD)


def world_runs(study: pd.DataFrame, trajectory: str) -> pd.DataFrame:
    """The runs of a study on one flight under the random walk, with the ``world`` of each, in the order of a figure; of
    `OURS`, those of the report's sensor only with methods that also fly with another one. Other sensors than the usual
    one count with the settings of their presets."""
    others = set(study.loc[study["sensor"] != "report-4cm", "method"]) & set(OURS)
    found = whole_flights(study, trajectory=[trajectory], noise=["random-walk", "random-walk+tilt"])
    found = found[found["method"].isin(others) & (~found["sensor"].isin(SENSORS) | (found["variant"] == ""))]
    columns = ["variant", "noise", "sensor", "trajectory"]
    worlds = [world_of(*row) for row in found[columns].itertuples(index=False)]
    order = [USUAL_WORLD, HONEST, TILTED, UPRIGHTED, "stand-off + 1 m", "stand-off + 2 m", *WORLDS.values()]
    known = [*order, *dict.fromkeys(world for world in worlds if world not in order)]
    return found.assign(world=pd.Categorical(worlds, known)).sort_values(["world", "method", "seed"], kind="stable")


def with_worlds(runs: pd.DataFrame, other: pd.DataFrame) -> pd.DataFrame:
    """Runs of the usual world, and below them those of `world_runs` that are of another, with their ``world``."""
    more = other[other["world"] != USUAL_WORLD]
    return pd.concat([runs.assign(world=USUAL_WORLD), more.assign(world=more["world"].astype(str))])


@style()
def figure_runs(
    runs: pd.DataFrame,
    rows: str,
    beside: str = "method",
    down: str | None = None,
    across: str | None = None,
    limits_m: Mapping[str, float] | None = None,
) -> Figure:
    """ATE of each run as a dot on a logarithmic scale, with the means, over the range of the drift.

    A row for each value of the column ``rows``, and in it the values of ``beside`` one below the other; panels below
    and beside each other for each value of the columns ``down`` and ``across``. The colour is that of the method; where
    that is what the rows are, the marker tells what is ``beside``. ``limits_m`` are lines, by names in the legend.
    """
    known = {name: place for place, name in enumerate(LABELS)}
    names, parts = (sorted(dict.fromkeys(runs[each]), key=lambda name: known.get(name, 0)) for each in (rows, beside))
    low, wide = (list(dict.fromkeys(runs[column])) if column else [""] for column in (down, across))
    marks = {part: "o" if beside == "method" else mark for part, mark in zip(parts, MARKERS * 3, strict=False)}
    height = len(low) * len(names) * (0.15 + 0.07 * len(parts))
    figure = Figure(figsize=(3.2 + max(3.2 * len(wide), 6.3), 1.9 + height))
    grid = figure.subplots(len(low), len(wide), sharex=True, sharey=True, squeeze=False)
    for (i, j), panel in np.ndenumerate(grid):
        here = runs[runs[down] == low[i]] if down else runs
        here = here[here[across] == wide[j]] if across else here
        for place, name in enumerate(names):
            _draw_row(panel, place, here[here[rows] == name], beside, marks)
        for limit_m, dash in zip((limits_m or {}).values(), ("--", ":"), strict=False):
            panel.axvline(100 * limit_m, color=COLOURS["report"], linestyle=dash)
        panel.set(xscale="log", ylim=(len(names) - 0.5, -0.5))
        panel.set_yticks(range(len(names)), [LABELS.get(name, name) for name in names])
        panel.grid(axis="y", visible=False)
        panel.set_title(", ".join(filter(None, (low[i], wide[j]))))
    for panel in grid[-1]:
        panel.set_xlabel("ATE, root mean square (cm)")
    keys: dict[str, dict[str, Any]] = {
        LABELS.get(part, part): {"color": COLOURS.get(part, GREY), "marker": mark, "ls": ""}
        for part, mark in marks.items()
    }
    keys |= {"mean": {"color": BLACK, "lw": 2.0}, LABELS["none"]: {"fc": COLOURS["none"], "alpha": 0.25}}
    for name, dash in zip(limits_m or {}, ("--", ":"), strict=False):
        keys[name] = {"color": COLOURS["report"], "ls": dash}
    draw_legend(figure, keys, ncols=4 if across else 3, fontsize=10)
    named = {"trajectory", "sensor", "seed"} - {down, across}
    figure.suptitle(caption(runs[sorted(named, reverse=True)]))
    return figure


def _draw_row(panel: Axes, place: int, runs: pd.DataFrame, beside: str, marks: Mapping[str, str]) -> None:
    """The runs of a row of `figure_runs`, and the range of their drift behind."""
    step = 0.84 / len(marks)
    if len(runs):
        low, high = 100 * runs["raw_ate_rmse_m"].min(), 100 * runs["raw_ate_rmse_m"].max()
        panel.fill_betweenx([place - 0.42, place + 0.42], low, high, color=COLOURS["none"], alpha=0.25, lw=1)
    for k, (part, mark) in enumerate(marks.items()):
        own = runs[runs[beside] == part]
        if len(own):
            at, ate_cm = place + step * (k - 0.5 * (len(marks) - 1)), 100 * own["ate_rmse_m"].to_numpy()
            colour = COLOURS[own["method"].iloc[0]]
            draw_sample(panel, at, ate_cm, colour, mark, width=0.7 * step, across=True, ms=4)
