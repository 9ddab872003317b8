"""Builds worlds and drives from a name, a seed and some options, when they are first used."""

import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from rcnn_odom.geometry import FloatArray, planar_to_poses
from rcnn_odom.simulation.blind.drive import BlindDrive, blind_drive, kind_of
from rcnn_odom.simulation.indoor.building import Building, plan_building
from rcnn_odom.simulation.indoor.people import populate
from rcnn_odom.simulation.indoor.robot import random_walk
from rcnn_odom.simulation.scene import NO_WALLS, Scene
from rcnn_odom.simulation.sparse_places import bare_corridor, drive_straight, few_posts
from rcnn_odom.simulation.street.city import Plan, Roads, Warp, random_plan, random_warp
from rcnn_odom.simulation.street.drive import Drive, at_other_paces, random_drive
from rcnn_odom.simulation.street.speed import FRAME_TIME
from rcnn_odom.simulation.street.street import build_streets
from rcnn_odom.simulation.street.traffic import build_traffic
from rcnn_odom.simulation.terrain import Ground, flat_ground, place_on_ground, random_ground

WORLDS = ("street", "indoor", "corridor", "few_returns", "standstill", "standstill_street", "blind")
MINUTE_RATE = 10.0
"""Default number of scans per second, except for ``street`` and ``indoor``."""

STRETCH = 20
"""Number of frames that share one selection of the walls in range."""

LASER_HEIGHT = 1.73
"""Metres, mean height of a car's laser above the ground."""
MOUNTING_DEG, MOUNTING_HEIGHT = 0.2, 0.03
"""Standard deviations of the laser's mounting on a car: pitch and roll in degrees, and height in metres."""


@dataclass(frozen=True)
class Recipe:
    """All options from which a world and the drive through it are built.

    Attributes:
        name, seed: choose the world.
        world: one of ``WORLDS``.
        frames: number of scans of the drive.
        movers: whether other cars and people move.
        tilt: whether the car pitches and rolls on its springs and the ground has slopes.
        other_paces: whether a car drives faster and slower than KITTI's.
        turn_rate_deg_s: degrees per second at which the robot indoors turns on the spot; None: a random rate.
        scan_rate_hz: scans per second, not for streets; None: a random rate for ``indoor``, otherwise
            ``MINUTE_RATE``.
    """

    name: str
    seed: int
    world: str
    frames: int
    movers: bool
    tilt: bool
    other_paces: bool
    turn_rate_deg_s: float | None = None
    scan_rate_hz: float | None = None

    def generator(self, *purpose: int) -> np.random.Generator:
        """A random generator that is independent for every seed, name and purpose."""
        return np.random.default_rng([self.seed, zlib.crc32(self.name.encode()), *purpose])


_PLAN, _DRIVE, _GROUND, _STANDING, _MOVING, SCAN = range(6)


class _Street(NamedTuple):
    """A city and a drive through it."""

    plan: Plan
    warp: Warp
    ground: Ground
    drive: Drive
    poses: FloatArray


@lru_cache(maxsize=4)
def _street(recipe: Recipe) -> _Street:
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
        poses = place_on_ground(drive.planar, drive.tilt + mounting, height, ground)
    else:
        ground = flat_ground(low, high)
        poses = place_on_ground(drive.planar, np.zeros_like(drive.tilt), height, ground)
    return _Street(plan, warp, ground, drive, poses)


@lru_cache(maxsize=4)
def _indoor(recipe: Recipe) -> tuple[Building, FloatArray, FloatArray]:
    """A building, the laser's x, y and heading (N, 3) in it, and the stamps (N,) in seconds."""
    building, rng = plan_building(recipe.generator(_PLAN)), recipe.generator(_DRIVE)
    if recipe.world == "standstill":
        place, _ = random_walk(building, 1, rng)
        return building, place.repeat(recipe.frames, axis=0), _even_stamps(recipe)
    pace = recipe.turn_rate_deg_s, recipe.scan_rate_hz
    return building, *random_walk(building, recipe.frames, rng, *pace)


@lru_cache(maxsize=4)
def _blind(recipe: Recipe) -> BlindDrive:
    return blind_drive(kind_of(recipe.name), _even_stamps(recipe), recipe.tilt, recipe.generator(_PLAN))


def _parked(recipe: Recipe) -> _Street:
    """The street where a parked car stands: a drive of two frames, whose first pose is used."""
    return _street(replace(recipe, world="street", frames=2))


@lru_cache(maxsize=4)
def poses_of(recipe: Recipe) -> FloatArray:
    """Poses (N, 4, 4) of the laser in the world."""
    if recipe.world == "street":
        return _street(recipe).poses
    if recipe.world == "standstill_street":
        return _parked(recipe).poses[:1].repeat(recipe.frames, axis=0)
    if recipe.world in ("indoor", "standstill"):
        return planar_to_poses(_indoor(recipe)[1])
    if recipe.world == "blind":
        return _blind(recipe).poses
    return planar_to_poses(drive_straight(_even_stamps(recipe)))


def stamps_of(recipe: Recipe) -> FloatArray:
    """Stamps (N,) of the scans in seconds."""
    if recipe.world in ("indoor", "standstill"):
        return _indoor(recipe)[2]
    if recipe.world == "street":
        return FRAME_TIME * np.arange(recipe.frames, dtype=np.float64)
    return _even_stamps(recipe)


def _even_stamps(recipe: Recipe) -> FloatArray:
    return np.arange(recipe.frames, dtype=np.float64) / (recipe.scan_rate_hz or MINUTE_RATE)


def roads_of(recipe: Recipe) -> Roads:
    """The kind of roads of a drive on streets."""
    return _street(recipe).plan.roads


@lru_cache(maxsize=2)
def scene_near(recipe: Recipe, number: int, max_range: float) -> Scene:
    """The scene with only the standing walls that are in range on a stretch of the drive.

    Args:
        recipe: the world and drive.
        number: number of the stretch, of ``STRETCH`` frames.
        max_range: metres.
    """
    scene, (middles, longest) = _scene(recipe), _index_walls(recipe)
    driven = poses_of(recipe)[number * STRETCH : (number + 1) * STRETCH, :2, 3]
    centre = driven.mean(0)
    reach = max_range + np.hypot(*(driven - centre).T).max() + longest / 2
    near = middles.query_ball_point(centre, reach, return_sorted=True)
    return replace(scene, standing=scene.standing[np.array(near, dtype=np.int64)])


@lru_cache(maxsize=2)
def _index_walls(recipe: Recipe) -> tuple[cKDTree, float]:
    """A search tree of the middles of the standing walls, and the length of the longest wall in metres."""
    ends = _scene(recipe).standing.ends
    return cKDTree((ends[:, :2] + ends[:, 2:]) / 2), float(np.hypot(*(ends[:, 2:] - ends[:, :2]).T).max())


@lru_cache(maxsize=2)
def _scene(recipe: Recipe) -> Scene:
    standing, moving = recipe.generator(_STANDING), recipe.generator(_MOVING)
    no_movers = np.zeros(recipe.frames + 1, dtype=np.int64)
    if recipe.world in ("corridor", "few_returns"):
        build = bare_corridor if recipe.world == "corridor" else few_posts
        return Scene(build(float(drive_straight(stamps_of(recipe))[-1, 0]), standing), NO_WALLS, no_movers)
    if recipe.world == "blind":
        return Scene(_blind(recipe).walls, NO_WALLS, no_movers, _blind(recipe).ground)
    if recipe.world in ("indoor", "standstill"):
        building, planar, _ = _indoor(recipe)
        return populate(building, planar, standing, recipe.movers, recipe.scan_rate_hz)
    street = _parked(recipe) if recipe.world == "standstill_street" else _street(recipe)
    plan, warp, ground, drive, _ = street
    walls = build_streets(plan, warp, ground, drive.path, standing)
    if not recipe.movers or recipe.world == "standstill_street":
        return Scene(walls, NO_WALLS, no_movers, ground)
    return Scene(walls, *build_traffic(plan, warp, ground, drive, moving), ground)
