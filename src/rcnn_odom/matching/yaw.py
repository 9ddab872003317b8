"""The turn between two scans from their normals alone, by circular correlation of histograms.

Weiss, Wetzler and von Puttkamer, "Keeping track of position and orientation of moving indoor systems by
correlation of range-finder scans", IROS 1994.
"""

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray, wrap_angle

BINS = 360
"""Bins of directions, each one degree wide."""
SMOOTH = 3
"""Bins on each side over which each direction is smoothed."""


@compiled
def _histogram(normals):  # type: ignore[no-untyped-def]
    """Smoothed histogram (360,) of the directions of normals (P, 2)."""
    raw = np.zeros(BINS)
    for i in range(len(normals)):
        angle = np.arctan2(normals[i, 1], normals[i, 0])
        raw[int((angle + np.pi) / (2 * np.pi) * BINS) % BINS] += 1.0
    smooth = np.zeros(BINS)
    for i in range(BINS):
        for k in range(-SMOOTH, SMOOTH + 1):
            smooth[i] += (SMOOTH + 1 - abs(k)) * raw[(i + k) % BINS]
    return smooth


def turn_candidates(before: FloatArray, now: FloatArray, most: int) -> FloatArray:
    """The turns of the laser between two scans for which their normals agree best.

    Args:
        before, now: (P, 2), (Q, 2) normals, each in the frame of its scan.
        most: the largest number of turns.

    Returns:
        (N,) radians in [-pi, pi), the best first; N is at most ``most``.

    Example:
        The laser turns by 30 degrees to the left, so that two walls appear 30 degrees further to the right:

        >>> before, now = np.deg2rad([180.5, 280.5]), np.deg2rad([150.5, 250.5])
        >>> normals = [np.stack([np.cos(angles), np.sin(angles)], axis=1) for angles in (before, now)]
        >>> np.rad2deg(turn_candidates(*normals, most=1)).round(6)
        array([30.])
    """
    spectra = np.fft.rfft(_histogram(before)) * np.conj(np.fft.rfft(_histogram(now)))
    agreement = np.fft.irfft(spectra, BINS)
    peaks = np.flatnonzero((agreement >= np.roll(agreement, 1)) & (agreement > np.roll(agreement, -1)))
    best = peaks[np.argsort(-agreement[peaks], kind="stable")][:most]
    return wrap_angle(best * (2 * np.pi / BINS))
