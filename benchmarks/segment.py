"""Bars of merged clouds of towers, by `steelnb segment` and by other methods; what a cloud's condition does.

PYTHONPATH=. .venv/bin/python benchmarks/segment.py [--seeds 21 22] [--towers slender heavy] [-o FILE.csv]

The clouds are the preprocessed scans of a Starling 2 in loops around a tower, placed at the true poses, ground
included; a random one in ten of their points is taken (`steelnb.notebook.frames`).
"""

import argparse

import pandas as pd

from steelnb.notebook.frames import CONDITIONS, cloud_trials


def main() -> None:
    """Print one row per cloud, condition and method, and the means over the seeds."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, nargs="+", default=[21])
    parser.add_argument("--towers", nargs="+", default=["slender", "heavy", "light", "report", "tapered"])
    parser.add_argument("--conditions", nargs="+", default=list(CONDITIONS), choices=list(CONDITIONS))
    parser.add_argument("--methods", nargs="+", default=["steelnb segment"])
    parser.add_argument("-o", "--output")
    options = parser.parse_args()
    tables = []
    for seed in options.seeds:
        for tower in options.towers:
            duration_s = 200.0 if tower == "tapered" else 120.0
            tables.append(cloud_trials(tower, seed, duration_s, options.conditions, options.methods))
            print(tables[-1].round(3).to_string(), flush=True)
    table = pd.concat(tables)
    if options.output:
        table.to_csv(options.output, index=False)
    means = table.groupby(["method", "condition", "tower"], sort=False).mean(numeric_only=True)
    print(means.drop(columns="seed").round(3).to_string())


if __name__ == "__main__":
    main()
