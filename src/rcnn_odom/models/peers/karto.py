"""Karto's scan matcher, which slam_toolbox uses: correlation with a grid of the last scans.

Konolige, Grisetti, Kuemmerle, Burgard, Limketkai and Vincent, "Efficient Sparse Pose Adjustment for 2D
Mapping", IROS 2010.
"""

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from rcnn_odom.geometry import FloatArray, planar_to_poses
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.peers.peer import Peer
from rcnn_odom.recordings.scan import Scan

LAST_SCANS = 10
"""Number of last scans that make up the grid, the same as in slam_toolbox."""
SEARCH_IN_CELLS, SMEAR_IN_CELLS = 30.0, 3.0
"""Side of the searched square, and the standard deviation by which points are smeared, in cells of the grid.

These are the ratios of Karto's defaults, 0.3 m and 0.03 m for cells of 0.01 m.
"""
FINEST_DEG = 0.25
"""Degrees; beams with a smaller spacing are merged, which had no measurable effect on the accuracy."""


class Karto(Peer):
    """Karto's matcher without odometry: the initial guess is the last motion. ``voxel`` is its cell size."""

    name = "karto"
    package = "karto-scanmatcher"

    def aligner(self) -> "KartoAligner":
        """Makes the peer, before its first scan."""
        return KartoAligner(self.imported("karto_scanmatcher"), self.options["voxel"], self.sensor)


class KartoAligner:
    """Karto's matcher with the last scans and their estimated poses."""

    def __init__(self, library: Any, cell: float, sensor: Sensor) -> None:
        self._library, self._sensor = library, _limit_resolution(sensor)
        sensor = self._sensor
        config = library.ScanMatcherConfig()
        config.resolution, config.range_threshold = cell, sensor.max_range
        config.search_size, config.smear_deviation = SEARCH_IN_CELLS * cell, SMEAR_IN_CELLS * cell
        self._matcher = library.Wrapper(config)
        first = np.deg2rad(sensor.first_bin_deg)
        self._laser = library.LaserScanConfig(
            float(first),
            float(first + np.deg2rad((sensor.bins - 1) * sensor.resolution_deg)),
            float(np.deg2rad(sensor.resolution_deg)),
            0.01,
            sensor.max_range,
            sensor.max_range,
            "laser",
        )
        self._scans: deque[Any] = deque(maxlen=LAST_SCANS)
        self._pose, self._motion = np.eye(4), np.eye(4)
        self._count = 0

    def add(self, scan: Scan, points: FloatArray) -> FloatArray:
        """Adds one more scan; returns the laser's pose (4, 4)."""
        # Karto requires evenly spaced beams. A range of 0 would be a point at the laser.
        depths = self._sensor.encode(scan)
        ranges = np.where(depths > 0, depths, np.inf).tolist()
        guess = self._pose @ self._motion
        pose = guess
        if self._scans:
            found = self._matcher.match_scan(
                self._make_scan(ranges, guess), list(self._scans), True, True
            ).best_pose
            pose = planar_to_poses([[found.x, found.y, found.yaw]])[0]
            self._motion = np.linalg.inv(self._pose) @ pose
        self._scans.append(self._make_scan(ranges, pose))
        self._pose = pose
        self._count += 1
        return pose

    def _make_scan(self, ranges: list[float], pose: FloatArray) -> Any:
        """Karto's object of a scan with the pose (4, 4) of its laser."""
        x, y, yaw = float(pose[0, 3]), float(pose[1, 3]), float(np.arctan2(pose[1, 0], pose[0, 0]))
        place = self._library.Pose2(x, y, yaw)
        return self._library.LocalizedRangeScan(self._laser, ranges, place, place, self._count, 0.0)


def _limit_resolution(sensor: Sensor) -> Sensor:
    """The same sensor with a spacing of at least ``FINEST_DEG``."""
    beams = max(1, int(sensor.field_of_view_deg / FINEST_DEG))
    spacing = max(sensor.resolution_deg, sensor.field_of_view_deg / beams)
    return replace(sensor, resolution_deg=spacing)
