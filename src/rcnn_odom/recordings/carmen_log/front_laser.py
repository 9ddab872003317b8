"""How a laser's field of view, the spacing of its beams and their number fit together."""

import math
from decimal import Decimal
from typing import NamedTuple

CIRCLE = 2 * math.pi + 1e-3
"""Radians; 2 pi as it may be printed."""
PRINTED = 5e-7
"""Half of the last digit of numbers with six decimals, as CARMEN prints them."""
COARSEST = 0.03
"""Part of a resolution: no rounding is taken to be larger."""


class FrontLaser(NamedTuple):
    """The laser of a log's FLASER lines, which do not say these things themselves.

    Attributes:
        field_of_view: radians.
        resolution: radians from beam to beam, 0 where unknown.
        maximum: metres; readings at or beyond it are no returns.
        rounding: radians that the resolution may be off; infinite where a user's field of view counts more.
    """

    field_of_view: float = math.pi
    resolution: float = 0.0
    maximum: float = math.inf
    rounding: float = 0.0

    def spacing(self, count: int) -> float:
        """Radians from one of so many beams to the next.

        The field of view is more exact than a resolution, which tells whether it is open at its left end.
        """
        even = even_spacing(self.field_of_view, count)
        ends = self.field_of_view / count, self.field_of_view / max(count - 1, 1)
        nearest = min(ends, key=lambda spacing: abs(spacing - self.resolution))
        return nearest if abs(nearest - self.resolution) <= ends[1] - ends[0] else even

    def fits(self, count: int) -> bool:
        """Whether so many beams cover the field of view at the resolution, as far as it is known."""
        return not self.resolution or agree(self.field_of_view, self.resolution, count, self.rounding)


def even_spacing(field_of_view: float, count: int) -> float:
    """The spacing of beams that only their field of view and number are known of.

    An even number leaves the field of view open at its left end (SICK's 180 of 181 beams), an odd one
    closes it.
    """
    return field_of_view / (count if count % 2 == 0 or count == 1 else count - 1)


def agree(field_of_view: float, resolution: float, count: int, rounding: float = PRINTED) -> bool:
    """Whether beams of this spacing cover the field of view, within one spacing.

    Args:
        field_of_view, resolution: both in radians or both in degrees, not negative.
        count: of the beams.
        rounding: how far off the resolution may be because of its last printed digit.
    """
    return abs(field_of_view - resolution * (count - 1)) <= resolution + max(rounding, PRINTED) * count


def rounding_of(word: str) -> float:
    """How far a number may be off because of its last printed digit, but no more than a few per cent."""
    value = Decimal(word)
    exponent = value.as_tuple().exponent
    if not isinstance(exponent, int):
        return 0.0
    return min(0.5 * 10.0 ** max(min(exponent, 9), -300), COARSEST * abs(float(value)))
