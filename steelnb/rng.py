"""One seed, many independent named random streams: adding a noise source never changes another."""

import zlib

import numpy as np


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Random generator that depends on the seed and on its names alone.

    Parameters: ``seed`` non-negative integer; ``names`` e.g. ``("tof", 17)`` for scan 17.
    The names are hashed with CRC-32, which is the same on every machine and in every process.
    """
    key = tuple(zlib.crc32(name.encode()) if isinstance(name, str) else name for name in names)
    return np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=key))
