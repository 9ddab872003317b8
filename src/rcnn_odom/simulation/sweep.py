"""Poses of a moving laser at the times of its beams."""

import numpy as np
from scipy.spatial.transform import Rotation

from rcnn_odom.geometry import FloatArray, wrap_angle


def poses_at(poses: FloatArray, stamps: FloatArray, moments: FloatArray) -> FloatArray:
    """Interpolate poses: linearly in position and at a constant turn rate between two frames.

    Args:
        poses: (N, 4, 4), N >= 2.
        stamps: (N,) seconds, increasing.
        moments: (B,) seconds; before the first and after the last frame, the nearest motion is extrapolated.

    Returns:
        Poses (B, 4, 4) at the moments.

    >>> poses = np.stack([np.eye(4), np.eye(4)])
    >>> poses[1, 0, 3] = 2.0
    >>> float(poses_at(poses, np.array([0.0, 1.0]), np.array([0.25]))[0, 0, 3])
    0.5
    """
    start = np.clip(np.searchsorted(stamps, moments, side="right") - 1, 0, len(stamps) - 2)
    share = (moments - stamps[start]) / (stamps[start + 1] - stamps[start])
    here, there = poses[start], poses[start + 1]
    turns = Rotation.from_matrix(here[:, :3, :3]).inv() * Rotation.from_matrix(there[:, :3, :3])
    turned = Rotation.from_rotvec(share[:, None] * turns.as_rotvec()).as_matrix()
    between = here.copy()
    between[:, :3, :3] = here[:, :3, :3] @ turned
    between[:, :3, 3] += share[:, None] * (there[:, :3, 3] - here[:, :3, 3])
    return between


def ring_times(azimuth: FloatArray, rate_hz: float) -> FloatArray:
    """Seconds (B,) of an HDL-64's shots after it pointed straight ahead.

    Args:
        azimuth: (B,) radians.
        rate_hz: turns per second.

    The laser turns clockwise, and a turn begins and ends behind the car. As in KITTI's raw recordings, the
    stamp is the time when the laser points ahead.
    """
    return -wrap_angle(azimuth) / (2 * np.pi * rate_hz)
