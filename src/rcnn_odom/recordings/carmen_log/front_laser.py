"""Relations between the field of view of a laser, the spacing of its beams and their number."""

import math
from decimal import Decimal
from typing import NamedTuple

CIRCLE = 2 * math.pi + 1e-3
"""Radians; 2 pi, and a little more because printed numbers are rounded."""
PRINTED = 5e-7
"""Largest rounding error of numbers with six decimals, as CARMEN prints them."""
COARSEST = 0.03
"""Upper bound of a number's assumed rounding error, as a part of the number."""


class FrontLaser(NamedTuple):
    """The laser of a log's FLASER lines, which do not hold these parameters themselves.

    Attributes:
        field_of_view: radians.
        resolution: radians from beam to beam; 0: unknown.
        maximum: metres; readings at or beyond it are no returns.
        rounding: radians, possible error of the resolution; infinite if the user gave the field of view,
            which then has priority.
    """

    field_of_view: float = math.pi
    resolution: float = 0.0
    maximum: float = math.inf
    rounding: float = 0.0

    def spacing(self, count: int) -> float:
        """Radians from beam to beam, for ``count`` beams.

        It is computed from the field of view, which is more exact than the resolution. The resolution decides
        whether the last beam lies at the left end of the field of view or one spacing before it.
        """
        even = even_spacing(self.field_of_view, count)
        ends = self.field_of_view / count, self.field_of_view / max(count - 1, 1)
        nearest = min(ends, key=lambda spacing: abs(spacing - self.resolution))
        return nearest if abs(nearest - self.resolution) <= ends[1] - ends[0] else even

    def fits(self, count: int) -> bool:
        """Whether ``count`` beams at the resolution cover the field of view; True if it is unknown."""
        return not self.resolution or agree(self.field_of_view, self.resolution, count, self.rounding)


def even_spacing(field_of_view: float, count: int) -> float:
    """The spacing of beams if only their field of view and their number are known.

    With an odd number, the last beam lies at the left end of the field of view. With an even number it lies
    one spacing before that end, as if SICK's 181st beam were missing.

    >>> even_spacing(180.0, 181), even_spacing(180.0, 180)
    (1.0, 1.0)
    """
    return field_of_view / (count if count % 2 == 0 or count == 1 else count - 1)


def agree(field_of_view: float, resolution: float, count: int, rounding: float = PRINTED) -> bool:
    """Whether beams at this resolution cover the field of view, to within one spacing.

    Args:
        field_of_view, resolution: both in radians or both in degrees, not negative.
        count: number of beams.
        rounding: possible error of the resolution due to its last printed digit.

    >>> agree(180.0, 1.0, 181), agree(180.0, 1.0, 361)
    (True, False)
    """
    return abs(field_of_view - resolution * (count - 1)) <= resolution + max(rounding, PRINTED) * count


def rounding_of(word: str) -> float:
    """Possible error of a printed number due to its last digit, but at most ``COARSEST`` of the number.

    >>> rounding_of("0.0175")
    5e-05
    """
    value = Decimal(word)
    exponent = value.as_tuple().exponent
    if not isinstance(exponent, int):
        return 0.0
    return min(0.5 * 10.0 ** max(min(exponent, 9), -300), COARSEST * abs(float(value)))
