"""The iterative transform on the cloud of a whole structure, in blocks."""
