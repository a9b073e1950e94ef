"""Planned flights over many seeds and towers, in gusts: sight, information, distance to steel, collisions, and what a
flight over the whole tower lets one rebuild.

    PYTHONPATH=. .venv/bin/python benchmarks/planned-flights.py [--seeds 101 102 …] [--duration 60] [--flight planned …]
        [--sensor report …] [--tower report heavy light] [--gust 0.5] [--rebuild] [--workers 2]

Every flight drifts by the random walk and is corrected by `combined`, which steers the planned ones. With
``--rebuild``, each is then smoothed, and its bars are found and scored. Prints a row for each flight, and the tables
of planned-flights.md: means over the seeds with their 95 % intervals.
"""

# ruff: noqa: E402 - libraries count their threads when they are imported
import argparse
import itertools
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"

import pandas as pd

from steelnb import experiment
from steelnb.errors import CollisionError
from steelnb.fusion.reconstruct import reconstruct
from steelnb.metrics.reconstruction import reference, score_structure
from steelnb.report.intervals import mean_over_seeds, share_of_seeds
from steelnb.report.planned_flights import FLIGHTS, flight_table, fly_all, make_flights
from steelnb.settings import OdometrySettings, TowerSettings

CASE = ("flight", "sensor", "tower", "seed")
SCALES = {
    "few_share": ("scans with few returns (%)", 100.0),
    "no_pair_share": ("scans without a pair (%)", 100.0),
    "ate_rmse_m": ("ATE (mm)", 1e3),
    "bound_ratio": ("worst / median bound", 1.0),
    "clearance_m": ("least distance from the middle of a member (m)", 1.0),
    "seen_share": ("steel seen (%)", 100.0),
    "smoothed_ate_m": ("ATE, smoothed (mm)", 1e3),
    "structure_recall": ("recall", 1.0),
    "edge_recall": ("recall of edges", 1.0),
    "members_seen": ("members seen well enough (%)", 100.0),
}
"""Columns of the table of means: what they are called, and their factor."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(101, 131)))
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--flight", choices=FLIGHTS, nargs="+", default=["planned"])
    parser.add_argument("--sensor", nargs="+", default=["report"])
    parser.add_argument("--tower", nargs="+", default=["tapered", "heavy", "light"])
    parser.add_argument("--gust", type=float, default=0.5)
    parser.add_argument("--rebuild", action="store_true")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    cases = list(itertools.product(arguments.flight, arguments.sensor, arguments.tower, arguments.seeds))
    look = partial(row, arguments.duration, arguments.gust, arguments.rebuild)
    rows = []
    with ProcessPoolExecutor(arguments.workers) as pool:
        for each in pool.map(look, cases):
            rows.append(each)
            shown = (f"{value:.4g}" if isinstance(value, float) else str(value) for value in each.values())
            print(" ".join(f"{name}={value}" for name, value in zip(each, shown, strict=True)), flush=True)
    print("\n".join(["", *table(pd.DataFrame(rows))]))


def row(duration_s: float, gust_m_s: float, rebuilt: bool, case: tuple[str, str, str, int]) -> dict[str, Any]:
    """What came of one flight; of one that hit something, only that."""
    name, sensor, tower, seed = case
    changes = {"flight.gust_sigma_m_s": gust_m_s}
    settings = make_flights([name], "random-walk", "combined", sensor, seed, duration_s, changes)[name]
    settings = settings.replace(tower=TowerSettings.preset(tower))
    found: dict[str, Any] = dict(zip(CASE, case, strict=True))
    try:
        flown = fly_all({name: settings})
    except CollisionError as error:
        return {**found, "collision": 1, "why": str(error)}
    found |= {"collision": 0, **{str(column): value for column, value in flight_table(flown).iloc[0].items()}}
    if rebuilt:
        flight, truth = flown[name].flight, flown[name].result.truth
        smoothed = experiment.estimate(
            settings.replace(odometry=OdometrySettings.preset("smoothed", sensor)), flight, truth
        )
        structure = reconstruct(flight.scans, smoothed.corrected.T_world_drone, flight.T_drone_sensor)
        score = score_structure(structure, reference(truth.tower, truth.visibility)).metrics
        found |= {
            "smoothed_ate_m": smoothed.metrics["ate_rmse_m"],
            "structure_recall": score["recall"],
            "edge_recall": score["edge_recall"],
        }
    return found


def table(rows: pd.DataFrame) -> Iterator[str]:
    """Lines of Markdown: for each flight, sensor and tower, the number of collisions and the means over the seeds."""
    columns = [name for name in SCALES if name in rows]
    heads = ["flight", "sensor", "tower", "seeds", "collisions", *(SCALES[name][0] for name in columns)]
    yield f"| {' | '.join(heads)} |"
    yield "|---" * len(heads) + "|"
    for case, chosen in rows.groupby(["flight", "sensor", "tower"], sort=False):
        hit = share_of_seeds(chosen["collision"].to_numpy(dtype=float))
        cells = [*map(str, case), f"{len(chosen)}", f"{int(chosen['collision'].sum())} (≤ {100 * hit.high:.0f} %)"]
        for name in columns:
            values = SCALES[name][1] * chosen[name].dropna().to_numpy()
            if len(values) < 2:
                cells.append(", ".join(f"{value:.3g}" for value in values))
                continue
            mean = mean_over_seeds(values)
            worst = values.min() if name in LEAST else values.max()
            cells.append(f"{mean.estimate:.3g} ({mean.low:.3g} to {mean.high:.3g}; worst {worst:.3g})")
        yield f"| {' | '.join(cells)} |"


LEAST = ("clearance_m", "seen_share", "structure_recall", "edge_recall", "members_seen")
"""Columns whose worst value is the least."""


if __name__ == "__main__":
    main()
