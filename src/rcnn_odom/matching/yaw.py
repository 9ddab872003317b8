"""How far a scan is turned, from its normals alone: circular correlation of their histograms."""

import numpy as np
from numba import njit

from rcnn_odom.geometry import FloatArray, wrap_angle

BINS = 360
SMOOTH = 3
"""Degrees of the kernel's half width."""


@njit(cache=True)
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
    """The turns in radians between two scans on which their normals (P, 2) agree best, the best first."""
    spectra = np.fft.rfft(_histogram(before)) * np.conj(np.fft.rfft(_histogram(now)))
    agreement = np.fft.irfft(spectra, BINS)
    peaks = np.flatnonzero((agreement >= np.roll(agreement, 1)) & (agreement > np.roll(agreement, -1)))
    best = peaks[np.argsort(-agreement[peaks], kind="stable")][:most]
    return wrap_angle(best * (2 * np.pi / BINS))
