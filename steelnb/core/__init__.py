"""What all rooms share: types, errors, random streams, files, the cache, checks of arrays, determinism."""
