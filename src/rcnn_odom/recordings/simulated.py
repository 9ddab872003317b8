"""Drives through generated worlds, seen by a 2D laser: no download, and never the same world twice.

``street`` is a car with one ring of an HDL-64 in a city, its motion like KITTI's; ``indoor`` is a robot with
a level scanner in a building; ``blind`` are places where the walls tell little of the way. A name stands for
a world and a drive of its own, so ``05`` is always the same drive, but it has nothing in common with KITTI's
05 except its name and, in full scale, its length.
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
"""Counts changes of the generator: part of every fingerprint."""

LIBRARIES = [(name, version(name)) for name in ("numpy", "scipy", "numba")]
"""Another version of these may draw other numbers from the same seed."""

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
"""Of a small drive that validates or tests: well over 400 m, so that drift has segments of 100 to 400 m."""
FRAMES: dict[str, dict[str, int]] = {
    "full": KITTI_FRAMES,
    "small": {name: frames // 10 for name, frames in KITTI_FRAMES.items()}
    | dict.fromkeys(("05", "07", "10"), SCORED_FRAMES),
}
DEFAULT_FRAMES = 600
"""Of a drive with another name."""
BLIND_FRAMES = 1800
"""Of a drive of ``blind`` in either scale: three minutes, in which also a robot comes 100 m far."""

SENSORS: dict[str, dict[str, Any]] = {
    "street": {},
    "indoor": {"resolution_deg": 1.0, "field_of_view_deg": 180.0, "max_range": 40.0},
}
"""What the lasers of the worlds are like unless the caller says otherwise: KITTI's, and a SICK's."""

LONGEST_RANGE = 80.0
MIRROR_RATE_HZ = 75.0
"""Turns a second of a laser that sees half the circle or less, of no other kind: a SICK's."""
ON_WHEELS = 3.0
"""Metres that a laser moves in one of its turns at most."""

MINUTE = 60.0
"""Seconds of the drives that are special cases, whatever their names."""

STREETS = ("street", "standstill_street")


@dataclass(kw_only=True)
class RealismOptions:
    """``data.realism``."""

    tilt: bool
    movers: bool
    missing: bool
    skew: bool = option(default=False)


@dataclass(kw_only=True)
class Options:
    """What ``conf/data/simulated.yaml``, ``indoor.yaml`` and ``blind.yaml`` set beside what all data have."""

    realism: RealismOptions
    fresh_worlds: bool
    keep_worlds: bool
    vary_pace: bool
    world: str = option(choices=WORLDS)
    scale: str = option(choices=("small", "full"))
    frames: int | None = option(above=0)
    world_seed: int = option(least=0, below=2**32, wanted="a whole number, not negative")
    laser: LaserOptions = option(default=None)  # noqa: RUF009 - None stands for a run of before
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
    """A simulated drive: another world for every name and seed.

    Args:
        name: any name; the same name and seed always give the same drive. ``NAME~1``, ``NAME~2`` ... are
            other drives in other worlds, each as long as ``NAME``.
        sensor: ``resolution_deg``, ``field_of_view_deg`` and ``max_range`` in metres; the others are
            KITTI's, or indoors a SICK's. With a ``laser`` it says nothing of that.
        world: ``street`` or ``indoor``; ``blind``, whose names begin with the kind of place: ``tunnel-``,
            ``corridor-`` or ``posts-`` (see :mod:`rcnn_odom.simulation.blind.drive`); or a special case that
            lasts a minute: ``corridor`` (two bare walls without an end), ``few_returns`` (a plain with some
            posts), ``standstill`` (a robot at rest in a building) and ``standstill_street`` (a parked car,
            without traffic).
        scale: by which ``FRAMES`` says how long the drive of a name is.
        frames: its length whatever its name; None: by scale and name.
        seed: chooses the set of worlds, 0 or more.
        movers: other cars and people move.
        missing: some beams do not come back although there is something within range.
        tilt: the car leans on its springs and the ground has slopes; a level laser still sways sideways.
        skew: the laser moves while it turns, so that every beam starts from where it is then, and scans have
            times. The pose is that of the stamp: of the first beam, or of an HDL-64's look straight ahead.
            What moves besides stands still during a turn.
        vary_pace: a car drives the drives ``NAME~1`` ... faster and slower than KITTI's; ``NAME`` never.
        laser: another laser: see :class:`rcnn_odom.simulation.kinds.LaserOptions`, for instance
            ``{"kind": "sick", "spacing_deg": 0.5}``. All but an HDL-64 give all beams, inf for no return.
        turn_rate_deg_s: of the robot indoors when it turns on the spot; None: its own.
        scan_rate_hz: scans a second, but not in streets; None: the robot's own, in special cases 10.

    Returns:
        The drive. Its scans are computed when they are read.

    Raises:
        InputError: fewer than two frames, a negative seed, an unknown world or scale, too long a range, an
            option of the laser that does not fit, or a rate that the world does not have.
    """
    _check(name, world, scale, frames, seed)
    _check_rates(name, world, turn_rate_deg_s, scan_rate_hz)
    if world == "blind":
        kind_of(name)
    length = frames or _length(name, world, scale, scan_rate_hz)
    other_paces = vary_pace and world == "street" and "~" in name
    recipe = Recipe(name, seed, world, length, movers, tilt, other_paces, turn_rate_deg_s, scan_rate_hz)
    reader = _reader(recipe, sensor or {}, laser or {}, missing, skew)
    # Without what is None, options that came later, so that drives without them are still known by their key.
    recipe_and_laser = asdict(reader, dict_factory=_without_none)
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


def _without_none(items: list[tuple[str, Any]]) -> dict[str, Any]:
    return {key: value for key, value in items if value is not None}


def _length(name: str, world: str, scale: str, scan_rate_hz: float | None) -> int:
    """Frames of a drive."""
    if world == "blind":
        return BLIND_FRAMES
    if world in ("street", "indoor"):
        return FRAMES[scale].get(name.split("~")[0], DEFAULT_FRAMES)
    return round(MINUTE * (scan_rate_hz or MINUTE_RATE)) + 1


def _check(name: str, world: str, scale: str, frames: int | None, seed: int) -> None:
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
            f"simulated sequence {name}: data.turn_rate_deg_s is of the robot of data.world=indoor; "
            "leave it out"
        )
    if scan_rate_hz is not None and world in STREETS:
        raise InputError(
            f"simulated sequence {name}: the laser of a car scans {1 / FRAME_TIME:g} times a second; "
            "leave out data.scan_rate_hz"
        )
    for option_name, rate in (("turn_rate_deg_s", turn_rate_deg_s), ("scan_rate_hz", scan_rate_hz)):
        if rate is not None and not 0 < rate < np.inf:
            raise InputError(f"simulated sequence {name}: data.{option_name}={rate:g}: must be above 0")


def _reader(
    recipe: Recipe, sensor: dict[str, Any], given: dict[str, Any], missing: bool, skew: bool
) -> "ScanReader":
    """What looks at the world: with the laser that is asked for, or with the one that the world has."""
    chosen = choose_laser(given)
    if chosen is None:
        chosen = _own_laser(recipe.name, recipe.world, sensor, skew)
    laser, beams, rate = chosen
    if recipe.world in STREETS and laser.max_range > LONGEST_RANGE:
        group = "laser" if given.get("kind") else "sensor"
        raise InputError(
            f"simulated sequence {recipe.name}: the streets are drawn for lasers that see {LONGEST_RANGE:g} "
            f"m; lower data.{group}.max_range, {laser.max_range:g}"
        )
    if not skew:
        return ScanReader(recipe, laser, missing, beams)
    frame_time = float(np.median(np.diff(stamps_of(recipe))))
    return ScanReader(recipe, laser, missing, beams, rate or 1 / frame_time)


def _own_laser(
    name: str, world: str, given: dict[str, Any], skew: bool
) -> tuple[Laser, EvenBeams | None, float | None]:
    """The laser that a world has unless told otherwise, in the form of ``choose_laser``."""
    if given.get("facing_deg") and given.get("field_of_view_deg") != 360:
        raise InputError(
            f"simulated sequence {name}: its laser looks ahead; leave out data.sensor.facing_deg"
        )
    if world in STREETS:
        return hdl64_ring(given.get("max_range", LONGEST_RANGE)), None, None
    default = SENSORS["indoor"]
    level = default | {key: value for key, value in given.items() if key in default}
    if not skew:
        return scanner(**level), None, None
    # Which beam comes when is plain only where all of them are given.
    beams = EvenBeams(level["resolution_deg"], level["field_of_view_deg"])
    return scanner(**level), beams, MIRROR_RATE_HZ if beams.field_of_view_deg <= 180 else None


@dataclass(frozen=True)
class ScanReader:
    """Looks at a world from the poses of a drive: the ``read_scan`` of a simulated sequence.

    It holds the recipe only. The world is built by whichever process reads the first scan, and kept.
    """

    recipe: Recipe
    laser: Laser
    missing: bool
    beams: EvenBeams | None = None
    """Those of a laser that gives all of them; None: returns alone."""
    rate_hz: float | None = None
    """Turns a second of a laser that moves meanwhile; None: it looks everywhere at once."""

    def points(self, frame: int) -> npt.NDArray[np.float32]:
        """(P, 4) x, y, z in metres in the laser's frame and reflectance 0: a KITTI file."""
        bearings, ranges, _ = self._shots(range(self.recipe.frames)[frame])
        return self.laser.points(bearings, ranges)

    def __call__(self, frame: int) -> Scan:
        """All beams, or those that came back with their ranges horizontal."""
        frame = range(self.recipe.frames)[frame]
        stamp = float(stamps_of(self.recipe)[frame])
        bearings, ranges, times = self._shots(frame)
        if self.beams is not None:
            return Scan(ranges, bearings, times, stamp)
        scan = Scan.from_points(self.laser.points(bearings, ranges), stamp)
        return scan if times is None else replace(scan, times=times[np.isfinite(ranges)])

    def _shots(self, frame: int) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Bearings, ranges and, of a laser that moves while it turns, times of all shots (B,)."""
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
    """What kind of roads a street drive goes along."""
    assert isinstance(drive.read_scan, ScanReader)
    return worlds.roads_of(drive.read_scan.recipe)
