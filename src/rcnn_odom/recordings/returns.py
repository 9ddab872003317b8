"""Counts why the readings of scans are no returns, for the message if no scan can be used."""

from collections import Counter

import numpy as np

from rcnn_odom.recordings.scan import Scan


class AbsentReturns:
    """Counts the readings of scans that are no returns, by the reason.

    Args:
        max_range: metres, maximum range of the sensor.

    Attributes:
        scans: number of scans.
        kinds: number of readings for each reason.

    >>> absent = AbsentReturns(max_range=40.0)
    >>> absent.add(Scan(np.array([0.0, 0.0])))
    >>> print(absent)
    none of its 1 scans has a return: of their readings 2 are 0, negative, nan, or below their laser's minimum
    """

    def __init__(self, max_range: float) -> None:
        self.max_range = max_range
        self.scans, self.kinds = 0, Counter[str]()

    def add(self, scan: Scan) -> None:
        """Count the readings of a scan."""
        ranges = scan.ranges
        self.scans += 1
        self.kinds["are infinite, or at their laser's maximum or beyond it"] += int(np.isposinf(ranges).sum())
        far = np.isfinite(ranges) & (ranges >= self.max_range)
        self.kinds[f"are at the sensor's {self.max_range:g} m or beyond it"] += int(far.sum())
        self.kinds["are 0, negative, nan, or below their laser's minimum"] += int((~(ranges > 0)).sum())

    def __str__(self) -> str:
        """The message, without a full stop, so that advice can follow."""
        kinds = [f"{count} {kind}" for kind, count in self.kinds.most_common() if count]
        found = f"of their readings {', '.join(kinds)}" if kinds else "they hold no readings"
        return f"none of its {self.scans} scans has a return: {found}"
