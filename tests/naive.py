"""Slow twins of the fast code: short, obviously right, and used by nothing but the tests."""

import numpy as np

from steelnb.hough import directions


def voxel_grid(points, leaf_m):
    cubes = {}
    for point in points:
        cubes.setdefault(tuple(np.floor(point / leaf_m).astype(int)), []).append(point)
    return np.array([np.mean(cubes[cube], axis=0) for cube in sorted(cubes)])


def hough_lines(points, dx, min_votes=2, max_lines=None, granularity=2):
    """The iterative Hough transform with a full vote volume, as in the paper: [(anchor, direction, indices), …]."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    low, high = points.min(axis=0) - centre, points.max(axis=0) - centre
    half = max(np.linalg.norm(low), np.linalg.norm(high))
    columns = int(2 * half / dx + 0.5)
    sphere = directions(granularity)
    left, lines = np.arange(len(points)), []
    while len(left) > 1 and (max_lines is None or len(lines) < max_lines):
        shifted = points[left] - centre
        volume = np.zeros((columns * columns, len(sphere)), dtype=int)
        for j, (bx, by, bz) in enumerate(sphere):
            beta = 1 / (1 + bz)
            for px, py, pz in shifted:
                x = (1 - beta * bx * bx) * px - beta * bx * by * py - bx * pz
                y = -beta * bx * by * px + (1 - beta * by * by) * py - by * pz
                cell = int((x + half) / dx + 0.5) * columns + int((y + half) / dx + 0.5)
                if cell < columns * columns:
                    volume[cell, j] += 1
        cell, j = np.unravel_index(volume.argmax(), volume.shape)  # the first of equals: smallest cell, then direction
        bx, by, bz = b = sphere[j]
        x, y, beta = (cell // columns) * dx - half, (cell % columns) * dx - half, 1 / (1 + bz)
        a = np.array([x * (1 - beta * bx * bx) - y * beta * bx * by, -x * beta * bx * by + y * (1 - beta * by * by),
                      -x * bx - y * by])  # fmt: skip
        near = close_to_line(shifted, a, b, dx)
        a, b = fit_line(shifted[near])
        near = close_to_line(shifted, a, b, dx)
        if near.sum() < min_votes:
            break
        a, b = fit_line(shifted[near])
        lines.append((a + centre, b, left[near]))
        left = left[~near]
    return lines


def close_to_line(points, anchor, direction, distance):
    apart = points - anchor
    return np.linalg.norm(apart - np.outer(apart @ direction, direction), axis=1) <= distance


def fit_line(points):
    mean = points.mean(axis=0)
    return mean, np.linalg.eigh((points - mean).T @ (points - mean))[1][:, 2]
