"""GenZ-ICP: point-to-plane where the map is a plane, else point-to-point, in one estimate.

Lee, Lim and Han, "GenZ-ICP: Generalizable and Degeneracy-Robust LiDAR Odometry Using an Adaptive Weighting",
IEEE Robotics and Automation Letters 10, 2025.

Where z = 0 everywhere, every plane is the floor, which says nothing about x, y and heading: on straight walls
without noise nothing else is left, and the estimate flies off. So no point counts as one of a plane here.
"""

from typing import Any

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.models.peers.peer import Peer
from rcnn_odom.recordings.scan import Scan

NO_PLANES = -1.0
"""Of the share of a neighbourhood's spread that is across its plane: below this one lies none."""


class GenZICP(Peer):
    """GenZ-ICP with its own settings, but for the voxel, the laser's range and planes.

    It has no option for its threads: who measures it has to bind the process to one core.
    """

    name = "genz_icp"
    package = "genz-icp"

    def aligner(self) -> "GenZAligner":
        """The peer before its first scan."""
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
        """Takes one more scan's points (P, 3); the pose (4, 4)."""
        self._odometry.register_frame(points, np.empty(0))
        return np.array(self._odometry.last_pose)
