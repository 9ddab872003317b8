"""Planar geometry: poses, the steps between them, and poses composed of steps (paper eq. 2).

A *pose* is a 4x4 matrix from the laser's frame (x forward, y left, z up) to a fixed frame. A *step* is where
the laser is at one scan, seen from where it was at the scan before: x and y in metres and the heading in
radians, counter-clockwise. Every estimator gives steps, and everything that scores or draws knows them only.
"""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

FORWARD_CAMERA: FloatArray = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Laser to a camera at the same place that looks forward: x right, y down, z forward."""


def unknown_covariance(*shape: int) -> FloatArray:
    """Covariances (*shape, 3, 3) of which nothing is known: nan, never 0, which would mean certainty."""
    return np.full((*shape, 3, 3), np.nan)


@dataclass(frozen=True, eq=False)
class Step:
    """The motion from one scan to the next.

    Attributes:
        x, y: metres ahead and to the left in the frame of the earlier scan.
        heading: radians, counter-clockwise.
        covariance: (3, 3) of x, y and heading in the frame of the earlier scan; nan where unknown.

    >>> Step(1.0, 0.0, 0.1).array()
    array([1. , 0. , 0.1])
    """

    x: float
    y: float
    heading: float
    covariance: FloatArray = field(default_factory=unknown_covariance)

    def array(self) -> FloatArray:
        """x, y and heading, (3,)."""
        return np.array([self.x, self.y, self.heading])


@dataclass(frozen=True, eq=False)
class Steps:
    """The steps between the N consecutive scans of a drive.

    Attributes:
        values: (N-1, 3) x and y in metres and heading in radians, each in the frame of its earlier scan.
        covariances: (N-1, 3, 3); nan where unknown.
    """

    values: FloatArray
    covariances: FloatArray

    @classmethod
    def with_unknown_covariance(cls, values: npt.ArrayLike) -> "Steps":
        """Steps (N-1, 3) of a method that does not know how good they are."""
        values = np.asarray(values, dtype=np.float64).reshape(-1, 3)
        return cls(values, unknown_covariance(len(values)))

    def __len__(self) -> int:
        return len(self.values)

    def poses(self) -> FloatArray:
        """Laser poses (N, 4, 4), the first the identity."""
        return compose(self.values)


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


def relative_steps(poses: npt.ArrayLike) -> FloatArray:
    """Steps (N-1, 3) between consecutive poses (N, 4, 4) of the laser: x, y in metres, heading in radians."""
    poses = np.asarray(poses, dtype=np.float64)
    return poses_to_planar(np.linalg.inv(poses[:-1]) @ poses[1:])


def motions_of(steps: npt.ArrayLike) -> FloatArray:
    """The paper's two numbers of steps (..., 3): distance in metres and heading change in radians, (..., 2).

    Distance is the projection of the step on the heading in mid-turn (paper III: "travelling distance"). Its
    sign makes reversing representable, and it is continuous for a laser that is mounted off the axis of a
    robot that turns on the spot.

    >>> motions_of([[2.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    array([[ 2.,  0.],
           [-1.,  0.]])
    """
    x, y, heading = np.moveaxis(np.asarray(steps, dtype=np.float64), -1, 0)
    return np.stack([x * np.cos(heading / 2) + y * np.sin(heading / 2), heading], axis=-1)


def motion_errors(motions: FloatArray, truth: FloatArray) -> FloatArray:
    """Errors (N, 2) of motions (N, 2): metres, and radians the short way round."""
    errors = motions - truth
    errors[:, 1] = wrap_angle(errors[:, 1])
    return errors


def advance(pose: FloatArray, step: FloatArray) -> FloatArray:
    """The next pose, x, y and heading (3,), after one step (3,): a step of :func:`compose`.

    >>> advance(np.array([1.0, 0.0, np.pi / 2]), np.array([2.0, 0.0, 0.0])).round(6)
    array([1.      , 2.      , 1.570796])
    """
    x, y, heading = pose
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([x + cos * step[0] - sin * step[1], y + sin * step[0] + cos * step[1], heading + step[2]])


def compose(steps: npt.ArrayLike) -> FloatArray:
    """Poses (T+1, 4, 4), the first the identity, out of steps (T, 3): paper eq. 2.

    The paper prints the heading *increment* inside the sine and cosine; the accumulated heading must
    stand there.
    """
    x, y, turn = np.asarray(steps, dtype=np.float64).reshape(-1, 3).T
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    planar = np.zeros((len(heading), 3))
    planar[1:, 0] = np.cumsum(cos * x - sin * y)
    planar[1:, 1] = np.cumsum(sin * x + cos * y)
    planar[:, 2] = heading
    return planar_to_poses(planar)


def change_frame(poses: npt.ArrayLike, new_from_old: npt.ArrayLike) -> FloatArray:
    """The same motion, (N, 4, 4), told of another frame on the same body.

    With KITTI's ``Tr`` (camera from laser) laser poses become camera poses; with its inverse, back.
    """
    new_from_old = np.asarray(new_from_old, dtype=np.float64)
    return new_from_old @ np.asarray(poses, dtype=np.float64) @ np.linalg.inv(new_from_old)
