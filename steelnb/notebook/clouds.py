"""The assembled clouds of runs, and how far they are bent."""

from collections.abc import Iterable, Sequence

import pandas as pd

from steelnb import experiment
from steelnb.core.types import Array
from steelnb.metrics import bend
from steelnb.metrics.clouds import paired_clouds
from steelnb.simulation import Tower


def assembled_clouds(results: Sequence[experiment.Result]) -> list[tuple[Array, Array]]:
    """The points of each run at its estimated and at the true poses (`paired_clouds`). Flights are simulated again; a
    flight that several runs share, once."""
    settings = {experiment.world(result.settings): result.settings for result in results}
    flights = {world: experiment.simulate(one)[0] for world, one in settings.items()}
    return [
        paired_clouds(flights[experiment.world(one.settings)], one, one.truth, one.settings.odometry.preprocess)
        for one in results
    ]


def cloud_bends(clouds: Iterable[tuple[Array, Array]], tower: Tower) -> pd.DataFrame:
    """Bend of each pair of `assembled_clouds`, one row per pair: `metrics.bend` about the vertical axis of a tower."""
    axis = tower.vertices[:, :2].mean(axis=0)
    return pd.DataFrame([bend(*pair, axis) for pair in clouds])
