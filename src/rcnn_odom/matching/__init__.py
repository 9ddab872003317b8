"""Scan matching: points of a scan, a local map, and the motion between them. Numpy, scipy and numba."""
