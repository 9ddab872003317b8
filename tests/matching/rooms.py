"""A room made of straight walls, and exact scans of it: independent of the simulator."""

import numpy as np

from rcnn_odom.recordings.scan import Scan

BOX = np.array(
    [
        *[[-4, -3, 7, -3], [7, -3, 7, 4], [7, 4, -4, 4], [-4, 4, -4, -3]],
        *[[2, 1, 3, 1], [3, 1, 3, 2], [3, 2, 2, 2], [2, 2, 2, 1]],
    ],
    dtype=float,
)
"""Walls (W, 4) x, y, x, y in metres: 11 by 7 m with a box in it."""


def cast(pose, bearings, walls=BOX):
    """Ranges (B,) by intersecting every beam with every wall; pose (3,) or one for every beam (B, 3)."""
    pose = np.broadcast_to(pose, (len(bearings), 3))
    ways = np.stack([np.cos(pose[:, 2] + bearings), np.sin(pose[:, 2] + bearings)], axis=1)[:, None]
    start, along = walls[:, :2] - pose[:, None, :2], walls[:, 2:] - walls[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        across = ways[..., 0] * along[:, 1] - ways[..., 1] * along[:, 0]
        distance = (start[..., 0] * along[:, 1] - start[..., 1] * along[:, 0]) / across
        share = (start[..., 0] * ways[..., 1] - start[..., 1] * ways[..., 0]) / across
        met = (distance > 0) & (share >= 0) & (share <= 1)
    return np.where(met, distance, np.inf).min(axis=1)


def circle(spacing_deg=0.5, view_deg=360.0):
    """Bearings (B,) of a laser that looks ahead."""
    return np.deg2rad(np.arange(-view_deg / 2, view_deg / 2 - 1e-9, spacing_deg))


def drive(poses, bearings, noise=0.0, seed=0, walls=BOX, rate=10.0):
    """Scans from these poses (N, 3)."""
    rng = np.random.default_rng(seed)
    return [
        Scan(
            cast(pose, bearings, walls) + noise * rng.standard_normal(len(bearings)), bearings, stamp=n / rate
        )
        for n, pose in enumerate(poses)
    ]


def loop(frames=60):
    """Poses (N, 3) of a quiet bend through the box: 3 m, 1.2 rad, from rest."""
    share = np.linspace(0, 1, frames) ** 2 * (3 - 2 * np.linspace(0, 1, frames))
    heading = 1.2 * share
    return np.stack([2.5 * np.sin(heading) - 1.5, 2.5 * (1 - np.cos(heading)) - 1, heading], axis=1)


def relative(a, b):
    """Pose b (3,) seen from pose a, by matrices."""

    def matrix(pose):
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        return np.array([[cos, -sin, pose[0]], [sin, cos, pose[1]], [0, 0, 1]])

    moved = np.linalg.inv(matrix(a)) @ matrix(b)
    return np.array([moved[0, 2], moved[1, 2], np.arctan2(moved[1, 0], moved[0, 0])])
