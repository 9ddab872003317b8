"""How a driver goes along a route: the line of the wheels, the speed on it, and the sway of the car.

The constants and ranges here and in ``line.py``, ``speed.py`` and ``sway.py`` were learnt from the motion of
KITTI's sequences 00 02 03 04 06 08 09, never from 05, 07 or 10;
``python -m rcnn_odom.comparison.motion`` compares the two.
"""

from dataclasses import dataclass, replace

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.street.city import Plan, Roads, Warp, random_route
from rcnn_odom.simulation.street.line import LEAD_IN, PATH_STEP, driven_line, headings
from rcnn_odom.simulation.street.polyline import resample, unit
from rcnn_odom.simulation.street.speed import FRAME_TIME, SPEED_VARIES, travel
from rcnn_odom.simulation.street.sway import sway

LEVER = (0.75, 1.0)
"""Metres of the laser ahead of the rear axle; with the slip of the tyres and the way driven while turning,
its step aside in turns comes to 0.78 to 0.95 metres a radian."""

SLIP = 0.008
"""Radians by which tyres slip outwards for every m/s^2 of lateral acceleration."""

MOUNTING = (-0.002, 0.005)
"""Radians by which a laser looks past the way that its car goes."""

SWAY_HEIGHT = 1.2
"""Metres of the laser above the axis about which a car pitches and rolls: it moves with them."""

PACE = (0.4, 1.6)
PACE_FRAMES = 100
"""By what factor a drive at another pace is slower or faster, and after how many frames that changes."""


@dataclass(frozen=True)
class Drive:
    """N frames of a drive.

    Attributes:
        planar: (N, 3) x and y in metres and heading in radians of the laser in the world.
        tilt: (N, 2) pitch (positive: nose down) and roll (positive: left side up) in radians of the car on
            its springs, relative to the road it stands on.
        path: (M, 2) metres, the line that the middle of the rear axle drives, points `PATH_STEP` apart; it
            begins before the drive and goes on after it.
        along: (N,) metres along the path.
    """

    planar: FloatArray
    tilt: FloatArray
    path: FloatArray
    along: FloatArray


def random_drive(plan: Plan, warp: Warp, frames: int, rng: np.random.Generator) -> Drive:
    """Another drive for every draw from ``rng``; a longer one begins like a shorter one.

    Args:
        plan: the streets, whose kind says how they are driven.
        warp: from the plan to the world.
        frames: number of scans, `FRAME_TIME` apart.
        rng: where all choices come from.
    """
    route_rng, line_rng, speed_rng, body_rng = rng.spawn(4)
    roads = plan.roads
    fastest = roads.speed[1] * (1 + SPEED_VARIES)
    length = 2 * LEAD_IN + FRAME_TIME * (frames + 50) * fastest
    # More than asked for: rounding the corners and averaging shorten it.
    route = random_route(plan, 1.2 * length + 200, route_rng)
    path, crossings = driven_line(route, warp, roads, line_rng)
    heading = headings(path)
    # Two frames more at both ends, where differences of differences are one-sided.
    along = travel(heading, crossings, route.turn, roads, frames + 4, speed_rng)
    planar, tilt = _laser(path, heading, along, roads, body_rng)
    path = path[: int((along[-1] + LEAD_IN) / PATH_STEP) + 1]
    return Drive(planar[2:-2], tilt[2:-2], path, along[2:-2])


def _laser(
    path: FloatArray, heading: FloatArray, along: FloatArray, roads: Roads, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """The laser's x, y and heading (N, 3), and pitch and roll (N, 2), on a car that is ``along`` a path."""
    lever, mounting = rng.uniform(*LEVER), rng.uniform(*MOUNTING)
    at = PATH_STEP * np.arange(len(path), dtype=np.float64)
    axle = resample(path, at, along)
    direction = np.interp(along, at, heading)
    speed = np.gradient(along, FRAME_TIME)
    aside = speed * np.gradient(direction, FRAME_TIME)
    pitch, roll, yaw = sway(speed, aside, rng.uniform(*roads.roughness), rng).T
    faces = direction + SLIP * aside + yaw
    forward = unit(faces)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    laser = axle + (lever + SWAY_HEIGHT * pitch)[:, None] * forward - (SWAY_HEIGHT * roll)[:, None] * left
    planar = np.concatenate([laser, faces[:, None] - mounting], axis=1)
    return planar, np.stack([pitch, roll], axis=1)


def at_other_paces(plan: Plan, warp: Warp, frames: int, rng: np.random.Generator) -> Drive:
    """A drive whose speed says little about its roads: it is half or one and a half times the usual.

    Everything happens as in a drive of `random_drive`, but faster or slower, and the pace changes
    every ten seconds. A network that learns from drives at KITTI's speeds alone guesses the speed
    from what a street looks like, and measures little.
    """
    drive_rng, pace_rng = rng.spawn(2)
    paces = pace_rng.uniform(*PACE, frames // PACE_FRAMES + 2)
    pace = np.interp(np.arange(frames), PACE_FRAMES * np.arange(len(paces)), paces)
    at = np.cumsum(pace)
    usual = random_drive(plan, warp, int(at[-1]) + 2, drive_rng)
    time = np.arange(len(usual.planar), dtype=np.float64)
    planar, tilt = resample(usual.planar, time, at), resample(usual.tilt, time, at)
    return replace(usual, planar=planar, tilt=tilt, along=np.interp(at, time, usual.along))
