"""How far a scan is turned, from its normals alone: circular correlation of their histograms."""

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray, wrap_angle

BINS = 360
"""Of the circle of directions, so that each is a degree wide."""
SMOOTH = 3
"""Bins on each side over which a direction is spread."""


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
    """The turns between two scans by which their normals agree best.

    Args:
        before, now: (P, 2), (Q, 2) normals, each in the frame of its scan.
        most: the largest number of turns.

    Returns:
        (N,) radians in [-pi, pi), the best first; N is at most ``most``.
    """
    spectra = np.fft.rfft(_histogram(before)) * np.conj(np.fft.rfft(_histogram(now)))
    agreement = np.fft.irfft(spectra, BINS)
    peaks = np.flatnonzero((agreement >= np.roll(agreement, 1)) & (agreement > np.roll(agreement, -1)))
    best = peaks[np.argsort(-agreement[peaks], kind="stable")][:most]
    return wrap_angle(best * (2 * np.pi / BINS))
