"""Bars of airborne clouds of real towers, judged by marks that a person made (`towers/README.md`).

    PYTHONPATH=. .venv/bin/python benchmarks/towers.py CLOUDS [--marks FOLDER] [--towers 003 006] [--pictures FOLDER]
        [-o FILE.csv]

CLOUDS has a file 003.txt or 003Tower.txt for each file 003.csv of marks.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from steelnb.core.types import Array, Segments
from steelnb.fusion.cloud_bars import bars_of_cloud
from steelnb.io.clouds import read_cloud

NEAR_M, NEAR_DEG, STEP_M = 0.3, 6.0, 0.1
KINDS = "leg", "ring", "crossing", "brace", "arm"
DOUBTFUL = "doubtful"
"""A bar at such a mark is neither found nor false."""


def read_marks(path: Path, origin: Array) -> tuple[Array, Array]:
    """Kinds ``(M,)`` and lines ``(M, 2, 3)`` of marks, metres relative to ``origin (3,)``."""
    table = pd.read_csv(path)
    return table["kind"].to_numpy(str), table.iloc[:, 1:].to_numpy(np.float64).reshape(-1, 2, 3) - origin


def samples_of(lines: Array) -> tuple[Array, NDArray[np.intp]]:
    """Middles of steps of about `STEP_M` along lines ``(M, 2, 3)``, ``(S, 3)``, and their lines ``(S,)``."""
    steps = np.maximum(1, np.round(np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1) / STEP_M)).astype(int)
    line = np.repeat(np.arange(len(lines)), steps)
    share = (np.arange(len(line)) - np.repeat(np.cumsum(steps) - steps, steps) + 0.5) / steps[line]
    return lines[line, 0] + share[:, None] * (lines[line, 1] - lines[line, 0]), line


def are_near(lines: Array, others: Array, angle_deg: float) -> list[NDArray[np.bool_]]:
    """For each of the lines ``(M, 2, 3)``, which of its samples have one of the others ``(K, 2, 3)`` within `NEAR_M`,
    at an angle of at most ``angle_deg``."""
    points, line = samples_of(lines)
    span, other = lines[:, 1] - lines[:, 0], others[:, 1] - others[:, 0]
    length = np.linalg.norm(other, axis=1)
    cosine = np.abs(span @ other.T) / (np.linalg.norm(span, axis=1)[:, None] * length)
    offset = points[:, None] - others[None, :, 0]
    along = np.clip(np.einsum("skx,kx->sk", offset, other) / length**2, 0, 1)
    distance = np.linalg.norm(offset - along[..., None] * other, axis=2)
    near = (distance <= NEAR_M) & (cosine >= np.cos(np.radians(angle_deg)))[line]
    return np.split(near.any(axis=1), np.flatnonzero(np.diff(line)) + 1)


def judged(kind: Array, marks: Array, bars: Segments) -> dict[str, float]:
    """Share of the marked length found, by kind and in all; share of the bars' length that lies at no mark."""
    lines = np.stack([bars.start, bars.end], axis=1)
    found = np.array([each.mean() for each in are_near(marks, lines, NEAR_DEG)])
    length = np.linalg.norm(marks[:, 1] - marks[:, 0], axis=1) * (kind != DOUBTFUL)
    row = {name: float(np.average(found[kind == name], weights=length[kind == name])) for name in KINDS}
    row["all"] = float(np.average(found, weights=length))
    right = np.array([each.mean() for each in are_near(lines, marks, 90.0)])
    row["false"] = float(np.average(1 - right, weights=bars.length)) if len(bars) else 0.0
    return row | {"bars": len(bars), "length_m": float(bars.length.sum())}


def save_picture(path: Path, points: Array, kind: Array, marks: Array, bars: Segments) -> None:
    """Save the four sides of a tower: points grey, marks blue (dotted if doubtful), bars green, or red if less than
    half of their length lies at a mark."""
    import matplotlib.pyplot as plt
    from matplotlib.collections import LineCollection

    legs = marks[kind == "leg"]
    feet = legs[np.argsort(-np.linalg.norm(legs[:, 1] - legs[:, 0], axis=1))[:4], 0, :2]
    centre = feet.mean(axis=0)
    feet = feet[np.argsort(np.arctan2(*(feet - centre).T))]
    lines = np.stack([bars.start, bars.end], axis=1)
    is_right = np.array([each.mean() >= 0.5 for each in are_near(lines, marks, 90.0)], dtype=bool)
    drawn = [
        (marks[kind != DOUBTFUL], "tab:blue", "solid"),
        (marks[kind == DOUBTFUL], "tab:blue", "dotted"),
        (lines[is_right], "tab:green", "solid"),
        (lines[~is_right], "tab:red", "solid"),
    ]
    figure, all_axes = plt.subplots(1, 4, figsize=(24, 16), sharey=True, layout="constrained")
    for axes, foot, following in zip(all_axes, feet, np.roll(feet, -1, axis=0), strict=True):
        across = (following - foot) / np.linalg.norm(following - foot)
        outward = np.array([-across[1], across[0]])
        outward *= np.sign(outward @ (foot - centre))
        front = points[(points[:, :2] - centre) @ outward > 0]
        axes.scatter((front[:, :2] - centre) @ across, front[:, 2], s=2, c="0.7", linewidths=0)
        for these, colour, style in drawn:
            here = these[(these.mean(axis=1)[:, :2] - centre) @ outward > -NEAR_M]
            flat = np.stack([(here[..., :2] - centre) @ across, here[..., 2]], axis=-1)
            width = 0.7 if colour == "tab:blue" else 1.2
            axes.add_collection(LineCollection(list(flat), colors=colour, linestyles=style, linewidths=width))
        axes.set_aspect("equal")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main() -> None:
    """Print one row per tower, and the means of all."""
    parser = argparse.ArgumentParser()
    parser.add_argument("clouds", type=Path)
    parser.add_argument("--marks", type=Path, default=Path(__file__).parent / "towers")
    parser.add_argument("--towers", nargs="+", help="by default all that have marks")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("-o", "--output")
    options = parser.parse_args()
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    rows = []
    for tower in options.towers or sorted(path.stem for path in options.marks.glob("*.csv")):
        plain = options.clouds / f"{tower}.txt"
        cloud = read_cloud(plain if plain.exists() else options.clouds / f"{tower}Tower.txt")
        kind, marks = read_marks(options.marks / f"{tower}.csv", cloud.origin)
        start_s = time.perf_counter()
        bars = bars_of_cloud(cloud.points).bars
        seconds = time.perf_counter() - start_s
        rows.append({"tower": tower} | judged(kind, marks, bars) | {"seconds": seconds})
        print(pd.DataFrame(rows[-1:]).round(3).to_string(index=False, header=len(rows) == 1, col_space=8), flush=True)
        if options.pictures:
            save_picture(options.pictures / f"{tower}.png", cloud.points, kind, marks, bars)
    table = pd.DataFrame(rows)
    if options.output:
        table.to_csv(options.output, index=False)
    print(table.drop(columns="tower").mean().round(3).to_string())


if __name__ == "__main__":
    main()
