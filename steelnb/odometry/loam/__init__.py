"""LOAM: edge and planar features of a scan."""
