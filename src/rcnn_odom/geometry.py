"""Planar geometry: poses, the steps between them, and the composition of steps to poses (paper eq. 2).

A *pose* is a 4x4 matrix from the laser's frame (x forward, y left, z up) to a fixed frame. A *step* is the
pose of the laser at one scan in the frame of the previous scan: x and y in metres and the heading in radians,
counter-clockwise. Every estimator returns steps, and all scores and figures are computed from them.
"""

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

FORWARD_CAMERA: FloatArray = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Transform from the laser to a forward-looking camera at the same place (x right, y down, z forward)."""


def unknown_covariance(*shape: int) -> FloatArray:
    """Unknown covariances (*shape, 3, 3): every entry is nan, never 0, because 0 would mean certainty.

    Example:
        >>> unknown_covariance()
        array([[nan, nan, nan],
               [nan, nan, nan],
               [nan, nan, nan]])
        >>> unknown_covariance(5).shape
        (5, 3, 3)
    """
    return np.full((*shape, 3, 3), np.nan)


@dataclass(frozen=True, eq=False)
class Step:
    """The motion from one scan to the next.

    Attributes:
        x, y: metres ahead and to the left in the frame of the earlier scan.
        heading: radians, counter-clockwise.
        covariance: (3, 3) of x, y and heading in the frame of the earlier scan; nan where unknown.
        taken_back: (3, 3) covariance of the part of the error that the next step cancels, in the frame of
            the later scan. The error of a pose in a map is such a part: it is in the step to that pose and,
            with the opposite sign, in the step from it. 0 if the errors of the steps are independent.

    Example:
        >>> step = Step(1.0, 0.0, np.pi / 2)  # 1 m ahead and a turn of 90 degrees to the left
        >>> step.array().round(4)
        array([1.    , 0.    , 1.5708])
    """

    x: float
    y: float
    heading: float
    covariance: FloatArray = field(default_factory=unknown_covariance)
    taken_back: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))

    def array(self) -> FloatArray:
        """x, y and heading, (3,)."""
        return np.array([self.x, self.y, self.heading])


@dataclass(frozen=True, eq=False)
class Steps:
    """The steps between the N consecutive scans of a drive.

    Attributes:
        values: (N-1, 3) x and y in metres and heading in radians, each in the frame of its earlier scan.
        covariances: (N-1, 3, 3); nan where unknown.

    Example:
        >>> square = Steps.with_unknown_covariance([[1.0, 0.0, np.pi / 2]] * 4)
        >>> len(square)
        4
        >>> square.poses()[2, :2, 3].round(3)  # x and y after two sides of a square of 1 m
        array([1., 1.])
    """

    values: FloatArray
    covariances: FloatArray

    @classmethod
    def with_unknown_covariance(cls, values: npt.ArrayLike) -> "Steps":
        """Steps (N-1, 3) of a method that gives no covariance."""
        values = np.asarray(values, dtype=np.float64).reshape(-1, 3)
        return cls(values, unknown_covariance(len(values)))

    def __len__(self) -> int:
        return len(self.values)

    def poses(self) -> FloatArray:
        """Laser poses (N, 4, 4); the first is the identity."""
        return compose(self.values)


def wrap_angle(angle: npt.ArrayLike) -> FloatArray:
    """Angles in radians, wrapped to [-pi, pi).

    Example:
        >>> np.rad2deg(wrap_angle(np.deg2rad([10.0, 190.0, -350.0]))).round(6)
        array([  10., -170.,   10.])
    """
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi


def planar_to_poses(planar: npt.ArrayLike) -> FloatArray:
    """Poses (N, 4, 4) from rows (N, 3) of x and y in metres and heading in radians.

    Example:
        >>> planar_to_poses([[1.0, 2.0, np.pi / 2]])[0].round(6)
        array([[ 0., -1.,  0.,  1.],
               [ 1.,  0.,  0.,  2.],
               [ 0.,  0.,  1.,  0.],
               [ 0.,  0.,  0.,  1.]])
    """
    x, y, heading = np.asarray(planar, dtype=np.float64).T
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(heading)
    poses[:, 1, 0] = np.sin(heading)
    poses[:, 0, 1] = -poses[:, 1, 0]
    poses[:, 0, 3], poses[:, 1, 3] = x, y
    return poses


def poses_to_planar(poses: npt.ArrayLike) -> FloatArray:
    """Rows (N, 3) of x and y in metres and heading in [-pi, pi]: poses (N, 4, 4) projected on the x-y plane.

    Example:
        >>> poses_to_planar(planar_to_poses([[1.0, 2.0, 0.5]])).round(6)
        array([[1. , 2. , 0.5]])
    """
    poses = np.asarray(poses, dtype=np.float64)
    heading = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    return np.stack([poses[:, 0, 3], poses[:, 1, 3], heading], axis=1)


def relative_steps(poses: npt.ArrayLike) -> FloatArray:
    """Steps (N-1, 3) between consecutive laser poses (N, 4, 4): x and y in metres, heading in radians.

    Example:
        >>> poses = planar_to_poses([[0.0, 0.0, np.pi / 2], [0.0, 1.0, np.pi / 2]])  # 1 m along its heading
        >>> relative_steps(poses).round(6) + 0.0
        array([[1., 0., 0.]])
    """
    poses = np.asarray(poses, dtype=np.float64)
    return poses_to_planar(np.linalg.inv(poses[:-1]) @ poses[1:])


def motions_of(steps: npt.ArrayLike) -> FloatArray:
    """The paper's two numbers (..., 2) for steps (..., 3): distance in metres and heading change in radians.

    Distance is the projection of the step on the heading in mid-turn (paper III: "travelling distance"). It
    is negative in reverse, and it is continuous for a laser that is mounted off the axis of a robot that
    turns on the spot.

    Example:
        >>> motions_of([[2.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])  # 2 m ahead, 1 m in reverse
        array([[ 2.,  0.],
               [-1.,  0.]])
        >>> motions_of([1.0, 1.0, np.pi / 2]).round(3)  # a quarter circle of radius 1 m: its chord
        array([1.414, 1.571])
    """
    x, y, heading = np.moveaxis(np.asarray(steps, dtype=np.float64), -1, 0)
    return np.stack([x * np.cos(heading / 2) + y * np.sin(heading / 2), heading], axis=-1)


def motion_errors(motions: FloatArray, truth: FloatArray) -> FloatArray:
    """Errors (N, 2) of motions (N, 2) in metres and radians; the angle is wrapped to [-pi, pi).

    Example:
        >>> estimate, truth = np.deg2rad([[0.0, 179.0]]), np.deg2rad([[0.0, -179.0]])
        >>> np.rad2deg(motion_errors(estimate, truth)).round(6)
        array([[ 0., -2.]])
    """
    errors = motions - truth
    errors[:, 1] = wrap_angle(errors[:, 1])
    return errors


def advance(pose: FloatArray, step: FloatArray) -> FloatArray:
    """The pose after one step, which :func:`compose` does for a sequence.

    Args:
        pose: (3,) x and y in metres and heading in radians; the heading is not wrapped.
        step: (3,) in the frame of the pose.

    Example:
        >>> to_the_left = np.array([1.0, 0.0, np.pi / 2])
        >>> advance(to_the_left, np.array([2.0, 0.0, 0.0])).round(3)  # 2 m along its heading
        array([1.   , 2.   , 1.571])
    """
    x, y, heading = pose
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array([x + cos * step[0] - sin * step[1], y + sin * step[0] + cos * step[1], heading + step[2]])


def relative_step(pose: FloatArray, later: FloatArray) -> FloatArray:
    """The step (3,) from one pose to a later one, the inverse of :func:`advance`.

    Args:
        pose, later: (3,) x and y in metres and heading in radians.

    Example:
        >>> relative_step(np.array([1.0, 0.0, np.pi / 2]), np.array([1.0, 2.0, np.pi])).round(3)
        array([2.   , 0.   , 1.571])
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x, y = later[0] - pose[0], later[1] - pose[1]
    turn = (later[2] - pose[2] + math.pi) % (2 * math.pi) - math.pi
    return np.array([cos * x + sin * y, -sin * x + cos * y, turn])


def compound_covariance(pose: FloatArray, covariance: FloatArray, step: Step) -> FloatArray:
    """The covariance (3, 3) of the pose after a step whose error is independent of the pose before.

    To first order (Smith, Self and Cheeseman, 1990), in the frame in which the pose is given.

    Args:
        pose: (3,) x, y and heading before the step.
        covariance: (3, 3) of that pose; nan where unknown.
        step: the step, with its covariance.

    Example:
        A heading with a deviation of 0.1 radians moves a point 2 m ahead sideways, with a deviation of 0.2 m:

        >>> ahead = Step(2.0, 0.0, 0.0, np.zeros((3, 3)))
        >>> compound_covariance(np.zeros(3), np.diag([0.0, 0.0, 0.01]), ahead).round(6).tolist()
        [[0.0, 0.0, 0.0], [0.0, 0.04, 0.02], [0.0, 0.02, 0.01]]
    """
    return _compound(pose[2], covariance, step, step.covariance)


def _compound(heading: float, covariance: FloatArray, step: Step, step_covariance: FloatArray) -> FloatArray:
    """The covariance (3, 3) after a step from a pose with this heading and this covariance (3, 3)."""
    turn = rotation_matrix(heading)
    x, y = turn[0, 0] * step.x + turn[0, 1] * step.y, turn[1, 0] * step.x + turn[1, 1] * step.y
    return _propagate(lever_matrix(x, y), covariance) + _propagate(turn, step_covariance)


class AccumulatedCovariance:
    """The covariance of a pose, accumulated over the steps to it, in the frame of the first pose.

    The part of an error that the next step cancels (``Step.taken_back``) does not accumulate. It is counted
    once, for the last step, because no further step has cancelled it yet.

    Attributes:
        value: (3, 3) of x, y and heading. Entries that depend on a step of unknown covariance stay nan.

    Example:
        Three steps, each with an independent error of 0.1 m along x, have a variance of 3 times 0.01:

        >>> accumulated, step = AccumulatedCovariance(), Step(1.0, 0.0, 0.0, np.diag([0.01, 0.0, 0.0]))
        >>> for x in (0.0, 1.0, 2.0):
        ...     accumulated.add(np.array([x, 0.0, 0.0]), step)
        >>> accumulated.value.diagonal().round(6)
        array([0.03, 0.  , 0.  ])
    """

    def __init__(self) -> None:
        self.value: FloatArray = np.zeros((3, 3))
        self._lasting: FloatArray = np.zeros((3, 3))
        self._taken_back: FloatArray = np.zeros((3, 3))  # by the next step, in the frame of the last pose

    def add(self, pose: FloatArray, step: Step) -> None:
        """Adds a step that starts at this pose (3,): x and y in metres, heading in radians."""
        if not (step.covariance.any() or step.array().any()):
            return  # the zero step of a scan that was not used
        lasting = step.covariance
        if self._taken_back.any() or step.taken_back.any():
            cancelled = relative_covariance(step, self._taken_back, step.taken_back)
            lasting = _nearest_covariance(lasting - cancelled)
        self._taken_back = step.taken_back
        self._lasting = _compound(pose[2], self._lasting, step, lasting)
        self.value = self._lasting + turn_covariance(self._taken_back, pose[2] + step.heading)


def lever_matrix(x: float, y: float) -> FloatArray:
    """The Jacobian (3, 3) of a pose x and y metres away with respect to the pose from which it is seen.

    Example:
        >>> lever_matrix(2.0, 0.0) @ [0.0, 0.0, 0.1]  # 2 m ahead, an error of the heading is one sideways
        array([0. , 0.2, 0.1])
    """
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])


def rotation_matrix(heading: float) -> FloatArray:
    """The matrix (3, 3) that rotates x and y by a heading in radians and leaves the heading as it is.

    Example:
        >>> (rotation_matrix(math.pi / 2) @ [1.0, 0.0, 0.3]).round(3)
        array([0. , 1. , 0.3])
    """
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _nearest_covariance(covariance: FloatArray) -> FloatArray:
    """The positive semi-definite matrix nearest to a symmetric one (3, 3); one with nan is unchanged."""
    (a, b, c), (_, d, e), (_, _, f) = covariance.tolist()
    # The usual case has positive leading minors; checking them takes a tenth of the time of eigh.
    if a > 0 and a * d > b * b and a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d) > 0:
        return covariance
    if np.isnan(covariance).any():
        return covariance
    variances, directions = np.linalg.eigh(covariance)
    return (directions * np.maximum(variances, 0.0)) @ directions.T


def change_step_frame(step: Step, laser_pose: tuple[float, float, float]) -> Step:
    """The robot's step from its laser's step S: T S T^-1, where T is the pose of the laser on the robot.

    The covariance is propagated to first order.

    Args:
        step: of the laser.
        laser_pose: x and y in metres and heading in radians of the laser on the robot.

    Example:
        The robot turns by 90 degrees on the spot, which moves a laser that is mounted 0.5 m ahead:

        >>> robot = change_step_frame(Step(-0.5, 0.5, np.pi / 2), (0.5, 0.0, 0.0))
        >>> robot.array().round(3) + 0.0
        array([0.   , 0.   , 1.571])
    """
    x, y, angle = laser_pose
    cos, sin = np.cos(angle), np.sin(angle)
    cos_turn, sin_turn = np.cos(step.heading), np.sin(step.heading)
    jacobian = np.array(
        [
            [cos, -sin, sin_turn * x + cos_turn * y],
            [sin, cos, -cos_turn * x + sin_turn * y],
            [0.0, 0.0, 1.0],
        ]
    )
    return Step(
        float(x + cos * step.x - sin * step.y - (cos_turn * x - sin_turn * y)),
        float(y + sin * step.x + cos * step.y - (sin_turn * x + cos_turn * y)),
        step.heading,
        _propagate(jacobian, step.covariance),
        _propagate(np.array([[cos, -sin, y], [sin, cos, -x], [0.0, 0.0, 1.0]]), step.taken_back),
    )


def relative_covariance(step: Step, earlier: FloatArray, later: FloatArray) -> FloatArray:
    """The covariance (3, 3) of a step between two poses with independent errors.

    To first order, in the frame of the earlier pose.

    Args:
        step: from the earlier to the later pose.
        earlier, later: (3, 3) covariances of the two poses, each in its own frame.

    Example:
        An earlier heading with a deviation of 0.1 radians sees a pose 2 m ahead with 0.2 m sideways:

        >>> earlier, later = np.diag([0.0, 0.0, 0.01]), np.zeros((3, 3))
        >>> relative_covariance(Step(2.0, 0.0, 0.0), earlier, later).diagonal().round(6)
        array([0.  , 0.04, 0.01])
    """
    return _propagate(lever_matrix(step.x, step.y), earlier) + turn_covariance(later, step.heading)


def turn_covariance(covariance: FloatArray, heading: float) -> FloatArray:
    """A covariance (3, 3) from the frame of a pose to the frame in which the pose has this heading.

    Args:
        covariance: (3, 3) of x, y and heading; nan where unknown.
        heading: radians.

    Example:
        >>> turn_covariance(np.diag([1.0, 4.0, 0.1]), np.pi / 2).diagonal().round(6)  # x and y swap
        array([4. , 1. , 0.1])
    """
    return _propagate(rotation_matrix(heading), covariance)


def covariance_ellipse(covariance: FloatArray, deviations: float) -> tuple[FloatArray, float] | None:
    """The ellipse of so many standard deviations around a position with this covariance (2, 2).

    Returns:
        The half axes (2,) in metres, the longer first, and the direction of the longer one in radians; None
        if the covariance is unknown.

    Example:
        >>> axes, direction = covariance_ellipse(np.diag([0.01, 0.04]), 3.0)  # 0.1 m along x, 0.2 m along y
        >>> axes.round(6).tolist(), round(direction % np.pi, 3)
        ([0.6, 0.3], 1.571)
    """
    if not np.isfinite(covariance).all():
        return None
    variances, directions = np.linalg.eigh(covariance)  # the larger last
    half_axes = deviations * np.sqrt(np.maximum(variances[::-1], 0.0))
    return half_axes, math.atan2(directions[1, 1], directions[0, 1])


def turn_to_middle(step: Step) -> Step:
    """A step in the frame of the heading in mid-turn; divided by its duration it is the body's velocity.

    Example:
        >>> half_circle = Step(0.0, 1.0, np.pi)  # to the left; in mid-turn the body heads along y
        >>> turn_to_middle(half_circle).array().round(3)
        array([1.   , 0.   , 3.142])
    """
    cos, sin = np.cos(step.heading / 2), np.sin(step.heading / 2)
    x, y = float(cos * step.x + sin * step.y), float(-sin * step.x + cos * step.y)
    jacobian = np.array([[cos, sin, y / 2], [-sin, cos, -x / 2], [0.0, 0.0, 1.0]])
    return Step(x, y, step.heading, _propagate(jacobian, step.covariance))


def _propagate(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """J C J^T for a covariance C (3, 3), in which unknown entries (nan) affect only what depends on them."""
    if not math.isnan(covariance.sum()):
        return jacobian @ covariance @ jacobian.T
    unknown = np.isnan(covariance)
    propagated = jacobian @ np.where(unknown, 0.0, covariance) @ jacobian.T
    weights = (jacobian != 0).astype(np.float64)
    propagated[weights @ unknown @ weights.T > 0] = np.nan
    return propagated


def compose(steps: npt.ArrayLike) -> FloatArray:
    """Poses (T+1, 4, 4) from steps (T, 3); the first pose is the identity (paper eq. 2).

    The paper prints the heading *increment* inside the sine and cosine, where the accumulated heading is
    needed.

    Example:
        >>> poses = compose([[1.0, 0.0, np.pi / 2], [1.0, 0.0, 0.0]])  # 1 m, a left turn, 1 m
        >>> poses_to_planar(poses).round(3)
        array([[0.   , 0.   , 0.   ],
               [1.   , 0.   , 1.571],
               [1.   , 1.   , 1.571]])
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
    """The same motion, poses (N, 4, 4), of another frame on the same body.

    With KITTI's ``Tr`` (4, 4) (camera from laser) laser poses become camera poses; its inverse reverts that.

    Example:
        >>> laser = planar_to_poses([[0.0, 0.0, 0.0], [2.0, 0.5, 0.0]])  # 2 m ahead, 0.5 m to the left
        >>> change_frame(laser, FORWARD_CAMERA)[1, :3, 3] + 0.0  # x right, y down, z forward
        array([-0.5,  0. ,  2. ])
    """
    new_from_old = np.asarray(new_from_old, dtype=np.float64)
    return new_from_old @ np.asarray(poses, dtype=np.float64) @ np.linalg.inv(new_from_old)
