"""KISS-ICP: point-to-point matching with a voxel map and an adaptive distance threshold.

Vizzo, Guadagnino, Mersch, Wiesmann, Behley and Stachniss, "KISS-ICP: In Defense of Point-to-Point ICP",
IEEE Robotics and Automation Letters 8, 2023. Point-to-point matching also works if z = 0 for all points.
"""

from typing import Any

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.models.peers.peer import Peer
from rcnn_odom.recordings.scan import Scan


class KissICP(Peer):
    """KISS-ICP with its default settings, except for the voxel size, the laser's range and one thread."""

    name = "kiss_icp"
    package = "kiss-icp"

    def aligner(self) -> "KissAligner":
        """Makes the peer, before its first scan."""
        config = self.imported("kiss_icp.config").KISSConfig(
            data={"max_range": self.sensor.max_range, "min_range": 0.0, "deskew": False},
            mapping={"voxel_size": self.options["voxel"]},
            registration={"max_num_threads": 1},
        )
        return KissAligner(self.imported("kiss_icp.kiss_icp").KissICP(config))


class KissAligner:
    """KISS-ICP with its map."""

    def __init__(self, odometry: Any) -> None:
        self._odometry = odometry

    def add(self, scan: Scan, points: FloatArray) -> FloatArray:
        """Adds the points (P, 3) of one more scan; returns the laser's pose (4, 4)."""
        self._odometry.register_frame(points, np.empty(0))
        return np.array(self._odometry.last_pose)
