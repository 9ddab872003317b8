"""Which readings mean that nothing came back: many lasers write one and the same large number."""

import numpy as np

from rcnn_odom.compiled import compiled
from rcnn_odom.geometry import FloatArray

TOP = 0.994
"""Part of the largest reading from which on readings may be that number: some lasers vary it by half a
percent."""
BELOW = 0.97
"""Part of the largest reading down to which readings are compared with those at the top."""
FEWEST, TIMES = 5, 3
"""Readings at the top are no walls if there are so many, and so many times as many as just below."""
LEAST = 3.5
"""Metres: no laser's maximum is smaller, and in a small round room all readings are the largest."""


class NoReturn:
    """Learns from the readings of one laser what it writes where nothing came back."""

    def __init__(self) -> None:
        self._state = np.zeros(3)  # the largest reading, and how many were at the top and just below

    def limit(self, ranges: FloatArray, farthest: float) -> float:
        """Metres at or beyond which a reading of this scan (P,) is no return, at most ``farthest``."""
        return min(farthest, _learn(ranges, farthest, self._state))


@compiled
def _learn(ranges, farthest, state):  # type: ignore[no-untyped-def]
    """Counts the readings of a scan; returns the limit in metres, inf if there is none yet."""
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
