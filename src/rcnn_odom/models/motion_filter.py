"""A Kalman filter of pose and motion with nearly constant velocity; this module needs only numpy."""

from typing import NamedTuple

import numpy as np

from rcnn_odom.geometry import FloatArray, advance, lever_matrix, rotation_matrix, turn_covariance


class _Predicted(NamedTuple):
    """Predicted covariances (3, 3) of the errors at a later scan, in the frame of the last scan.

    Attributes:
        periods: from the last scan to the later one.
        pose: part of the pose's covariance that comes from the pose of the last scan. All poses are relative
            to the key scan.
        shift: part that comes from the motion between the two scans.
        pose_and_shift: cross-covariance of these two errors.
        motion: covariance of the motion per period at the later scan.
        pose_and_motion: cross-covariance of the whole error of the predicted pose and that of the motion.
    """

    periods: int
    pose: FloatArray
    shift: FloatArray
    pose_and_shift: FloatArray
    motion: FloatArray
    pose_and_motion: FloatArray

    @property
    def whole_pose(self) -> FloatArray:
        """Covariance of the whole error of the predicted pose."""
        return self.pose + self.shift + self.pose_and_shift + self.pose_and_shift.T


class Weighed(NamedTuple):
    """A measurement of a scan's pose, weighed against the prediction.

    Attributes:
        correction: (3,) the corrected pose in the frame of the predicted one.
        rotated: (3,) the measured residual, in the frame of the scan before like the following ones.
        measured: (3, 3) covariance of the measurement.
        inverse: (3, 3) inverse of the covariance of the difference between measurement and prediction.
        gain: (3, 3) the Kalman gain of the pose.
        predicted: the predicted covariances.
        turn: the predicted turn to the scan in radians.
    """

    correction: FloatArray
    rotated: FloatArray
    measured: FloatArray
    inverse: FloatArray
    gain: FloatArray
    predicted: _Predicted
    turn: float


class MotionFilter:
    """Predicts the pose of the next scan and corrects it by a measurement.

    The state is the pose relative to a key scan and the motion per period (a model of constant velocity). In
    directions where a measurement is inaccurate, the motion continues nearly as before and does not follow
    the measurement's errors. In directions where it is accurate, the estimate equals the measurement.

    Args:
        change: (3,) standard deviations of the change of the motion from scan to scan, metres and radians.
        typical: (3,) root mean square of the motions; twice this is the initial standard deviation.

    Attributes:
        motion: (3,) predicted motion to the next scan, in the frame of the last one.

    Example:
        An accurate measurement, 1 m ahead of the predicted pose, is used almost unchanged:

        >>> motion_filter = MotionFilter(change=np.full(3, 0.1), typical=np.ones(3))
        >>> weighed = motion_filter.weigh(np.array([1.0, 0.0, 0.0]), 1e-8 * np.eye(3))
        >>> _ = motion_filter.correct(weighed)
        >>> weighed.correction.round(3).tolist(), motion_filter.motion.round(3).tolist()
        ([1.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    """

    def __init__(self, change: FloatArray, typical: FloatArray) -> None:
        self._change, self._unknown_motion = np.diag(np.square(change)), np.diag(np.square(2 * typical))
        self.begin()

    def begin(self) -> None:
        """Forgets pose and motion: the next scan is the first one."""
        self.motion: FloatArray = np.zeros(3)
        # Covariance of pose and motion in the frame of the last scan.
        self._errors: FloatArray = np.zeros((6, 6))
        self._errors[3:, 3:] = self._unknown_motion
        self._predicted: _Predicted | None = None  # from this state; each comparison of a scan needs it

    def forget_motion(self) -> None:
        """Makes the motion as uncertain as at the beginning; its estimate remains the best guess."""
        self._errors[3:], self._errors[:, 3:] = 0.0, 0.0
        self._errors[3:, 3:] = self._unknown_motion
        self._predicted = None

    def take_key(self) -> None:
        """Makes the last scan the key scan, so that its relative pose has no error."""
        self._errors[:3], self._errors[:, :3] = 0.0, 0.0
        self._predicted = None

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the last scan's pose relative to the key scan, in the last scan's frame."""
        return self._errors[:3, :3].copy()

    def displacement(self, periods: int = 1) -> FloatArray:
        """The predicted displacement (3,) after ``periods`` periods, in the frame of the last scan."""
        displacement = self.motion
        for _ in range(periods - 1):
            displacement = advance(displacement, self.motion)
        return displacement

    def weigh(self, residual: FloatArray, covariance: FloatArray, periods: int = 1) -> Weighed:
        """Weighs a measurement of the next scan's pose against the prediction; the state does not change.

        Args:
            residual: (3,) measured pose in the frame of the predicted pose.
            covariance: (3, 3) of the residual, in the same frame.
            periods: periods from the last scan to this one.
        """
        predicted, turn = self._predict(periods), periods * float(self.motion[2])
        pose, towards = predicted.whole_pose, rotation_matrix(turn)
        measured = turn_covariance(covariance, turn)  # in the frame of the scan before, like all the others
        inverse = np.linalg.inv(pose + measured).astype(np.float64, copy=False)
        gain, rotated = pose @ inverse, towards @ residual
        return Weighed(towards.T @ gain @ rotated, rotated, measured, inverse, gain, predicted, turn)

    def predict(self, periods: int = 1) -> tuple[FloatArray, FloatArray]:
        """Moves the state on by ``periods`` periods without a measurement.

        Returns:
            The covariance (3, 3) of the step, in the frame of the scan before; and the covariance (3, 3) of
            the error that the next step cancels, in the new scan's frame. Here this is the whole error of the
            pose.
        """
        turn, predicted = periods * float(self.motion[2]), self._predict(periods)
        self._store_errors(predicted.whole_pose, predicted.pose_and_motion, predicted.motion, turn)
        return predicted.shift, self.pose_covariance

    def correct(self, weighed: Weighed) -> tuple[FloatArray, FloatArray]:
        """Moves the state on to the next scan and corrects it by a weighed measurement of that scan's pose.

        Args:
            weighed: as :meth:`weigh` has returned it for the present state.

        Returns:
            The covariance (3, 3) of the step to the scan, in the frame of the scan before; and the covariance
            (3, 3) of the error that the next step cancels, in the new scan's frame (see
            :class:`rcnn_odom.geometry.Step`).
        """
        predicted, gain = weighed.predicted, weighed.gain
        pose, cross = predicted.whole_pose, predicted.pose_and_motion
        motion_gain, rest = cross.T @ weighed.inverse, np.eye(3) - gain
        both = gain @ predicted.pose_and_shift @ rest.T
        step = (
            gain @ (predicted.pose + weighed.measured) @ gain.T
            + rest @ predicted.shift @ rest.T
            - both
            - both.T
        )
        after = weighed.turn + float(weighed.correction[2])
        self.motion = self.motion + motion_gain @ weighed.rotated
        self._store_errors(rest @ pose, rest @ cross, predicted.motion - motion_gain @ cross, after)
        taken_back = turn_covariance(gain @ rest @ pose, -after)
        return step, (taken_back + taken_back.T) / 2

    def _predict(self, periods: int) -> _Predicted:
        """The covariances at a scan that is ``periods`` periods later.

        The displacement after n periods depends on an error of the motion by the Jacobian ``own[n]``: each
        period adds the error itself, and the error of the heading so far moves the end of the period. A
        change of the motion acts from its period on, like an error over the periods that are left.
        """
        if self._predicted is not None and self._predicted.periods == periods:
            return self._predicted
        motion, change = self._errors[3:, 3:], self._change
        turns = [rotation_matrix(number * float(self.motion[2])) for number in range(periods)]
        own = [np.eye(3)]
        for turn in turns[1:]:
            own.append(lever_matrix(*(turn @ self.motion)[:2]) @ own[-1] + turn)
        lever, all_periods = lever_matrix(*self.displacement(periods)[:2]), own[-1]
        changes = [turn @ own[periods - 1 - number] for number, turn in enumerate(turns)]
        both = lever @ self._errors[:3, 3:]
        self._predicted = _Predicted(
            periods,
            pose=lever @ self._errors[:3, :3] @ lever.T,
            shift=all_periods @ motion @ all_periods.T + sum(each @ change @ each.T for each in changes),
            pose_and_shift=both @ all_periods.T,
            motion=motion + periods * change,
            pose_and_motion=both + all_periods @ motion + sum(changes) @ change,
        )
        return self._predicted

    def _store_errors(self, pose: FloatArray, both: FloatArray, motion: FloatArray, turn: float) -> None:
        """Stores the covariances after a scan.

        Args:
            pose, both: (3, 3) of the pose, and of pose and motion with each other, the pose in the frame of
                the scan before; they are stored in the frame of the scan.
            motion: (3, 3) of the motion, which goes with the laser and needs no other frame.
            turn: heading of the scan in the frame of the scan before.
        """
        back = rotation_matrix(-turn)
        self._errors[:3, :3], self._errors[:3, 3:] = back @ pose @ back.T, back @ both
        self._errors[3:, :3], self._errors[3:, 3:] = self._errors[:3, 3:].T, motion
        self._errors = (self._errors + self._errors.T) / 2
        self._predicted = None
