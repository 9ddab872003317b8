"""Models that look at pairs of encoded scans, in a stream of whole scans."""

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray, Step, Steps, advance, relative_covariance, unknown_covariance
from rcnn_odom.models.encoding import decode
from rcnn_odom.models.streaming import Network, Registered, Stepper
from rcnn_odom.recordings.beams import BeamCheck
from rcnn_odom.recordings.scan import Scan

if TYPE_CHECKING:
    from rcnn_odom.models.warping import WarpingStepper

LONGEST_HOLD = 10
"""Periods over which the last motion goes on; for longer it is not known to."""
SAME_SPACING = 0.2
"""Part by which the spacing of a laser's returns may differ between scans."""
OTHER_LASER = "other laser"
"""Kind of trouble."""


def as_used(network: Stepper) -> Stepper:
    """What steps through encoded scans: a network itself, or what predicts and warps for it."""
    return _predicting(network) or network


def _predicting(network: Stepper) -> "WarpingStepper | None":
    """What predicts and warps for a network that measures residual motions; None for other networks."""
    if network.description.warping is None:
        return None
    from rcnn_odom.models.warping import WarpingStepper  # compiled code, which other networks do not need

    return network if isinstance(network, WarpingStepper) else WarpingStepper(cast(Network, network))


class PairTracker:
    """A :class:`rcnn_odom.models.streaming.ScanTracker` of a model of pairs of depth vectors.

    Whatever happens leaves the model's state as it was, and a step suffers from:

    - *no returns*: the last motion goes on, as over a gap.
    - *gap*, where scans were dropped or had no returns, so that more than one period has passed: the last
      motion goes on over it, for ``LONGEST_HOLD`` periods at most. Networks do not know such long steps;
      comparing the scans at both ends all the same is several times worse (docs/deployment.md). A network
      that measures residual motions compares them from where the motion leads, across as many periods.
    - *other laser*, beams that do not lie where the sensor has them, or readings that cannot be metres (see
      :mod:`rcnn_odom.recordings.beams`): not used, the last motion goes on.
    - *beam count*, other than before: the scan is encoded into the same bins as any other.
    - *few returns*: less than half as many bins have one as in nearly all (95 %) of the validation scans; the
      estimate stands.
    - *no estimate*: the network gave nan or inf; the last motion goes on, and its state starts anew.

    Args:
        stepper: the model, at its start.

    Attributes:
        description: of the model.
        period: seconds between scans in its training.
        beam_check: compares the scans' beams with those that it knows.
    """

    def __init__(self, stepper: Stepper) -> None:
        self._predicting = _predicting(stepper)
        self._stepper = self._predicting or stepper
        self.description, self.period = stepper.description, stepper.description.period
        self._forget()

    def reset(self) -> None:
        """Forgets everything: the next scan is the first of another laser or of another place of it."""
        self._stepper.reset()
        self._forget()

    def _forget(self) -> None:
        self._earlier: npt.NDArray[np.float32] | None = None  # the last scan with returns
        self._present: npt.NDArray[np.float32] | None = None  # the last scan
        self._motion, self._held, self._missed = np.zeros(3), 0, 0
        self._open = np.zeros((3, 3))  # of the last step's error, what the next estimate would take back
        self._beams, self._spacing = 0, 0.0
        # Surfaces are drawn alike whatever the beams: they may be fewer than the sensor's, on a part of it.
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
        """Takes a scan that is not compared with those before; what it suffers from."""
        notes: list[str] = []
        depth = self._encode(scan, notes)
        self._earlier, self._missed = (depth if depth.any() else None), 0
        return tuple(notes)

    def register(self, scan: Scan, periods: int = 1, seconds: float | None = None) -> Registered:
        """The step to one more scan, ``periods`` after the last one; see the class."""
        assert self._earlier is not None, "there is a scan to compare with; begin comes first"
        notes: list[str] = []
        depth = self._encode(scan, notes)
        if not depth.any():
            self._missed += periods
            return self._go_on(periods, notes)
        pair, self._earlier = np.stack([self._earlier, depth]), depth
        gap, self._missed = periods + self._missed, 0
        is_across = self._predicting is not None and gap <= LONGEST_HOLD
        if gap > 1:
            how = "compared across it" if is_across else "the last motion goes on"
            notes.append(f"gap: {gap} periods after the last scan, {how}")
            if not is_across:
                return self._hold(periods, notes)
        step = self._predicting(pair, periods) if self._predicting else self._stepper(pair)
        if not np.isfinite(step.array()).all():
            self._stepper.reset()  # its state is nan as well
            return self._hold(periods, [*notes, "no estimate: the last motion goes on"])
        if periods == 1:
            self._motion = step.array()
        self._held, self._open = 0, step.taken_back
        return Registered(step, tuple(notes))

    def _go_on(self, periods: int, notes: list[str]) -> Registered:
        """The step to a scan without returns."""
        if self._predicting is None or self._held + periods > LONGEST_HOLD:
            return self._hold(periods, notes)
        step = self._predicting.predict(periods)
        self._held, self._open = self._held + periods, step.taken_back
        return Registered(step, tuple(notes), is_estimated=False)

    def _encode(self, scan: Scan, notes: list[str]) -> npt.NDArray[np.float32]:
        """A depth vector (bins,), empty where the scan does not fit; adds what is unusual to ``notes``."""
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
        """Words about another number of beams than before, if there is one.

        Where bearings are given, only another spacing counts, that of most neighbours: they may be those of
        the returns alone, whose number changes.
        """
        before, last, count = self._beams, self._spacing, len(scan.ranges)
        if not scan.has_all_beams or count == before or count < 2:
            return []
        spacing = math.nan if scan.bearings is None else float(np.median(np.diff(np.sort(scan.bearings))))
        self._beams, self._spacing = count, spacing
        same = not before or abs(spacing - last) < SAME_SPACING * last
        return [] if same else [f"beam count: {count} after {before}"]

    def _hold(self, periods: int, notes: list[str]) -> Registered:
        """The last motion goes on, over ``LONGEST_HOLD`` periods in all at most."""
        moving = min(periods, LONGEST_HOLD - self._held)
        self._held += moving
        held = np.zeros(3)
        for _ in range(moving):
            held = advance(held, self._motion)
        typical = periods * np.array(self.description.typical_step)
        # What is unknown of one is unknown of its covariances with the others.
        covariance = np.diag(np.square(typical)) + 0 * np.outer(typical, typical)
        x, y, heading = held.tolist()
        # It takes nothing back of the last step's error, which whoever adds up covariances takes off.
        stays = relative_covariance(Step(x, y, heading), 2 * self._open, np.zeros((3, 3)))
        self._open = np.zeros((3, 3))
        return Registered(Step(x, y, heading, covariance + stays), tuple(notes), is_estimated=False)


def estimate_pairs(stepper: Stepper, pairs: Iterable[npt.NDArray[np.float32]]) -> Steps:
    """The steps of a row of pairs of encoded scans (2, bins), of which each begins where the last one ends.

    Where one that draws its scans does not know the place (nan), the last motion goes on with an unknown
    covariance; it has begun again by itself.
    """
    steps: list[Step] = []
    for pair in pairs:
        step = stepper(pair)
        if stepper.description.warping and not np.isfinite(step.array()).all():
            last = steps[-1] if steps else Step(0.0, 0.0, 0.0)
            step = replace(last, covariance=unknown_covariance())
        steps.append(step)
    return Steps(
        np.array([step.array() for step in steps]).reshape(-1, 3),
        np.array([step.covariance for step in steps]).reshape(-1, 3, 3),
    )
