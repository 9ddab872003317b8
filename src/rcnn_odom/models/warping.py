"""Predict, warp, correct: how a network that measures what is left of a motion is used in a stream.

Needs numpy and numba alone. The network itself is :mod:`rcnn_odom.models.cnn_warp`.
"""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import (
    FloatArray,
    Step,
    advance,
    relative_covariance,
    relative_step,
    turn_covariance,
)
from rcnn_odom.models.reprojection import render
from rcnn_odom.models.streaming import Network

LOST = 5.0
"""Times ``settled``: where the last of several corrections is larger, the network does not know the place."""


class WarpingStepper:
    """A :class:`rcnn_odom.models.streaming.Stepper` out of a network that measures residual motions.

    The motion is predicted to go on; the key scan is seen from where it leads (:func:`~.reprojection.render`)
    and compared with the present scan; the network says what is left, which corrects the prediction.

    Args:
        network: measures where the later of two drawn scans (2, bins drawn) was taken, seen from where the
            earlier one seems to have been taken; its description says how it is used.
    """

    def __init__(self, network: Network) -> None:
        assert network.description.warping is not None
        self.network, self.description = network, network.description
        self.warping, self._drawn = network.description.warping, network.description.input_sensor
        self.reset()

    def reset(self) -> None:
        """Forgets all earlier scans."""
        self.network.reset()
        self._last: npt.NDArray[np.float32] | None = None
        self._motion = np.zeros(3)

    def __call__(self, pair: npt.NDArray[np.float32]) -> Step:
        """The step between two encoded scans (2, bins), the earlier first."""
        if self._last is None or not np.array_equal(pair[0], self._last):
            self._take_key(pair[0])  # the first pair, or scans between were not for the network
        measured = self._measure(pair[1])
        if measured is None:
            self.reset()
            return Step(math.nan, math.nan, math.nan)
        step, pose, covariance = measured
        is_key = self._is_far(pose)
        if is_key:
            self._take_key(pair[1])
            taken_back = np.zeros((3, 3))
        else:
            self._pose, self._covariance, taken_back = pose, covariance, covariance
        self._last, self._motion = pair[1].copy(), step.array()
        return replace(step, taken_back=taken_back)

    def _take_key(self, scan: npt.NDArray[np.float32]) -> None:
        """Compares the next scans with this one."""
        self._key, self._pose, self._covariance = scan.copy(), np.zeros(3), np.zeros((3, 3))

    def _is_far(self, pose: FloatArray) -> bool:
        """Whether a pose (3,) in the frame of the key scan is far enough away for a new key."""
        x, y, heading = pose.tolist()
        is_turned = abs(heading) >= math.radians(self.warping.key_turn_deg)
        return math.hypot(x, y) >= self.warping.key_distance or is_turned

    def _measure(self, scan: npt.NDArray[np.float32]) -> tuple[Step, FloatArray, FloatArray] | None:
        """The step to a scan; its pose (3,) in the frame of the key, and covariance (3, 3) in its own.

        None where the network finds no place for it.
        """
        now = render(scan, self.description.sensor, np.zeros(3), self._drawn)
        pose = advance(self._pose, self._motion)
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
        covariance = turn_covariance(residual.covariance, -residual.heading)
        x, y, heading = relative_step(self._pose, pose).tolist()
        step = Step(x, y, heading)
        of_step = relative_covariance(step, self._covariance, covariance)
        return replace(step, covariance=of_step), pose, covariance
