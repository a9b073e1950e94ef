"""Our methods on the report's tower beside the tapered one: position errors, and the structure from smoothed poses.

    PYTHONPATH=. .venv/bin/python benchmarks/report-ours.py [--seeds 21 22] [--flights vertical orbit]
        [--sections angle] [--sensors report starling2] [--values report-4cm starling2]

Flights of 200 s with a random walk start at `--start`, where the drift is zero. `--values` selects the settings of the
methods: `report-4cm` was chosen with four times the noise, `starling2` are the methods' own. Prints a table of
report.md. With STEELNB_CACHE set to a folder, flights and estimates are kept between calls.
"""

import argparse
import itertools
from dataclasses import replace
from typing import Any

from steelnb import experiment
from steelnb.core.determinism import machine
from steelnb.core.types import Flight, Trajectory
from steelnb.fusion.reconstruct import reconstruct
from steelnb.metrics.structure import reference, score_structure
from steelnb.settings import ExperimentSettings
from steelnb.simulation import Truth

METHODS = ("best", "faces", "smoothed")
VALUES: dict[str, dict[str, Any]] = {
    "report-4cm": {"prior_sigma": (0.05, 0.005), "sigma_filter_px": 1},
    "starling2": {"prior_sigma": (0.05, 0.02), "sigma_filter_px": 0},
    "no robust weights": {"robust_scale": 100.0},
}
"""Settings of the methods that differ between the sensors' presets, and a third choice without robust weights."""
SHOWN = ("recall", "precision", "edge_recall", "edge_precision", "offset_median_m", "joint_error_median_m")


def simulated(settings: ExperimentSettings) -> tuple[Flight, Truth]:
    """The flight, with a position drift that is zero at the first scan."""
    flight, truth = experiment.simulate(settings)
    T_world_drone = flight.prior.T_world_drone.copy()
    T_world_drone[:, :3, 3] -= (flight.prior.position - truth.trajectory.at(flight.prior.stamp_s).position)[0]
    return replace(flight, prior=Trajectory(flight.prior.stamp_s, T_world_drone)), truth


def row(given: tuple[str, ...], section: str, seed: int, values: str | None, start_s: float) -> str:
    """A row of the table: errors in millimetres and the scores of the structure."""
    trajectory, sensor = given
    settings = ExperimentSettings.preset(trajectory, sensor=sensor, seed=seed, duration_s=start_s + 200.0)  # type: ignore[arg-type]
    settings = settings.override({"tower.section": section, "tof.start_s": start_s})
    flight, truth = simulated(settings)
    told, found = [], None
    for method in METHODS:
        odometry = ExperimentSettings.preset(trajectory, sensor=sensor, method=method).odometry  # type: ignore[arg-type]
        for name, value in VALUES[values].items() if values else ():
            odometry = odometry.override({name: value})
        found = experiment.estimate(settings.replace(odometry=odometry), flight, truth)
        told.append(f"{1e3 * found.metrics['ate_rmse_m']:.1f}" + (" !" if found.unsmoothed else ""))
    assert found is not None
    structure = reconstruct(flight.scans, found.corrected.T_world_drone, flight.T_drone_sensor)
    score = score_structure(structure, reference(truth.tower, truth.visibility)).metrics
    told += [f"{1e3 * score[name]:.1f}" if name.endswith("_m") else f"{score[name]:.2f}" for name in SHOWN]
    drift = 1e3 * found.metrics["raw_ate_rmse_m"]
    case = f"{trajectory}, {start_s:g} s | {section} | {sensor} | {values or 'its own'} | {seed} | {drift:.0f}"
    return f"| {case} | {' | '.join(told)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[21, 22])
    parser.add_argument("--flights", nargs="+", default=["vertical", "orbit"])
    parser.add_argument("--sections", nargs="+", default=["angle", "round"])
    parser.add_argument("--sensors", nargs="+", default=["report", "starling2"])
    parser.add_argument("--values", nargs="+", choices=VALUES, help="default: those of the sensor's preset")
    parser.add_argument("--start", type=float, default=0.0, help="seconds at the first scan")
    asked = parser.parse_args()
    print(f"{machine()}\n")
    head = ("flight", "section", "sensor", "values", "seed", "drift", *METHODS, "recall", "precision", "edge recall",
            "edge precision", "offset", "joint error")  # fmt: skip
    print(f"| {' | '.join(head)} |\n{'|---' * len(head)}|")
    for seed, section, values in itertools.product(asked.seeds, asked.sections, asked.values or [None]):
        for given in itertools.product(asked.flights, asked.sensors):
            print(row(given, section, seed, values, asked.start), flush=True)


if __name__ == "__main__":
    main()
