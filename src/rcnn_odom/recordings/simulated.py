"""Drives through generated worlds, seen by a 2D laser: no download, and never the same world twice.

``street`` is a car with one ring of an HDL-64 in a city, its motion like KITTI's; ``indoor`` is a robot with
a level scanner in a building. A name stands for a world and a drive of its own, so ``05`` is always the same
drive, but it has nothing in common with KITTI's 05 except its name and, in full scale, its length.
"""

import hashlib
import zlib
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, planar_to_poses
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.simulation.indoor.building import Building, plan_building
from rcnn_odom.simulation.indoor.people import populate
from rcnn_odom.simulation.indoor.robot import random_walk
from rcnn_odom.simulation.laser import Laser, hdl64_ring, scanner
from rcnn_odom.simulation.scene import NO_WALLS, Scene
from rcnn_odom.simulation.street.city import Plan, Roads, Warp, random_plan, random_warp
from rcnn_odom.simulation.street.drive import Drive, at_other_paces, random_drive
from rcnn_odom.simulation.street.speed import FRAME_TIME
from rcnn_odom.simulation.street.street import build_streets
from rcnn_odom.simulation.street.traffic import build_traffic
from rcnn_odom.simulation.terrain import Ground, flat_ground, random_ground, stand

VERSION = 4
"""Counts changes of the generator: part of every fingerprint."""

LIBRARIES = [(name, version(name)) for name in ("numpy", "scipy", "numba")]
"""Another version of these may draw other numbers from the same seed."""

World = Literal["street", "indoor"]
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

SENSORS: dict[str, dict[str, Any]] = {
    "street": {},
    "indoor": {"resolution_deg": 1.0, "field_of_view_deg": 180.0, "max_range": 40.0},
}
"""What the lasers of the worlds are like unless the caller says otherwise: KITTI's, and a SICK's."""

STRETCH = 20
"""Frames for which what is in range is picked out together."""

LONGEST_RANGE = 80.0
LASER_HEIGHT = 1.73
MOUNTING_DEG, MOUNTING_HEIGHT = 0.2, 0.03
"""Standard deviation of how the laser sits on this drive's car: pitch and roll, and metres."""


@dataclass(kw_only=True)
class RealismOptions:
    """``data.realism``."""

    tilt: bool
    movers: bool
    missing: bool


@dataclass(kw_only=True)
class Options:
    """What ``conf/data/simulated.yaml`` and ``indoor.yaml`` set beside what all recordings have."""

    realism: RealismOptions
    fresh_worlds: bool
    keep_worlds: bool
    vary_pace: bool
    world: str = option(choices=("street", "indoor"))
    scale: str = option(choices=("small", "full"))
    frames: int | None = option(above=0)
    world_seed: int = option(least=0, below=2**32, wanted="a whole number, not negative")


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
    vary_pace: bool = True,
) -> Recording:
    """A simulated drive: another world for every name and seed.

    Args:
        name: any name; the same name and seed always give the same drive. ``NAME~1``, ``NAME~2`` ... are
            other drives in other worlds, each as long as ``NAME``.
        sensor: ``resolution_deg``, ``field_of_view_deg`` and ``max_range`` in metres; the others are
            KITTI's, or indoors a SICK's.
        world: ``street`` or ``indoor``.
        scale: by which ``FRAMES`` says how long the drive of a name is.
        frames: its length whatever its name; None: by scale and name.
        seed: chooses the set of worlds, 0 or more.
        movers: other cars and people move.
        missing: some beams do not come back although there is something within range.
        tilt: the car leans on its springs and the ground has slopes; a level laser still sways sideways.
        vary_pace: a car drives the drives ``NAME~1`` ... faster and slower than KITTI's; ``NAME`` never.

    Returns:
        The drive. Its scans are computed when they are read.

    Raises:
        InputError: fewer than two frames, a negative seed, an unknown world or scale, or too long a range.
    """
    _check(name, world, scale, frames, seed)
    length = frames or FRAMES[scale].get(name.split("~")[0], DEFAULT_FRAMES)
    other_paces = vary_pace and world == "street" and "~" in name
    recipe = _Recipe(name, seed, world, length, movers, tilt, other_paces)
    reader = ScanReader(recipe, _laser(name, world, sensor or {}), missing)
    return Recording(
        name=name,
        poses=_poses(recipe).copy(),
        stamps=_stamps(recipe).copy(),
        read_scan=reader,
        fingerprint=hashlib.sha256(f"simulated {VERSION} {LIBRARIES} {asdict(reader)}".encode()).hexdigest(),
    )


def _check(name: str, world: str, scale: str, frames: int | None, seed: int) -> None:
    for fits, advice in (
        (frames is None or frames >= 2, f"a drive has at least 2 frames, not {frames}; change data.frames"),
        (seed >= 0, f"a seed is 0 or more, not {seed}; change data.world_seed"),
        (world in ("street", "indoor"), f"no world {world!r}; data.world is street or indoor"),
        (scale in FRAMES, f"no scale {scale!r}; data.scale is small or full"),
    ):
        if not fits:
            raise InputError(f"simulated sequence {name}: {advice}")


def _laser(name: str, world: str, given: dict[str, Any]) -> Laser:
    if given.get("facing_deg") and given.get("field_of_view_deg") != 360:
        raise InputError(
            f"simulated sequence {name}: its laser looks ahead; leave out data.sensor.facing_deg"
        )
    if world == "indoor":
        return scanner(
            **{key: value for key, value in (SENSORS[world] | given).items() if key in SENSORS[world]}
        )
    max_range = given.get("max_range", LONGEST_RANGE)
    if max_range > LONGEST_RANGE:
        raise InputError(
            f"simulated sequence {name}: the streets are drawn for lasers that see {LONGEST_RANGE:g} m; "
            f"lower data.sensor.max_range, {max_range:g}"
        )
    return hdl64_ring(max_range)


@dataclass(frozen=True)
class _Recipe:
    """Everything that a world and the drive through it follow from."""

    name: str
    seed: int
    world: str
    frames: int
    movers: bool
    tilt: bool
    other_paces: bool

    def generator(self, *purpose: int) -> np.random.Generator:
        """Independent random numbers for every seed, name and purpose."""
        return np.random.default_rng([self.seed, zlib.crc32(self.name.encode()), *purpose])


_PLAN, _DRIVE, _GROUND, _STANDING, _MOVING, _SCAN = range(6)


@dataclass(frozen=True)
class ScanReader:
    """Looks at a world from the poses of a drive: the ``read_scan`` of a simulated sequence.

    It holds the recipe only. The world is built by whichever process reads the first scan, and kept.
    """

    recipe: _Recipe
    laser: Laser
    missing: bool

    def points(self, frame: int) -> npt.NDArray[np.float32]:
        """(P, 4) x, y, z in metres in the laser's frame and reflectance 0: a KITTI file."""
        frame = range(self.recipe.frames)[frame]
        rng = self.recipe.generator(_SCAN, frame)
        scene = _stretch(self.recipe, frame // STRETCH, self.laser.max_range)
        return self.laser.look(scene, frame, _poses(self.recipe)[frame], rng, self.missing)

    def __call__(self, frame: int) -> Scan:
        """The beams that came back, their ranges horizontal."""
        return Scan.from_points(self.points(frame), float(_stamps(self.recipe)[frame]))


def roads_of(drive: Recording) -> Roads:
    """What kind of roads a street drive goes along."""
    assert isinstance(drive.read_scan, ScanReader)
    return _street(drive.read_scan.recipe).plan.roads


class _Street(NamedTuple):
    plan: Plan
    warp: Warp
    ground: Ground
    drive: Drive
    poses: FloatArray


@lru_cache(maxsize=4)
def _street(recipe: _Recipe) -> _Street:
    rng = recipe.generator(_PLAN)
    plan = random_plan(rng)
    warp = random_warp(plan, rng)
    drive_through = at_other_paces if recipe.other_paces else random_drive
    drive = drive_through(plan, warp, recipe.frames, recipe.generator(_DRIVE))
    rng = recipe.generator(_GROUND)
    margin = 100.0
    low, high = drive.path.min(0) - margin, drive.path.max(0) + margin
    mounting = rng.normal(0, np.deg2rad(MOUNTING_DEG), 2)
    height = LASER_HEIGHT + rng.normal(0, MOUNTING_HEIGHT)
    if recipe.tilt:
        ground = random_ground(low, high, rng)
        poses = stand(drive.planar, drive.tilt + mounting, height, ground)
    else:
        ground = flat_ground(low, high)
        poses = stand(drive.planar, np.zeros_like(drive.tilt), height, ground)
    return _Street(plan, warp, ground, drive, poses)


@lru_cache(maxsize=4)
def _indoor(recipe: _Recipe) -> tuple[Building, FloatArray, FloatArray]:
    """A building, where in it the laser goes, (N, 3), and when, (N,)."""
    building = plan_building(recipe.generator(_PLAN))
    return building, *random_walk(building, recipe.frames, recipe.generator(_DRIVE))


@lru_cache(maxsize=4)
def _poses(recipe: _Recipe) -> FloatArray:
    """Laser to world, (N, 4, 4)."""
    if recipe.world == "street":
        return _street(recipe).poses
    return planar_to_poses(_indoor(recipe)[1])


def _stamps(recipe: _Recipe) -> FloatArray:
    """Seconds, (N,): those of KITTI's laser, or of the robot's own."""
    if recipe.world == "indoor":
        return _indoor(recipe)[2]
    return FRAME_TIME * np.arange(recipe.frames, dtype=np.float64)


@lru_cache(maxsize=2)
def _stretch(recipe: _Recipe, number: int, max_range: float) -> Scene:
    """The scene without what is out of range on a stretch of the drive: most of a city always is."""
    scene, (middles, longest) = _scene(recipe), _places(recipe)
    driven = _poses(recipe)[number * STRETCH : (number + 1) * STRETCH, :2, 3]
    centre = driven.mean(0)
    reach = max_range + np.hypot(*(driven - centre).T).max() + longest / 2
    near = middles.query_ball_point(centre, reach, return_sorted=True)
    return replace(scene, standing=scene.standing[np.array(near, dtype=np.int64)])


@lru_cache(maxsize=2)
def _places(recipe: _Recipe) -> tuple[cKDTree, float]:
    """The middles of the standing walls, to be looked up by place, and the longest one's metres."""
    ends = _scene(recipe).standing.ends
    return cKDTree((ends[:, :2] + ends[:, 2:]) / 2), float(np.hypot(*(ends[:, 2:] - ends[:, :2]).T).max())


@lru_cache(maxsize=2)
def _scene(recipe: _Recipe) -> Scene:
    standing, moving = recipe.generator(_STANDING), recipe.generator(_MOVING)
    if recipe.world == "indoor":
        building, planar, _ = _indoor(recipe)
        return populate(building, planar, standing, recipe.movers)
    plan, warp, ground, drive, _ = _street(recipe)
    walls = build_streets(plan, warp, ground, drive.path, standing)
    if not recipe.movers:
        return Scene(walls, NO_WALLS, np.zeros(recipe.frames + 1, dtype=np.int64), ground)
    return Scene(walls, *build_traffic(plan, warp, ground, drive, moving), ground)
