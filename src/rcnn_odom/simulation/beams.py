"""Directions and times of the beams of a laser that spaces them evenly."""

from dataclasses import dataclass

import numpy as np

from rcnn_odom.geometry import FloatArray

_ROUNDING = 1e-9
"""Tolerance in spacings, so that 180 degrees have a last beam at 180 however 180 / spacing is rounded."""


@dataclass(frozen=True)
class EvenBeams:
    """Beams at equal angles over a part of the circle; see also :class:`~.kinds.LaserOptions`.

    In a whole circle, the first beam is not repeated at 360 degrees; if the circle is not a multiple of the
    spacing, the last gap is smaller.

    Attributes:
        spacing_deg: angle from beam to beam.
        field_of_view_deg: angle that the beams cover.
        facing_deg: direction of the middle of the field of view, counter-clockwise from straight ahead.
        phase_deg: angle from the edge of the field of view to the first beam.
        interlaced: whether the beams of every second scan, from frame 1 on, are shifted by half a spacing; a
            beam that then leaves the field of view is dropped. SICK's LMS have this in their finer modes.
        clockwise: whether the bearings of the beams decrease.

    >>> np.rad2deg(EvenBeams(spacing_deg=45.0, field_of_view_deg=90.0).bearings(0)).tolist()
    [-45.0, 0.0, 45.0]
    """

    spacing_deg: float
    field_of_view_deg: float
    facing_deg: float = 0.0
    phase_deg: float = 0.0
    interlaced: bool = False
    clockwise: bool = False

    def bearings(self, frame: int) -> FloatArray:
        """Bearings (B,) of the beams in order, in radians, 0 ahead and counter-clockwise, not wrapped."""
        offsets = self._offsets_deg(frame)
        return np.deg2rad(self.facing_deg + (-offsets if self.clockwise else offsets))

    def times(self, frame: int, rate_hz: float) -> FloatArray:
        """Seconds (B,) from the start of the field of view to each beam, at ``rate_hz`` turns per second."""
        return (self._offsets_deg(frame) + self.field_of_view_deg / 2) / (360 * rate_hz)

    def _offsets_deg(self, frame: int) -> FloatArray:
        """Degrees (B,) from the middle of the field of view to each beam, in the direction of turning."""
        view, spacing = self.field_of_view_deg, self.spacing_deg
        first = self.phase_deg + (spacing / 2 if self.interlaced and frame % 2 else 0)
        if view < 360:
            count = int(np.floor((view - first) / spacing + _ROUNDING)) + 1
        else:
            count = int(np.ceil(360 / spacing - _ROUNDING))
        return first - view / 2 + spacing * np.arange(max(count, 1), dtype=np.float64)
