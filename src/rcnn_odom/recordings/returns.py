"""Why a laser's readings are no returns, counted over scans of which none can be used."""

from collections import Counter

import numpy as np

from rcnn_odom.recordings.scan import Scan


class AbsentReturns:
    """Counts the readings of scans by what keeps them from being returns.

    Args:
        max_range: metres that the sensor sees.
    """

    def __init__(self, max_range: float) -> None:
        self.max_range = max_range
        self.scans, self.kinds = 0, Counter[str]()

    def add(self, scan: Scan) -> None:
        """One more scan."""
        ranges = scan.ranges
        self.scans += 1
        self.kinds["are infinite, or at their laser's maximum or beyond it"] += int(np.isposinf(ranges).sum())
        far = np.isfinite(ranges) & (ranges >= self.max_range)
        self.kinds[f"are at the sensor's {self.max_range:g} m or beyond it"] += int(far.sum())
        self.kinds["are 0, negative, nan, or below their laser's minimum"] += int((~(ranges > 0)).sum())

    def __str__(self) -> str:
        """A sentence without a full stop; advice is appended."""
        kinds = [f"{count} {kind}" for kind, count in self.kinds.most_common() if count]
        found = f"of their readings {', '.join(kinds)}" if kinds else "they hold no readings"
        return f"none of its {self.scans} scans has a return: {found}"
