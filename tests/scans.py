"""Scans as tests compare them."""


def beams(scan):
    """Bearings in radians and ranges in metres, each (P,)."""
    return scan.bearings, scan.ranges
