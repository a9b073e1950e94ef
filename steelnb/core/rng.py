"""Independent random streams from one seed, identified by name: a new noise source does not change the others."""

import zlib
from typing import Literal

import numpy as np

from steelnb.core.checks import checked_integer

Seed = int | Literal["report"]
"""A non-negative integer, or ``report``: the drift then uses the random draws of the report's program
(`steelnb.simulation.drift`)."""
REPORT_SEED = 42
"""The seed of the report's program."""


def stream(seed: Seed, *names: str | int) -> np.random.Generator:
    """A random generator that depends only on the seed and the names, such as ``("tof", 17)`` for scan 17.

    The seed ``report`` counts as `REPORT_SEED`. Names are hashed with CRC-32, the same on every machine. Raises
    `InputError` for another seed.
    """
    key = tuple(zlib.crc32(name.encode()) if isinstance(name, str) else name for name in names)
    entropy = REPORT_SEED if seed == "report" else checked_integer(seed, "seed", 0)
    return np.random.default_rng(np.random.SeedSequence(entropy=entropy, spawn_key=key))


def report_generator() -> np.random.RandomState:
    """The generator of the report's program, ``numpy.random.seed(42)``; newer NumPy versions still have it."""
    return np.random.RandomState(REPORT_SEED)
