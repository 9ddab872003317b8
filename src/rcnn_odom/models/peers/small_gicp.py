"""small_gicp: point-to-point ICP from scan to scan.

Koide, "small_gicp: Efficient and parallel algorithms for point cloud registration", Journal of Open Source
Software 9, 2024. Its ``PLANE_ICP`` fits planes to the points. If z = 0 for all points, every plane is the
floor, and the estimate does not move, without any message. Its ``GICP`` then equals point-to-point ICP.
"""

from typing import Any

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.models.peers.peer import Peer
from rcnn_odom.recordings.scan import Scan

GATE_IN_VOXELS = 4.0
"""Maximum distance between corresponding points as a multiple of the voxel size.

This is the ratio of the package's defaults, 1 m and 0.25 m.
"""

SETTLED, MOST_ITERATIONS = 1e-4, 50
"""The iteration ends after a change of fewer metres and radians, or after so many iterations.

The first is at most a tenth of the package's defaults, because a robot moves only a few centimetres between
scans.
"""


class SmallGICP(Peer):
    """small_gicp on one thread; the initial guess is the last motion, as in its own odometry example."""

    name = "small_gicp"
    package = "small_gicp"

    def aligner(self) -> "SmallGICPAligner":
        """Makes the peer, before its first scan."""
        return SmallGICPAligner(self.imported("small_gicp"), self.options["voxel"])


class SmallGICPAligner:
    """small_gicp with the last scan, with which the next one is aligned."""

    def __init__(self, library: Any, voxel: float) -> None:
        self._library, self._voxel = library, voxel
        self._target: Any = None
        self._tree: Any = None
        self._pose, self._motion = np.eye(4), np.eye(4)

    def add(self, scan: Scan, points: FloatArray) -> FloatArray:
        """Adds the points (P, 3) of one more scan; returns the laser's pose (4, 4)."""
        cloud = self._library.voxelgrid_sampling(points, self._voxel)
        if self._target is not None:
            found = self._library.align(
                self._target,
                cloud,
                self._tree,
                self._motion,
                registration_type="ICP",
                max_correspondence_distance=GATE_IN_VOXELS * self._voxel,
                num_threads=1,
                max_iterations=MOST_ITERATIONS,
                rotation_epsilon=SETTLED,
                translation_epsilon=SETTLED,
            )
            self._motion = np.array(found.T_target_source)
        self._target, self._tree = cloud, self._library.KdTree(cloud)
        self._pose = self._pose @ self._motion
        return self._pose
