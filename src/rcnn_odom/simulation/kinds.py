"""Kinds of lasers by name, with values from their data sheets, and options to change them.

SICK LMS 200: 180 degrees, 0.25 to 1 degree, a mirror with 75 turns per second, statistical error 5 mm, at
most 80 m. Hokuyo UTM-30LX: 1,081 beams over 270 degrees, 25 ms a scan, counter-clockwise, repeatability below
10 mm up to 10 m and below 30 mm up to 30 m; beyond 10 m it is modelled as proportional to the range. Slamtec
RPLidar A2 (A2M6 and A2M8): 4,000 samples per second, so 0.9 degrees at the usual ten turns per second (0.45
in the mode with 8,000), 5 to 15 turns, clockwise, 12 m, and a resolution of 1 % of the range, which is used
as the standard deviation. Velodyne HDL-64E: fitted to real frames, see
:class:`rcnn_odom.simulation.laser.Laser`.
No data sheet gives the range up to which a wall hit at a right angle always returns the beam (``reach``). It
is set to twice the longest range for the small lasers, and to the value of the HDL-64 for the others.
"""

from dataclasses import dataclass, replace
from typing import Any

from rcnn_odom.errors import InputError
from rcnn_odom.options import check_options, option
from rcnn_odom.simulation.beams import EvenBeams
from rcnn_odom.simulation.laser import Laser, hdl64_ring


@dataclass(frozen=True)
class Kind:
    """A kind of laser with evenly spaced beams.

    Attributes:
        beams: directions of the beams.
        laser: measurement model.
        rate_hz: turns per second; None: one turn in the time between two scans.
    """

    beams: EvenBeams
    laser: Laser
    rate_hz: float | None = None


def _level_laser(max_range: float, noise: float, reach: float, noise_share: float | None = None) -> Laser:
    return Laser(0.0, max_range=max_range, noise=noise, reach=reach, noise_share=noise_share)


KINDS = {
    "sick": Kind(EvenBeams(1.0, 180.0), _level_laser(80.0, 0.005, 110.0), 75.0),
    "hokuyo": Kind(EvenBeams(0.25, 270.0), _level_laser(30.0, 0.01, 60.0, 0.001), 40.0),
    "rplidar": Kind(EvenBeams(0.9, 360.0, clockwise=True), _level_laser(12.0, 0.005, 24.0, 0.01), 10.0),
    "regular": Kind(EvenBeams(0.5, 360.0), _level_laser(80.0, 0.01, 110.0)),
}
HDL64 = "hdl64"
RING_RANGE = 80.0
"""Metres, default maximum range of the HDL-64."""


@dataclass(kw_only=True)
class LaserOptions:
    """Options of ``data.laser``; an option that is null has the value of the kind.

    Attributes:
        kind: ``hdl64`` or one of ``KINDS``; null: the default laser of the world.
        spacing_deg: degrees from beam to beam.
        phase_deg: degrees from the edge of the field of view to the first beam, less than ``spacing_deg``.
        field_of_view_deg, facing_deg: degrees that the beams cover, and direction of their middle.
        interlaced: whether the beams of every second scan lie half a spacing beside those of the others.
        clockwise: whether the bearings of the beams decrease.
        noise: metres, standard deviation at any range.
        max_range: metres.
        rate_hz: turns per second, for ``data.realism.skew``.
    """

    kind: str | None = option(default=None, choices=(HDL64, *KINDS))
    spacing_deg: float | None = option(
        default=None,
        least=0.05,
        fits=lambda degrees: degrees <= 1,
        wanted="a number of degrees from 0.05 to 1",
    )
    phase_deg: float | None = option(default=None, least=0)
    field_of_view_deg: float | None = option(
        default=None,
        above=0,
        fits=lambda degrees: degrees <= 360,
        wanted="a number of degrees above 0, at most 360",
    )
    facing_deg: float | None = option(
        default=None, fits=lambda degrees: abs(degrees) <= 360, wanted="a number of degrees from -360 to 360"
    )
    interlaced: bool | None = option(default=None)
    clockwise: bool | None = option(default=None)
    noise: float | None = option(default=None, least=0)
    max_range: float | None = option(default=None, above=0.1)
    rate_hz: float | None = option(default=None, above=0)


def choose_laser(given: dict[str, Any]) -> tuple[Laser, EvenBeams | None, float | None] | None:
    """Make the laser that options describe.

    Args:
        given: ``data.laser``: see :class:`LaserOptions`. Options may be missing.

    Returns:
        The laser; its beams, None for an HDL-64, whose beams are irregular; and its turns per second, None if
        it turns once in the time between two scans. None instead of all three if there is no kind.

    Raises:
        InputError: an option is unknown, out of bounds, does not fit the others, or is given without a kind.

    >>> laser, beams, rate = choose_laser({"kind": "sick", "spacing_deg": 0.5})
    >>> laser.max_range, beams.spacing_deg, rate
    (80.0, 0.5, 75.0)
    """
    check_options(LaserOptions, values := dict(given), "data.laser.")
    kind = values.pop("kind")
    chosen = {name: value for name, value in values.items() if value is not None}
    if kind is None:
        if chosen:
            raise InputError(
                f"data.laser.{next(iter(chosen))}: needs a kind of laser; add data.laser.kind=regular"
            )
        return None
    rate = chosen.pop("rate_hz", None)
    if kind == HDL64:
        return _ring(chosen), None, rate
    found = KINDS[kind]
    measures: dict[str, Any] = {name: chosen.pop(name) for name in ("noise", "max_range") if name in chosen}
    if "noise" in measures:
        measures["noise_share"] = None
    beams = replace(found.beams, **chosen)
    if beams.phase_deg >= beams.spacing_deg:
        raise InputError(
            f"data.laser.phase_deg={beams.phase_deg:g}: must be less than the spacing of the beams, "
            f"{beams.spacing_deg:g}"
        )
    return replace(found.laser, **measures), beams, rate or found.rate_hz


def _ring(chosen: dict[str, Any]) -> Laser:
    """The HDL-64's ring with the chosen options.

    Raises:
        InputError: an option does not exist for an HDL-64.
    """
    for name in ("phase_deg", "interlaced", "clockwise"):
        if name in chosen:
            raise InputError(
                f"data.laser.{name}: an HDL-64 has irregular beams and turns clockwise; "
                "leave it out, or set data.laser.kind=regular"
            )
    ring = hdl64_ring(chosen.pop("max_range", RING_RANGE))
    if "spacing_deg" in chosen:
        chosen["step_deg"] = chosen.pop("spacing_deg")
    if "field_of_view_deg" in chosen:
        chosen.setdefault("facing_deg", 0.0)
    return replace(ring, **chosen)
