"""Notebook 11: what the accuracy rests on; the same odometries in worlds in which none of their settings was chosen."""

from typing import Any

import pandas as pd

from steelnb.report.batch import caption, seeds_text
from steelnb.report.style import COLOURS, GREY, LABELS, Figure, draw_legend, draw_sample, style
from steelnb.settings import FlightSettings

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
SENSORS = {"report": "the report's sensor", "starling2-honest": HONEST}
OURS = ("least_squares_yaw", "best", "combined", "faces", "smoothed", "calibrated")
"""Methods whose settings were chosen here, by segments and by all points: notebook 17 compares the others."""


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


def world_runs(runs: pd.DataFrame, trajectory: str) -> pd.DataFrame:
    """The runs of a study on one flight under the random walk, seeing all the time, with the ``world`` of each, in the
    order of a figure; of `OURS`, those of the report's sensor only with methods that also fly with another one. Other
    sensors than the usual one count with the settings of their presets."""
    chosen = (runs["trajectory"] == trajectory) & (runs["status"] == "ok") & (runs["blind"] == "")
    chosen &= runs["noise"].isin(["random-walk", "random-walk+tilt"]) & (runs["duration_s"] == 200.0)
    others = set(runs.loc[(runs["sensor"] != "report") & runs["method"].isin(OURS), "method"])
    found = runs[chosen & runs["method"].isin(others) & (~runs["sensor"].isin(SENSORS) | (runs["variant"] == ""))]
    columns = ["variant", "noise", "sensor", "trajectory"]
    worlds = [world_of(*row) for row in found[columns].itertuples(index=False)]
    order = [USUAL_WORLD, HONEST, TILTED, UPRIGHTED, "stand-off + 1 m", "stand-off + 2 m", *WORLDS.values()]
    known = [*order, *dict.fromkeys(world for world in worlds if world not in order)]
    return found.assign(world=pd.Categorical(worlds, known)).sort_values(["world", "method", "seed"], kind="stable")


def with_worlds(runs: pd.DataFrame, other: pd.DataFrame) -> pd.DataFrame:
    """Runs of the usual world, and below them those of `world_runs` that are of another, with their ``world``."""
    more = other[other["world"] != USUAL_WORLD]
    return pd.concat([runs.assign(world=USUAL_WORLD), more.assign(world=more["world"].astype(str))])


def world_table(runs: pd.DataFrame) -> pd.DataFrame:
    """A row a world and method of `world_runs`: seeds, mean and worst ATE, that of the drift, and in how many seeds the
    correction is worse than the drift."""
    worse = runs.assign(worse=runs["ate_rmse_m"] > runs["raw_ate_rmse_m"])
    return (
        worse.groupby(["world", "method"], observed=True, sort=True)
        .agg(
            seeds=("seed", "nunique"), ate_mean_m=("ate_rmse_m", "mean"), ate_worst_m=("ate_rmse_m", "max"),
            drift_mean_m=("raw_ate_rmse_m", "mean"), worse_than_drift=("worse", "sum"),
        )
        .reset_index()
    )  # fmt: skip


def worlds_sentence(table: pd.DataFrame) -> str:
    """The range of each method over the worlds, and where one is worse than the drift."""
    other = table[table["world"] != USUAL_WORLD]
    ranges = [
        f"{LABELS[str(method)]}: {100 * rows['ate_mean_m'].min():.1f} to {100 * rows['ate_mean_m'].max():.1f} cm"
        for method, rows in other.groupby("method", sort=False)
    ]
    lost = table[table["worse_than_drift"] > 0]
    failures = [
        f"{LABELS[row['method']]} with {row['world']} ({row['worse_than_drift']} of {row['seeds']} seeds, "
        f"{100 * row['ate_mean_m']:.0f} cm against {100 * row['drift_mean_m']:.0f})"
        for row in lost.to_dict("records")
    ]
    end = f"Worse than the drift: {'; '.join(failures)}." if failures else "None is worse than the drift."
    return f"Mean ATE in the other worlds: {'; '.join(ranges)}. {end}"


@style()
def figure_worlds(runs: pd.DataFrame) -> Figure:
    """ATE of each run of `world_runs`, a row a world, on a logarithmic scale, with that of the drift behind."""
    worlds = [world for world in runs["world"].cat.categories if (runs["world"] == world).any()]
    methods = sorted(set(runs["method"]))
    figure = Figure(figsize=(9.5, 1.6 + 0.75 * len(worlds)))
    panel = figure.add_subplot()
    for row, world in enumerate(worlds):
        here = runs[runs["world"] == world]
        drift = here.drop_duplicates("seed")["raw_ate_rmse_m"]
        panel.plot(
            100 * drift, [row] * len(drift), "|", color=COLOURS["none"], markersize=24, markeredgewidth=2, zorder=0
        )
        for k, method in enumerate(methods):
            ate = 100 * here.loc[here["method"] == method, "ate_rmse_m"].to_numpy()
            if len(ate):
                place = row + 0.8 / len(methods) * (k - 0.5 * (len(methods) - 1))
                draw_sample(panel, place, ate, COLOURS[method], width=0.6 / len(methods), across=True, markersize=5)
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter("{x:g}")
    panel.set_yticks(range(len(worlds)), worlds)
    panel.set(xlabel="ATE, root mean square (cm)", ylim=(len(worlds) - 0.4, -0.6))
    keys: dict[str, dict[str, Any]] = {
        LABELS[method]: {"color": COLOURS[method], "marker": "o", "ls": ""} for method in methods
    }
    keys |= {"mean": {"color": COLOURS["truth"], "lw": 2.0}}
    keys |= {LABELS["none"]: {"color": COLOURS["none"], "marker": "|", "ls": "", "ms": 14, "mew": 2}}
    draw_legend(figure, keys, ncols=4)
    usual = runs[runs["world"] == USUAL_WORLD]
    seeds = sorted({*runs.groupby(["world", "method"], observed=True)["seed"].nunique()})
    number = f"{seeds[0]} to {seeds[-1]} seeds" if len(seeds) > 1 else seeds_text(runs["seed"])
    flown = caption(usual if len(usual) else runs).rpartition(", ")[0]
    figure.suptitle(f"{flown} unless said otherwise, {number} each")
    for side in range(len(worlds) - 1):
        panel.axhline(side + 0.5, color=GREY, linewidth=0.4, alpha=0.5)
    panel.grid(axis="y", visible=False)
    return figure
