"""Reads a robot's own odometry from a bag (nav_msgs/Odometry) and interpolates it at the stamps of scans."""

import math
from array import array
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, planar_to_poses, poses_to_planar, wrap_angle
from rcnn_odom.recordings.bags.files import Bag
from rcnn_odom.recordings.bags.messages import Clock, read_known
from rcnn_odom.recordings.bags.topics import ODOMETRY, choose_odometry

FARTHEST_IN_TIME = 0.5
"""Seconds; largest time between a scan and the poses that it is interpolated from."""

Planar = tuple[float, float, float]
"""x and y in metres, heading in radians."""


@dataclass(frozen=True, eq=False)
class WheelOdometry:
    """Poses from the robot's own odometry.

    Attributes:
        stamps: (M,) seconds, ascending.
        poses: (M, 3) x and y in metres, heading in radians.
        frame: the robot's frame, whose poses these are; empty if unknown.
        note: message for the user.
    """

    stamps: FloatArray
    poses: FloatArray
    frame: str
    note: str

    def at(self, stamp: float | None, laser: FloatArray) -> Planar | None:
        """Interpolate the pose of the laser; None if a pose before or after is missing or too far in time.

        Args:
            stamp: seconds; None: unknown.
            laser: (4, 4) pose of the laser on the robot.
        """
        if stamp is None:
            return None
        after = int(np.searchsorted(self.stamps, stamp))
        before = after if after < len(self.stamps) and self.stamps[after] == stamp else after - 1
        if before < 0 or after == len(self.stamps):
            return None
        since, until = stamp - self.stamps[before], self.stamps[after] - stamp
        if max(since, until) > FARTHEST_IN_TIME:
            return None
        change = self.poses[after] - self.poses[before]
        change[2] = wrap_angle(change[2])  # the short way round
        pose = self.poses[before] + change * (since / (since + until) if since else 0.0)
        x, y, heading = poses_to_planar(planar_to_poses([pose]) @ laser)[0].tolist()
        return x, y, heading


def read_wheels(path: Path, bag: Bag, wanted: str) -> WheelOdometry:
    """Read all poses of an odometry topic; only four numbers of each message are kept in memory.

    Args:
        path: path of the bag, for errors.
        bag: bag to read from.
        wanted: name of the topic.

    Raises:
        InputError: there is no such topic, or it has no pose that can be read.
    """
    topic = choose_odometry(path, bag, wanted)
    rows, clock, unreadable, frame = array("d"), Clock(), Counter[str](), ""
    for message, arrival in read_known(bag, topic, ODOMETRY, unreadable):
        stamp, pose = clock.stamp(message, arrival), _get_planar_pose(message.pose.pose)
        if stamp is None or not all(map(math.isfinite, pose)):
            unreadable[topic] += 1
            continue
        frame = frame or str(message.child_frame_id).strip("/")
        rows.extend((stamp, *pose))
    if not rows:
        raise InputError(
            f"{path}: no pose of {topic} can be read; choose another topic, or leave --odom-topic out"
        )
    table = np.frombuffer(rows).reshape(-1, 4)
    stamps, first = np.unique(table[:, 0], return_index=True)
    lost = f", {unreadable[topic]} messages could not be read" if unreadable[topic] else ""
    return WheelOdometry(stamps, table[first, 1:], frame, f"{len(stamps)} poses of {topic}{lost}")


def _get_planar_pose(pose: Any) -> Planar:
    """x, y and heading of a pose; the heading is nan if the quaternion is not a rotation."""
    at, turn = pose.position, pose.orientation
    sine, cosine = 2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2)
    is_rotation = abs(turn.x**2 + turn.y**2 + turn.z**2 + turn.w**2 - 1) < 0.1
    return float(at.x), float(at.y), math.atan2(sine, cosine) if is_rotation else math.nan
