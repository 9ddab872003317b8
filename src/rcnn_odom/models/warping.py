"""Predict, warp, correct: the use of a network that measures residual motions in a stream of scans.

This module needs only numpy and numba. The network itself is in :mod:`rcnn_odom.models.cnn_warp`.
"""

import math

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray, Step, advance, relative_step, turn_covariance
from rcnn_odom.models.motion_filter import MotionFilter, Weighed
from rcnn_odom.models.reprojection import render
from rcnn_odom.models.streaming import Network

LARGEST_CORRECTION = 0.5
"""Metres; a larger measured correction means that the motion is another one than predicted, if a comparison
from where it leads confirms it. If corrections do not settle and the last one is still larger than this, the
network has failed and there is no estimate."""

CHECKED_FROM = 0.03
"""Metres; a measurement is checked along each direction in which its standard deviation is larger."""
SHIFT, LEAST_SHIFT, LARGEST_SHIFT = 3.0, 0.1, 1.0
"""How far the viewpoint is moved for that, in standard deviations, and the bounds of it in metres."""
LEAST_RESPONSE, FULL_RESPONSE, LARGEST_RESPONSE = 0.05, 0.7, 1.5
"""Fractions of that shift by which the measurement changes. Between the last two, it is confirmed; between
the first two, it is divided by the fraction. Otherwise it tells nothing."""


class WarpingStepper:
    """Makes a :class:`rcnn_odom.models.streaming.Stepper` from a network that measures residual motions.

    The pose of the new scan is predicted from the last motion. The key scan is rendered from the predicted
    pose (:func:`~.reprojection.render`), and the network compares it with the new scan. A Kalman filter
    corrects the prediction by the measured residual motion (:class:`~.motion_filter.MotionFilter`).

    Args:
        network: measures the residual motion of two rendered scans (2, rendered bins): the pose of the later
            scan relative to the viewpoint of the earlier one. Its description has a ``warping``.

    Attributes:
        network: as given.
        description: that of the network.
        warping: that of the description.
    """

    def __init__(self, network: Network) -> None:
        assert network.description.warping is not None
        self.network, self.description = network, network.description
        self.warping, self._drawn = network.description.warping, network.description.input_sensor
        typical, change = (
            np.nan_to_num(np.array(each), nan=1.0)
            for each in (network.description.typical_step, network.description.typical_change)
        )
        self._filter = MotionFilter(change, typical)
        self.reset()

    def reset(self) -> None:
        """Forgets all earlier scans."""
        self.network.reset()
        self._filter.begin()
        self._last: npt.NDArray[np.float32] | None = None
        self._pose: FloatArray = np.zeros(3)

    def __call__(self, pair: npt.NDArray[np.float32], periods: int = 1) -> Step:
        """The step between two encoded scans; nan if the network fails, after which the stepper is reset.

        Args:
            pair: (2, bins) metres, the earlier scan first.
            periods: usual periods between the two scans, without those that :meth:`predict` has covered.
        """
        self._begin_at(pair[0])
        expected = advance(self._pose, self._filter.displacement(periods))
        weighed = self._measure(pair[1], expected, periods)
        if weighed is None:
            self.reset()
            return Step(math.nan, math.nan, math.nan)
        covariance, taken_back = self._filter.correct(weighed)
        pose = advance(expected, weighed.correction)
        x, y, heading = relative_step(self._pose, pose).tolist()
        self._last, self._pose = pair[1].copy(), pose
        if self.warping.needs_key(pose):
            self._take_key(pair[1])
            taken_back = np.zeros((3, 3))
        return Step(x, y, heading, covariance, taken_back)

    def predict(self, earlier: npt.NDArray[np.float32], periods: int) -> Step:
        """The step to a scan without returns, if the last motion goes on.

        Args:
            earlier: (bins,) metres, the last scan with returns.
            periods: since the last scan, with or without returns.
        """
        self._begin_at(earlier)
        x, y, heading = self._filter.displacement(periods).tolist()
        covariance, taken_back = self._filter.predict(periods)
        self._pose = advance(self._pose, np.array([x, y, heading]))
        return Step(x, y, heading, covariance, taken_back)

    def _begin_at(self, scan: npt.NDArray[np.float32]) -> None:
        """Makes a scan (bins,) the key scan, unless it is the last one that the stepper has seen."""
        if self._last is None or not np.array_equal(scan, self._last):
            self._take_key(scan)  # the first scan, or scans between were not used
            self._filter.forget_motion()
            self._last = scan.copy()

    def _take_key(self, scan: npt.NDArray[np.float32]) -> None:
        """Makes a scan (bins,) the key scan, with which the next scans are compared."""
        self._key = scan.copy()
        self._pose = np.zeros(3)
        self._filter.take_key()

    def _measure(self, scan: npt.NDArray[np.float32], expected: FloatArray, periods: int) -> Weighed | None:
        """Measures the pose of a scan by comparisons with the key scan, from better and better viewpoints.

        The viewpoint of each comparison is the filtered pose, not the measured one (an iterated Kalman
        filter). Otherwise it would drift with the measurement errors along a bare wall.

        Args:
            scan: (bins,) metres.
            expected: (3,) predicted pose in the frame of the key scan.
            periods: as in :meth:`__call__`.

        Returns:
            The measured pose in the frame of the expected one, weighed against it; None if the network gives
            nan or its corrections do not become small.
        """
        now = render(scan, self.description.sensor, np.zeros(3), self._drawn)
        correction = np.zeros(3)
        for number in range(self.warping.passes):
            if number:
                self.network.forget_last()  # the network's state must contain each scan only once
            pose = advance(expected, correction)
            residual = self._compare(pose, now)
            if not np.isfinite(residual.array()).all():
                return None
            is_far_off = self._size(residual.array()) > LARGEST_CORRECTION
            checked = self._check(residual, [residual.array()] if is_far_off else [], pose, now)
            if checked is residual:
                checked = self._check(residual, find_doubtful_shifts(residual), pose, now)
            if checked is None:
                return None
            if is_far_off and checked is residual:
                self._filter.forget_motion()  # it is another motion than the predicted one
            weighed = self._weigh(checked, pose, expected, periods)
            last, correction = correction, weighed.correction
            if self._size(correction - last) < self.warping.settled:
                return weighed
        return None if number and is_far_off else weighed

    def _weigh(self, residual: Step, viewpoint: FloatArray, expected: FloatArray, periods: int) -> Weighed:
        """Weighs a residual motion from a viewpoint (3,) against the expected pose (3,)."""
        measured = relative_step(expected, advance(viewpoint, residual.array()))
        covariance = turn_covariance(residual.covariance, float(measured[2]) - residual.heading)
        return self._filter.weigh(measured, covariance, periods)

    def _compare(self, viewpoint: FloatArray, now: npt.NDArray[np.float32]) -> Step:
        """The measured residual motion from a viewpoint (3,), which is given in the frame of the key scan."""
        before = render(self._key, self.description.sensor, viewpoint, self._drawn)
        return self.network(np.stack([before, now]))

    def _check(
        self, residual: Step, shifts: list[FloatArray], viewpoint: FloatArray, now: npt.NDArray[np.float32]
    ) -> Step | None:
        """Checks a measured residual by comparisons from other viewpoints, and corrects it by what they tell.

        Where the scans tell little of the motion along a direction, such as a corridor's, the network gives
        the mean of likely residuals, which is nearly zero whatever the residual is. As a measurement that
        would be biased, and over many scans the path would run away. From a viewpoint that is farther on by a
        shift, the residual should be smaller by the shift. If it becomes smaller by a fraction of that only,
        residual and deviation are divided by the fraction.

        The state of a recurrent network then contains the last comparison in place of the first.

        Args:
            residual: measured from the viewpoint.
            shifts: (3,) motions from that viewpoint to the others, in metres and radians.
            viewpoint: (3,) in the frame of the key scan.
            now: the rendered scan.

        Returns:
            The residual itself if all comparisons confirm it, or there are none; None if one of them fails.
        """
        if not shifts:
            return residual  # as for nearly all scans, which should not wait for what follows
        units = np.array([1.0, 1.0, self.warping.radians_a_metre])
        motion, covariance = residual.array() / units, residual.covariance / np.outer(units, units)
        is_confirmed = True
        for shift in shifts:
            self.network.forget_last()
            farther = self._compare(advance(viewpoint, shift), now).array()
            if not np.isfinite(farther).all():
                return None
            length = float(np.linalg.norm(shift / units))
            direction = shift / units / length
            response = float((residual.array() - farther) / units @ direction) / length
            if FULL_RESPONSE < response < LARGEST_RESPONSE:
                continue
            is_confirmed, along = False, np.outer(direction, direction)
            is_told = LEAST_RESPONSE < response <= FULL_RESPONSE
            stretch = np.eye(3) + ((1 / response if is_told else 1 / LEAST_RESPONSE) - 1) * along
            motion, covariance = stretch @ motion, stretch @ covariance @ stretch
            if not is_told:  # Its deviation alone could be too small, however it is stretched.
                covariance = covariance + float(motion @ direction) ** 2 * along
        if is_confirmed:
            return residual
        x, y, heading = (motion * units).tolist()
        return Step(x, y, heading, covariance * np.outer(units, units))

    def _size(self, motion: FloatArray) -> float:
        """Length of a motion (3,) in metres, in which ``radians_a_metre`` of its turn count as one metre."""
        x, y, heading = motion.tolist()
        return math.hypot(x, y, heading / self.warping.radians_a_metre)


def find_doubtful_shifts(residual: Step) -> list[FloatArray]:
    """Shifts of the viewpoint along the directions in which a measured residual is inaccurate.

    Returns:
        At most two shifts (3,) in metres and radians, at right angles to each other; none if the residual has
        no covariance.

    Example:
        >>> wall_ahead = Step(0.0, 0.0, 0.0, np.diag([0.001, 0.1, 0.001]) ** 2)
        >>> np.abs(find_doubtful_shifts(wall_ahead)).round(3).tolist()
        [[0.0, 0.3, 0.0]]
    """
    if not np.isfinite(residual.covariance).all():
        return []
    variances, directions = np.linalg.eigh(residual.covariance[:2, :2])
    return [
        np.array([*(min(max(SHIFT * math.sqrt(variance), LEAST_SHIFT), LARGEST_SHIFT) * direction), 0.0])
        for variance, direction in zip(variances.tolist(), directions.T, strict=True)
        if variance > CHECKED_FROM**2
    ]
