"""Bars of made-up clouds with slim masts, models and trees: right and false ones.

PYTHONPATH=. .venv/bin/python benchmarks/objects.py
"""

import numpy as np

from steelnb.core.types import Array
from steelnb.fusion.cloud_bars import bars_of_cloud
from steelnb.metrics.segments import match_members
from tests.lattice import STEEL, TOWER, bare_tree, lattice, on_ground, scanned, tree

FACES_M, PER_M = (0.2, 0.25, 0.3, 0.4, 0.5), (100, 200, 500, 1000, 2000)


def main() -> None:
    """Print a line a cloud."""
    for face_m in FACES_M:
        mast = lattice(4.0, face_m, face_m, round(4.0 / face_m))
        long = mast[np.linalg.norm(mast[:, 1] - mast[:, 0], axis=1) > 1.2 * face_m]
        for per_m in PER_M:
            cloud = on_ground(scanned(mast, per_m, 0.02, 0.002), 4.0)
            report(f"mast of {face_m} m, {per_m} points/m", cloud, mast, long)
    for grown, name in ((tree, "trees"), (bare_tree, "bare trees")):
        for seed in (3, 4, 5, 6):
            rng = np.random.default_rng(seed)
            beside, near = ([grown(rng, *each) for each in places] for places in (((5, 0), (-3, 5)), ((3, 0), (-2, 2))))
            for where, parts in (("", beside), (" beside a tower", [*beside, STEEL]), (" in a tower", [*near, STEEL])):
                report(f"{name}{where}, seed {seed}", on_ground(np.concatenate(parts), 6.0), TOWER, TOWER)
    mast = lattice(4.0, 0.3, 0.3, 13)
    masts = [mast + np.array([4.0 * column, 4.0 * row, 0.0]) for column in range(5) for row in range(5)]
    cloud = on_ground(np.concatenate([scanned(each, 200, 0.02, 0.002) for each in masts]), 20.0, 100)
    report("25 masts of 0.3 m", cloud, np.concatenate(masts), np.concatenate(masts))


def report(name: str, cloud: Array, bars: Array, sought: Array) -> None:
    """Print how many of the ``sought`` bars are found, and how many lines are none of ``bars``."""
    found = bars_of_cloud(cloud).bars
    match, own = match_members(found, bars, distance_max_m=0.05), match_members(found, sought, distance_max_m=0.05)
    print(f"{name}: {len({*own.member[own.right]})} of {len(sought)}, {(~match.right).sum()} false", flush=True)


if __name__ == "__main__":
    main()
