"""The Hough transform beside the plainest form of its own idea: one bound per direction, alternating runs on one core.

    .venv/bin/python benchmarks/hough_plain.py > benchmarks/hough_plain.md

The plain form votes for the points in their order, searches all bounds for the largest, and has no heap.
"""

from shared import command  # first, as it pins the core

# isort: split
import time
from typing import Any

import numpy as np
from numba import njit

from hough import frames, some
from steelnb.core import rng
from steelnb.core.determinism import machine
from steelnb.core.types import Array, Lines
from steelnb.hough import detect_lines, lines
from steelnb.hough.transform import BLOCK, drop, fit_near_line, iterate
from steelnb.points import voxel_grid

SIZES, WIDTHS, RUNS, MIN_VOTES = (2_500, 5_000, 10_000, 20_000), (0.05, 0.1), 9, 12
REACH_M, LEAF_M = 3.0, 0.05
TABLE = """The lines agree to the last bit in every case. *Even*: points spread evenly over a cube of 4 m. *Scans*: a
random subset of the returns of a frame of `hough.py`, in order. *Filtered*: such frames within {} m, in
voxels of {} m. `min_votes` {}, weak lines skipped, all lines. Times and ratios are medians over the clouds, each with
the shortest of {} runs. The machine was not idle: times depend on it, ratios less so.

| clouds | points | dx (m) | lines | plain form (ms) | steelnb (ms) | ratio |
|---|---|---|---|---|---|---|"""


@njit
def vote(px, py, pz, direction, box, half, inverse_dx, columns, image, index):  # type: ignore[no-untyped-def]
    """Votes of one direction (equation 2): (largest count, first cell that has it).

    ``image`` holds zeros; ``index`` is scratch.
    """
    bx, by, bz = direction
    beta, shift = 1.0 / (1.0 + bz), half * inverse_dx + 0.5
    ax, ay, az = (1.0 - beta * bx * bx) * inverse_dx, -beta * bx * by * inverse_dx, -bx * inverse_dx
    cx, cy, cz = -beta * bx * by * inverse_dx, (1.0 - beta * by * by) * inverse_dx, -by * inverse_dx
    for i in range(len(px)):
        column = np.int32(ax * px[i] + ay * py[i] + az * pz[i] + shift)
        row = np.int32(cx * px[i] + cy * py[i] + cz * pz[i] + shift)
        index[i] = column * columns + row
    for i in range(len(px)):
        image[np.uint32(index[i])] += 1
    reach = abs(ax) * box[0] + abs(ay) * box[1] + abs(az) * box[2]
    begin, end = max(int(shift - reach) - 1, 0) * columns, min((int(shift + reach) + 3) * columns, columns * columns)
    image[columns * columns : (columns + 2) * (columns + 2)] = 0  # the published program drops these votes
    best, cell = np.int32(0), begin
    for first in range(begin, end, BLOCK):
        block, most = image[first : first + BLOCK], np.int32(0)
        for k in range(BLOCK):
            most = max(most, block[k])
        if most > best:
            best, cell = most, first
    while best > 0 and image[cell] != best:
        cell += 1
    image[begin:end] = 0
    return best, cell


@njit
def plain(  # type: ignore[no-untyped-def]
    px, py, pz, sphere, box, half, dx, columns, min_votes, max_lines, skip_weak
):
    """Replaces `steelnb.hough.transform.iterate`, with the same arguments."""
    n, found, weak_lines = len(px), 0, 0
    anchor, direction, counts = np.zeros((n // 2, 3)), np.zeros((n // 2, 3)), np.zeros(n // 2, np.int64)
    label = np.full(n, -1, np.int64)
    image, index = np.zeros((columns + 4) * (columns + 4) + BLOCK, np.int32), np.empty(n, np.int32)
    original, chosen, gone = np.arange(n), np.empty(n, np.int64), np.zeros(n, np.uint8)
    bound, cells = np.empty(len(sphere), np.int64), np.empty(len(sphere), np.int64)
    voted_in = np.zeros(len(sphere), np.int64)
    for j in range(len(sphere)):
        bound[j], cells[j] = vote(px, py, pz, sphere[j], box, half, 1.0 / dx, columns, image, index)
    while n > 1 and found < max_lines:
        top = 0
        for j in range(len(sphere)):
            if bound[j] > bound[top] or (bound[j] == bound[top] and cells[j] < cells[top]):
                top = j
        if voted_in[top] != found + weak_lines:
            bound[top], cells[top] = vote(
                px[:n], py[:n], pz[:n], sphere[top], box, half, 1.0 / dx, columns, image, index
            )
            voted_in[top] = found + weak_lines
            continue
        if bound[top] < (min_votes // 2 if skip_weak else 1):
            break
        bx, by, bz = sphere[top]
        x, y = (cells[top] // columns) * dx - half, (cells[top] % columns) * dx - half
        beta = 1.0 / (1.0 + bz)
        ax = x * (1.0 - beta * bx * bx) - y * beta * bx * by
        ay = -x * beta * bx * by + y * (1.0 - beta * by * by)
        fitted, count, ax, ay, az, ux, uy, uz = fit_near_line(
            px[:n], py[:n], pz[:n], ax, ay, -x * bx - y * by, bx, by, bz, dx, min_votes, chosen
        )
        if not fitted and (not skip_weak or count == 0):
            break
        for k in range(count):
            gone[original[chosen[k]]] = 1
            label[original[chosen[k]]] = found if fitted else -1
        n = drop(gone, px[:n], py[:n], pz[:n], original)
        if fitted:
            anchor[found, 0], anchor[found, 1], anchor[found, 2] = ax, ay, az
            direction[found, 0], direction[found, 1], direction[found, 2] = ux, uy, uz
            counts[found] = count
            found += 1
        else:
            weak_lines += 1
    return anchor[:found], direction[:found], counts[:found], label


def timed(loop: Any, points: Array, dx: float) -> tuple[float, Lines]:
    """CPU seconds of `detect_lines` with a compiled loop, and its lines."""
    vars(lines)["iterate"] = loop
    began = time.process_time()
    found = detect_lines(points, dx, MIN_VOTES, skip_weak=True)
    return time.process_time() - began, found


def compare(name: str, clouds: list[Array], dx: float) -> None:
    """Print a row: medians over the clouds of both loops' shortest times. Raises AssertionError if the lines differ."""
    shortest, numbers = [], []
    for points in clouds:
        seconds = []
        for _ in range(RUNS):
            (their_s, theirs), (our_s, ours) = timed(plain, points, dx), timed(iterate, points, dx)
            seconds.append((their_s, our_s))
            for field in ("anchor", "direction", "count", "label"):
                np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))
        shortest.append(np.min(seconds, axis=0))
        numbers.append(len(ours))
    (their_s, our_s), size = np.median(shortest, axis=0), int(np.median([len(points) for points in clouds]))
    ratio = np.median([our_s / their_s for their_s, our_s in shortest])
    print(
        f"| {name} | {size} | {dx} | {np.median(numbers):.0f} | {1e3 * their_s:.1f} | {1e3 * our_s:.1f} "
        f"| **{ratio:.2f}** |", flush=True,
    )  # fmt: skip


def main() -> None:
    print(f"# The Hough transform beside its plain form\n\n{machine()}. `{command(__doc__)}`\n")
    print(TABLE.format(REACH_M, LEAF_M, MIN_VOTES, RUNS))
    for loop in (plain, iterate):
        timed(loop, rng.stream(1, "benchmark").random((100, 3)), 0.1)  # compiled before it is timed
    scans = frames()
    for dx in WIDTHS:
        for size in SIZES:
            compare("even", [rng.stream(k, "benchmark").uniform(-2, 2, (size, 3)) for k in range(3)], dx)
        for size in SIZES:
            compare("scans", [some(scan, size) for scan in scans], dx)
        near = [scan[np.linalg.norm(scan, axis=1) < REACH_M] for scan in scans]
        compare("filtered", [voxel_grid(scan, LEAF_M) for scan in near if len(scan)], dx)


if __name__ == "__main__":
    main()
