"""The planner beside the orbit of the report: sight, information, error and clearance.

    PYTHONPATH=. .venv/bin/python benchmarks/planner.py [--seeds 101 102 …] [--duration 200] [--sensor report starling2]
        [--method combined] [--workers 2]

Each flight has the random walk. *Planned* goes around the tower as far, as high and as fast as *orbit*; *view only* and
*information only* are without the other barriers. Prints a row for each sensor and flight, means over the seeds, with
the number of flights that touched the tower; the times are those of a machine that does nothing else.
"""

import argparse
import itertools
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from steelnb import experiment
from steelnb.closed_loop import OnboardPilot
from steelnb.errors import CollisionError
from steelnb.metrics import score_segments, score_trajectory
from steelnb.metrics.limit import gather, see
from steelnb.settings import ExperimentSettings
from steelnb.simulation import build_tower, fly, scan_flight

FLIGHTS: dict[str, dict[str, Any]] = {
    "orbit": {},
    "planned": {},
    "view only": {"flight.planner.keep_information": False},
    "information only": {"flight.planner.keep_view": False},
}
POINTS_MIN = 300


def one(sensor: str, flight: str, seed: int, duration_s: float, method: str) -> dict[str, float]:
    """Numbers of a flight; of one that ends in a collision, that it did."""
    trajectory: Any = "orbit" if flight == "orbit" else "planned"
    settings = ExperimentSettings.preset(trajectory, "random-walk", method, sensor, seed, duration_s, FLIGHTS[flight])
    tower, decide_ms = build_tower(settings.tower), list[float]()
    try:
        if trajectory == "orbit":
            flown, truth = experiment.simulate(settings)
            result = experiment.estimate(settings, flown, truth)
            corrected, matches, segments = result.corrected, result.matches, result.segments
            scans, visibility, true = flown.scans, truth.visibility, truth.trajectory
        else:
            pilot = timed(OnboardPilot(settings, tower), decide_ms)
            true, _ = fly(tower, settings.flight, seed, pilot)
            scans, visibility = scan_flight(tower, true, settings.tof.T_drone_sensor, settings.tof, seed)
            corrected, matches = pilot.estimate()
            segments = pilot.odometry.map_segments()
    except CollisionError:
        return {"collisions": 1.0}
    returns = np.array([np.isfinite(scan.points[..., 0]).sum() for scan in scans])
    at = true.at(corrected.stamp_s)
    information = gather(see(tower, at.T_world_drone, settings.tof)).pose
    sigma = 1 / np.sqrt(np.maximum(np.linalg.eigvalsh(information)[:, 0], 1e-9))
    turned = np.einsum("nki,nkj->nij", at.T_world_drone[:, :3, :3], corrected.T_world_drone[:, :3, :3])
    return {
        "collisions": 0.0,
        "few points": float((returns[: len(at)] < POINTS_MIN).mean()),
        "no pair": float((matches[1:] == 0).mean()),
        "ate_m": score_trajectory(corrected, true)["ate_rmse_m"],
        "yaw_deg": float(np.degrees(np.arctan2(turned[:, 1, 0], turned[:, 0, 0])).mean()),
        "bound_ratio": float(sigma.max() / np.median(sigma)),
        "bound_median_m": float(np.median(sigma)),
        "recall": score_segments(segments, tower.axes, observed=visibility.observed()).recall,
        "decide_ms": float(np.median(decide_ms)) if decide_ms else np.nan,
        "decide_p99_ms": float(np.percentile(decide_ms, 99)) if decide_ms else np.nan,
    }


def timed(pilot: OnboardPilot, into: list[float]) -> OnboardPilot:
    """The pilot, whose decisions are timed."""
    decide = pilot.planner.decide

    def clocked(*given: Any) -> Any:
        begin = time.perf_counter()
        decision = decide(*given)
        into.append(1e3 * (time.perf_counter() - begin))
        return decision

    pilot.planner.decide = clocked  # type: ignore[method-assign]
    return pilot


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102])
    parser.add_argument("--duration", type=float, default=200.0)
    parser.add_argument("--sensor", nargs="+", default=["report", "starling2"])
    parser.add_argument("--method", default="combined")
    parser.add_argument("--flight", choices=FLIGHTS, nargs="+", default=list(FLIGHTS))
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    cases = list(itertools.product(given.sensor, given.flight))
    heads = ["sensor", "flight", "seeds", "touched", "< 300 points", "no pair", "ATE (mm), mean / worst", "yaw (°)"]
    heads += ["worst / median bound", "median bound (mm)", "recall", "decision (ms), median / p99"]
    print(f"| {' | '.join(heads)} |\n" + "|---" * len(heads) + "|", flush=True)
    with ProcessPoolExecutor(given.workers) as pool:
        runs = {
            case: [pool.submit(one, *case, seed, given.duration, given.method) for seed in given.seeds]
            for case in cases
        }
        for (sensor, flight), futures in runs.items():
            print(f"| {sensor} | {flight} | {len(futures)} | {row([each.result() for each in futures])} |", flush=True)


def row(found: Iterable[dict[str, float]]) -> str:
    runs = list(found)
    whole = [run for run in runs if not run["collisions"]]
    touched = f"{len(runs) - len(whole)}"
    if not whole:
        return f"{touched} |" + " – |" * 7 + " –"
    of = {name: np.array([run[name] for run in whole]) for name in whole[0]}
    ate, mean = 1e3 * of["ate_m"], {name: float(values.mean()) for name, values in of.items()}
    timing = "–" if np.isnan(mean["decide_ms"]) else f"{mean['decide_ms']:.1f} / {mean['decide_p99_ms']:.1f}"
    return (
        f"{touched} | {mean['few points']:.1%} | {mean['no pair']:.1%} | {ate.mean():.0f} / {ate.max():.0f}"
        f" | {mean['yaw_deg']:+.1f} | {mean['bound_ratio']:.1f} | {1e3 * mean['bound_median_m']:.1f}"
        f" | {mean['recall']:.2f} | {timing}"
    )


if __name__ == "__main__":
    main()
