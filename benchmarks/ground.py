"""Bars of made-up clouds on ground that is sampled more sparsely than the steel, or in rings.

PYTHONPATH=. .venv/bin/python benchmarks/ground.py
"""

import numpy as np

from steelnb.core.types import Array
from steelnb.fusion.cloud_bars import bars_of_cloud
from steelnb.metrics.segments import match_members
from tests.lattice import lattice, scanned
from tests.scanner import seen

HALF_M, SLOPE = 5.0, 0.3
WIDTH_M, NOISE_M = 0.08, 0.01
"""Of the members, and of all points."""


def ground(rng: np.random.Generator, spacing_m: float, slope: float) -> Array:
    """A random sample of a square, with points ``spacing_m`` apart on average."""
    place = rng.uniform(-HALF_M, HALF_M, (int((2 * HALF_M / spacing_m) ** 2), 2))
    return np.column_stack([place, slope * place[:, 0] + rng.normal(0, NOISE_M, len(place))])


def main() -> None:
    """Print right and false bars of each cloud."""
    poles = np.array([[[x, y, SLOPE * x], [x, y, 4.0 + SLOPE * x]] for x in (-3, 0, 3) for y in (-3, 0, 3)])
    cases: dict[str, tuple[Array, float, tuple[int, ...], tuple[float, ...]]] = {
        "mast": (lattice(10, 1.5, 1.0, 6), 0.0, (100, 200, 400, 1000), (0.04, 0.05, 0.06, 0.08, 0.1)),
        "poles": (poles, SLOPE, (200, 1000), (0.04, 0.05, 0.06, 0.08)),
    }
    for name, (bars, slope, densities, spacings) in cases.items():
        for per_m in densities:
            for spacing_m in spacings:
                steel = scanned(bars, per_m, WIDTH_M, NOISE_M)
                cloud = np.concatenate([steel, ground(np.random.default_rng(1), spacing_m, slope)])
                report(f"{name}, {per_m} points/m, ground {spacing_m} m", cloud, bars)
    mast = lattice(8.0, 2.0, 1.0, 4)
    steel = scanned(mast, 400, 0.06, 0.005)
    for stations in (1, 2, 3, 4):
        for beams, half_deg, wall_x in ((16, 15.0, None), (64, 22.5, None), (64, 22.5, -14.0)):
            cloud = np.concatenate([seen(beams, half_deg, wall_x, stations=stations), steel])
            report(f"{beams} beams, {stations} stations{', wall' if wall_x else ''}", cloud, mast)


def report(name: str, cloud: Array, bars: Array) -> None:
    """Print right and false bars of a cloud."""
    right = match_members(bars_of_cloud(cloud).bars, bars).right
    print(f"{name}: {right.sum()} right, {(~right).sum()} false", flush=True)


if __name__ == "__main__":
    main()
