"""GenZ-ICP: point-to-plane matching where the map is planar, and point-to-point matching elsewhere.

Lee, Lim and Han, "GenZ-ICP: Generalizable and Degeneracy-Robust LiDAR Odometry Using an Adaptive Weighting",
IEEE Robotics and Automation Letters 10, 2025.

If z = 0 for all points, every fitted plane is the floor, which does not constrain x, y and heading. At
straight walls without noise there are no other constraints, and the estimate diverges. Therefore planes are
disabled here.
"""

from typing import Any

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.models.peers.peer import Peer
from rcnn_odom.recordings.scan import Scan

NO_PLANES = -1.0
"""Threshold of planarity (the fraction of a neighbourhood's variance across its plane) that none is below."""


class GenZICP(Peer):
    """GenZ-ICP with its default settings, except for the voxel size, the laser's range and the planes.

    It has no option for the number of threads; to measure it on one thread, bind the process to one core.
    """

    name = "genz_icp"
    package = "genz-icp"

    def aligner(self) -> "GenZAligner":
        """Makes the peer, before its first scan."""
        config = self.imported("genz_icp.config").GenZConfig(
            data={"max_range": self.sensor.max_range, "min_range": 0.0, "deskew": False},
            mapping={"voxel_size": self.options["voxel"], "planarity_threshold": NO_PLANES},
        )
        return GenZAligner(self.imported("genz_icp.genz_icp").GenZICP(config))


class GenZAligner:
    """GenZ-ICP with its map."""

    def __init__(self, odometry: Any) -> None:
        self._odometry = odometry

    def add(self, scan: Scan, points: FloatArray) -> FloatArray:
        """Adds the points (P, 3) of one more scan; returns the laser's pose (4, 4)."""
        self._odometry.register_frame(points, np.empty(0))
        return np.array(self._odometry.last_pose)
