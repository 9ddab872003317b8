"""Predict, warp, correct: how a network that measures what is left of a motion is used in a stream.

Needs numpy and numba alone. The network itself is :mod:`rcnn_odom.models.cnn_warp`.
"""

import math

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray, Step, advance, relative_step, turn_covariance
from rcnn_odom.models.motion_filter import MotionFilter
from rcnn_odom.models.reprojection import render
from rcnn_odom.models.streaming import Network

LOST = 0.5
"""Metres: after a larger correction nothing of the prediction is kept. Where the last of several still is
that large, the network does not know the place."""


class WarpingStepper:
    """A :class:`rcnn_odom.models.streaming.Stepper` out of a network that measures residual motions.

    The motion is predicted to go on; the key scan is seen from where it leads (:func:`~.reprojection.render`)
    and compared with the present scan; the network says what is left, which corrects the prediction as far as
    it is known better than that (:class:`~.motion_filter.MotionFilter`).

    Args:
        network: measures where the later of two drawn scans (2, bins drawn) was taken, seen from where the
            earlier one seems to have been taken; its description says how it is used.
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
        """The step between two encoded scans (2, bins), the earlier first.

        Args:
            pair: the two scans.
            periods: usual times between scans from the earlier scan, or from where :meth:`predict` has led
                since, to the later one.
        """
        if self._last is None or not np.array_equal(pair[0], self._last):
            self._take_key(pair[0])  # the first pair, or scans between were not for the network
        expected = advance(self._pose, self._filter.displacement(periods))
        measured = self._measure(pair[1], expected, periods)
        if measured is None:
            self.reset()
            return Step(math.nan, math.nan, math.nan)
        believed, covariance, taken_back = self._filter.correct(*measured, periods)
        pose = advance(expected, believed)
        x, y, heading = relative_step(self._pose, pose).tolist()
        self._last, self._pose = pair[1].copy(), pose
        if self.warping.needs_key(pose):
            self._take_key(pair[1])
            taken_back = np.zeros((3, 3))
        return Step(x, y, heading, covariance, taken_back)

    def predict(self, periods: int) -> Step:
        """The step over so many periods to a scan that shows nothing: the motion goes on."""
        x, y, heading = self._filter.displacement(periods).tolist()
        covariance, taken_back = self._filter.predict(periods)
        self._pose = advance(self._pose, np.array([x, y, heading]))
        return Step(x, y, heading, covariance, taken_back)

    def _take_key(self, scan: npt.NDArray[np.float32]) -> None:
        """Compares the next scans with this one."""
        self._key = scan.copy()
        self._pose = np.zeros(3)
        self._filter.take_key()

    def _measure(
        self, scan: npt.NDArray[np.float32], expected: FloatArray, periods: int
    ) -> tuple[FloatArray, FloatArray] | None:
        """Where a scan was taken, seen from where it is expected (3,), and the covariance (3, 3) of that.

        None where the network finds no place for it. The expected pose (3,) is told of the key's frame. It is
        compared again from where it is believed to be, not from where it was measured (an iterated Kalman
        filter): along a bare wall the place to compare from must not wander off with the measurements.
        """
        now = render(scan, self.description.sensor, np.zeros(3), self._drawn)
        believed = np.zeros(3)
        for number in range(self.warping.passes):
            if number:
                self.network.forget_last()  # of several passes the last one is the scan's
            pose = advance(expected, believed)
            before = render(self._key, self.description.sensor, pose, self._drawn)
            residual = self.network(np.stack([before, now]))
            if not np.isfinite(residual.array()).all():
                return None
            whole = relative_step(expected, advance(pose, residual.array()))
            covariance = turn_covariance(residual.covariance, float(whole[2]) - residual.heading)
            last, is_far_off = believed, self._size(residual.array()) > LOST
            believed = whole if is_far_off else self._filter.weigh(whole, covariance, periods)
            if self._size(believed - last) < self.warping.settled:
                break
        if number and is_far_off:
            return None  # it jumps about
        return whole, covariance

    def _size(self, motion: FloatArray) -> float:
        """Of a motion (3,) in metres, its turn by ``radians_a_metre``."""
        x, y, heading = motion.tolist()
        return math.hypot(x, y, heading / self.warping.radians_a_metre)
