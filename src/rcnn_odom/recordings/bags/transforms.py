"""Where a laser sits on its robot, by the transforms of a bag's ``/tf_static`` (tf2_msgs/TFMessage)."""

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from rcnn_odom.geometry import FloatArray, poses_to_planar
from rcnn_odom.recordings.bags.files import Bag
from rcnn_odom.recordings.bags.messages import read_known
from rcnn_odom.recordings.bags.topics import TRANSFORMS

MOST_TILT = math.radians(5.0)
"""A laser that is tilted by more sees other walls than a level one, and its ranges are longer."""

Parents = dict[str, tuple[str, FloatArray]]
"""By a frame's name that of its parent, and its pose (4, 4) there."""


class Mount(NamedTuple):
    """How a laser is mounted.

    Attributes:
        pose: x and y in metres and heading in radians in the robot's frame.
        is_upside_down: its bearings count clockwise as seen from above.
    """

    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    is_upside_down: bool = False


def find_mount(bag: Bag, base: str, laser: str) -> Mount:
    """Where a laser sits.

    Args:
        bag: with the transforms.
        base: the robot's frame. laser: that of the scans. Slashes around them do not count.

    Raises:
        ValueError: the transforms do not tell, or it is not mounted level.
    """
    base, laser = base.strip("/"), laser.strip("/")
    if not laser:
        raise ValueError("the scans name no frame of their laser")
    if base == laser:
        return Mount()
    parents = _read_parents(bag)
    frames = sorted(parents.keys() | {parent for parent, _ in parents.values()})
    if not frames:
        raise ValueError("there is no /tf_static in it, which would say where the laser sits")
    for name in (base, laser):
        if name not in frames:
            raise ValueError(f"/tf_static has no frame {name}, only {', '.join(frames)}")
    root_of_base, base_pose = _to_root(parents, base)
    root_of_laser, laser_pose = _to_root(parents, laser)
    if root_of_base != root_of_laser:
        raise ValueError(f"/tf_static does not connect {base} with {laser}")
    if not (np.isfinite(base_pose).all() and np.isfinite(laser_pose).all()):
        raise ValueError(f"/tf_static holds no rotation between {base} and {laser}")
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
                    pose = _pose(each.transform)
                    parents[each.child_frame_id.strip("/")] = each.header.frame_id.strip("/"), pose
    return parents


def _pose(transform: object) -> FloatArray:
    """(4, 4); of nan where the rotation is none."""
    from scipy.spatial.transform import Rotation

    place, turn = transform.translation, transform.rotation  # type: ignore[attr-defined]
    pose = np.eye(4)
    pose[:3, 3] = place.x, place.y, place.z
    try:
        pose[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    except ValueError:  # of length 0
        pose[:] = np.nan
    return pose


def _to_root(parents: Parents, name: str) -> tuple[str, FloatArray]:
    """The frame that has no parent, and a frame's pose (4, 4) in it; ValueError where none is without one."""
    pose, passed = np.eye(4), {name}
    while name in parents:
        name, step = parents[name]
        pose = step @ pose
        if name in passed:
            raise ValueError(f"the frames of /tf_static go round in a ring, by way of {name}")
        passed.add(name)
    return name, pose
