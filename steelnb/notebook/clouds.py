"""The assembled clouds of runs, and how far they are bent."""

from collections.abc import Iterable, Sequence

import pandas as pd

from steelnb import experiment
from steelnb.core.errors import InputError
from steelnb.core.types import Array
from steelnb.metrics import bend
from steelnb.metrics.clouds import paired_clouds
from steelnb.notebook.runs import Flights
from steelnb.simulation import Tower

BENDS = ("bend_deg", "tilt_max_deg", "yaw_max_deg", "offset_max_m", "blur_mean_m")
"""The numbers of a bend."""


def assembled_clouds(results: Sequence[experiment.Result]) -> list[tuple[Array, Array]]:
    """The points of each run at its estimated and at the true poses (`paired_clouds`). Flights are simulated
    again, once for all runs of a flight that follow each other."""
    flights = Flights()
    return [
        paired_clouds(flights(one.settings)[0], one, one.truth, one.settings.odometry.preprocess) for one in results
    ]


def cloud_bends(clouds: Iterable[tuple[Array, Array]], tower: Tower) -> pd.DataFrame:
    """Bend of each pair of `assembled_clouds`, one row per pair: `metrics.bend` about the vertical axis of a tower. NaN
    for a cloud that has too few points, as those of a flight of seconds."""
    axis, rows = tower.vertices[:, :2].mean(axis=0), []
    for pair in clouds:
        try:
            rows.append(bend(*pair, axis))
        except InputError:
            rows.append({})
    return pd.DataFrame(rows, columns=BENDS)
