"""Detects which ranges mean "no return": many lasers report the same large number for it."""

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray

TOP = 0.994
"""Ranges of at least this fraction of the largest range may be that number, which some lasers vary by half a
percent."""
BELOW = 0.97
"""Ranges between this fraction and ``TOP`` of the largest range are counted for comparison."""
FEWEST, TIMES = 5, 3
"""The largest ranges are no walls if there are at least ``FEWEST`` of them, and at least ``TIMES`` as many as
just below."""
LEAST = 3.5
"""Metres: the number is never smaller. In a small round room all ranges are near the largest one."""


class NoReturn:
    """Learns from the ranges of one laser which number it reports where nothing came back.

    Example:
        A laser that sees walls up to 5 m away and reports 8 m where nothing came back:

        >>> ranges = np.concatenate([np.linspace(1.0, 5.0, 90), np.full(20, 8.0)])
        >>> round(NoReturn().limit(ranges, farthest=120.0), 3)  # half a percent below 8 m
        7.952
    """

    def __init__(self) -> None:
        self._state = np.zeros(3)  # the largest range, and the numbers of ranges at the top and just below

    def limit(self, ranges: FloatArray, farthest: float) -> float:
        """Metres; a range of this scan (P,) of at least that is no return. It is at most ``farthest``."""
        return min(farthest, _learn(ranges, farthest, self._state))


@compiled
def _learn(ranges, farthest, state):  # type: ignore[no-untyped-def]
    """Counts the ranges of a scan in ``state``; returns the limit in metres, inf if none is known yet."""
    largest = state[0]
    for i in range(len(ranges)):
        if ranges[i] > largest and ranges[i] < farthest:
            largest = ranges[i]
    if largest * TOP > state[0]:
        state[1], state[2] = 0, 0
    state[0] = largest
    for i in range(len(ranges)):
        if ranges[i] >= TOP * largest and ranges[i] < farthest:
            state[1] += 1
        elif BELOW * largest <= ranges[i] < TOP * largest:
            state[2] += 1
    if largest >= LEAST and state[1] >= FEWEST and state[1] >= TIMES * state[2]:
        return TOP * largest
    return np.inf
