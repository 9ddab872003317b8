"""Finds the pose of a laser on its robot from the transforms of ``/tf_static`` (tf2_msgs/TFMessage)."""

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from rcnn_odom.geometry import FloatArray, poses_to_planar
from rcnn_odom.recordings.bags.files import Bag
from rcnn_odom.recordings.bags.messages import read_known
from rcnn_odom.recordings.bags.topics import TRANSFORMS

MOST_TILT = math.radians(5.0)
"""Largest tilt of a laser; with more, it hits other walls than a level one, and its ranges are longer."""

Parents = dict[str, tuple[str, FloatArray]]
"""For the name of each frame: the name of its parent, and its pose (4, 4) in the parent."""


class Mount(NamedTuple):
    """How a laser is mounted.

    Attributes:
        pose: x and y in metres and heading in radians in the robot's frame.
        is_upside_down: whether the laser is upside down, so that its bearings count clockwise from above.
    """

    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    is_upside_down: bool = False


def find_mount(bag: Bag, base: str, laser: str) -> Mount:
    """Find how a laser is mounted.

    Args:
        bag: bag with the transforms.
        base: the robot's frame; slashes around it are ignored.
        laser: the frame of the scans; slashes around it are ignored.

    Raises:
        ValueError: the transforms do not connect the frames, or the laser is not mounted level.
    """
    base, laser = base.strip("/"), laser.strip("/")
    if not laser:
        raise ValueError("the scans name no frame of their laser")
    if base == laser:
        return Mount()
    parents = _read_parents(bag)
    frames = sorted(parents.keys() | {parent for parent, _ in parents.values()})
    if not frames:
        raise ValueError("the bag has no /tf_static, so the pose of the laser on the robot is unknown")
    for name in (base, laser):
        if name not in frames:
            raise ValueError(f"/tf_static has no frame {name}, only {', '.join(frames)}")
    root_of_base, base_pose = _follow_to_root(parents, base)
    root_of_laser, laser_pose = _follow_to_root(parents, laser)
    if root_of_base != root_of_laser:
        raise ValueError(f"/tf_static does not connect {base} with {laser}")
    if not (np.isfinite(base_pose).all() and np.isfinite(laser_pose).all()):
        raise ValueError(f"/tf_static has no valid rotation between {base} and {laser}")
    pose = np.linalg.inv(base_pose) @ laser_pose
    tilt = math.acos(min(abs(pose[2, 2]), 1.0))
    if tilt > MOST_TILT:
        raise ValueError(
            f"{laser} is not mounted level on {base}: it is tilted by {math.degrees(tilt):.0f} degrees"
        )
    x, y, heading = poses_to_planar([pose])[0].tolist()
    return Mount((x, y, heading), bool(pose[2, 2] < 0))


def _read_parents(bag: Bag) -> Parents:
    parents: Parents = {}
    for topic, kinds in bag.topics.items():
        if topic.rpartition("/")[2] == "tf_static" and TRANSFORMS in kinds:
            for message, _ in read_known(bag, topic, TRANSFORMS, Counter()):
                for each in message.transforms:
                    pose = _to_matrix(each.transform)
                    parents[each.child_frame_id.strip("/")] = each.header.frame_id.strip("/"), pose
    return parents


def _to_matrix(transform: object) -> FloatArray:
    """Pose (4, 4) of a transform; nan if its quaternion is not a rotation."""
    from scipy.spatial.transform import Rotation

    place, turn = transform.translation, transform.rotation  # type: ignore[attr-defined]
    pose = np.eye(4)
    pose[:3, 3] = place.x, place.y, place.z
    try:
        pose[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    except ValueError:  # of length 0
        pose[:] = np.nan
    return pose


def _follow_to_root(parents: Parents, name: str) -> tuple[str, FloatArray]:
    """Follow the parents of a frame to the root.

    Returns:
        Name of the root, the frame without a parent; and the pose (4, 4) of the given frame in it.

    Raises:
        ValueError: there is no root, because the parents form a loop.
    """
    pose, passed = np.eye(4), {name}
    while name in parents:
        name, step = parents[name]
        pose = step @ pose
        if name in passed:
            raise ValueError(f"the frames of /tf_static form a loop through {name}")
        passed.add(name)
    return name, pose
