"""Planar geometry: poses, the steps between them, and poses composed of steps (paper eq. 2).

A *pose* is a 4x4 matrix from the laser's frame (x forward, y left, z up) to a fixed frame. A *step* is where
the laser is at one scan, seen from where it was at the scan before: x and y in metres and the heading in
radians, counter-clockwise. Every estimator gives steps, and everything that scores or draws knows them only.
"""

import math
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
        taken_back: (3, 3) covariance of the part of its error that the next step takes back, in the frame of
            the later scan: the error of a pose in a map, for instance, which is in the step to it and, with
            the opposite sign, in the step from it. 0: the errors of steps are independent.

    >>> Step(1.0, 0.0, 0.1).array()
    array([1. , 0. , 0.1])
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
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array([x + cos * step[0] - sin * step[1], y + sin * step[0] + cos * step[1], heading + step[2]])


def relative_step(pose: FloatArray, later: FloatArray) -> FloatArray:
    """The step (3,) from one pose, x, y and heading (3,), to a later one: what :func:`advance` undoes.

    >>> relative_step(np.array([1.0, 0.0, np.pi / 2]), np.array([1.0, 2.0, np.pi / 2])).round(6)
    array([2., 0., 0.])
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x, y = later[0] - pose[0], later[1] - pose[1]
    turn = (later[2] - pose[2] + math.pi) % (2 * math.pi) - math.pi
    return np.array([cos * x + sin * y, -sin * x + cos * y, turn])


def compound_covariance(pose: FloatArray, covariance: FloatArray, step: Step) -> FloatArray:
    """The covariance (3, 3) of the pose after a step that is independent of the poses before.

    To first order (Smith, Self and Cheeseman, 1990), in the frame that the pose is told of.

    Args:
        pose: x, y and heading (3,) before the step.
        covariance: (3, 3), its own; nan where unknown.
        step: the step, with its covariance.

    >>> ahead = Step(2.0, 0.0, 0.0, np.zeros((3, 3)))
    >>> compound_covariance(np.zeros(3), np.diag([0.0, 0.0, 0.01]), ahead).round(6).tolist()
    [[0.0, 0.0, 0.0], [0.0, 0.04, 0.02], [0.0, 0.02, 0.01]]
    """
    return _add_up(pose[2], covariance, step, step.covariance)


def _add_up(heading: float, covariance: FloatArray, step: Step, of_step: FloatArray) -> FloatArray:
    """The covariance after a step from a pose with this heading, with that of the step given apart."""
    turn = _turn(heading)
    x, y = turn[0, 0] * step.x + turn[0, 1] * step.y, turn[1, 0] * step.x + turn[1, 1] * step.y
    return _carry(_lever(x, y), covariance) + _carry(turn, of_step)


class AccumulatedCovariance:
    """The covariance of a pose, accumulated along the steps to it, in the frame of the first pose.

    What a step takes back of the error of the one before (``Step.taken_back``) does not add up: only the rest
    does, and beside it stands what the next step will take back.

    Attributes:
        value: (3, 3) of x, y and heading; what depends on a step of unknown covariance stays nan.
    """

    def __init__(self) -> None:
        self.value: FloatArray = np.zeros((3, 3))
        self._drift: FloatArray = np.zeros((3, 3))
        self._open: FloatArray = np.zeros((3, 3))  # what the next step takes back, in the last pose's frame

    def add(self, pose: FloatArray, step: Step) -> None:
        """One more step, from this pose, x, y and heading (3,)."""
        if not (step.covariance.any() or step.array().any()):
            return  # a scan that was passed over: nothing has happened
        lasting = step.covariance
        if self._open.any() or step.taken_back.any():
            before = _carry(_lever(step.x, step.y), self._open)
            lasting = _without_negative(lasting - before - _carry(_turn(step.heading), step.taken_back))
        self._open = step.taken_back
        self._drift = _add_up(pose[2], self._drift, step, lasting)
        self.value = self._drift + _carry(_turn(pose[2] + step.heading), self._open)


def _lever(x: float, y: float) -> FloatArray:
    """What an error of the heading does to a place x and y metres away."""
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])


def _turn(heading: float) -> FloatArray:
    """What turns x and y of a covariance (3, 3) by a heading."""
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _without_negative(covariance: FloatArray) -> FloatArray:
    """The nearest matrix (3, 3) that is a covariance; one with nan as it is."""
    (a, b, c), (_, d, e), (_, _, f) = covariance.tolist()
    # Positive leading minors, the usual case, are looked at in a tenth of the time of what follows.
    if a > 0 and a * d > b * b and a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d) > 0:
        return covariance
    if np.isnan(covariance).any():
        return covariance
    variances, directions = np.linalg.eigh(covariance)
    return (directions * np.maximum(variances, 0.0)) @ directions.T


def change_step_frame(step: Step, laser_pose: tuple[float, float, float]) -> Step:
    """The step of a robot whose laser has made one: T S T^-1 with the pose T of the laser on the robot.

    The covariance is carried over to first order.

    Args:
        step: of the laser.
        laser_pose: x and y in metres and heading in radians of the laser on the robot.

    >>> turn = change_step_frame(Step(-0.5, 0.5, np.pi / 2), (0.5, 0.0, 0.0))  # the laser is ahead
    >>> (turn.array().round(6) + 0.0).tolist()  # the robot turns on the spot
    [0.0, 0.0, 1.570796]
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
        _carry(jacobian, step.covariance),
        _carry(np.array([[cos, -sin, y], [sin, cos, -x], [0.0, 0.0, 1.0]]), step.taken_back),
    )


def relative_covariance(step: Step, earlier: FloatArray, later: FloatArray) -> FloatArray:
    """The covariance (3, 3) of a step between two poses whose errors are independent.

    To first order, in the frame of the earlier pose.

    Args:
        step: from the earlier to the later pose.
        earlier, later: (3, 3) covariances of the two poses, each in its own frame.

    >>> turned = np.diag([0.0, 0.0, 0.01])
    >>> relative_covariance(Step(2.0, 0.0, 0.0), turned, np.zeros((3, 3))).round(6).tolist()
    [[0.0, 0.0, 0.0], [0.0, 0.04, 0.02], [0.0, 0.02, 0.01]]
    """
    return _carry(_lever(step.x, step.y), earlier) + _carry(_turn(step.heading), later)


def turn_covariance(covariance: FloatArray, heading: float) -> FloatArray:
    """A covariance (3, 3) of x, y and heading, told of a frame that sees it turned by ``heading`` radians.

    >>> turn_covariance(np.diag([1.0, 4.0, 0.1]), np.pi / 2).round(6).tolist()
    [[4.0, -0.0, 0.0], [-0.0, 1.0, 0.0], [0.0, 0.0, 0.1]]
    """
    return _carry(_turn(heading), covariance)


def turn_to_middle(step: Step) -> Step:
    """A step told of the heading in mid-turn: what the body itself moves, divided by the time its velocity.

    >>> turn_to_middle(Step(0.0, 1.0, np.pi)).array().round(6).tolist()  # a half circle to the left
    [1.0, 0.0, 3.141593]
    """
    cos, sin = np.cos(step.heading / 2), np.sin(step.heading / 2)
    x, y = float(cos * step.x + sin * step.y), float(-sin * step.x + cos * step.y)
    jacobian = np.array([[cos, sin, y / 2], [-sin, cos, -x / 2], [0.0, 0.0, 1.0]])
    return Step(x, y, step.heading, _carry(jacobian, step.covariance))


def _carry(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """J C J^T, where what is unknown (nan) spreads only to what depends on it."""
    if not math.isnan(covariance.sum()):
        return jacobian @ covariance @ jacobian.T
    unknown = np.isnan(covariance)
    carried = jacobian @ np.where(unknown, 0.0, covariance) @ jacobian.T
    weights = (jacobian != 0).astype(np.float64)
    carried[weights @ unknown @ weights.T > 0] = np.nan
    return carried


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
