"""Which readings mean that nothing came back: many lasers write one and the same large number."""

import numpy as np
from numba import njit

from rcnn_odom.geometry import FloatArray

TOP = 0.994
"""Readings from this part of the largest one on may be the number: some lasers vary it by half a percent."""
BELOW = 0.97
"""Down to this part of the largest lie the readings that it is compared with."""
FEWEST, TIMES = 5, 3
"""So many readings at the top, and so many times those just below, are no walls."""
LEAST = 3.5
"""Metres: no laser's maximum is smaller, and in a small round room all readings are the largest."""


class NoReturn:
    """Learns from the readings of one laser what it writes where nothing came back."""

    def __init__(self) -> None:
        self._state = np.zeros(3)  # the largest reading, and how many were at the top and just below

    def limit(self, ranges: FloatArray, farthest: float) -> float:
        """Metres at or beyond which a reading of this scan (P,) is no return, at most ``farthest``."""
        return min(farthest, _learn(ranges, self._state))


@njit(cache=True)
def _learn(ranges, state):  # type: ignore[no-untyped-def]
    largest = state[0]
    for i in range(len(ranges)):
        if ranges[i] > largest and ranges[i] < np.inf:
            largest = ranges[i]
    if largest * TOP > state[0]:
        state[1], state[2] = 0, 0
    state[0] = largest
    for i in range(len(ranges)):
        if ranges[i] >= TOP * largest and ranges[i] < np.inf:
            state[1] += 1
        elif BELOW * largest <= ranges[i] < TOP * largest:
            state[2] += 1
    if largest >= LEAST and state[1] >= FEWEST and state[1] >= TIMES * state[2]:
        return TOP * largest
    return np.inf
