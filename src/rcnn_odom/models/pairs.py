"""Runs models of pairs of encoded scans on a stream of whole scans."""

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray, Step, Steps, advance, relative_covariance
from rcnn_odom.models.encoding import decode
from rcnn_odom.models.streaming import Network, Registered, Stepper
from rcnn_odom.recordings.beams import BeamCheck
from rcnn_odom.recordings.scan import Scan

if TYPE_CHECKING:
    from rcnn_odom.models.warping import WarpingStepper

LONGEST_HOLD = 10
"""Periods for which the last motion is assumed to go on; after that the pose stands still."""
SAME_SPACING = 0.2
"""Relative difference in the spacing of returns up to which two scans have the same spacing."""
OTHER_LASER = "other laser"
"""Kind of fault, with which the note begins."""


def wrap_for_stream(network: Stepper) -> Stepper:
    """The stepper of a network in a stream: for residual motions a ``WarpingStepper``, else the network."""
    return _find_warping_stepper(network) or network


def _find_warping_stepper(network: Stepper) -> "WarpingStepper | None":
    """The stepper that predicts and warps for a network of residual motions; None for other networks."""
    if network.description.warping is None:
        return None
    from rcnn_odom.models.warping import WarpingStepper  # compiles code, which other networks do not need

    return network if isinstance(network, WarpingStepper) else WarpingStepper(cast(Network, network))


class PairTracker:
    """A :class:`rcnn_odom.models.streaming.ScanTracker` for a model of pairs of depth vectors.

    Notes are of these kinds; unless stated otherwise, the model's state does not change:

    - *no returns*: the last motion goes on, as over a gap.
    - *gap*: more than one period has passed since the last scan with returns. The last motion goes on over
      the gap, for at most ``LONGEST_HOLD`` periods. Networks are not trained on such long steps, and
      comparing the scans at both ends of the gap is several times less accurate (docs/deployment.md). A
      network that measures residual motions does compare them, up to ``LONGEST_HOLD`` periods.
    - *other laser*: the beams do not match those of the sensor, or the ranges cannot be in metres (see
      :mod:`rcnn_odom.recordings.beams`). The scan is not used; the last motion goes on.
    - *beam count*: it has changed; the scan is encoded into the same bins as any other, and used.
    - *few returns*: less than half as many bins with a return as in 95 % of the validation scans; the
      estimate is used.
    - *no estimate*: the network gave nan or inf; the last motion goes on, and the model is reset.

    Args:
        stepper: the model, without earlier scans.

    Attributes:
        description: that of the model.
        period: seconds between scans in its training.
        beam_check: compares the beams of scans with the sensor and with earlier scans.
        corrects_prediction: whether scans without returns came before the last one, so that its step also
            corrects what was predicted for them.
    """

    def __init__(self, stepper: Stepper) -> None:
        self._warping_stepper = _find_warping_stepper(stepper)
        self._stepper = self._warping_stepper or stepper
        self.description, self.period = stepper.description, stepper.description.period
        self._forget()

    def reset(self) -> None:
        """Forgets everything: the next scan is the first one, or the laser or its mounting has changed."""
        self._stepper.reset()
        self._forget()

    def _forget(self) -> None:
        self._earlier: npt.NDArray[np.float32] | None = None  # the last scan with returns
        self._present: npt.NDArray[np.float32] | None = None  # the last scan
        self._motion = np.zeros(3)  # the last estimated step over one period
        self._held, self._missed = 0, 0  # periods without an estimate, and without returns
        self.corrects_prediction = False
        self._is_lost = False  # whether the network has failed since the last estimate
        self._is_predicted = True  # whether the stepper has predicted all periods without returns
        self._taken_back = np.zeros((3, 3))  # the part of the last step's error that the next step cancels
        self._beams, self._spacing = 0, 0.0
        # Rendering does not need the sensor's beams: there may be fewer, or they may cover only a part of it.
        self.beam_check = BeamCheck(self.description.sensor, partly=self.description.warping is not None)

    @property
    def has_seen(self) -> bool:
        """Whether there is a scan with returns that the next one can be compared with."""
        return self._earlier is not None

    def returns(self) -> FloatArray:
        """Points (P, 2) in metres of the last scan in the laser's frame: its bins with a return."""
        if self._present is None:
            return np.empty((0, 2))
        return decode(self._present, self.description.sensor)

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Takes a scan that is not compared with those before; returns notes."""
        notes: list[str] = []
        self.begin_encoded(self._encode(scan, notes))
        return tuple(notes)

    def begin_encoded(self, depth: npt.NDArray[np.float32]) -> None:
        """:meth:`begin` for a depth vector (bins,)."""
        self._earlier, self._missed = (depth if depth.any() else None), 0
        self._is_predicted = True

    def register(self, scan: Scan, periods: int = 1, seconds: float | None = None) -> Registered:
        """The step to one more scan, ``periods`` after the last one; the class lists the notes."""
        notes: list[str] = []
        return self.register_encoded(self._encode(scan, notes), periods, notes)

    def register_encoded(
        self, depth: npt.NDArray[np.float32], periods: int = 1, notes: Iterable[str] = ()
    ) -> Registered:
        """:meth:`register` for a depth vector (bins,) and the notes on its scan."""
        assert self._earlier is not None, "call begin first, until has_seen"
        notes = list(notes)
        if not depth.any():
            self._missed += periods
            return self._predict(periods, notes)
        pair, self._earlier = np.stack([self._earlier, depth]), depth
        gap, self.corrects_prediction, self._missed = periods + self._missed, self._missed > 0, 0
        can_compare = self._warping_stepper is not None and self._is_predicted and gap <= LONGEST_HOLD
        self._is_predicted = True  # from this scan on
        note = f"gap: {gap} periods after the last scan"
        if gap > 1 and not can_compare:
            return self._hold(periods, [*notes, f"{note}, the last motion goes on"])
        step = self._warping_stepper(pair, periods) if self._warping_stepper else self._stepper(pair)
        self._is_lost = not np.isfinite(step.array()).all()
        if self._is_lost:
            self._stepper.reset()  # its state is nan as well
            return self._hold(periods, [*notes, "no estimate: the last motion goes on"])
        if gap == 1:
            self._motion = step.array()
        else:
            notes.append(f"{note}, compared across it")
        self._held, self._taken_back = 0, step.taken_back
        return Registered(step, tuple(notes))

    def _predict(self, periods: int, notes: list[str]) -> Registered:
        """The step to a scan without returns, which networks of residual motions predict themselves."""
        if self._warping_stepper is None or self._is_lost or self._held + periods > LONGEST_HOLD:
            self._is_predicted = False
            return self._hold(periods, notes)
        assert self._earlier is not None
        step = self._warping_stepper.predict(self._earlier, periods)
        self._held, self._taken_back = self._held + periods, step.taken_back
        return Registered(step, tuple(notes), is_estimated=False)

    def _encode(self, scan: Scan, notes: list[str]) -> npt.NDArray[np.float32]:
        """The depth vector (bins,) of a scan, all 0 if the laser does not fit; appends to ``notes``."""
        sensor = self.description.sensor
        if misfit := self.beam_check(scan):
            notes.append(f"{OTHER_LASER}: {misfit}")
            self._present = np.zeros(sensor.bins, np.float32)
            return self._present
        depth = self._present = sensor.encode(scan)
        if not depth.any():
            notes.append("no returns: the last motion goes on" if self.has_seen else "no returns: none yet")
            return depth
        notes += self._compare_beams(scan)
        filled = np.count_nonzero(depth) / len(depth)
        if filled < self.description.least_filled:
            notes.append(f"few returns: {filled:.1%} of the bins have one")
        return depth

    def _compare_beams(self, scan: Scan) -> list[str]:
        """The note on a number of beams that has changed; empty if it has not.

        If the scan has bearings, the median spacing of neighbours must have changed as well, because the
        bearings may be those of the returns only, whose number varies.
        """
        before, last, count = self._beams, self._spacing, len(scan.ranges)
        if not scan.has_all_beams or count == before or count < 2:
            return []
        spacing = math.nan if scan.bearings is None else float(np.median(np.diff(np.sort(scan.bearings))))
        self._beams, self._spacing = count, spacing
        same = not before or abs(spacing - last) < SAME_SPACING * last
        return [] if same else [f"beam count: {count} after {before}"]

    def _hold(self, periods: int, notes: list[str]) -> Registered:
        """Repeats the last motion, for at most ``LONGEST_HOLD`` periods in a row."""
        moving = min(periods, LONGEST_HOLD - self._held)
        self._held += moving
        held = np.zeros(3)
        for _ in range(moving):
            held = advance(held, self._motion)
        typical = periods * np.array(self.description.typical_step)
        # The product makes covariances with a component nan whose variance is unknown.
        covariance = np.diag(np.square(typical)) + 0 * np.outer(typical, typical)
        x, y, heading = held.tolist()
        # This step does not cancel any error of the last step, but the accumulation of covariances assumes
        # that it does. Therefore that part is added here.
        compensation = relative_covariance(Step(x, y, heading), 2 * self._taken_back, np.zeros((3, 3)))
        self._taken_back = np.zeros((3, 3))
        return Registered(Step(x, y, heading, covariance + compensation), tuple(notes), is_estimated=False)


def estimate_encoded(stepper: Stepper, scans: Iterable[npt.NDArray[np.float32]]) -> Steps:
    """The steps between consecutive encoded scans, one period apart.

    A network that measures residual motions is used as in a stream: it predicts the steps to scans without
    returns, and the last motion goes on where it fails. Other networks see all pairs.

    Args:
        stepper: the model, without earlier scans.
        scans: (bins,) metres each, 0 without a return.

    Returns:
        One step for each pair of consecutive scans.
    """
    if stepper.description.warping is None:
        steps = [stepper(np.stack(pair)) for pair in pairwise(scans)]
    else:
        tracker, steps = PairTracker(stepper), []
        for depth in scans:
            if tracker.has_seen:
                steps.append(tracker.register_encoded(depth).step)
            else:
                tracker.begin_encoded(depth)
                steps.append(Step(0.0, 0.0, 0.0))
        steps = steps[1:]
    return Steps(
        np.array([step.array() for step in steps]).reshape(-1, 3),
        np.array([step.covariance for step in steps]).reshape(-1, 3, 3),
    )
