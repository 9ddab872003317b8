"""Checks that the beams of a laser lie where the description of a sensor puts them."""

from typing import NamedTuple, Protocol

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.laser_scan import has_most_beyond
from rcnn_odom.recordings.scan import Scan

PATIENCE = 5
"""After this many misfitting scans in a row, the laser is taken to be another one."""
LEAST_COVERED = 0.9
"""Part of the sensor's field of view that the beams must cover."""
WIDEST_GAP = 3.0
"""Largest gap, in beam spacings, between the beams of a laser that turns all round."""
CLOSEST, FARTHEST = 0.3, 2.05
"""Bins between two neighbouring beams. Allows beams of 0.5 degrees in bins of 1, and 0.18 in bins of 0.1."""
LARGEST_ANGLE = 1e6
"""Radians; larger numbers are not angles."""
FAR = 100.0
"""Metres; no planar laser measures most of its returns beyond this range."""
RESOLUTIONS_DEG = (0.02, 0.05, 0.1, 0.2, 0.25, 0.3, 0.5, 0.6, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
"""Resolutions that the advice for a sensor chooses from; each divides the circle."""


class Sensor(Protocol):
    """A 2D laser as a model sees it; see :class:`rcnn_odom.models.encoding.Sensor`."""

    @property
    def resolution_deg(self) -> float:
        """Degrees from one bin to the next."""

    @property
    def field_of_view_deg(self) -> float:
        """Degrees that the sensor covers."""

    @property
    def facing_deg(self) -> float:
        """Degrees from straight ahead to the middle of its field of view."""


class Beams(NamedTuple):
    """Where the beams of a laser lie, in degrees.

    Attributes:
        first: direction of the clockwise end, counted counter-clockwise from straight ahead.
        covered: angle from the first beam to the last; 360 for a laser that turns all round.
        spacing: angle between neighbouring beams.

    >>> print(Beams(first=-90.0, covered=180.0, spacing=0.5))
    from -90 to 90 degrees, one every 0.5
    """

    first: float
    covered: float
    spacing: float

    @property
    def middle(self) -> float:
        """Direction of the middle of the beams, in (-180, 180]."""
        return _wrap(self.first + self.covered / 2)

    def __str__(self) -> str:
        if self.covered == 360:
            return f"all round, one every {self.spacing:.2g} degrees"
        start = self.middle - self.covered / 2
        return f"from {start:.4g} to {start + self.covered:.4g} degrees, one every {self.spacing:.2g}"

    def sensor_options(self) -> str:
        """The command-line options of a sensor for these beams; empty if no sensor fits them.

        >>> Beams(-90.0, 180.0, 0.5).sensor_options().split()[:2]
        ['data.sensor.field_of_view_deg=180', 'data.sensor.resolution_deg=0.5']
        """
        resolution = min((r for r in RESOLUTIONS_DEG if r > 0.99 * self.spacing), default=RESOLUTIONS_DEG[-1])
        if not CLOSEST * resolution < self.spacing < FARTHEST * resolution:
            return ""
        covered = self.covered
        if round(covered + self.spacing, 1) % 5 == 0:  # some lasers omit the beam at one end of 180 degrees
            covered += self.spacing
        width = min(max(1, round(covered / resolution)) * resolution, 360.0)
        is_aside = width < 360 and abs(self.middle) > max(resolution, self.spacing)
        # The beams should lie in the middle of bins, not on the edge between two.
        facing = round(_wrap(self.first + width / 2), 3) if is_aside else 0.0
        return (
            f"data.sensor.field_of_view_deg={width:g} data.sensor.resolution_deg={resolution:g} "
            f"data.sensor.facing_deg={facing:g}"
        )


def _wrap(degrees: float) -> float:
    """The same direction in (-180, 180]."""
    return 180.0 - (180.0 - degrees) % 360.0


def find_beams(bearings: FloatArray) -> Beams:
    """Find the extent and the spacing of a laser's beams.

    Args:
        bearings: (P,) radians, P >= 2, in any order.

    Raises:
        ValueError: the bearings are not finite, are all the same, or span more than a circle.

    >>> find_beams(np.deg2rad(np.arange(-90.0, 91.0)))
    Beams(first=270.0, covered=180.0, spacing=1.0)
    """
    if not (np.abs(bearings) < LARGEST_ANGLE).all():
        raise ValueError("the bearings of its beams are not finite, or too large to be angles")
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
    """Compare beams with a sensor.

    Args:
        beams: the beams of a laser.
        sensor: the sensor that they should fit.
        partly: whether the beams may cover only a part of the sensor's field of view, and be farther apart
            than its bins.

    Returns:
        The reason why the beams do not fit; empty if they do.
    """
    covered, width = beams.covered, sensor.field_of_view_deg
    # Tolerates rounding, and a laser that omits its last beam.
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
    relation = "which is no part of the sensor's" if partly else "but the sensor's lie"
    return f"its beams lie {beams}, {relation} {wanted}, one every {sensor.resolution_deg:g}"


def compare_ranges(ranges: FloatArray) -> str:
    """The reason why readings (P,) cannot be metres; empty if they can."""
    if not has_most_beyond(ranges, FAR):
        return ""
    median = np.median(ranges[(ranges > 0) & np.isfinite(ranges)])
    return f"half of its readings are beyond {median:.4g}, which cannot be metres"


class BeamCheck:
    """Compares the scans of one laser with a sensor, scan after scan.

    Scans that hold only returns (``has_all_beams`` is false), and scans without any return, always fit.

    Args:
        sensor: the sensor for which the scans are encoded.
        partly: whether the beams may be a part of the sensor's; see :func:`compare_beams`.

    Attributes:
        fitting, misfitting: number of scans that fitted, and of scans that did not.
        in_a_row: number of misfitting scans since the last one that fitted.
        reason: why the last misfitting scan did not fit.
        beams: beams of the last scan whose beams could be found.
    """

    def __init__(self, sensor: Sensor, partly: bool = False) -> None:
        self.sensor, self.partly = sensor, partly
        self.fitting, self.misfitting, self.in_a_row, self.reason = 0, 0, 0, ""
        self.beams: Beams | None = None
        self._last_geometry: object = None
        self._beam_reason, self._frame = "", ""

    @property
    def is_another_laser(self) -> bool:
        """Whether ``PATIENCE`` scans in a row did not fit, so that the laser must be another one."""
        return self.in_a_row >= PATIENCE

    def __call__(self, scan: Scan) -> str:
        """Check the next scan; returns the reason why it does not fit, empty if it does."""
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
        """The error to raise for a laser that does not fit the sensor.

        Args:
            name: name of the recording.
            remedy: advice to the user if the beams are the reason; ``{}`` in it is replaced by the options of
                a sensor that fits them.
        """
        beams = self.beams if self._beam_reason else None
        advice = "correct the recording: ranges in metres, angles in radians"
        if beams and (options := beams.sensor_options()):
            advice = remedy.format(options)
        elif beams:
            advice = f"no sensor has beams so far apart, {FARTHEST * RESOLUTIONS_DEG[-1]:.0f} degrees at most"
        return InputError(f"{name}: {self.reason}{self._frame}; {advice}")

    def _compare_beams(self, scan: Scan) -> str:
        """The reason why a scan's beams do not fit; compared again only when the scan's geometry changes."""
        if not scan.has_all_beams:
            return ""
        ends = None if scan.bearings is None else (scan.bearings[0], scan.bearings[-1])
        geometry = len(scan.ranges), ends, scan.frame_id
        if geometry != self._last_geometry:
            self._frame = f" (frame {scan.frame_id})" if scan.frame_id else ""
            self._last_geometry = geometry
            self._beam_reason = self._find_misfit(scan)
        return self._beam_reason

    def _find_misfit(self, scan: Scan) -> str:
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
