"""Where the beams of a laser point that spaces them evenly, and when each leaves it."""

from dataclasses import dataclass

import numpy as np

from rcnn_odom.geometry import FloatArray

_ROUNDING = 1e-9
"""Of a spacing: a field of view of 180 degrees has its last beam at 180, whatever 180 / spacing rounds to."""


@dataclass(frozen=True)
class EvenBeams:
    """Beams at equal angles over a part of the circle; options of :class:`~.kinds.LaserOptions`.

    A whole circle has no beam twice. Where the circle is no multiple of the spacing, its last gap is smaller.

    Attributes:
        spacing_deg: from beam to beam.
        field_of_view_deg: the part of the circle that they cover.
        facing_deg: where its middle points, counter-clockwise from straight ahead.
        phase_deg: from the edge of the field of view to the first beam.
        interlaced: every second scan, from frame 1 on, has its beams half a spacing further on, and one fewer
            where that leaves the field of view; SICK's LMS scan so in their finer modes.
        clockwise: the beams come in falling order of their bearings.
    """

    spacing_deg: float
    field_of_view_deg: float
    facing_deg: float = 0.0
    phase_deg: float = 0.0
    interlaced: bool = False
    clockwise: bool = False

    def bearings(self, frame: int) -> FloatArray:
        """Radians (B,) of the beams in their order, 0 ahead and counter-clockwise, not wrapped."""
        turned = self._turned(frame)
        return np.deg2rad(self.facing_deg + (-turned if self.clockwise else turned))

    def times(self, frame: int, rate_hz: float) -> FloatArray:
        """Seconds (B,) from the laser's passing the edge of its field of view to each of its beams."""
        return (self._turned(frame) + self.field_of_view_deg / 2) / (360 * rate_hz)

    def _turned(self, frame: int) -> FloatArray:
        """Degrees (B,) by which each beam comes after the middle of the field of view."""
        view, spacing = self.field_of_view_deg, self.spacing_deg
        first = self.phase_deg + (spacing / 2 if self.interlaced and frame % 2 else 0)
        if view < 360:
            count = int(np.floor((view - first) / spacing + _ROUNDING)) + 1
        else:
            count = int(np.ceil(360 / spacing - _ROUNDING))
        return first - view / 2 + spacing * np.arange(max(count, 1), dtype=np.float64)
