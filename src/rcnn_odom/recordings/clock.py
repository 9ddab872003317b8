"""Interprets the stamps of scans: counts periods between scans, and finds late scans and changed clocks."""

import math
from collections import deque
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np

INTERVALS = 15
"""Number of recent intervals from which the usual period is computed."""
FOLLOWING = 0.2
"""Part of a stamp's jitter that is added to the expected time of the next scan."""
MOST_LOST = 1e9
"""Upper bound on the number of lost periods, so that it fits into an integer."""
SLOW = 1.5
"""Largest ratio of the usual period to the period of training; larger steps were not trained."""
LATE_IN_A_ROW = 5
"""After this many late scans in a row, the clock must have been set."""
EQUAL_STAMPS = 5
"""After this many scans with the stamp of the scan before, the clock is too coarse to detect late scans."""
JUMPS_IN_A_ROW = 5
"""After this many jumps in a row, stamps are not used any more."""
CLOCK_JUMP = 10.0
"""Seconds; after a longer interval between stamps, forward or back, the clock must have been set."""
LATE, CLOCK_SET = "late scan", "clock set"
"""Kinds of faults, with which the messages begin."""


@dataclass(frozen=True)
class Tick:
    """What follows from the stamp of one scan.

    Attributes:
        periods: number of usual periods since the scan before, 1 or more.
        seconds: time since the scan before; None if the stamps do not show it.
        late: why the scan must be skipped; empty if it must not.
        clock_set: message that the clock was set, so that the time since the scan before is unknown; empty if
            it was not.
        notes: messages about an unusual period.
    """

    periods: int = 1
    seconds: float | None = None
    late: str = ""
    clock_set: str = ""
    notes: tuple[str, ...] = ()


class Clock:
    """Interprets the stamps of one stream; :class:`rcnn_odom.models.tracking.Tracking` explains the faults.

    Args:
        trained: seconds between the scans on which the estimator was trained; nan: it fits any period.

    >>> clock = Clock(trained=0.1)
    >>> [clock.read(stamp).periods for stamp in (0.0, 0.1, 0.2, 0.5)]
    [1, 1, 1, 3]
    """

    def __init__(self, trained: float) -> None:
        self._trained = trained
        self._equal, self._jumps = 0, 0
        self._forget()

    def _forget(self) -> None:
        self._stamp: float | None = None
        self._expected, self._unstamped, self._late = 0.0, 0, 0
        self._intervals: deque[float] = deque(maxlen=INTERVALS)

    def read(self, stamp: float | None, *, repeats: bool = False) -> Tick:
        """Interpret the stamp of the next scan.

        Args:
            stamp: seconds. None, nan and inf count as no stamp, and so does 0 from a driver without a clock.
            repeats: whether the scan equals the scan before, so that an equal stamp is correct.
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
        """Whether a stamp holds no time: its clock is coarse or jumps, or it is 0 for lack of one."""
        is_coarse = stamp == self._stamp and self._equal >= EQUAL_STAMPS and not repeats
        if self._jumps >= JUMPS_IN_A_ROW or is_coarse:
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
        message = f"{CLOCK_SET}: from {was:.15g} to {stamp:.15g} s, no motion is added"
        if self._jumps == JUMPS_IN_A_ROW:
            message += f", for the {JUMPS_IN_A_ROW}th time in a row: stamps are not used from here on"
        return Tick(clock_set=message)

    def _count_late(self, stamp: float) -> Tick:
        self._late += 1
        if self._late < LATE_IN_A_ROW:
            return Tick(late=f"{LATE}: stamp {stamp:.6f} is not after {self._stamp:.6f}, passed over")
        periods = self._late
        self._forget()
        self._begin(stamp)
        return Tick(periods)

    def _count_periods(self, stamp: float, before: float) -> Tick:
        """Count the periods since the last scan was expected; the expected time slowly follows the stamps."""
        self._stamp = stamp
        scans, self._unstamped = 1 + self._unstamped, 0
        # After scans without stamps, the time since the last one of them is unknown.
        seconds = stamp - before if scans == 1 else None
        # The median is robust against single gaps, the mean against scans that arrive in bursts.
        middles = [median(self._intervals), fmean(self._intervals)] if len(self._intervals) >= 3 else []
        recent = min(middles, default=math.nan)
        usual = float(np.fmax(recent, self._trained))
        self._intervals.append((stamp - before) / scans)
        if math.isnan(usual):
            self._expected = stamp
            return Tick(1, seconds)
        late = stamp - self._expected - scans * usual
        lost = max(0, round(min(late / usual, MOST_LOST)))
        self._expected = stamp - (1 - FOLLOWING) * (late - lost * usual)
        return Tick(1 + lost, seconds, notes=self._compare_pace(recent, max(middles, default=math.inf)))

    def _compare_pace(self, recent: float, most: float) -> tuple[str, ...]:
        """Notes if the period differs from that of training; ``recent`` and ``most`` bound the usual one."""
        if recent > SLOW * self._trained:
            return (f"slow scans: one every {recent:.3g} s, in training every {self._trained:.3g} s",)
        if most * SLOW < self._trained:
            return (f"fast scans: one every {recent:.3g} s, in training every {self._trained:.3g} s",)
        return ()
