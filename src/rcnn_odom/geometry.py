"""Planar motion: relative motions out of poses, and poses out of relative motions (paper eq. 2).

A *pose* is a 4x4 matrix from the laser's frame (x forward, y left, z up) to a fixed frame.
A *motion* is the pair (distance, heading change) from scan t-1 to scan t in metres and radians:
all that the networks estimate.
"""

from typing import Literal

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ApplyStep = Literal["start", "middle", "end"]

STEP_FRACTION = {"start": 0.0, "middle": 0.5, "end": 1.0}
"""How much of a heading change has happened when the step is taken."""

FORWARD_CAMERA: FloatArray = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Laser to a camera at the same place that looks forward: x right, y down, z forward."""


def wrap_angle(angle: npt.ArrayLike) -> FloatArray:
    """Angles in radians, brought into [-pi, pi)."""
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi


def planar_to_poses(planar: npt.ArrayLike) -> FloatArray:
    """Poses (N, 4, 4) out of rows of x, y in metres and heading in radians, (N, 3)."""
    x, y, heading = np.asarray(planar, dtype=np.float64).T
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(heading)
    poses[:, 1, 0] = np.sin(heading)
    poses[:, 0, 1] = -poses[:, 1, 0]
    poses[:, 0, 3], poses[:, 1, 3] = x, y
    return poses


def poses_to_planar(poses: npt.ArrayLike) -> FloatArray:
    """Rows of x, y and heading in [-pi, pi], (N, 3): the shadow of (N, 4, 4) on the x-y plane."""
    poses = np.asarray(poses, dtype=np.float64)
    heading = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    return np.stack([poses[:, 0, 3], poses[:, 1, 3], heading], axis=1)


def relative_motions(poses: npt.ArrayLike) -> FloatArray:
    """Motions (N-1, 2) between consecutive poses (N, 4, 4) of the laser.

    Distance is the length of the step in the plane of the earlier scan, negative when the step goes
    backwards (paper III: "travelling distance"; the sign makes reversing representable).
    """
    poses = np.asarray(poses, dtype=np.float64)
    steps = np.linalg.inv(poses[:-1]) @ poses[1:]
    forward, left = steps[:, 0, 3], steps[:, 1, 3]
    distance = np.where(forward < 0, -1.0, 1.0) * np.hypot(forward, left)
    return np.stack([distance, np.arctan2(steps[:, 1, 0], steps[:, 0, 0])], axis=1)


def motion_errors(motions: FloatArray, truth: FloatArray) -> FloatArray:
    """Errors (N, 2) of motions (N, 2): metres, and radians the short way round."""
    errors = motions - truth
    errors[:, 1] = wrap_angle(errors[:, 1])
    return errors


def advance(pose: FloatArray, motion: FloatArray, apply: ApplyStep = "end") -> FloatArray:
    """The next pose, x, y and heading (3,), after one motion (2,): a step of :func:`compose`."""
    x, y, heading = pose
    distance, turn = motion
    direction = heading + STEP_FRACTION[apply] * turn
    return np.array([x + distance * np.cos(direction), y + distance * np.sin(direction), heading + turn])


def compose(motions: npt.ArrayLike, apply: ApplyStep = "end") -> FloatArray:
    """Poses (T+1, 4, 4), the first the identity, out of motions (T, 2): paper eq. 2.

    The paper prints the heading *increment* inside the sine and cosine; the accumulated heading must
    stand there. ``apply`` says where along the turn the step is taken.
    """
    distance, turn = np.asarray(motions, dtype=np.float64).T
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    direction = heading[:-1] + STEP_FRACTION[apply] * turn
    planar = np.zeros((len(heading), 3))
    planar[1:, 0] = np.cumsum(distance * np.cos(direction))
    planar[1:, 1] = np.cumsum(distance * np.sin(direction))
    planar[:, 2] = heading
    return planar_to_poses(planar)


def change_frame(poses: npt.ArrayLike, new_from_old: npt.ArrayLike) -> FloatArray:
    """The same motion, (N, 4, 4), told of another frame on the same body.

    With KITTI's ``Tr`` (camera from laser) laser poses become camera poses; with its inverse, back.
    """
    new_from_old = np.asarray(new_from_old, dtype=np.float64)
    return new_from_old @ np.asarray(poses, dtype=np.float64) @ np.linalg.inv(new_from_old)
