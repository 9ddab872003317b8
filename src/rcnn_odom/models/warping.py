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
"""Metres; a larger measured correction means that the motion is another one than predicted, if a second
measurement confirms it. If corrections do not settle and the last one is still larger than this, the network
has failed and there is no estimate."""

PROBED_FROM = 0.03
"""Metres; a measurement with a larger standard deviation is repeated from another viewpoint."""
PROBE, LEAST_PROBE, LARGEST_PROBE = 3.0, 0.1, 1.0
"""Distance of that viewpoint, in standard deviations, and its bounds in metres."""
LEAST_RESPONSE, FULL_RESPONSE = 0.05, 0.7
"""Fractions of that distance by which the measurement changes: the least one that is assumed, and the one
above which the scans tell enough."""


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
            unbiased = self._undo_shrinkage(residual, pose, now, is_far_off)
            if is_far_off and unbiased is residual:
                self._filter.forget_motion()  # it is another motion than the predicted one
            weighed = self._weigh(unbiased, pose, expected, periods)
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
        """The measured residual motion from a viewpoint (3,) in the frame of the key scan."""
        before = render(self._key, self.description.sensor, viewpoint, self._drawn)
        return self.network(np.stack([before, now]))

    def _undo_shrinkage(
        self, residual: Step, viewpoint: FloatArray, now: npt.NDArray[np.float32], is_far_off: bool
    ) -> Step:
        """Corrects a measured residual that is too small because the scans tell little.

        Where the scans tell little of the motion along a direction, such as a corridor's, the network gives
        the mean of likely residuals, which is nearly zero whatever the residual is. As a measurement that
        would be biased, and over many scans the path would run away. Therefore the comparison is repeated
        from a viewpoint farther on in that direction. The residual should become smaller by as much. If it
        becomes smaller by a fraction of that only, residual and deviation are divided by the fraction.

        The state of a recurrent network then contains the second comparison in place of the first.

        Args:
            residual: measured from the viewpoint.
            viewpoint: (3,) in the frame of the key scan.
            now: the rendered scan.
            is_far_off: whether the residual is so large that it is checked whatever its deviation.

        Returns:
            The residual itself if it is accurate, or becomes smaller as it should, or has no covariance.
        """
        if not np.isfinite(residual.covariance).all():
            return residual
        variances, directions = np.linalg.eigh(residual.covariance[:2, :2])
        deviation = math.sqrt(max(float(variances[1]), 0.0))
        if deviation < PROBED_FROM and not is_far_off:
            return residual
        direction = np.array([*directions[:, 1], 0.0])
        distance = min(max(PROBE * deviation, LEAST_PROBE), LARGEST_PROBE)
        self.network.forget_last()
        farther = self._compare(advance(viewpoint, distance * direction), now)
        response = float((residual.array() - farther.array()) @ direction) / distance
        if response > FULL_RESPONSE:
            return residual
        factor = 1 / max(LEAST_RESPONSE, response)  # in this order: a response of nan confirms nothing
        stretch = np.eye(3) + (factor - 1) * np.outer(direction, direction)
        x, y, heading = (stretch @ residual.array()).tolist()
        return Step(x, y, heading, stretch @ residual.covariance @ stretch)

    def _size(self, motion: FloatArray) -> float:
        """Length of a motion (3,) in metres, in which ``radians_a_metre`` of its turn count as one metre."""
        x, y, heading = motion.tolist()
        return math.hypot(x, y, heading / self.warping.radians_a_metre)
