"""One seed, many independent named random streams: adding a noise source never changes another."""

import zlib
from typing import Literal

import numpy as np

Seed = int | Literal["report"]
"""A non-negative integer; or ``report``, with which the drift is the original's, draw for draw (`steelnb.noise`)."""
REPORT_SEED = 42
"""The seed of the original's only generator."""


def stream(seed: Seed, *names: str | int) -> np.random.Generator:
    """Random generator that depends on the seed and on its names alone.

    Parameters: ``seed``, where ``report`` counts as `REPORT_SEED`; ``names`` e.g. ``("tof", 17)`` for scan 17.
    The names are hashed with CRC-32, which is the same on every machine and in every process.
    """
    key = tuple(zlib.crc32(name.encode()) if isinstance(name, str) else name for name in names)
    entropy = REPORT_SEED if seed == "report" else seed
    return np.random.default_rng(np.random.SeedSequence(entropy=entropy, spawn_key=key))


def report_generator() -> np.random.RandomState:
    """The original's generator at its start: ``numpy.random.seed(42)``, which newer NumPy keeps as it was."""
    return np.random.RandomState(REPORT_SEED)
