"""Structures for the tests of files."""

from dataclasses import replace

import numpy as np

from steelnb.fusion.structure import Structure
from steelnb.settings import TowerSettings
from steelnb.simulation import build_tower
from steelnb.types import Segments

UTM = np.array([299100.0, 2801400.0, 1900.0])


def tower(seed: int = 0) -> Structure:
    """The simulated tower as if it had been reconstructed: numbers with all their digits, one width not known."""
    built, rng = build_tower(TowerSettings()), np.random.default_rng(seed)
    axes, n = built.axes + rng.normal(scale=1e-3, size=built.axes.shape), len(built.members)
    segments = Segments(axes[:, 0], axes[:, 1], rng.integers(100, 9000, n), rng.uniform(0.005, 0.03, n))
    width = np.array([member.section_m[0] for member in built.members])
    width[3] = np.nan
    tie = np.array(sorted({(joint, bar) for bar, member in enumerate(built.members) for joint in member.joints}))
    sigma = rng.gamma(2.0, 0.003, n)
    return Structure(segments, width, rng.integers(1, 90, n), sigma, built.joints.copy(), tie)


def frame() -> Structure:
    """A post of 4 m, a beam of 3 m and a strut between them, with three joints: small enough to count by hand."""
    start = np.array([[0.0, 0, 0], [0, 0, 4], [0, 0, 2]])
    end = np.array([[0.0, 0, 4], [3, 0, 4], [2, 0, 4]])
    segments = Segments(start, end, np.array([900, 400, 250]), np.array([0.02, 0.01, 0.01]))
    joint = np.array([[0.0, 0, 4], [0, 0, 2], [2, 0, 4]])
    tie = np.array([[0, 0], [0, 1], [1, 0], [1, 2], [2, 1], [2, 2]])
    width, sigma = np.array([0.12, 0.08, np.nan]), np.array([0.001, 0.004, np.nan])
    return Structure(segments, width, np.array([40, 12, 3]), sigma, joint, tie)


def shifted(structure: Structure, by: np.ndarray) -> Structure:
    s = structure.segments
    moved = Segments(s.start + by, s.end + by, s.count, s.radius)
    return replace(structure, segments=moved, joint=structure.joint + by)
