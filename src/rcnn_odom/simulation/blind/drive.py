"""Drives through a tunnel, along a bare corridor or over open ground: walls and poses."""

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
from rcnn_odom.simulation.terrain import Ground, flat_ground, place_on_ground

BEYOND = 100.0
"""Metres by which a place continues before and after the drive, farther than the range of the laser."""
CAR_LASER = (0.75, 1.0)
ROBOT_LASER = (0.0, 0.25)
"""Metres from the axle forward to the laser."""
ROAD_ROUGHNESS = (0.5, 1.0)
"""Roughness of the road, 1 is usual in a town."""
CAR_HEIGHT = 1.73
"""Metres, height of a car's laser above the road."""


@dataclass(frozen=True)
class Kind:
    """A kind of place, and the vehicle that drives there. Pairs of numbers are ranges of uniform draws.

    Attributes:
        lay_out: makes the way from its length and a random generator.
        build: makes the walls from the way, its length and a random generator.
        pace: speeds of the vehicle.
        aside: metres, mean offset of a drive to the left of the way.
        straying: metres, amplitude of a drive's deviation from that offset.
        waves: metres, wavelengths of this deviation.
        is_car: True: a car on springs, on the ground, with a high laser. False: a robot with a level laser.
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
"""Kinds of places by the beginning of a drive's name."""


@dataclass(frozen=True)
class BlindDrive:
    """A drive of N frames.

    Attributes:
        poses: (N, 4, 4) laser to world.
        walls: walls of the place.
        ground: ground under a car; None for a robot.
    """

    poses: FloatArray
    walls: Walls
    ground: Ground | None


def kind_of(name: str) -> Kind:
    """The kind of place that the name of a drive begins with, before the first ``-``.

    Raises:
        InputError: there is no such kind.

    >>> kind_of("tunnel-1").is_car
    True
    """
    kind = KINDS.get(name.split("-")[0])
    if kind is None:
        begins = ", ".join(f"{each}-1" for each in KINDS)
        raise InputError(f"simulated sequence {name}: not a name in data.world=blind; name it like {begins}")
    return kind


def blind_drive(kind: Kind, stamps: FloatArray, tilts: bool, rng: np.random.Generator) -> BlindDrive:
    """Make a random place and a drive through it.

    Args:
        kind: kind of the place.
        stamps: (N,) seconds of the frames, evenly spaced.
        tilts: whether a car pitches and rolls on its springs.
        rng: source of all random choices.
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
    return BlindDrive(place_on_ground(planar, tilt if tilts else 0 * tilt, CAR_HEIGHT, ground), walls, ground)


def _drive_along(
    way: Way, along: FloatArray, stamps: FloatArray, kind: Kind, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Drive along a way.

    Args:
        way: the way.
        along: (N,) metres along the way.
        stamps: (N,) seconds.
        kind: kind of the place.
        rng: source of all random choices.

    Returns:
        x, y and heading of the laser (N, 3) in metres and radians, and speed (N,) in metres per second.
    """
    offset, straying, waves = (
        rng.uniform(*kind.aside),
        rng.uniform(*kind.straying),
        random_waves(kind.waves, rng),
    )

    def line(at: FloatArray) -> FloatArray:
        return way.place(at, offset + straying * meander(at, waves))

    # The heading is the direction of the line, which is also defined while the vehicle stands.
    ahead = line(along + 0.05) - line(along - 0.05)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    lever = rng.uniform(*(CAR_LASER if kind.is_car else ROBOT_LASER))
    laser = line(along) + lever * unit(heading)
    return np.column_stack([laser, heading]), np.gradient(along, stamps)
