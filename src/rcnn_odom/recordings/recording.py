"""What every recording looks like once it has been read."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from rcnn_odom.geometry import FORWARD_CAMERA, FloatArray

ReadScan = Callable[[int], tuple[FloatArray, FloatArray]]
"""Frame index -> angles in radians (0 ahead, counter-clockwise) and ranges in metres, both (P,)."""


@dataclass(frozen=True)
class Sequence:
    """One drive: scans in file order with the truth about where each was taken.

    Attributes:
        name: as a user names it, for instance ``05`` or ``mit-killian``.
        poses: (N, 4, 4) laser to world. nan where the truth is unknown.
        stamps: (N,) seconds.
        read_scan: returns of one frame; a picklable callable, since encoding runs in processes.
        fingerprint: changes whenever ``read_scan`` would return something else: the cache's key.
        camera_from_laser: (4, 4), KITTI's ``Tr``: the frame in which trajectories are written.
        wheel_odometry: (N, 4, 4) laser poses by the robot's own odometry, where the log has them.
        notes: what the reader noticed, counted or flagged, in words for the user.
    """

    name: str
    poses: FloatArray
    stamps: FloatArray
    read_scan: ReadScan
    fingerprint: str
    camera_from_laser: FloatArray = field(default_factory=FORWARD_CAMERA.copy)
    wheel_odometry: FloatArray | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.poses)

    def __post_init__(self) -> None:
        assert self.poses.shape == (len(self.stamps), 4, 4), (self.name, self.poses.shape)
        assert self.poses.dtype == self.stamps.dtype == np.float64
