"""The other methods of the report's section 1.1: RANSAC, DBSCAN, Gaussian mixtures and others, and their refinement."""
