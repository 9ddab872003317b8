"""Simulated drives of a 2D laser through generated worlds; no download is needed.

``street`` is a car with one ring of an HDL-64 in a city, with motion like KITTI's. ``indoor`` is a robot with
a level scanner in a building. ``blind`` are places where scan matching has little information about the
motion along the way. Each name is a world and a drive of its own: ``05`` is always the same drive, but has
only its name and, in full scale, its length in common with KITTI's 05.
"""

import hashlib
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.simulation import worlds
from rcnn_odom.simulation.beams import EvenBeams
from rcnn_odom.simulation.blind.drive import kind_of
from rcnn_odom.simulation.kinds import LaserOptions, choose_laser
from rcnn_odom.simulation.laser import Laser, hdl64_ring, scanner
from rcnn_odom.simulation.street.city import Roads
from rcnn_odom.simulation.sweep import poses_at, ring_times
from rcnn_odom.simulation.worlds import FRAME_TIME, MINUTE_RATE, STRETCH, WORLDS, Recipe, poses_of, stamps_of

VERSION = 4
"""Increase it when the generator changes; it is part of every fingerprint."""

LIBRARIES = [(name, version(name)) for name in ("numpy", "scipy", "numba")]
"""Other versions of these libraries may give other numbers for the same seed."""

World = Literal["street", "indoor", "corridor", "few_returns", "standstill", "standstill_street", "blind"]
Scale = Literal["small", "full"]

KITTI_FRAMES = dict(
    zip(
        ("00", "01", "02", "03", "04", "05", "06", "07", "08", "09", "10"),
        (4541, 1101, 4661, 801, 271, 2761, 1101, 1101, 4071, 1591, 1201),
        strict=True,
    )
)
SCORED_FRAMES = 800
"""Length of a small drive for validation or test: well over 400 m, so that drift has long segments."""
FRAMES: dict[str, dict[str, int]] = {
    "full": KITTI_FRAMES,
    "small": {name: frames // 10 for name, frames in KITTI_FRAMES.items()}
    | dict.fromkeys(("05", "07", "10"), SCORED_FRAMES),
}
DEFAULT_FRAMES = 600
"""Length of a drive with another name."""
BLIND_FRAMES = 1800
"""Length of a drive of ``blind`` in both scales: three minutes, in which even a robot drives 100 m."""

SENSORS: dict[str, dict[str, Any]] = {
    "street": {},
    "indoor": {"resolution_deg": 1.0, "field_of_view_deg": 180.0, "max_range": 40.0},
}
"""Default lasers of the worlds: KITTI's on streets, and a SICK indoors."""

LONGEST_RANGE = 80.0
"""Metres; streets are only built for lasers that see no farther."""
MIRROR_RATE_HZ = 75.0
"""Turns per second, as of a SICK's mirror; for lasers without a kind that see at most half a circle."""
ON_WHEELS = 3.0
"""Metres; largest motion of a laser during one of its turns."""

MINUTE = 60.0
"""Seconds; duration of the drives of special cases, whatever their names."""

STREETS = ("street", "standstill_street")


@dataclass(kw_only=True)
class RealismOptions:
    """Options of ``data.realism``; see :func:`load`."""

    tilt: bool
    movers: bool
    missing: bool
    skew: bool = option(default=False)


@dataclass(kw_only=True)
class Options:
    """Options of ``conf/data/simulated.yaml``, ``indoor.yaml`` and ``blind.yaml`` not common to all data."""

    realism: RealismOptions
    fresh_worlds: bool
    keep_worlds: bool
    vary_pace: bool
    world: str = option(choices=WORLDS)
    scale: str = option(choices=("small", "full"))
    frames: int | None = option(above=0)
    world_seed: int = option(least=0, below=2**32, wanted="a whole number, not negative")
    laser: LaserOptions = option(default=None)  # noqa: RUF009 - older runs do not have this option
    turn_rate_deg_s: float | None = option(default=None, above=0)
    scan_rate_hz: float | None = option(default=None, above=0)


def load(
    name: str,
    *,
    sensor: dict[str, Any] | None = None,
    world: World = "street",
    scale: Scale = "small",
    frames: int | None = None,
    seed: int = 0,
    movers: bool = True,
    missing: bool = True,
    tilt: bool = True,
    skew: bool = False,
    vary_pace: bool = True,
    laser: dict[str, Any] | None = None,
    turn_rate_deg_s: float | None = None,
    scan_rate_hz: float | None = None,
) -> Recording:
    """Make a simulated drive; every name and seed give another world.

    Args:
        name: any name; the same name and seed always give the same drive. ``NAME~1``, ``NAME~2`` ... are
            other drives in other worlds, each as long as ``NAME``.
        sensor: ``resolution_deg``, ``field_of_view_deg`` and ``max_range`` (metres) of the world's default
            laser; those not given are KITTI's, or indoors a SICK's. Not used if ``laser`` is given.
        world: ``street`` or ``indoor``; ``blind``, where names begin with the kind of place: ``tunnel-``,
            ``corridor-`` or ``posts-`` (see :mod:`rcnn_odom.simulation.blind.drive`); or a special case that
            lasts a minute: ``corridor`` (two bare walls whose ends are out of sight), ``few_returns`` (a
            plain with some posts), ``standstill`` (a robot at rest in a building) or ``standstill_street`` (a
            parked car, without traffic).
        scale: ``small`` or ``full``, which sets the length of a drive by its name: see ``FRAMES``.
        frames: length of the drive, whatever its name; None: by scale and name.
        seed: number of the set of worlds, 0 or more.
        movers: whether other cars and people move.
        missing: whether some beams get no return although something is within range.
        tilt: whether the car pitches and rolls on its springs and the ground has slopes. Without it, a level
            laser still sways sideways.
        skew: whether the laser moves while it turns, so that beams start from different poses and scans have
            times. The true pose is that at the stamp: at the first beam, or when an HDL-64 points ahead.
            Other cars and people do not move during a turn.
        vary_pace: whether the drives ``NAME~1`` ... on streets are faster and slower than KITTI's.
        laser: another laser: see :class:`rcnn_odom.simulation.kinds.LaserOptions`, for instance
            ``{"kind": "sick", "spacing_deg": 0.5}``. All lasers but an HDL-64 give all beams, inf for no
            return.
        turn_rate_deg_s: degrees per second at which the robot indoors turns on the spot; None: a random rate.
        scan_rate_hz: scans per second, not for streets; None: a random rate for ``indoor``, otherwise 10.

    Returns:
        The drive. Its scans are computed when they are read.

    Raises:
        InputError: there are fewer than two frames, the seed is negative, the world or scale is unknown, the
            range is too long, an option of the laser does not fit, or the world does not have such a rate.

    >>> drive = load("05", world="indoor", frames=3)
    >>> drive.poses.shape, len(drive.read_scan(0).ranges) > 0
    ((3, 4, 4), True)
    """
    _check_options(name, world, scale, frames, seed)
    _check_rates(name, world, turn_rate_deg_s, scan_rate_hz)
    if world == "blind":
        kind_of(name)
    length = frames or _count_frames(name, world, scale, scan_rate_hz)
    other_paces = vary_pace and world == "street" and "~" in name
    recipe = Recipe(name, seed, world, length, movers, tilt, other_paces, turn_rate_deg_s, scan_rate_hz)
    reader = _make_reader(recipe, sensor or {}, laser or {}, missing, skew)
    # Options that are None are left out, so a new option does not change the fingerprints of other drives.
    recipe_and_laser = asdict(reader, dict_factory=_drop_none)
    return Recording(
        name=name,
        poses=poses_of(recipe).copy(),
        stamps=stamps_of(recipe).copy(),
        read_scan=reader,
        fingerprint=hashlib.sha256(
            f"simulated {VERSION} {LIBRARIES} {recipe_and_laser}".encode()
        ).hexdigest(),
        is_compensated=not skew,
    )


def _drop_none(items: list[tuple[str, Any]]) -> dict[str, Any]:
    return {key: value for key, value in items if value is not None}


def _count_frames(name: str, world: str, scale: str, scan_rate_hz: float | None) -> int:
    """Number of frames of a drive."""
    if world == "blind":
        return BLIND_FRAMES
    if world in ("street", "indoor"):
        return FRAMES[scale].get(name.split("~")[0], DEFAULT_FRAMES)
    return round(MINUTE * (scan_rate_hz or MINUTE_RATE)) + 1


def _check_options(name: str, world: str, scale: str, frames: int | None, seed: int) -> None:
    kinds = f"{', '.join(WORLDS[:-1])} or {WORLDS[-1]}"
    for fits, advice in (
        (frames is None or frames >= 2, f"a drive has at least 2 frames, not {frames}; change data.frames"),
        (seed >= 0, f"a seed is 0 or more, not {seed}; change data.world_seed"),
        (world in WORLDS, f"no world {world!r}; data.world is {kinds}"),
        (scale in FRAMES, f"no scale {scale!r}; data.scale is small or full"),
    ):
        if not fits:
            raise InputError(f"simulated sequence {name}: {advice}")


def _check_rates(name: str, world: str, turn_rate_deg_s: float | None, scan_rate_hz: float | None) -> None:
    if turn_rate_deg_s is not None and world != "indoor":
        raise InputError(
            f"simulated sequence {name}: data.turn_rate_deg_s is only for the robot of data.world=indoor; "
            "leave it out"
        )
    if scan_rate_hz is not None and world in STREETS:
        raise InputError(
            f"simulated sequence {name}: the laser of a car always scans {1 / FRAME_TIME:g} times a second; "
            "leave out data.scan_rate_hz"
        )
    for option_name, rate in (("turn_rate_deg_s", turn_rate_deg_s), ("scan_rate_hz", scan_rate_hz)):
        if rate is not None and not 0 < rate < np.inf:
            raise InputError(f"simulated sequence {name}: data.{option_name}={rate:g}: must be above 0")


def _make_reader(
    recipe: Recipe, sensor: dict[str, Any], given: dict[str, Any], missing: bool, skew: bool
) -> "ScanReader":
    """Make the reader of scans, with the given laser or with the default laser of the world."""
    chosen = choose_laser(given)
    if chosen is None:
        chosen = _default_laser(recipe.name, recipe.world, sensor, skew)
    laser, beams, rate = chosen
    if recipe.world in STREETS and laser.max_range > LONGEST_RANGE:
        group = "laser" if given.get("kind") else "sensor"
        raise InputError(
            f"simulated sequence {recipe.name}: the streets are drawn for lasers that see {LONGEST_RANGE:g} "
            f"m; lower data.{group}.max_range, which is {laser.max_range:g}"
        )
    if not skew:
        return ScanReader(recipe, laser, missing, beams)
    frame_time = float(np.median(np.diff(stamps_of(recipe))))
    return ScanReader(recipe, laser, missing, beams, rate or 1 / frame_time)


def _default_laser(
    name: str, world: str, given: dict[str, Any], skew: bool
) -> tuple[Laser, EvenBeams | None, float | None]:
    """The default laser of a world, in the form of ``choose_laser``'s result."""
    if given.get("facing_deg") and given.get("field_of_view_deg") != 360:
        raise InputError(
            f"simulated sequence {name}: its laser always faces ahead; leave out data.sensor.facing_deg"
        )
    if world in STREETS:
        return hdl64_ring(given.get("max_range", LONGEST_RANGE)), None, None
    default = SENSORS["indoor"]
    level = default | {key: value for key, value in given.items() if key in default}
    if not skew:
        return scanner(**level), None, None
    # The times of the beams are known only if the scan holds all beams.
    beams = EvenBeams(level["resolution_deg"], level["field_of_view_deg"])
    return scanner(**level), beams, MIRROR_RATE_HZ if beams.field_of_view_deg <= 180 else None


@dataclass(frozen=True)
class ScanReader:
    """Computes the scans of a drive through a world: the ``read_scan`` of a simulated sequence.

    It holds only the recipe of the world. Each process builds the world when it reads its first scan, and
    keeps it.
    """

    recipe: Recipe
    laser: Laser
    missing: bool
    beams: EvenBeams | None = None
    """Beams of a laser whose scans hold all beams; None: scans hold only returns."""
    rate_hz: float | None = None
    """Turns per second of a laser that moves while it turns; None: all beams are measured at once."""

    def points(self, frame: int) -> npt.NDArray[np.float32]:
        """Points (P, 4) as in a KITTI file: x, y, z in metres in the laser's frame, and reflectance 0."""
        bearings, ranges, _ = self._shots(range(self.recipe.frames)[frame])
        return self.laser.points(bearings, ranges)

    def __call__(self, frame: int) -> Scan:
        """The scan of a frame: all beams, or only the returns with their horizontal ranges."""
        frame = range(self.recipe.frames)[frame]
        stamp = float(stamps_of(self.recipe)[frame])
        bearings, ranges, times = self._shots(frame)
        if self.beams is not None:
            return Scan(ranges, bearings, times, stamp)
        scan = Scan.from_points(self.laser.points(bearings, ranges), stamp)
        return scan if times is None else replace(scan, times=times[np.isfinite(ranges)])

    def _shots(self, frame: int) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Bearings (radians) and ranges (metres) of all shots (B,), and their times in seconds.

        The times are None if all beams are measured at once.
        """
        rng = self.recipe.generator(worlds.SCAN, frame)
        bearings = self.laser.azimuths(rng) if self.beams is None else self.beams.bearings(frame)
        poses, stamps = poses_of(self.recipe), stamps_of(self.recipe)
        pose, times, further = poses[frame], None, 0.0
        if self.rate_hz is not None:
            times = (
                ring_times(bearings, self.rate_hz)
                if self.beams is None
                else self.beams.times(frame, self.rate_hz)
            )
            pose, further = poses_at(poses, stamps, stamps[frame] + times), ON_WHEELS
        scene = worlds.scene_near(self.recipe, frame // STRETCH, self.laser.max_range + further)
        return bearings, self.laser.shoot(scene, frame, pose, bearings, rng, self.missing), times


def roads_of(drive: Recording) -> Roads:
    """The kind of roads of a drive on streets."""
    assert isinstance(drive.read_scan, ScanReader)
    return worlds.roads_of(drive.read_scan.recipe)
