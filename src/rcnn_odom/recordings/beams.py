"""One check, wherever scans meet a sensor's description: do the laser's beams lie where the sensor says?"""

from typing import NamedTuple, Protocol

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.laser_scan import has_most_beyond
from rcnn_odom.recordings.scan import Scan

PATIENCE = 5
"""So many scans in a row that do not fit are no accident: the laser is another one."""
LEAST_COVERED = 0.9
"""Part of the sensor's field of view that the beams must cover."""
WIDEST_GAP = 3.0
"""Beam spacings: a laser whose beams leave no wider gap turns all round."""
CLOSEST, FARTHEST = 0.3, 2.05
"""Bins between two beams: from 0.5 degrees for bins of 1, to a Velodyne's 0.18 for bins of 0.1."""
LARGEST_ANGLE = 1e6
"""Radians; larger numbers are no angles."""
FAR = 100.0
"""Metres: no planar laser has most of its returns from farther away."""
RESOLUTIONS_DEG = (0.02, 0.05, 0.1, 0.2, 0.25, 0.3, 0.5, 0.6, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
"""What the advice for a sensor chooses from; each divides the circle."""


class Sensor(Protocol):
    """A 2D laser as a model sees it; see :class:`rcnn_odom.models.encoding.Sensor`."""

    @property
    def resolution_deg(self) -> float:
        """Degrees between the bins."""

    @property
    def field_of_view_deg(self) -> float:
        """Degrees that it covers."""

    @property
    def facing_deg(self) -> float:
        """Degrees from straight ahead to the middle of its field of view."""


class Beams(NamedTuple):
    """Where the beams of a laser lie, in degrees.

    Attributes:
        first: the clockwise end, counter-clockwise from straight ahead.
        covered: from there to the other end; 360 for a laser that turns all round.
        spacing: between neighbours.
    """

    first: float
    covered: float
    spacing: float

    @property
    def middle(self) -> float:
        """The direction of the middle, in (-180, 180]."""
        return _wrap(self.first + self.covered / 2)

    def __str__(self) -> str:
        if self.covered == 360:
            return f"all round, one every {self.spacing:.2g} degrees"
        start = self.middle - self.covered / 2
        return f"from {start:.4g} to {start + self.covered:.4g} degrees, one every {self.spacing:.2g}"

    def sensor_options(self) -> str:
        """The command-line options of a sensor for these beams; empty where none fits them."""
        resolution = min((r for r in RESOLUTIONS_DEG if r > 0.99 * self.spacing), default=RESOLUTIONS_DEG[-1])
        if not CLOSEST * resolution < self.spacing < FARTHEST * resolution:
            return ""
        covered = self.covered
        if round(covered + self.spacing, 1) % 5 == 0:  # the beam at one end of, say, 180 degrees is left out
            covered += self.spacing
        width = min(max(1, round(covered / resolution)) * resolution, 360.0)
        is_aside = width < 360 and abs(self.middle) > max(resolution, self.spacing)
        # The beams shall lie in the middle of bins, not between two of them.
        facing = round(_wrap(self.first + width / 2), 3) if is_aside else 0.0
        return (
            f"data.sensor.field_of_view_deg={width:g} data.sensor.resolution_deg={resolution:g} "
            f"data.sensor.facing_deg={facing:g}"
        )


def _wrap(degrees: float) -> float:
    """The same direction in (-180, 180]."""
    return 180.0 - (180.0 - degrees) % 360.0


def find_beams(bearings: FloatArray) -> Beams:
    """Where beams lie whose bearings (P,) in radians are given in any order or direction, P >= 2.

    Raises:
        ValueError: the bearings are not finite, all the same, or go round the circle more than once.
    """
    if not (np.abs(bearings) < LARGEST_ANGLE).all():
        raise ValueError("the bearings of its beams are not finite, or wild")
    degrees = np.rad2deg(bearings)
    extent = float(np.ptp(degrees))
    typical = float(np.median(np.abs(np.diff(degrees))))
    if extent > 360.0 + 2.0 * typical or typical > 180.0:
        raise ValueError(
            f"its beams span {extent:.0f} degrees, more than a circle, as if its angles were not in radians"
        )
    if extent < 1e-6:
        raise ValueError("its beams all point the same way")
    degrees = np.sort(degrees % 360.0)
    gaps = np.diff(degrees, append=degrees[0] + 360.0)
    widest = int(np.argmax(gaps))
    inner = np.delete(gaps, widest)
    spacing = float(np.median(inner[inner > 1e-6]))
    if gaps[widest] <= WIDEST_GAP * spacing and len(gaps) > WIDEST_GAP:
        return Beams(-180.0, 360.0, spacing)
    first = float(degrees[(widest + 1) % len(degrees)])
    return Beams(first, 360.0 - float(gaps[widest]), spacing)


def compare_beams(beams: Beams, sensor: Sensor, partly: bool = False) -> str:
    """Why these beams are not the sensor's; empty where they fit.

    Args:
        beams: of a laser.
        sensor: what it should be like.
        partly: they may cover only a part of its field of view, and be farther apart than its bins.
    """
    covered, width = beams.covered, sensor.field_of_view_deg
    # Rounding, and a laser that leaves its last beam out, are no other laser.
    slack = beams.spacing + sensor.resolution_deg
    fits = partly or covered >= LEAST_COVERED * width - slack
    if width < 360:
        aside = abs(_wrap(beams.middle - sensor.facing_deg))
        fits = fits and aside + covered / 2 <= width / 2 + slack
    farthest = FARTHEST * (RESOLUTIONS_DEG[-1] if partly else sensor.resolution_deg)
    if fits and CLOSEST * sensor.resolution_deg < beams.spacing < farthest:
        return ""
    if width == 360:
        wanted = "all round"
    else:
        low = sensor.facing_deg - width / 2
        wanted = f"from {low:.4g} to {low + width:.4g} degrees"
    words = "no part of the sensor's" if partly else "the sensor's"
    return f"its beams lie {beams}, {words} {wanted}, one every {sensor.resolution_deg:g}"


def compare_ranges(ranges: FloatArray) -> str:
    """Why these readings (P,) cannot be metres; empty where they may be."""
    if not has_most_beyond(ranges, FAR):
        return ""
    median = np.median(ranges[(ranges > 0) & np.isfinite(ranges)])
    return f"half of its readings are beyond {median:.4g}, which cannot be metres"


class BeamCheck:
    """Compares the scans of one laser with a sensor, scan after scan.

    Scans that list only their returns (``has_all_beams`` is false), and scans without a reading, always fit.

    Args:
        sensor: what the scans are encoded for.
        partly: their beams may be a part of the sensor's; see :func:`compare_beams`.

    Attributes:
        fitting, misfitting: scans that did fit, and that did not.
        in_a_row: scans since the last one that did fit.
        reason: why the last one did not, in words.
        beams: of the last scan that told of them.
    """

    def __init__(self, sensor: Sensor, partly: bool = False) -> None:
        self.sensor, self.partly = sensor, partly
        self.fitting, self.misfitting, self.in_a_row, self.reason = 0, 0, 0, ""
        self.beams: Beams | None = None
        self._seen: object = None
        self._beam_reason, self._frame = "", ""

    @property
    def is_for_good(self) -> bool:
        """Whether so many scans in a row did not fit that the laser must be another one."""
        return self.in_a_row >= PATIENCE

    def __call__(self, scan: Scan) -> str:
        """Why this scan is not one of the sensor's; empty where it fits."""
        if not ((scan.ranges > 0) & np.isfinite(scan.ranges)).any():
            return ""
        reason = self._compare_beams(scan) or compare_ranges(scan.ranges)
        if reason:
            self.misfitting += 1
            self.in_a_row, self.reason = self.in_a_row + 1, reason
        else:
            self.in_a_row, self.fitting = 0, self.fitting + 1
        return reason

    def refusal(self, name: str, remedy: str) -> InputError:
        """The error of a laser that is another one for good.

        Args:
            name: of the recording.
            remedy: what the user can do where the beams are the reason, ``{}`` for the options of a sensor
                that they fit.
        """
        beams = self.beams if self._beam_reason else None
        advice = "correct the recording: metres, and radians between its beams"
        if beams and (options := beams.sensor_options()):
            advice = remedy.format(options)
        elif beams:
            advice = f"no sensor has them so far apart, {FARTHEST * RESOLUTIONS_DEG[-1]:.0f} degrees at most"
        return InputError(f"{name}: {self.reason}{self._frame}; {advice}")

    def _compare_beams(self, scan: Scan) -> str:
        if not scan.has_all_beams:
            return ""
        ends = None if scan.bearings is None else (scan.bearings[0], scan.bearings[-1])
        seen = len(scan.ranges), ends, scan.frame_id
        if seen != self._seen:
            self._frame = f" (frame {scan.frame_id})" if scan.frame_id else ""
            self._seen = seen
            self._beam_reason = self._judge(scan)
        return self._beam_reason

    def _judge(self, scan: Scan) -> str:
        width = self.sensor.field_of_view_deg
        if len(scan.ranges) < 2:
            return "it has a single beam"
        if scan.bearings is None:
            low = self.sensor.facing_deg - width / 2
            self.beams = Beams(low, width, width / (len(scan.ranges) - 1))
        else:
            try:
                self.beams = find_beams(scan.bearings)
            except ValueError as error:
                self.beams = None
                return str(error)
        return compare_beams(self.beams, self.sensor, self.partly)
