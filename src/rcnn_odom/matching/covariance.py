"""What a match determines and how well: held directions, and the covariance of a pose in the map."""

from typing import NamedTuple

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray
from rcnn_odom.matching.outline import Outline

LEAST_NORMAL_NOISE = 0.01
"""Radians: the least standard deviation of a normal."""
LEAST_INFORMATION = 0.004
"""Mean information of the pairs on a direction: the mean square of the residuals' change over metres or
radians. Where there is less, as along a bare corridor, the guess counts more than the match."""
WEAK_INFORMATION = 0.03
"""The same, where the information of a match counts by half: the few points that determine such a direction
have errors in common."""
HARDLY = 0.05
"""The same, below which other places along a direction are tried as well."""
HARDLY_TURNS = 0.1
"""Radians a metre: a direction that is held along with less than that of a turn is one of the plane."""
MAP_ERROR = 0.006
"""Metres: the error of a point of the map in addition to the scatter of a scan."""
CORRELATED = 1.1
"""Points that share one error, as neighbours on a wall share those of the wall and its line. Fitted."""
DRIFTS = np.array([8.0, 0.5])
"""Variance by which a map that moves along drifts per median range of the way and per radian, over that of a
match. Fitted."""


class Aligned(NamedTuple):
    """What an alignment found.

    Attributes:
        pose: (3,) in the map's frame.
        score: see :func:`rcnn_odom.matching.align.align`.
        fit: the same of the points on lines, if there are enough of them.
        information: (3, 3) on x, y and heading in the map's frame, a mean over the pairs, without what errors
            of normals feign.
        weight: sum of the pairs' weights, multiplied by the scan's points over those that
            were aligned: points that were left out have helped to fit the lines.
        square: square metres, the variance of a point: the geometric mean of the mean square of the
            residuals, which is too small since lines smooth, and of the scatter of the returns about their
            lines, which is too large where surfaces are rough.
        share: part of the points with a partner.
    """

    pose: FloatArray
    score: float
    fit: float
    information: FloatArray
    weight: float
    square: float
    share: float

    @classmethod
    def of(
        cls, pose: FloatArray, score: float, fit: float, found: FloatArray, scan: Outline, aligned: int
    ) -> "Aligned":
        """Of what :func:`rcnn_odom.matching.align.align` gives for ``aligned`` points of a scan."""
        information = found[:3] - max(scan.normal_noise, LEAST_NORMAL_NOISE**2) * found[3:6]
        scatter = scan.scatter if scan.lines else found[6, 1]
        square = float(np.sqrt(found[6, 1] * scatter)) + MAP_ERROR**2
        weight = float(found[6, 0]) * len(scan.points) / aligned
        return cls(pose, score, fit, information, weight, square, float(found[6, 2]))


def hold_undetermined(
    aligned: Aligned, guess: FloatArray, spread: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Puts the guess in place of the match along what the scan does not determine.

    Zhang, Kaess and Singh, "On Degeneracy of Optimization-based State Estimation Problems", ICRA 2016; but
    gradually, so that nothing jumps where a direction is just determined.

    Args:
        aligned: the match.
        guess: (3,) pose in the map's frame.

    Returns:
        The pose (3,); the directions (3, K) along which the guess counts more than the match; and the
        information (3, 3) of the match on the pose, inverse square metres and radians. All of them in the
        map's frame.
    """
    pose, directions, share, information = _hold(
        aligned.pose, guess, spread, aligned.information, aligned.weight / (CORRELATED * aligned.square)
    )
    return pose, directions[:, share > 0.5], information


def weakest_direction(aligned: Aligned) -> FloatArray | None:
    """The direction (3,) of motion, a metre long, that is hardly determined.

    None where all are determined, or where it is the heading that is not.
    """
    least, along = _weakest(aligned.information)
    if least > HARDLY or abs(along[2]) > 0.7:
        return None
    direction: FloatArray = np.array([along[0], along[1], 0.0]) / np.hypot(along[0], along[1])
    return direction


@compiled
def _weakest(information):  # type: ignore[no-untyped-def]
    """The least information and its direction (3,)."""
    values, vectors = np.linalg.eigh(information)
    return values[0], vectors[:, 0].copy()


@compiled
def _hold(pose, guess, spread, information, of_all):  # type: ignore[no-untyped-def]
    """The held pose, the directions (3, 3), the share of the guess in each, and the match's information."""
    strengths, directions = np.linalg.eigh(information)
    strengths = np.maximum(strengths, 0.0)
    share = LEAST_INFORMATION**2 / (LEAST_INFORMATION**2 + strengths**2)
    off = pose - guess
    off[2] = (off[2] + np.pi) % (2 * np.pi) - np.pi
    held = pose - directions @ (share * (directions.T @ off))
    strengths = of_all * strengths * strengths / (strengths + WEAK_INFORMATION)
    for k in range(3):
        # Of the guess's error its share stays, whatever the match says of itself.
        stays = share[k] ** 2 * (directions[:, k] @ spread @ directions[:, k].copy())
        if strengths[k] * stays > 1:
            strengths[k] = 1 / stays
    weighed = (directions * strengths) @ directions.T
    for k in range(3):
        # A wall that is not quite straight feigns that the heading is held a little with the way along it.
        if share[k] > 0.5 and abs(directions[2, k]) < HARDLY_TURNS:
            along = directions[:, k].copy()
            along[2] = 0.0
            along /= np.sqrt(along[0] ** 2 + along[1] ** 2)
            directions[:, k] = along
            across = np.eye(3) - np.outer(along, along)
            weighed = across @ weighed @ across
    return held, directions, share, weighed


class Uncertainty:
    """Covariances of the pose in the map and of the last step, by a Kalman filter.

    The error e of a pose in the map becomes e' = (1 - G) (F e + w) + G m, with the error w of the guess, the
    error m of the match, the gain G, which is 0 where the scan says nothing and 1 where it says enough, and
    F, by which an error of heading moves what lies ahead. The error of the step is e' - F e.

    Attributes:
        pose: (3, 3) covariance of the last pose in the map's frame.
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
        """One match more.

        Args:
            before, after: poses (3,) in the map's frame.
            guess: (3, 3) covariance of the guessed step in the map's frame.
            information: (3, 3) of the match on the later pose, in the map's frame; 0 where there is none.
            reach: median range of the scan in metres, by which the map's length goes.

        Returns:
            Covariances (3, 3) of the step, in the frame of the earlier pose, and of the part of its error
            that the next step takes back, G m, in the frame of the later pose.
        """
        self.pose, step, noise = _update(self.pose, before, after, guess, information, DRIFTS / [reach, 1.0])
        return step, noise


@compiled
def _update(pose, before, after, guess, information, drifts):  # type: ignore[no-untyped-def]
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
    back, back_after = np.eye(3), np.eye(3)
    for turned, heading in ((back, before[2]), (back_after, after[2])):
        turned[0, 0] = turned[1, 1] = np.cos(heading)
        turned[0, 1] = np.sin(heading)
        turned[1, 0] = -turned[0, 1]
    return updated, back @ step @ back.T, back_after @ noise @ back_after.T
