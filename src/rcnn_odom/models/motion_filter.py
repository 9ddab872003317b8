"""A Kalman filter of a motion that changes little from scan to scan; needs numpy alone."""

import math

import numpy as np

from rcnn_odom.geometry import FloatArray, turn_covariance


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

    def weigh(self, residual: FloatArray, covariance: FloatArray) -> FloatArray:
        """What of a residual (3,) would be believed: see :meth:`correct`, which also takes it in."""
        pose, motion, both = self._predict()
        expected, turn = pose + motion + both + both.T, float(self.motion[2])
        gain = expected @ np.linalg.inv(expected + turn_covariance(covariance, turn))
        return _rotate(gain @ _rotate(residual, turn), -turn)

    def _predict(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Covariances (3, 3) at the next scan: of the pose, of the motion, and of both together."""
        motion = self._errors[3:, 3:] + np.diag(np.square(self._change))
        # An error of the heading moves the place that the motion leads to.
        x, y, _ = self.motion.tolist()
        lever = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
        return lever @ self._errors[:3, :3] @ lever.T, motion, lever @ self._errors[:3, 3:]

    def correct(
        self, residual: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Takes what was measured at the next scan.

        Args:
            residual: (3,) where it was measured, seen from where it was expected.
            covariance: (3, 3) of that.

        Returns:
            What of the residual is believed (3,); the covariance (3, 3) of the step to the scan, in the frame
            of the scan before; and the part of the pose's (3, 3) that the next measurement takes back, in the
            scan's own frame.
        """
        pose, motion, both = self._predict()
        expected = pose + motion + both + both.T
        turn = float(self.motion[2])
        measured = turn_covariance(covariance, turn)  # told of the frame of the scan before, as all here
        inverse = np.linalg.inv(expected + measured)
        gain, of_motion = expected @ inverse, (both.T + motion) @ inverse
        rest = np.eye(3) - gain
        cross = gain @ both @ rest.T
        step = gain @ (pose + measured) @ gain.T + rest @ motion @ rest.T - cross - cross.T
        seen = _rotate(residual, turn)
        believed = _rotate(gain @ seen, -turn)
        after = turn + float(believed[2])
        self.motion = self.motion + of_motion @ seen
        self._keep(rest @ expected, rest @ (both + motion), motion - of_motion @ (both + motion), after)
        taken = turn_covariance(gain @ rest @ expected, -after)
        return believed, step, (taken + taken.T) / 2

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
