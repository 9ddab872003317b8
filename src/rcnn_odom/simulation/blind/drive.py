"""A drive through a tunnel, along a bare corridor or over open ground: walls and poses."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, planar_to_poses
from rcnn_odom.simulation.blind import places
from rcnn_odom.simulation.blind.pace import CAR, CAR_ON_A_TRACK, ROBOT, Pace, travel
from rcnn_odom.simulation.blind.way import Way, bending_way, straight_way
from rcnn_odom.simulation.scene import Walls
from rcnn_odom.simulation.street.polyline import unit
from rcnn_odom.simulation.street.smooth import meander, random_waves
from rcnn_odom.simulation.street.sway import sway
from rcnn_odom.simulation.terrain import Ground, flat_ground, stand

BEYOND = 100.0
"""Metres of the place before the drive and after it: more than the laser sees."""
CAR_LASER = (0.75, 1.0)
ROBOT_LASER = (0.0, 0.25)
"""Metres of the laser ahead of the axle."""
ROAD_ROUGHNESS = (0.5, 1.0)
CAR_HEIGHT = 1.73
"""Metres of a car's laser above the road."""


@dataclass(frozen=True)
class Kind:
    """A kind of place and who drives there.

    Attributes:
        lay_out: the way from its length and random numbers.
        build: what stands along it, from the way, its length and random numbers.
        pace: how fast it is driven.
        aside: metres to the left of the way that a drive keeps on average, drawn evenly.
        straying: metres by which it strays from there, drawn evenly ...
        waves: ... in waves of so many metres.
        is_car: on springs, over ground, with a high laser; otherwise a robot whose laser looks level.
    """

    lay_out: Callable[[float, np.random.Generator], Way]
    build: Callable[[Way, float, np.random.Generator], Walls]
    pace: Pace
    aside: tuple[float, float]
    straying: tuple[float, float]
    waves: tuple[float, float]
    is_car: bool


def _lay_out_tunnel(length: float, rng: np.random.Generator) -> Way:
    return bending_way(length, radii=(180.0, 800.0), sections=(80.0, 300.0), straight=0.4, rng=rng)


def _lay_out_corridor(length: float, rng: np.random.Generator) -> Way:
    return straight_way(length)


def _lay_out_track(length: float, rng: np.random.Generator) -> Way:
    return bending_way(length, radii=(40.0, 300.0), sections=(20.0, 100.0), straight=0.3, rng=rng)


KINDS = {
    "tunnel": Kind(_lay_out_tunnel, places.tunnel, CAR, (-2.0, -1.5), (0.1, 0.3), (40.0, 150.0), True),
    "corridor": Kind(_lay_out_corridor, places.corridor, ROBOT, (-0.2, 0.2), (0.1, 0.3), (8.0, 30.0), False),
    "posts": Kind(
        _lay_out_track, places.open_ground, CAR_ON_A_TRACK, (-0.3, 0.3), (0.1, 0.4), (20.0, 80.0), True
    ),
}
"""By what the name of a drive begins with."""


@dataclass(frozen=True)
class BlindDrive:
    """A drive of N frames.

    Attributes:
        poses: (N, 4, 4) laser to world.
        walls: what stands there.
        ground: under a car.
    """

    poses: FloatArray
    walls: Walls
    ground: Ground | None


def kind_of(name: str) -> Kind:
    """The kind of place that the name of a drive stands for: what comes before its first ``-``.

    Raises:
        InputError: it is none.
    """
    kind = KINDS.get(name.split("-")[0])
    if kind is None:
        begins = ", ".join(f"{each}-1" for each in KINDS)
        raise InputError(f"simulated sequence {name}: no drive of data.world=blind; name it like {begins}")
    return kind


def blind_drive(kind: Kind, stamps: FloatArray, tilts: bool, rng: np.random.Generator) -> BlindDrive:
    """Another drive and another place for every draw from ``rng``.

    Args:
        kind: of the place.
        stamps: (N,) seconds of the frames, evenly spaced.
        tilts: a car leans on its springs.
        rng: where all chance comes from.
    """
    way_rng, place_rng, pace_rng, body_rng = rng.spawn(4)
    driven = travel(kind.pace, stamps, pace_rng)
    length = float(driven[-1]) + 2 * BEYOND
    way = kind.lay_out(length, way_rng)
    walls = kind.build(way, length, place_rng)
    planar, speed = _drive_along(way, BEYOND + driven, stamps, kind, body_rng)
    if not kind.is_car:
        return BlindDrive(planar_to_poses(planar), walls, None)
    aside = speed * np.gradient(planar[:, 2], stamps)
    tilt = sway(speed, aside, body_rng.uniform(*ROAD_ROUGHNESS), body_rng)[:, :2]
    ground = flat_ground(way.points.min(0) - BEYOND, way.points.max(0) + BEYOND)
    return BlindDrive(stand(planar, tilt if tilts else 0 * tilt, CAR_HEIGHT, ground), walls, ground)


def _drive_along(
    way: Way, along: FloatArray, stamps: FloatArray, kind: Kind, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Laser's x, y and heading (N, 3) in metres and radians, and the speed (N,) in metres a second."""
    keeps, straying, waves = (
        rng.uniform(*kind.aside),
        rng.uniform(*kind.straying),
        random_waves(kind.waves, rng),
    )

    def line(at: FloatArray) -> FloatArray:
        return way.place(at, keeps + straying * meander(at, waves))

    # Where the wheels roll is where they go to, also at rest.
    ahead = line(along + 0.05) - line(along - 0.05)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    lever = rng.uniform(*(CAR_LASER if kind.is_car else ROBOT_LASER))
    laser = line(along) + lever * unit(heading)
    return np.column_stack([laser, heading]), np.gradient(along, stamps)
