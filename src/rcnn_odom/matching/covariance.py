"""The uncertainty of a match: the directions that it does not determine, and covariances of pose and step."""

from typing import NamedTuple

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray
from rcnn_odom.matching.outline import Outline

LEAST_NORMAL_NOISE = 0.01
"""Radians: the least standard deviation of a normal that is assumed."""
LEAST_INFORMATION = 0.004
"""Mean information of the pairs on a direction: the mean square of the change of the residuals per metre or
radian. With less, as along a bare corridor, the guess counts more than the match."""
WEAK_INFORMATION = 0.03
"""The same, at which the information of a match is halved: the few points that determine such a direction
have correlated errors."""
HARDLY = 0.05
"""The same, below which other starts along the direction are tried as well."""
HARDLY_TURNS = 0.1
"""Radians per metre: an undetermined direction with less turn than that is taken as a pure translation."""
MAP_ERROR = 0.006
"""Metres: the error of a map point, in addition to the scatter of a scan."""
CORRELATED = 1.1
"""Number of points with one common error, as neighbours on a wall share the error of its line. Fitted."""
DRIFTS = np.array([8.0, 0.5])
"""Drift of the moving map: its variance per median range travelled and per radian turned, relative to the
variance of a match. Fitted."""


class Aligned(NamedTuple):
    """The result of an alignment.

    Attributes:
        pose: (3,) in the map's frame.
        score: see :func:`rcnn_odom.matching.align.align`.
        fit: the score of the points on lines, if there are enough of them.
        information: (3, 3) on x, y and heading in the map's frame, a mean over the pairs, without the
            spurious part from errors of the normals.
        weight: sum of the weights of the pairs, scaled from the aligned points to all points of the scan,
            because points that were left out contributed to the lines.
        square: variance of a point in square metres. It is the geometric mean of the mean square of the
            residuals, which is too small because fitting lines smooths, and of the scatter of the returns
            about their lines, which is too large on rough surfaces.
        share: share of the points with a partner.

    Example:
        >>> corridor = np.diag([0.0, 0.9, 4.0])  # the walls determine y and the heading, but not x
        >>> match = Aligned(np.zeros(3), 0.9, 0.9, corridor, weight=200.0, square=1e-4, share=1.0)
        >>> weakest_direction(match).round(3).tolist() in ([1.0, 0.0, 0.0], [-1.0, 0.0, 0.0])
        True
    """

    pose: FloatArray
    score: float
    fit: float
    information: FloatArray
    weight: float
    square: float
    share: float

    @classmethod
    def from_alignment(
        cls, pose: FloatArray, score: float, fit: float, found: FloatArray, scan: Outline, aligned: int
    ) -> "Aligned":
        """The result from what :func:`rcnn_odom.matching.align.align` returns and writes.

        Args:
            pose, score, fit: as returned.
            found: (7, 3), as written.
            scan: the outline whose points were aligned.
            aligned: number of its points that were used.

        Example:
            Half of the 200 points were aligned, with a sum of their weights of 90:

            >>> scan = Outline(*[np.zeros((200, 2))] * 3, 200, 1e-4, 0.0, reach=2.0, spacing=0.01)
            >>> found = np.vstack([np.eye(3), np.zeros((3, 3)), [90.0, 1e-4, 0.95]])
            >>> Aligned.from_alignment(np.zeros(3), 0.9, 0.9, found, scan, aligned=100).weight
            180.0
        """
        information = found[:3] - max(scan.normal_noise, LEAST_NORMAL_NOISE**2) * found[3:6]
        scatter = scan.scatter if scan.lines else found[6, 1]
        square = float(np.sqrt(found[6, 1] * scatter)) + MAP_ERROR**2
        weight = float(found[6, 0]) * len(scan.points) / aligned
        return cls(pose, score, fit, information, weight, square, float(found[6, 2]))


def hold_undetermined(
    aligned: Aligned, guess: FloatArray, spread: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Replaces the match by the guess along the directions that the scan does not determine.

    Zhang, Kaess and Singh, "On Degeneracy of Optimization-based State Estimation Problems", ICRA 2016. Here
    the transition is gradual, so that the pose does not jump where a direction becomes determined.

    Args:
        aligned: the match.
        guess: (3,) pose in the map's frame.
        spread: (3, 3) covariance of the guess in the map's frame.

    Returns:
        The pose (3,); the directions (3, K) along which the guess counts more than the match; and the
        information (3, 3) of the match on the pose, in inverse square metres and radians. All are in the
        map's frame.

    Example:
        Along a corridor x comes from the guess, which is 1 m, and y from the match, which is 0.2 m:

        >>> pose, corridor = np.array([0.3, 0.2, 0.0]), np.diag([0.0, 0.9, 4.0])
        >>> match = Aligned(pose, 0.9, 0.9, corridor, weight=200.0, square=1e-4, share=1.0)
        >>> held, directions, _ = hold_undetermined(match, np.array([1.0, 0.0, 0.0]), spread=np.eye(3))
        >>> held.round(3) + 0.0, np.abs(directions.T)
        (array([1. , 0.2, 0. ]), array([[1., 0., 0.]]))
    """
    pose, directions, share, information = _replace_undetermined(
        aligned.pose, guess, spread, aligned.information, aligned.weight / (CORRELATED * aligned.square)
    )
    return pose, directions[:, share > 0.5], information


def weakest_direction(aligned: Aligned) -> FloatArray | None:
    """The direction (3,) of a translation by 1 m that the match hardly determines.

    None if all directions are determined, or if the least determined one is the heading.

    Example:
        >>> room = np.diag([0.5, 0.5, 4.0])  # walls on all sides
        >>> match = Aligned(np.zeros(3), 0.9, 0.9, room, weight=200.0, square=1e-4, share=1.0)
        >>> weakest_direction(match) is None
        True
        >>> corridor = match._replace(information=np.diag([0.0, 0.9, 4.0]))  # walls along x
        >>> np.abs(weakest_direction(corridor))
        array([1., 0., 0.])
    """
    least, along = _least_information(aligned.information)
    if least > HARDLY or abs(along[2]) > 0.7:
        return None
    direction: FloatArray = np.array([along[0], along[1], 0.0]) / np.hypot(along[0], along[1])
    return direction


@compiled
def _least_information(information):  # type: ignore[no-untyped-def]
    """The least eigenvalue of an information matrix (3, 3) and its direction (3,)."""
    values, vectors = np.linalg.eigh(information)
    return values[0], vectors[:, 0].copy()


@compiled
def _replace_undetermined(pose, guess, spread, information, scale):  # type: ignore[no-untyped-def]
    """The pose, the directions (3, 3), the share of the guess in each (3,), and the match's information.

    Args:
        pose, guess, spread: as in :func:`hold_undetermined`.
        information: (3, 3) of the match, a mean over the pairs.
        scale: factor from the mean to the information of all pairs, inverse square metres.
    """
    strengths, directions = np.linalg.eigh(information)
    strengths = np.maximum(strengths, 0.0)
    share = LEAST_INFORMATION**2 / (LEAST_INFORMATION**2 + strengths**2)
    off = pose - guess
    off[2] = (off[2] + np.pi) % (2 * np.pi) - np.pi
    held = pose - directions @ (share * (directions.T @ off))
    strengths = scale * strengths * strengths / (strengths + WEAK_INFORMATION)
    for k in range(3):
        # The guess leaves a share of its error in the pose, so the variance is at least that.
        remaining = share[k] ** 2 * (directions[:, k] @ spread @ directions[:, k].copy())
        if strengths[k] * remaining > 1:
            strengths[k] = 1 / remaining
    weighted = (directions * strengths) @ directions.T
    for k in range(3):
        # A wall that is not quite straight seems to couple the heading to the translation along it.
        if share[k] > 0.5 and abs(directions[2, k]) < HARDLY_TURNS:
            along = directions[:, k].copy()
            along[2] = 0.0
            along /= np.sqrt(along[0] ** 2 + along[1] ** 2)
            directions[:, k] = along
            across = np.eye(3) - np.outer(along, along)
            weighted = across @ weighted @ across
    return held, directions, share, weighted


class Uncertainty:
    """Covariances of the pose in the map and of the last step, by a Kalman filter.

    The error e of a pose in the map becomes e' = (1 - G) (F e + w) + G m. Here w is the error of the guess
    and m that of the match. The gain G is 0 if the scan gives no information and 1 if it gives enough. F
    propagates an error of the heading to the next position. The error of the step is e' - F e.

    Attributes:
        pose: (3, 3) covariance of the last pose in the map's frame.

    Example:
        A guess and a match of the same variance; together they have half of it:

        >>> uncertainty, pose = Uncertainty(), np.zeros(3)
        >>> step, noise = uncertainty.update(pose, pose, guess=np.eye(3), information=np.eye(3))
        >>> uncertainty.pose.diagonal().round(6)
        array([0.5, 0.5, 0.5])
    """

    def __init__(self) -> None:
        self.pose = np.zeros((3, 3))

    def update(
        self,
        before: FloatArray,
        after: FloatArray,
        guess: FloatArray,
        information: FloatArray,
        reach: float = 1.0,
    ) -> tuple[FloatArray, FloatArray]:
        """Adds the match of one more scan.

        Args:
            before, after: poses (3,) in the map's frame.
            guess: (3, 3) covariance of the guessed step in the map's frame.
            information: (3, 3) of the match on the later pose, in the map's frame; 0 without a match.
            reach: median range of the scan in metres, to which the length of the map is proportional.

        Returns:
            Covariances (3, 3) of the step, in the frame of the earlier pose, and of the part G m of its error
            that the next step cancels, in the frame of the later pose.
        """
        self.pose, step, noise = _update(self.pose, before, after, guess, information, DRIFTS / [reach, 1.0])
        return step, noise


@compiled
def _update(pose, before, after, guess, information, drifts):  # type: ignore[no-untyped-def]
    """The new covariance of the pose, and what :meth:`Uncertainty.update` returns."""
    x, y = after[0] - before[0], after[1] - before[1]
    distance, turn = np.sqrt(x * x + y * y), abs(after[2] - before[2])
    moved = np.eye(3)
    moved[0, 2], moved[1, 2] = -y, x
    carried = moved @ pose @ moved.T
    prior = carried + guess
    updated = np.linalg.inv(information + np.linalg.inv(prior))
    gain = updated @ information
    rest = np.eye(3) - gain
    noise = updated @ information @ updated.T
    step = gain @ carried @ gain.T + rest @ guess @ rest.T
    step += noise * (1 + drifts[0] * distance + drifts[1] * turn)
    to_before, to_after = np.eye(3), np.eye(3)
    for rotation, heading in ((to_before, before[2]), (to_after, after[2])):
        rotation[0, 0] = rotation[1, 1] = np.cos(heading)
        rotation[0, 1] = np.sin(heading)
        rotation[1, 0] = -rotation[0, 1]
    return updated, to_before @ step @ to_before.T, to_after @ noise @ to_after.T
