"""Where a laser is at each of its beams, when it moves while it turns."""

import numpy as np
from scipy.spatial.transform import Rotation

from rcnn_odom.geometry import FloatArray, wrap_angle


def poses_at(poses: FloatArray, stamps: FloatArray, moments: FloatArray) -> FloatArray:
    """Poses (B, 4, 4) at some moments: straight on and turning evenly from each frame to the next.

    Args:
        poses: (N, 4, 4) of two frames or more.
        stamps: (N,) seconds, rising.
        moments: (B,) seconds; before the first frame and after the last the nearest motion goes on.
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
    """Seconds of an HDL-64's shots (B,) after it looked straight ahead.

    It turns clockwise from behind to behind, as on KITTI's car, whose raw recordings are stamped when the
    laser looks ahead.
    """
    return -wrap_angle(azimuth) / (2 * np.pi * rate_hz)
