"""What stamps tell: how many periods have passed, which scan came late, and when a clock was set."""

import math
from collections import deque
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np

REMEMBERED = 15
"""Intervals that tell the usual period."""
FOLLOWING = 0.2
"""Part of a stamp's jitter that the expected time of the next scan follows."""
FOREVER = 1e9
"""Upper bound on the number of lost periods, so that it fits an integer."""
SLOW = 1.5
"""Times the period of training from which on steps are longer than a network knows."""
LATE_IN_A_ROW = 5
"""After so many late scans it is the clock that has been set."""
COARSE = 5
"""After so many scans with the stamp of the one before such a stamp no longer means a late scan."""
JUMPS_IN_A_ROW = 5
"""After so many jumps in a row the stamps tell nothing."""
CLOCK_JUMP = 10.0
"""Seconds from one stamp to the next, forward or back, from which on a clock has been set."""
LATE, CLOCK_SET = "late scan", "clock set"
"""Kinds of trouble."""


@dataclass(frozen=True)
class Tick:
    """What one stamp tells.

    Attributes:
        periods: usual periods since the scan before, 1 or more.
        seconds: since the scan before; None where the stamps do not tell.
        late: why the scan is to be passed over; empty where it is not.
        clock_set: from when to when the clock was set, so that nobody knows how much time has passed; empty
            where it was not.
        notes: what is unusual about the period, in words.
    """

    periods: int = 1
    seconds: float | None = None
    late: str = ""
    clock_set: str = ""
    notes: tuple[str, ...] = ()


class Clock:
    """Follows the stamps of one stream; see :class:`rcnn_odom.models.tracking.Tracking` for what is told.

    Args:
        trained: seconds between scans that the estimator knows; nan: any.
    """

    def __init__(self, trained: float) -> None:
        self._trained = trained
        self._equal, self._jumps = 0, 0
        self._forget()

    def _forget(self) -> None:
        self._stamp: float | None = None
        self._expected, self._unstamped, self._late = 0.0, 0, 0
        self._intervals: deque[float] = deque(maxlen=REMEMBERED)

    def read(self, stamp: float | None, *, repeats: bool = False) -> Tick:
        """What the next stamp tells.

        Args:
            stamp: seconds; None, nan and inf are none, and 0 where it is no time.
            repeats: the scan is the very same as the one before, so that an equal stamp is right.
        """
        if stamp is None or not math.isfinite(stamp) or self._is_no_time(stamp, repeats):
            self._unstamped += 1
            return Tick()
        if self._stamp is None or (self._stamp == 0 and stamp > CLOCK_JUMP):
            return self._begin(stamp)
        if abs(stamp - self._stamp) > CLOCK_JUMP:
            return self._jump(stamp, self._stamp)
        self._jumps = 0
        if stamp <= self._stamp:
            self._equal += stamp == self._stamp and not repeats
            return self._count_late(stamp)
        self._late = 0
        return self._count_periods(stamp, self._stamp)

    def _is_no_time(self, stamp: float, repeats: bool) -> bool:
        """Whether a stamp says nothing: one of a coarse or wild clock, or the 0 of a driver that has none."""
        if self._jumps >= JUMPS_IN_A_ROW or (stamp == self._stamp and self._equal >= COARSE and not repeats):
            return True
        return stamp == 0 and self._stamp is not None and (self._stamp == 0 or abs(self._stamp) > CLOCK_JUMP)

    def _begin(self, stamp: float) -> Tick:
        self._stamp = self._expected = stamp
        self._unstamped = 0
        return Tick()

    def _jump(self, stamp: float, was: float) -> Tick:
        self._forget()
        self._begin(stamp)
        self._jumps += 1
        told = f"{CLOCK_SET}: from {was:.15g} to {stamp:.15g} s, no motion is added"
        if self._jumps == JUMPS_IN_A_ROW:
            told += f", for the {JUMPS_IN_A_ROW}th time in a row: from here on stamps do not count"
        return Tick(clock_set=told)

    def _count_late(self, stamp: float) -> Tick:
        self._late += 1
        if self._late < LATE_IN_A_ROW:
            return Tick(late=f"{LATE}: stamp {stamp:.6f} is not after {self._stamp:.6f}, passed over")
        periods = self._late
        self._forget()
        self._begin(stamp)
        return Tick(periods)

    def _count_periods(self, stamp: float, before: float) -> Tick:
        """Measured from where the last scan was expected, which follows a jittering clock slowly."""
        self._stamp = stamp
        scans, self._unstamped = 1 + self._unstamped, 0
        # Between scans without stamps of their own nobody knows how the time is shared out.
        seconds = stamp - before if scans == 1 else None
        # The median does without single gaps, the mean without bursts.
        middles = [median(self._intervals), fmean(self._intervals)] if len(self._intervals) >= 3 else []
        recent = min(middles, default=math.nan)
        usual = float(np.fmax(recent, self._trained))
        self._intervals.append((stamp - before) / scans)
        if math.isnan(usual):
            self._expected = stamp
            return Tick(1, seconds)
        late = stamp - self._expected - scans * usual
        lost = max(0, round(min(late / usual, FOREVER)))
        self._expected = stamp - (1 - FOLLOWING) * (late - lost * usual)
        return Tick(1 + lost, seconds, notes=self._compare_pace(recent, max(middles, default=math.inf)))

    def _compare_pace(self, recent: float, most: float) -> tuple[str, ...]:
        """Words about another period than that of training, from the least and the greatest middle."""
        if recent > SLOW * self._trained:
            return (f"slow scans: one every {recent:.3g} s, in training every {self._trained:.3g} s",)
        if most * SLOW < self._trained:
            return (f"fast scans: one every {recent:.3g} s, in training every {self._trained:.3g} s",)
        return ()
