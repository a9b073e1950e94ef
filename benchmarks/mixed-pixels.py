"""Mixed pixels of a real Time-of-Flight frame and of simulated ones.

    PYTHONPATH=. .venv/bin/python benchmarks/mixed-pixels.py FOLDER

FOLDER holds a checkout of the repository of the case *cage* of real-recordings.py. Prints a row a frame: of all pixels
between two neighbours whose ranges differ by more than 5, 10 and 30 cm, the share whose own range lies well between
both. See mixed-pixels.md.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.io.clouds import read_points
from steelnb.report.honest import HONEST, IDEAL
from steelnb.settings import ExperimentSettings
from steelnb.simulation import build_tower
from steelnb.simulation.tof import CastScans
from steelnb.simulation.tower import half_width
from steelnb.types import Array, Trajectory

ROWS, COLUMNS = 424, 512
FRAME = "data/Gabbiatrice.pcd"
STEPS_M = (0.05, 0.1, 0.3)
BETWEEN = (0.1, 0.9)
DISTANCES_M, HEIGHT_M = (0.6, 0.9), 3.0
FAULTS = ("lateral_px", "exposure_s", "multipath")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    points = read_points(parser.parse_args().folder / FRAME)
    range_m = np.linalg.norm(points, axis=1).reshape(COLUMNS, ROWS).T / 1000
    frames = {"a steel cage, real": np.where(range_m > 0, range_m, np.nan)}
    sharp = dict.fromkeys(FAULTS, 0.0)
    for distance_m in DISTANCES_M:
        frames |= {
            f"the tower from {distance_m} m, {IDEAL}": simulated(IDEAL, distance_m, {}),
            f"from {distance_m} m, {HONEST} without jitter, blur, multipath": simulated(HONEST, distance_m, sharp),
            f"from {distance_m} m, {HONEST}": simulated(HONEST, distance_m, {}),
        }
    print("| frame | " + " | ".join(f"steps above {100 * step:g} cm: share between (of)" for step in STEPS_M) + " |")
    print("|---|" + "---|" * len(STEPS_M))
    for name, frame in frames.items():
        places = [between(frame, step) for step in STEPS_M]
        cells = (f"{100 * ((at > BETWEEN[0]) & (at < BETWEEN[1])).mean():.0f} % ({len(at)})" for at in places)
        print(f"| {name} | {' | '.join(cells)} |")


def between(range_m: Array, step_m: float) -> Array:
    """Where ranges lie between those of their two neighbours in a row or a column, 0 at the nearer and 1 at the farther
    one, for all that differ by more than ``step_m``."""
    found = []
    for image in (range_m, range_m.T):
        one, own, other = image[:, :-2], image[:, 1:-1], image[:, 2:]
        apart = np.abs(other - one)
        step = apart > step_m  # not where one of them is missing
        found.append(((own - np.minimum(one, other)) / np.where(step, apart, 1.0))[step & np.isfinite(own)])
    return np.concatenate(found)


def simulated(sensor: str, distance_m: float, faults: dict[str, float]) -> Array:
    """Ranges ``(424, 512)`` of the tower by a sensor with the real one's pixels and field of view, held still."""
    tof = ExperimentSettings.preset(sensor=sensor).tof.replace(
        rows=ROWS, columns=COLUMNS, fov_horizontal_rad=np.radians(70), fov_vertical_rad=np.radians(60), range_max_m=3.0
    )
    if tof.faults:
        tof = tof.replace(faults=tof.faults.replace(**faults))
    tower, T = build_tower(), np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [np.pi / 2 + 0.3, 0.1, 0.0]).as_matrix()
    T[:3, 3] = -0.3, -half_width(tower.settings, HEIGHT_M) - distance_m, HEIGHT_M
    stamp_s = np.arange(0.0, 0.05, 0.001)
    still = Trajectory(stamp_s, np.tile(T, (len(stamp_s), 1, 1)))
    return next(CastScans(tower, still, np.eye(4), tof, 1).cast())[0].astype(np.float64)


if __name__ == "__main__":
    main()
