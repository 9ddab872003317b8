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

LOST = 5.0
"""Times ``settled``: where the last of several corrections is larger, the network does not know the place."""


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

    def __call__(self, pair: npt.NDArray[np.float32]) -> Step:
        """The step between two encoded scans (2, bins), the earlier first."""
        if self._last is None or not np.array_equal(pair[0], self._last):
            self._take_key(pair[0])  # the first pair, or scans between were not for the network
        expected = advance(self._pose, self._filter.motion)
        measured = self._measure(pair[1], expected)
        if measured is None:
            self.reset()
            return Step(math.nan, math.nan, math.nan)
        believed, covariance, taken_back = self._filter.correct(*measured)
        pose = advance(expected, believed)
        x, y, heading = relative_step(self._pose, pose).tolist()
        self._last, self._pose = pair[1].copy(), pose
        if self.warping.needs_key(pose):
            self._take_key(pair[1])
            taken_back = np.zeros((3, 3))
        return Step(x, y, heading, covariance, taken_back)

    def _take_key(self, scan: npt.NDArray[np.float32]) -> None:
        """Compares the next scans with this one."""
        self._key = scan.copy()
        self._pose = np.zeros(3)
        self._filter.take_key()

    def _measure(
        self, scan: npt.NDArray[np.float32], expected: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Where a scan was taken, seen from where it is expected (3,), and the covariance (3, 3) of that.

        None where the network finds no place for it. The expected pose (3,) is told of the key's frame.
        """
        now = render(scan, self.description.sensor, np.zeros(3), self._drawn)
        pose = expected
        for number in range(self.warping.passes):
            if number:
                self.network.forget_last()  # of several passes the last one is the scan's
            before = render(self._key, self.description.sensor, pose, self._drawn)
            residual = self.network(np.stack([before, now]))
            correction = math.hypot(residual.x, residual.y, residual.heading / self.warping.radians_a_metre)
            if not math.isfinite(correction):
                return None
            pose = advance(pose, residual.array())
            if correction < self.warping.settled:
                break
        if number and correction > LOST * self.warping.settled > 0:
            return None  # it jumps about
        whole = relative_step(expected, pose)
        return whole, turn_covariance(residual.covariance, float(whole[2]) - residual.heading)
