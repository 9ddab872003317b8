"""A Kalman filter of a motion that changes little from scan to scan; needs numpy alone."""

import math
from typing import NamedTuple

import numpy as np

from rcnn_odom.geometry import FloatArray, advance, turn_covariance


class _Predicted(NamedTuple):
    """Covariances (3, 3) of the errors at a later scan, in the frame of the last one.

    Attributes:
        pose: of the pose beside the key if the motion were known.
        moved: of the motion over the periods between.
        pose_and_moved: of these two with each other.
        motion: of the motion from scan to scan at the later scan.
        pose_and_motion: of the pose there, with all its errors, and of that motion with each other.
    """

    pose: FloatArray
    moved: FloatArray
    pose_and_moved: FloatArray
    motion: FloatArray
    pose_and_motion: FloatArray

    @property
    def expected(self) -> FloatArray:
        """Of the pose beside the key, with all its errors."""
        return self.pose + self.moved + self.pose_and_moved + self.pose_and_moved.T


class MotionFilter:
    """Where the next scan is expected, and how much of what is measured there is believed.

    Its state are the pose beside a key scan and the motion from scan to scan (a model of constant velocity).
    Where a measurement tells little, the motion goes on nearly as before, instead of taking the measurement's
    errors up in every scan; where it tells much, the measurement is all.

    Args:
        change: (3,) deviations of the change of the motion from scan to scan, metres and radians.
        typical: (3,) root mean square of the motions: what is known of the first one.

    Attributes:
        motion: (3,) expected to the next scan, in the frame of the last one.
    """

    def __init__(self, change: FloatArray, typical: FloatArray) -> None:
        self._change, self._typical = change, typical
        self.begin()

    def begin(self) -> None:
        """Forgets the motion."""
        self.motion: FloatArray = np.zeros(3)
        # Errors of pose and motion, both in the frame of the last scan.
        self._errors: FloatArray = np.zeros((6, 6))
        self._errors[3:, 3:] = np.diag(np.square(2 * self._typical))

    def take_key(self) -> None:
        """The last scan is the key: its pose beside itself is known."""
        self._errors[:3], self._errors[:, :3] = 0.0, 0.0

    @property
    def pose_covariance(self) -> FloatArray:
        """(3, 3) of the last scan's pose beside the key, in the scan's own frame."""
        return self._errors[:3, :3].copy()

    def displacement(self, periods: int = 1) -> FloatArray:
        """The motion (3,) over so many periods, in the frame of the last scan."""
        moved = self.motion
        for _ in range(periods - 1):
            moved = advance(moved, self.motion)
        return moved

    def weigh(self, residual: FloatArray, covariance: FloatArray, periods: int = 1) -> FloatArray:
        """The part of a residual (3,) that :meth:`correct` would believe; changes nothing."""
        expected, turn = self._predict(periods).expected, float(self.displacement(periods)[2])
        gain = expected @ np.linalg.inv(expected + turn_covariance(covariance, turn))
        return _rotate(gain @ _rotate(residual, turn), -turn)

    def predict(self, periods: int = 1) -> tuple[FloatArray, FloatArray]:
        """Moves on by so many periods in which nothing was measured.

        Returns:
            The covariance (3, 3) of the step, in the frame of the scan before; and the part of the pose's
            (3, 3) that the next measurement takes back, which is all of it, in the new scan's own frame.
        """
        turn, predicted = float(self.displacement(periods)[2]), self._predict(periods)
        self._keep(predicted.expected, predicted.pose_and_motion, predicted.motion, turn)
        return predicted.moved, self.pose_covariance

    def correct(
        self, residual: FloatArray, covariance: FloatArray, periods: int = 1
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Takes in what was measured at the next scan.

        Args:
            residual: (3,) where it was measured, seen from where it was expected.
            covariance: (3, 3) of that.
            periods: from the last scan to this one.

        Returns:
            The part of the residual that is believed (3,); the covariance (3, 3) of the step to the scan, in
            the frame of the scan before; and the part of the pose's (3, 3) that the next measurement takes
            back, in the scan's own frame.
        """
        predicted, turn = self._predict(periods), float(self.displacement(periods)[2])
        expected, cross = predicted.expected, predicted.pose_and_motion
        measured = turn_covariance(covariance, turn)  # in the frame of the scan before, as all here
        inverse = np.linalg.inv(expected + measured)
        gain, of_motion = expected @ inverse, cross.T @ inverse
        rest = np.eye(3) - gain
        both = gain @ predicted.pose_and_moved @ rest.T
        step = gain @ (predicted.pose + measured) @ gain.T + rest @ predicted.moved @ rest.T - both - both.T
        seen = _rotate(residual, turn)
        believed = _rotate(gain @ seen, -turn)
        after = turn + float(believed[2])
        self.motion = self.motion + of_motion @ seen
        self._keep(rest @ expected, rest @ cross, predicted.motion - of_motion @ cross, after)
        taken = turn_covariance(gain @ rest @ expected, -after)
        return believed, step, (taken + taken.T) / 2

    def _predict(self, periods: int) -> "_Predicted":
        """The errors at a scan so many periods later."""
        motion, change = self._errors[3:, 3:], np.diag(np.square(self._change))
        # An error of the heading moves the place that the motion leads to.
        x, y, _ = self.displacement(periods).tolist()
        lever = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
        both = lever @ self._errors[:3, 3:]
        # A change of the motion in the first of three periods counts three times, the next one twice, ...
        once = periods * (periods + 1) / 2
        squared = once * (2 * periods + 1) / 3
        return _Predicted(
            pose=lever @ self._errors[:3, :3] @ lever.T,
            moved=periods**2 * motion + squared * change,
            pose_and_moved=periods * both,
            motion=motion + periods * change,
            pose_and_motion=both + periods * motion + once * change,
        )

    def _keep(self, pose: FloatArray, both: FloatArray, motion: FloatArray, turn: float) -> None:
        """The errors after a scan, told of its own frame, which is turned by so many radians."""
        for rows, columns, block in ((0, 0, pose), (0, 3, both), (3, 3, motion)):
            self._errors[rows : rows + 3, columns : columns + 3] = turn_covariance(block, -turn)
        self._errors[3:, :3] = self._errors[:3, 3:].T
        self._errors = (self._errors + self._errors.T) / 2


def _rotate(values: FloatArray, turn: float) -> FloatArray:
    """x, y and heading (3,), told of a frame that sees them turned by ``turn`` radians."""
    cos, sin = math.cos(turn), math.sin(turn)
    return np.array([cos * values[0] - sin * values[1], sin * values[0] + cos * values[1], values[2]])
